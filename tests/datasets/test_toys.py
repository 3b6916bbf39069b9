import math
from dataclasses import replace

import pytest
import torch

from torchreg.datasets.solids import union_distance
from torchreg.datasets.toys import Hinge, excavator, random_toy, robot
from torchreg.errors import InputError
from torchreg.geometry.rigid import invert_rigid, transform_points

COARSE = 0.02


@pytest.fixture(scope="module", params=[robot, excavator, random_toy])
def toy(request):
    return request.param(spacing=COARSE)


def test_toys_have_six_to_eight_rigid_parts(toy):
    assert 6 <= toy.figure.num_parts <= 8
    assert set(toy.figure.weights.unique().tolist()) == {0.0, 1.0}
    assert bool((toy.figure.weights.sum(0) > 20).all())


def test_parts_touch_where_they_meet(toy):
    owner = toy.figure.weights.argmax(-1)
    for index in range(1, toy.figure.num_parts):
        parent = toy.parts[toy.figure.parents[index]]
        gap = union_distance(parent.solids, toy.figure.mesh.vertices[owner == index], 0.0)
        assert float(gap.min()) < 0.01


def test_hinges_turn_their_part_about_the_joint(toy):
    for number, hinge in enumerate(toy.hinges):
        angles = torch.zeros(len(toy.hinges), dtype=torch.float64)
        angles[number] = 0.3
        transforms = toy.figure.transforms(toy.rotations(angles))
        index = toy.figure.index(hinge.part)
        relative = invert_rigid(transforms[toy.figure.parents[index]]) @ transforms[index]
        axis = torch.tensor(hinge.axis, dtype=torch.float64)
        on_axis = toy.figure.joints[index] + torch.stack([0 * axis, 0.1 * axis])
        torch.testing.assert_close(transform_points(relative, on_axis), on_axis)
        assert math.isclose(float(relative[:3, :3].trace()), 1 + 2 * math.cos(0.3), rel_tol=1e-9)


def test_motion_stays_in_its_limits_takes_steps_and_runs_into_nothing(toy):
    angles = toy.random_motion(12, 0.4, torch.Generator().manual_seed(5))
    lower, upper = (torch.tensor([getattr(hinge, end) for hinge in toy.hinges]) for end in ("lower", "upper"))
    assert bool(((angles >= lower - 1e-9) & (angles <= upper + 1e-9)).all())
    steps = (angles[1:] - angles[:-1]).abs()
    assert 0.2 < float(steps.max()) <= 0.4 + 1e-9
    assert max(toy.overlap(pose) for pose in angles) <= 0.002
    torch.testing.assert_close(angles, toy.random_motion(12, 0.4, torch.Generator().manual_seed(5)), rtol=0, atol=0)
    torch.testing.assert_close(toy.random_motion(2), toy.random_motion(2, generator=torch.Generator().manual_seed(0)))


def test_overlap_is_seen():
    toy = robot(spacing=COARSE)
    angles = torch.zeros(len(toy.hinges), dtype=torch.float64)
    forearm = [hinge.part for hinge in toy.hinges].index("left forearm")
    assert toy.overlap(angles) == 0
    # The left arm swung inwards, so that the forearm is inside the body.
    angles[forearm - 1] = -0.8
    assert toy.overlap(angles) > 0.02


@pytest.mark.parametrize("count", [2, 3, 6, 9])
def test_random_toys_have_the_parts_asked_for_and_room_to_move(count):
    toy = random_toy(torch.Generator().manual_seed(count), count, spacing=COARSE)
    assert toy.figure.num_parts == count
    assert toy.overlap(torch.zeros(len(toy.hinges), dtype=torch.float64)) == 0
    assert toy.random_motion(3).shape == (3, len(toy.hinges))


def test_random_toys_follow_their_generator():
    first, again, other = (random_toy(torch.Generator().manual_seed(seed), spacing=COARSE) for seed in (1, 1, 2))
    assert torch.equal(first.figure.mesh.vertices, again.figure.mesh.vertices)
    assert first.parts != other.parts
    with pytest.raises(InputError, match="num_parts must be at most 9"):
        random_toy(num_parts=10)


def test_a_toy_without_room_says_so():
    toy = robot(spacing=COARSE)
    stuck = replace(toy, hinges=(Hinge("left upper arm", (0, 0, 1), -0.85, -0.8),))
    with pytest.raises(InputError, match="parts ran into each other"):
        stuck.random_motion(1)


def test_bad_arguments_are_named(toy):
    with pytest.raises(InputError, match="angles must have shape"):
        toy.rotations(torch.zeros(1))
    with pytest.raises(InputError, match="frames"):
        toy.random_motion(0)
    with pytest.raises(InputError, match="step"):
        toy.random_motion(2, -0.1)
