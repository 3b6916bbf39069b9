import dataclasses
import math
from dataclasses import replace

import pytest
import torch

from experiments.made_up.bodies import Proportions
from experiments.made_up.toys import excavator, random_toy
from experiments.made_up.walks import walking_animal, walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import ScanSequence, jointed_toy
from torchreg.datasets.solids import RoundBox, RoundCone, mesh_of, union_distance
from torchreg.datasets.toys import Hinge, robot
from torchreg.errors import InputError
from torchreg.geometry.mesh import interpolate
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.metrics import adjusted_rand

CLEAN = DepthScanner(noise=0.0, num_holes=0, num_points=2500)


@pytest.fixture(scope="module")
def walk():
    return walking_figure(190, dtype=torch.float64)


@pytest.fixture(scope="module")
def toy():
    return jointed_toy(8, missing=True, dtype=torch.float64, scanner=CLEAN)


def test_the_walk_has_the_pairs_and_the_motion_it_promises(walk):
    assert len(walk) == 190
    turns = walk.transforms[..., :3, :3]
    local = turns[:, list(walk.figure.parents[1:])].mT @ turns[:, 1:]
    change = local[:-1].mT @ local[1:]
    cosine = (change.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    fastest = torch.acos(cosine.clamp(-1, 1)).amax(1).rad2deg()
    assert 25 < float(fastest.max()) < 40
    assert float(fastest.median()) > 12


def test_a_pair_holds_what_fits_together(walk):
    pair = walk.pair(20, 21)
    count = len(pair.source)
    assert 2000 < count < 6000
    assert pair.truth.shape == (count, 3)
    assert pair.labels.shape == pair.visible.shape == pair.missing.shape == (count,)
    assert pair.target_labels.shape == (len(pair.target),)
    parts = len(pair.part_names)
    assert pair.joints.shape == pair.target_joints.shape == (parts - 1, 3)
    assert pair.joint_parts.shape == (parts - 1, 2)
    assert pair.transforms.shape == (parts, 4, 4)
    assert 0.8 < float(pair.visible.double().mean()) <= 1.0
    assert not bool(pair.missing.any())
    # What the target's camera sees of the truth, it has measured nearby.
    gap = torch.cdist(pair.truth[pair.visible], pair.target.points).amin(1)
    assert float(gap.quantile(0.9)) < 2 * pair.target.spacing


def test_a_frame_is_its_own_truth(walk):
    pair = walk.pair(7, 7)
    assert float((pair.truth - pair.source.points).norm(dim=-1).max()) < 0.02
    torch.testing.assert_close(pair.transforms, torch.eye(4, dtype=torch.float64).expand_as(pair.transforms))
    assert float(pair.error(pair.truth).max()) == 0
    shares = pair.error(pair.truth + 0.3) * pair.source.diagonal
    torch.testing.assert_close(shares, torch.full_like(shares, 0.3 * math.sqrt(3)))


def test_rigid_parts_move_as_their_transforms_say(toy):
    pair = toy.pair(0, 1)
    for part in pair.labels.unique().tolist():
        own = pair.labels == part
        moved = transform_points(pair.transforms[part], pair.source.points[own])
        torch.testing.assert_close(moved, pair.truth[own], atol=1e-9, rtol=0)
    for number, (parent, child) in enumerate(pair.joint_parts.tolist()):
        for part in (parent, child):
            moved = transform_points(pair.transforms[part], pair.joints[number : number + 1])
            torch.testing.assert_close(moved[0], pair.target_joints[number])


def test_missing_parts_are_missing_in_every_other_frame(toy):
    for frame in range(len(toy)):
        off = toy.missing[frame]
        assert (off >= 0) == (frame % 2 == 1)
        assert off not in toy.labels(frame).tolist()
    gone = [toy.pair(frame, frame + 1) for frame in range(0, 6, 2)]
    for frame, pair in zip(range(0, 6, 2), gone, strict=True):
        assert torch.equal(pair.missing, pair.labels == toy.missing[frame + 1])
        assert not bool((pair.visible & pair.missing).any())
    assert any(bool(pair.missing.any()) for pair in gone)
    assert not bool(toy.pair(1, 2).missing.any())


def test_parts_that_move_alike_get_one_moving_label(toy):
    pair = toy.pair(0, 1)
    assert pair.moving_labels(0.0).unique().numel() == pair.labels.unique().numel()
    assert pair.moving_labels(10.0).unique().numel() == 1
    assert adjusted_rand(pair.moving_labels(0.0), pair.labels) == pytest.approx(1.0)
    assert toy.pair(2, 2).moving_labels().unique().numel() == 1
    with pytest.raises(InputError, match="tolerance"):
        pair.moving_labels(-1.0)


@pytest.mark.parametrize("frames", [(40, 41), (40, 42), (3, 4), (40, 41, 42, 43)])
@pytest.mark.parametrize("tolerance", [0.005, 0.01])
def test_what_is_one_part_moves_as_its_largest_does_and_what_is_not_does_not(walk, frames, tolerance):
    some = ScanSequence(walk.figure, walk.transforms[list(frames)], walk.scanner, dtype=torch.float64)
    scan, moving, true = some[0], some.moving_labels(0, tolerance), some.labels(0)
    if len(frames) == 2:
        assert torch.equal(moving, some.pair(0, 1).moving_labels(tolerance))
    sizes = true.bincount(minlength=some.figure.num_parts)
    group = {int(part): int(moving[true == part][0]) for part in true.unique()}

    def gap(mover, part):
        """Return how far, in shares of the size, one part's motion takes another's points from where they went."""
        own = scan.points[true == part]
        steps = [motion @ torch.linalg.inv(some.transforms[0]) for motion in some.transforms]
        ends = [transform_points(step[mover], own) - transform_points(step[part], own) for step in steps]
        return max(float(end.norm(dim=-1).mean()) for end in ends) / scan.diagonal

    for label in set(group.values()):
        joined = [part for part in group if group[part] == label]
        largest = max(joined, key=lambda part: sizes[part])
        assert all(min(gap(largest, part), gap(part, largest)) < 2 * tolerance for part in joined)
    for one, other in some.joint_parts.tolist():
        if one in group and other in group and max(gap(one, other), gap(other, one)) < tolerance / 2:
            assert group[one] == group[other]
    assert len(set(group.values())) < len(group)


def test_a_part_that_is_not_seen_tells_nothing_apart(toy):
    pair = toy.pair(0, 0)
    parent, child = next((a, b) for a, b in pair.joint_parts.tolist() if b in pair.joint_parts[:, 0])
    hidden = dataclasses.replace(pair, labels=torch.where(pair.labels == child, parent, pair.labels))
    assert len(hidden.moving_labels().unique()) == 1


def test_every_way_to_ask_gives_the_same(toy):
    pairs = list(toy.pairs(2))
    assert len(pairs) == 6
    alone = toy.pair(3, 5)
    for name in ("truth", "labels", "target_labels", "joints", "visible"):
        assert torch.equal(getattr(pairs[3], name), getattr(alone, name))
    assert torch.equal(alone.source.points, toy[3].points)
    assert torch.equal(alone.target.points, toy[5].points)
    assert torch.equal(alone.truth, toy.truth(3, 5))
    assert torch.equal(alone.labels, toy.labels(3))
    assert torch.equal(alone.joints, toy.joints(3))
    assert torch.equal(toy[-1].points, toy[7].points)
    assert all(isinstance(scan, RangeScan) for scan in toy)
    with pytest.raises(IndexError):
        toy[8]


def test_seeds_decide_about_everything():
    small = DepthScanner(num_points=800)
    first, again, other = (walking_figure(3, seed, scanner=small) for seed in (4, 4, 5))
    assert torch.equal(first[1].points, again[1].points)
    assert not torch.equal(first.transforms, other.transforms)
    assert first[1].points.dtype == torch.float32


@pytest.mark.parametrize(
    "sequence",
    [
        lambda: walking_animal(3, scanner=CLEAN, gait="gallop"),
        lambda: walking_animal(3, scanner=CLEAN, proportions=Proportions.random(spread=0.2)),
        lambda: walking_figure(3, scanner=CLEAN, proportions=Proportions(size=0.5), cycles_per_frame=0.15),
        lambda: jointed_toy(3, toy=excavator(spacing=0.02), scanner=CLEAN, step=math.radians(10)),
    ],
)
def test_other_figures_give_scans_too(sequence):
    sequence = sequence()
    for pair in sequence.pairs():
        assert 1000 < len(pair.source) < 4000
        assert float(pair.error(pair.source.points).max()) > 0.01
        assert bool((pair.source.points[:, 2] > 0).all())


def test_bad_arguments_are_named(toy):
    with pytest.raises(InputError, match="frames"):
        walking_figure(1)
    with pytest.raises(InputError, match="cycles_per_frame"):
        walking_animal(3, cycles_per_frame=0.0)
    with pytest.raises(InputError, match="turn"):
        jointed_toy(3, turn=-1.0)
    with pytest.raises(InputError, match="step"):
        list(toy.pairs(0))
    with pytest.raises(InputError, match="missing must have one number per frame"):
        ScanSequence(toy.figure, toy.transforms, CLEAN, (1, 2))


BALL = mesh_of([RoundCone((0.1, 0.05, 3), (0.1, 0.05, 3), 0.5, 0.5)], 0.05)
CLEAN_CAMERA = DepthScanner(noise=0.0, num_holes=0)


def scan(scanner, mesh=BALL, seed=0, dtype=torch.float64):
    view = scanner.view(mesh, 0.4)
    return scanner.scan(mesh, view, torch.Generator().manual_seed(seed), dtype)


def test_a_clean_scan_lies_exactly_where_it_says():
    found = scan(CLEAN_CAMERA)
    torch.testing.assert_close(found.transferred(BALL.vertices, BALL.faces), found.scan.points)
    middle = torch.tensor([0.1, 0.05, 3], dtype=torch.float64)
    assert float(((found.scan.points - middle).norm(dim=-1) - 0.5).abs().max()) < 2e-3
    # The side that faces the camera, and normals that look at it.
    assert bool((((found.scan.points - middle) * found.scan.points).sum(-1) < 0).all())
    assert bool(((found.scan.normals * found.scan.points).sum(-1) < 0).all())


@pytest.mark.parametrize("count", [500, 3000])
def test_the_number_of_points_is_as_asked(count):
    found = scan(DepthScanner(num_points=count))
    assert abs(len(found.scan) / count - 1) < 0.1


def test_noise_grows_with_depth_and_lies_along_the_rays():
    near, far = (BALL, mesh_of([RoundCone((0, 0, 6), (0, 0, 6), 1.0, 1.0)], 0.1))
    spreads = []
    for mesh in (near, far):
        found = scan(DepthScanner(noise=1e-3, num_holes=0, num_points=4000), mesh)
        truth = found.transferred(mesh.vertices, mesh.faces)
        error = found.scan.points - truth
        assert float(torch.linalg.cross(error, truth).norm(dim=-1).max()) < 1e-9
        spreads.append(float((error[:, 2] / truth[:, 2].square()).std()))
    assert spreads == pytest.approx([1e-3, 1e-3], rel=0.05)


def test_slanted_surfaces_and_holes_are_not_measured():
    whole = scan(DepthScanner(noise=0.0, num_holes=0, max_slant=math.pi / 2))
    cut = scan(DepthScanner(noise=0.0, num_holes=0, max_slant=math.radians(50)))
    middle = torch.tensor([0.1, 0.05, 3], dtype=torch.float64)
    for found, limit in ((whole, 85), (cut, 52)):
        out = torch.nn.functional.normalize(found.scan.points - middle, dim=-1)
        slant = torch.rad2deg(torch.acos(-(out * torch.nn.functional.normalize(found.scan.points, dim=-1)).sum(-1)))
        assert limit - 6 < float(slant.max()) < limit + 6
    holes = DepthScanner(noise=0.0, num_holes=3, hole_radius=0.05)
    assert len(scan(holes).scan) < 0.97 * len(scan(CLEAN_CAMERA).scan)


def test_what_stands_before_something_hides_it():
    wall, post = RoundBox((0, 0, 3), (0.8, 0.8, 0.05), 0.01), RoundBox((0, 0, 2), (0.1, 0.6, 0.05), 0.01)
    both = mesh_of([wall, post], 0.05)
    points = scan(CLEAN_CAMERA, both).scan.points
    behind = points[points[:, 2] > 2.5]
    assert len(behind) > 100
    shadow = (behind[:, 0] / behind[:, 2]).abs() < 0.1 / 2 - 0.01
    low = (behind[:, 1] / behind[:, 2]).abs() < 0.6 / 2 - 0.05
    assert not bool((shadow & low).any())


def test_scans_repeat_under_a_seed_in_either_precision():
    scanner = DepthScanner()
    first, again, other = scan(scanner), scan(scanner), scan(scanner, seed=1)
    assert torch.equal(first.scan.points, again.scan.points)
    assert first.scan.points.shape != other.scan.points.shape or not torch.equal(first.scan.points, other.scan.points)
    single = scan(CLEAN_CAMERA, dtype=torch.float32)
    assert single.scan.points.dtype == torch.float32
    truth = interpolate(BALL.vertices, BALL.faces, single.face, single.barycentric)
    torch.testing.assert_close(single.scan.points.double(), truth, atol=1e-5, rtol=0)


def test_bad_cameras_are_named():
    for name, value in (
        ("num_points", 1),
        ("noise", -1.0),
        ("max_slant", 2.0),
        ("num_holes", -1),
        ("hole_radius", -0.1),
    ):
        with pytest.raises(InputError, match=name):
            DepthScanner(**{name: value})
    behind = mesh_of([RoundCone((5, 0, 3), (5, 0, 3), 0.5, 0.5)], 0.1)
    with pytest.raises(InputError, match="sees nothing"):
        CLEAN_CAMERA.view(behind, 0.4)
    with pytest.raises(InputError, match="sees nothing"):
        CLEAN_CAMERA.scan(behind, CLEAN_CAMERA.view(BALL, 0.4), torch.Generator(), torch.float64)


COARSE = 0.02


@pytest.fixture(scope="module", params=[robot, excavator, random_toy])
def rigid_toy(request):
    return request.param(spacing=COARSE)


def test_toys_have_six_to_eight_rigid_parts(rigid_toy):
    assert 6 <= rigid_toy.figure.num_parts <= 8
    assert set(rigid_toy.figure.weights.unique().tolist()) == {0.0, 1.0}
    assert bool((rigid_toy.figure.weights.sum(0) > 20).all())


def test_parts_touch_where_they_meet(rigid_toy):
    owner = rigid_toy.figure.weights.argmax(-1)
    for index in range(1, rigid_toy.figure.num_parts):
        parent = rigid_toy.parts[rigid_toy.figure.parents[index]]
        gap = union_distance(parent.solids, rigid_toy.figure.mesh.vertices[owner == index], 0.0)
        assert float(gap.min()) < 0.01


def test_hinges_turn_their_part_about_the_joint(rigid_toy):
    for number, hinge in enumerate(rigid_toy.hinges):
        angles = torch.zeros(len(rigid_toy.hinges), dtype=torch.float64)
        angles[number] = 0.3
        transforms = rigid_toy.figure.transforms(rigid_toy.rotations(angles))
        index = rigid_toy.figure.index(hinge.part)
        relative = invert_rigid(transforms[rigid_toy.figure.parents[index]]) @ transforms[index]
        axis = torch.tensor(hinge.axis, dtype=torch.float64)
        on_axis = rigid_toy.figure.joints[index] + torch.stack([0 * axis, 0.1 * axis])
        torch.testing.assert_close(transform_points(relative, on_axis), on_axis)
        assert math.isclose(float(relative[:3, :3].trace()), 1 + 2 * math.cos(0.3), rel_tol=1e-9)


def test_motion_stays_in_its_limits_takes_steps_and_runs_into_nothing(rigid_toy):
    angles = rigid_toy.random_motion(12, 0.4, torch.Generator().manual_seed(5))
    lower, upper = (torch.tensor([getattr(hinge, end) for hinge in rigid_toy.hinges]) for end in ("lower", "upper"))
    assert bool(((angles >= lower - 1e-9) & (angles <= upper + 1e-9)).all())
    steps = (angles[1:] - angles[:-1]).abs()
    assert 0.2 < float(steps.max()) <= 0.4 + 1e-9
    assert max(rigid_toy.overlap(pose) for pose in angles) <= 0.002
    torch.testing.assert_close(
        angles, rigid_toy.random_motion(12, 0.4, torch.Generator().manual_seed(5)), rtol=0, atol=0
    )
    torch.testing.assert_close(
        rigid_toy.random_motion(2), rigid_toy.random_motion(2, generator=torch.Generator().manual_seed(0))
    )


def test_overlap_is_seen():
    rigid_toy = robot(spacing=COARSE)
    angles = torch.zeros(len(rigid_toy.hinges), dtype=torch.float64)
    forearm = [hinge.part for hinge in rigid_toy.hinges].index("left forearm")
    assert rigid_toy.overlap(angles) == 0
    # The left arm swung inwards, so that the forearm is inside the body.
    angles[forearm - 1] = -0.8
    assert rigid_toy.overlap(angles) > 0.02


@pytest.mark.parametrize("count", [2, 3, 6, 9])
def test_random_toys_have_the_parts_asked_for_and_room_to_move(count):
    rigid_toy = random_toy(torch.Generator().manual_seed(count), count, spacing=COARSE)
    assert rigid_toy.figure.num_parts == count
    assert rigid_toy.overlap(torch.zeros(len(rigid_toy.hinges), dtype=torch.float64)) == 0
    assert rigid_toy.random_motion(3).shape == (3, len(rigid_toy.hinges))


def test_random_toys_follow_their_generator():
    first, again, other = (random_toy(torch.Generator().manual_seed(seed), spacing=COARSE) for seed in (1, 1, 2))
    assert torch.equal(first.figure.mesh.vertices, again.figure.mesh.vertices)
    assert first.parts != other.parts
    with pytest.raises(InputError, match="num_parts must be at most 9"):
        random_toy(num_parts=10)


def test_a_toy_without_room_says_so():
    rigid_toy = robot(spacing=COARSE)
    stuck = replace(rigid_toy, hinges=(Hinge("left upper arm", (0, 0, 1), -0.85, -0.8),))
    with pytest.raises(InputError, match="parts ran into each other"):
        stuck.random_motion(1)


def test_bad_toys_are_named(rigid_toy):
    with pytest.raises(InputError, match="angles must have shape"):
        rigid_toy.rotations(torch.zeros(1))
    with pytest.raises(InputError, match="frames"):
        rigid_toy.random_motion(0)
    with pytest.raises(InputError, match="step"):
        rigid_toy.random_motion(2, -0.1)
