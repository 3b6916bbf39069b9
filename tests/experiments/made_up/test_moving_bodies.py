"""Made-up people, animals, toys and plants: surfaces, gaits, walks before a camera, and parts that move alike."""

import dataclasses

import pytest
import torch

from experiments.made_up.bodies import person, quadruped
from experiments.made_up.gaits import GAITS, animal_walk, person_walk
from experiments.made_up.moving_labels import moving_labels, moving_labels_over_time
from experiments.made_up.plants import PlantForm, growing_plant
from experiments.made_up.toys import excavator, random_toy
from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import ScanSequence, jointed_toy
from torchreg.datasets.solids import union_distance
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import so3_log

PHASE = torch.arange(0, 5, 0.02, dtype=torch.float64)
CLEAN = DepthScanner(2500, noise=0.0, num_holes=0)


@pytest.fixture(scope="module")
def walker():
    return person(spacing=0.04)


@pytest.fixture(scope="module")
def animal():
    return quadruped(spacing=0.04)


@pytest.fixture(scope="module")
def walk():
    return walking_figure(190, dtype=torch.float64)


def euler(mesh):
    """Return Euler's number of a closed mesh: two for each piece without a handle."""
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=-1).values
    edges, counts = sides.unique(dim=0, return_counts=True)
    assert set(counts.tolist()) == {2}
    return mesh.num_vertices - len(edges) + mesh.num_faces


def test_bodies_are_one_closed_surface_and_mirror_images_of_themselves(walker, animal):
    for body in (walker, animal):
        assert euler(body.mesh) == 2  # nothing fused that should hang free
        assert torch.bincount(body.weights.argmax(-1), minlength=body.num_parts).min() > 10
        for index, name in enumerate(body.part_names):
            if "left" in name:
                other = body.joints[body.index(name.replace("left", "right"))]
                torch.testing.assert_close(body.joints[index] * other.new_tensor([-1.0, 1, 1]), other)
    lower, upper = walker.mesh.bounds()
    assert 1.7 < float(upper[1] - lower[1]) < 1.8


def lowest(figure, rotations, rise, parts):
    """Return the lowest vertex of each part over time."""
    vertices = figure.vertices(figure.transforms(rotations))[..., 1]
    owner = figure.weights.argmax(-1)
    return torch.stack([vertices[:, owner == figure.index(part)].amin(-1) + rise for part in parts])


def test_people_walk_as_people_do(walker):
    rotations, rise = person_walk(walker, PHASE)
    swings = so3_log(rotations[:, [walker.index("left thigh"), walker.index("right thigh")]])[..., 0]
    assert float(torch.corrcoef(swings.mT)[0, 1]) < -0.8
    knees = so3_log(rotations[:, walker.index("left shin")])[:, 0].rad2deg()
    assert float(knees.min()) > 0
    assert 45 < float(knees.max()) < 75
    ahead = walker.transforms(rotations)[:, :, :3, :3] @ torch.tensor([0.0, -1, 0], dtype=torch.float64)
    arm, leg = (ahead[:, walker.index(f"left {part}"), 2] for part in ("upper arm", "thigh"))
    assert float(torch.corrcoef(torch.stack([arm, leg]))[0, 1]) < -0.8
    feet = lowest(walker, rotations, rise, ("left foot", "right foot"))
    assert float(feet.amin(0).std()) < 0.03
    # Each swings through the air by turns; 0.02 cycles turn no joint by more than 10 degrees.
    assert float((feet - feet.amin(0)).amax(1).min()) > 0.05
    assert float((rotations[1:] - rotations[:-1]).flatten(1).norm(dim=-1).max()) < 0.5


@pytest.mark.parametrize("gait", list(GAITS))
def test_animals_stand_on_at_least_one_foot(animal, gait):
    feet = lowest(animal, *animal_walk(animal, PHASE, gait), [f"{leg} foot" for leg in GAITS[gait]])
    assert float(feet.amin(0).max()) < 0.15
    assert float((feet.amax(1) - feet.amin(1)).min()) > 0.05


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
def test_what_is_one_part_moves_as_its_largest_does_and_what_is_not_does_not(walk, frames, tolerance):
    some = ScanSequence(walk.figure, walk.transforms[list(frames)], walk.scanner, dtype=torch.float64)
    scan, moving, true = some[0], moving_labels_over_time(some, 0, tolerance), some.labels(0)
    if len(frames) == 2:
        assert torch.equal(moving, moving_labels(some.pair(0, 1), tolerance))
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


def test_a_part_that_is_not_seen_tells_nothing_apart():
    pair = jointed_toy(2, scanner=CLEAN).pair(0, 0)
    parent, child = next((a, b) for a, b in pair.joint_parts.tolist() if b in pair.joint_parts[:, 0])
    hidden = dataclasses.replace(pair, labels=torch.where(pair.labels == child, parent, pair.labels))
    assert len(moving_labels(hidden).unique()) == 1


@pytest.mark.parametrize("count", [2, 3, 6, 9, None])
def test_toys_have_the_parts_asked_for_touch_where_they_meet_and_have_room_to_move(count):
    toy = random_toy(torch.Generator().manual_seed(count), count, spacing=0.02) if count else excavator(spacing=0.02)
    assert toy.figure.num_parts == (count or 6)
    assert toy.overlap(torch.zeros(len(toy.hinges), dtype=torch.float64)) == 0
    assert toy.random_motion(3).shape == (3, len(toy.hinges))
    owner = toy.figure.weights.argmax(-1)
    for index in range(1, toy.figure.num_parts):
        parent = toy.parts[toy.figure.parents[index]]
        assert float(union_distance(parent.solids, toy.figure.mesh.vertices[owner == index], 0.0).min()) < 0.01


def test_tips_of_plants_lie_on_the_surface_as_long_as_organs_live_and_organs_lengthen():
    plant = growing_plant(PlantForm(num_leaves=4, num_branchlets=1), 10, resolution=40, dtype=torch.float64)
    frames = torch.arange(10)[:, None]
    alive = (frames >= plant.births) & (frames <= plant.ends)
    assert torch.equal(alive, ~plant.tips[..., 0].isnan())
    assert int(plant.births.max()) > 0
    assert int(plant.ends.min()) < 9
    for mesh, tips, there in zip(plant.meshes, plant.tips, alive, strict=True):
        assert float(nearest_neighbor(tips[there], mesh.vertices)[1].max()) < 0.05
    for organ, birth in enumerate(plant.births.tolist()):
        if 0 < birth < 8:
            heights = (plant.tips[birth:, organ] - plant.tips[birth:, 0]).norm(dim=-1)
            assert heights[heights.isfinite()][-1] > heights[0]
