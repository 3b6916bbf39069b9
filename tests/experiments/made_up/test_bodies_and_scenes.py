"""All made-up data: one table over kinds of bodies, seeds, wrong arguments; and how each kind moves and is scanned."""

import itertools
import math

import pytest
import torch

import torchreg as tr
from experiments.made_up.bodies import Proportions, person, quadruped
from experiments.made_up.creature_kinds import HELD_OUT_KINDS, TRAINING_KINDS
from experiments.made_up.creature_parts import Draw, FlatCone
from experiments.made_up.gaits import GAITS, animal_walk, person_tucks, person_walk
from experiments.made_up.matching_pairs import PosableBody, matching_pairs
from experiments.made_up.moving_labels import moving_labels, moving_labels_over_time
from experiments.made_up.plants import PlantForm, growing_plant
from experiments.made_up.shape_sequences import other_hand, rig_sequence
from experiments.made_up.toys import random_toy
from experiments.made_up.walks import walking_animal, walking_figure
from torchreg.datasets import depth_scanner, figures, scan_sequences, solids

HAND = tr.Hand().requires_grad_(False)
REST, STILL = HAND.rest_pose(), torch.zeros(HAND.num_dofs)
PHASE = torch.arange(0, 5, 0.02, dtype=torch.float64)
SMALL, CLEAN = depth_scanner.DepthScanner(num_points=800), depth_scanner.DepthScanner(2500, noise=0.0, num_holes=0)
MAN, BEAST = person(spacing=0.04), quadruped(spacing=0.04)
KINDS = {**TRAINING_KINDS, **HELD_OUT_KINDS}


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def euler(mesh):
    """Return Euler's number of a closed mesh: two for each piece without a handle."""
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=-1).values
    edges, counts = sides.unique(dim=0, return_counts=True)
    assert set(counts.tolist()) == {2}
    return mesh.num_vertices - len(edges) + mesh.num_faces


def creature(name):
    kind = KINDS[name][0](Draw(seeded(1)))
    return figures.meshed_figure(kind.parts, spacing=0.05, blend=0.01, softness=0.02)


@pytest.mark.parametrize(
    "mesh",
    [
        lambda: MAN.mesh,
        lambda: BEAST.mesh,
        lambda: creature("snake").mesh,
        lambda: growing_plant(PlantForm(2, 0), 2, resolution=32).meshes[-1],
    ],
)
def test_bodies_are_watertight(mesh):
    assert euler(mesh()) == 2  # nothing fused that should hang free


@pytest.mark.parametrize(
    "make",
    [
        lambda seed: torch.tensor([*vars(Proportions.random(seeded(seed))).values()]),
        lambda seed: person_walk(MAN, PHASE, seeded(seed))[0],
        lambda seed: person_tucks(MAN, PHASE, seeded(seed))[0],
        lambda seed: animal_walk(BEAST, PHASE, generator=seeded(seed))[0],
        lambda seed: walking_figure(2, seed, scanner=SMALL)[1].points,
        lambda seed: random_toy(seeded(seed), spacing=0.03).figure.mesh.vertices,
        lambda seed: growing_plant(PlantForm(2, 0), 2, resolution=24, seed=seed).tips,
        lambda seed: other_hand(seeded(seed)).bone_lengths,
        lambda seed: rig_sequence(HAND, STILL, 1, num_points=40, seed=seed)[0].points,
        lambda seed: next(matching_pairs(seed)).source.points,
    ],
)
def test_seeds_repeat_and_differ(make):
    first, again, other = make(0), make(0), make(1)
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Proportions(belly=0.0), "belly"),
        (lambda: animal_walk(BEAST, PHASE, "swim"), "gait must be one of walk, trot, gallop"),
        (lambda: person_walk(BEAST, PHASE), "must have a part called 'pelvis'"),
        (lambda: animal_walk(MAN, PHASE), "must have a part called 'chest'"),
        (lambda: walking_figure(1), "frames"),
        (lambda: walking_animal(3, cycles_per_frame=0.0), "cycles_per_frame"),
        (lambda: random_toy(num_parts=10), "num_parts must be at most 9"),
        (lambda: moving_labels(scan_sequences.jointed_toy(2).pair(0, 1), -1.0), "tolerance"),
        (lambda: PlantForm(num_leaves=1), "num_leaves must be at least 2"),
        (lambda: PlantForm(sway=-1.0), "sway must be zero or positive"),
        (lambda: growing_plant(num_frames=1), "num_frames must be at least 2"),
        (lambda: growing_plant(noise=-1.0), "noise must be zero or positive"),
        (lambda: growing_plant(resolution=4), "resolution must be at least 16"),
        (lambda: other_hand(scale=-0.1), "scale must be zero or positive"),
        (lambda: rig_sequence(HAND, torch.zeros(3)), "full_bend must have shape"),
        (lambda: rig_sequence(HAND, STILL + 1), "full_bend must be zero for the six"),
        (lambda: rig_sequence(HAND, STILL, 0), "num_frames must be at least 1, got 0"),
        (lambda: rig_sequence(HAND, STILL, fps=0.0), "fps must be positive"),
        (lambda: rig_sequence(HAND, STILL, turn=-1.0), "turn must be zero or positive"),
        (lambda: rig_sequence(HAND, STILL, distance=0.0), "distance must be positive"),
        (lambda: rig_sequence(HAND, STILL, facing=(1.0, 2.0)), r"facing must have shape \(3\)"),
        (lambda: rig_sequence(HAND, STILL, facing="front"), "facing must be"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises((tr.errors.InputError, tr.errors.InputTypeError), match=message):
        call()


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_creature_is_one_tree_of_parts_and_differs_at_every_draw(name):
    draw = Draw(seeded(0))
    creatures = [KINDS[name][0](draw) for _ in range(3)]
    for made in creatures:
        names = [part.name for part in made.parts]
        assert made.parts[0].parent is None
        assert all(part.parent in names[:index] for index, part in enumerate(made.parts) if index)
        assert len(made.limits) == len(made.parts) > 2
        assert all(0 < limit < 2.2 for limit in made.limits)
    assert creatures[0].parts != creatures[1].parts
    assert (name in TRAINING_KINDS) != (name in HELD_OUT_KINDS)


def test_a_flat_cone_is_flat_and_its_distances_are_bounds():
    flat = FlatCone(solids.RoundCone((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.2, 0.2), (0.0, 0.0, 1.0), 0.5)
    surface = torch.tensor([[0.5, 0.2, 0.0], [0.5, 0.0, 0.1], [1.2, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(flat.distance(surface), torch.zeros(3, dtype=torch.float64), atol=1e-12, rtol=0)
    around = torch.rand(200, 3, generator=seeded(0), dtype=torch.float64) * 2 - 0.5
    steps = around + 1e-4 * torch.nn.functional.normalize(around.flip(0) - 0.3, dim=1)
    assert bool(((flat.distance(steps) - flat.distance(around)).abs() <= 1.0001e-4).all())


def lowest(figure, rotations, rise, parts):
    """Return the lowest vertex of each part over time."""
    vertices, owner = figure.vertices(figure.transforms(rotations))[..., 1], figure.weights.argmax(-1)
    return torch.stack([vertices[:, owner == figure.index(part)].amin(-1) + rise for part in parts])


@pytest.mark.parametrize("gait", list(GAITS))
def test_animals_stand_on_at_least_one_foot(gait):
    feet = lowest(BEAST, *animal_walk(BEAST, PHASE, gait), [f"{leg} foot" for leg in GAITS[gait]])
    assert float(feet.amin(0).max()) < 0.15
    assert float((feet.amax(1) - feet.amin(1)).min()) > 0.05


@pytest.fixture(scope="module")
def walk():
    return walking_figure(190, dtype=torch.float64)


def test_the_walk_has_the_pairs_and_the_motion_it_promises(walk):
    turns = walk.transforms[..., :3, :3]
    local = turns[:, list(walk.figure.parents[1:])].mT @ turns[:, 1:]
    change = local[:-1].mT @ local[1:]
    fastest = torch.acos(((change.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)).amax(1).rad2deg()
    assert 25 < float(fastest.max()) < 40
    assert float(fastest.median()) > 12
    pair = walk.pair(20, 21)
    assert 2000 < len(pair.source) < 6000
    gap = torch.cdist(pair.truth[pair.visible], pair.target.points).amin(1)
    assert float(gap.quantile(0.9)) < 2 * pair.target.spacing


@pytest.mark.parametrize("frames", [(40, 41), (40, 42), (3, 4), (40, 41, 42, 43)])
@pytest.mark.parametrize("tolerance", [0.005, 0.01])
def test_parts_of_one_label_move_as_the_largest_does_and_others_do_not(walk, frames, tolerance):
    some = scan_sequences.ScanSequence(walk.figure, walk.transforms[list(frames)], walk.scanner, dtype=torch.float64)
    scan, moving, true = some[0], moving_labels_over_time(some, 0, tolerance), some.labels(0)
    if len(frames) == 2:
        assert torch.equal(moving, moving_labels(some.pair(0, 1), tolerance))
    sizes = true.bincount(minlength=some.figure.num_parts)
    group = {int(part): int(moving[true == part][0]) for part in true.unique()}

    def gap(mover, part):
        """Return how far, in shares of the size, one part's motion takes another's points from where they went."""
        own = torch.nn.functional.pad(scan.points[true == part], (0, 1), value=1.0)
        steps = [motion @ torch.linalg.inv(some.transforms[0]) for motion in some.transforms]
        ends = [(own @ (step[mover] - step[part]).mT)[:, :3] for step in steps]
        return max(float(end.norm(dim=-1).mean()) for end in ends) / scan.diagonal

    for label in set(group.values()):
        joined = [part for part in group if group[part] == label]
        largest = max(joined, key=lambda part: sizes[part])
        assert all(min(gap(largest, part), gap(part, largest)) < 2 * tolerance for part in joined)
    for one, other in some.joint_parts.tolist():
        if one in group and other in group and max(gap(one, other), gap(other, one)) < tolerance / 2:
            assert group[one] == group[other]
    assert len(set(group.values())) < len(group)


def test_tips_of_plants_lie_on_the_surface_as_long_as_organs_live_and_organs_lengthen():
    plant = growing_plant(PlantForm(num_leaves=4, num_branchlets=1), 10, resolution=40, dtype=torch.float64)
    frames = torch.arange(10)[:, None]
    alive = (frames >= plant.births) & (frames <= plant.ends)
    assert torch.equal(alive, ~plant.tips[..., 0].isnan())
    assert int(plant.births.max()) > 0
    assert int(plant.ends.min()) < 9
    for mesh, tips, visible in zip(plant.meshes, plant.tips, alive, strict=True):
        assert float(torch.cdist(tips[visible], mesh.vertices).amin(1).max()) < 0.05
    for organ, birth in enumerate(plant.births.tolist()):
        if 0 < birth < 8:
            heights = (plant.tips[birth:, organ] - plant.tips[birth:, 0]).norm(dim=-1)
            assert heights[heights.isfinite()][-1] > heights[0]


@pytest.mark.parametrize(("whole", "count", "least_visible"), [(0.0, 8, 0.25), (1.0, 3, 0.95)])
def test_the_truth_of_pairs_lies_on_the_other_scan_where_it_is_visible_and_leads_back(whole, count, least_visible):
    for pair in itertools.islice(matching_pairs(0, whole=whole), count):
        forth = pair.source_truth, pair.source_visible, pair.target
        for truth, visible, scan in (forth, (pair.target_truth, pair.target_visible, pair.source)):
            apart = torch.cdist(truth[visible], scan.points).amin(1) / scan.diagonal
            assert float(apart.max()) <= 0.03
            assert float(apart.median()) < 0.012
        assert float(pair.source_visible.double().mean()) >= least_visible
        nearest = torch.cdist(pair.source_truth[pair.source_visible], pair.target.points).argmin(1)
        back = (pair.target_truth[nearest] - pair.source.points[pair.source_visible]).norm(dim=-1)
        assert float(back.median()) < 0.02 * pair.source.diagonal


def test_pairs_among_other_things_keep_their_truth_and_hide_the_rest():
    """Beside distances to the other scan: what is visible lies on it; nothing else of a scan does."""
    plain, rough = matching_pairs(3), matching_pairs(3, rough=0.9)
    sizes, hidden = [], []
    for pair in itertools.islice(rough, 8):
        for truth, visible, scan in (
            (pair.source_truth, pair.source_visible, pair.target),
            (pair.target_truth, pair.target_visible, pair.source),
        ):
            assert float((torch.cdist(truth[visible], scan.points).amin(1) / scan.diagonal).max()) <= 0.03
        assert len(pair.target_truth) == len(pair.target) == len(pair.target_visible)
        sizes.append(len(pair.target))
        hidden.append(float((~pair.target_visible).double().mean()))
    assert min(sizes) < 1600
    assert max(hidden) > 0.2
    assert {pair.kind for pair in itertools.islice(plain, 1)} == {next(matching_pairs(3, rough=0.9)).kind}


def test_pairs_show_bodies_of_ones_own():
    limits = torch.tensor(TRAINING_KINDS["snake"][0](Draw(seeded(1))).limits, dtype=torch.float64)
    mine = ("mine", PosableBody(creature("snake"), limits))
    found = matching_pairs(2, bodies=lambda _: mine, body_share=1.0)
    assert {pair.kind for pair in itertools.islice(found, 2)} == {"mine"}


def test_a_shape_bends_and_turns_before_one_camera():
    bend = STILL.clone()
    bend[HAND.dof_names.index("index_pip_flexion")] = math.radians(60)
    clouds = rig_sequence(HAND, bend, facing=(0.0, 0.0, math.pi), num_points=40, distance=0.9)
    poses = torch.stack([cloud.pose for cloud in clouds])
    assert len(clouds) == 60
    assert all(len(cloud.points) == 50 and int(cloud.inliers.sum()) == 40 for cloud in clouds)
    torch.testing.assert_close(poses[25, 6:], REST[6:] + bend[6:])
    assert bool((poses[:, 6:] - REST[6:] <= bend[6:] + 1e-6).all())
    middle = HAND.part_transforms(poses)[..., :3, 3].mean(1)
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.0, 0.9]).expand(60, 3))
    # A turn to each side by 40 degrees before the facing: rotation vectors between the first and the widest.
    turned = HAND.part_transforms(poses)[:, 0, :3, :3]
    cosine = (turned @ turned[0].mT).diagonal(dim1=-2, dim2=-1).sum(-1) / 2 - 0.5
    assert float(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).max()) == pytest.approx(40, abs=0.1)
