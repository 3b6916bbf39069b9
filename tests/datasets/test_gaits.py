import pytest
import torch

from torchreg.datasets.bodies import person, quadruped
from torchreg.datasets.gaits import GAITS, animal_walk, person_walk
from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_log

PHASE = torch.arange(0, 5, 0.02, dtype=torch.float64)


@pytest.fixture(scope="module")
def walker():
    return person(spacing=0.05)


@pytest.fixture(scope="module")
def animal():
    return quadruped(spacing=0.05)


def height(figure, transforms, part):
    """The lowest vertex of a part over time."""
    own = figure.weights.argmax(-1) == figure.index(part)
    return figure.vertices(transforms)[:, own, 1].amin(-1)


def test_legs_take_turns_and_knees_bend_one_way_only(walker):
    rotations, _ = person_walk(walker, PHASE)
    swings = so3_log(rotations[:, [walker.index("left thigh"), walker.index("right thigh")]])[..., 0]
    assert float(torch.corrcoef(swings.mT)[0, 1]) < -0.8
    knees = so3_log(rotations[:, walker.index("left shin")])[:, 0].rad2deg()
    assert float(knees.min()) > 0
    assert 45 < float(knees.max()) < 75
    elbows = so3_log(rotations[:, walker.index("right forearm")])[:, 0].rad2deg()
    assert float(elbows.max()) < 0


def test_arms_swing_against_the_legs(walker):
    rotations, _ = person_walk(walker, PHASE)
    transforms = walker.transforms(rotations)
    ahead = transforms[:, :, :3, :3] @ torch.tensor([0.0, -1, 0], dtype=torch.float64)
    arm, leg = (ahead[:, walker.index(f"left {part}"), 2] for part in ("upper arm", "thigh"))
    assert float(torch.corrcoef(torch.stack([arm, leg]))[0, 1]) < -0.8


def test_a_foot_is_near_the_ground_at_every_time(walker):
    rotations, rise = person_walk(walker, PHASE)
    transforms = walker.transforms(rotations)
    feet = torch.stack([height(walker, transforms, f"{side} foot") + rise for side in ("left", "right")])
    lowest = feet.amin(0)
    assert float(lowest.std()) < 0.03
    # Each swings through the air by turns.
    assert float((feet - lowest).amax(1).min()) > 0.05


def test_walks_are_smooth_and_repeat_only_under_a_seed(walker):
    first = person_walk(walker, PHASE, torch.Generator().manual_seed(1))
    torch.testing.assert_close(first, person_walk(walker, PHASE, torch.Generator().manual_seed(1)), rtol=0, atol=0)
    assert not torch.allclose(first[0], person_walk(walker, PHASE, torch.Generator().manual_seed(2))[0])
    steps = (first[0][1:] - first[0][:-1]).flatten(1).norm(dim=-1)
    # 0.02 cycles turn no joint by more than 10 degrees.
    assert float(steps.max()) < 0.5
    one_cycle = 50
    assert not torch.allclose(first[0][0], first[0][one_cycle], atol=1e-3)


@pytest.mark.parametrize("gait", list(GAITS))
def test_animals_stand_on_at_least_one_foot(animal, gait):
    rotations, rise = animal_walk(animal, PHASE, gait)
    transforms = animal.transforms(rotations)
    feet = torch.stack([height(animal, transforms, f"{leg} foot") + rise for leg in GAITS[gait]])
    assert float(feet.amin(0).max()) < 0.15
    assert float((feet.amax(1) - feet.amin(1)).min()) > 0.05


def test_gaits_differ_and_know_their_figures(walker, animal):
    assert not torch.allclose(animal_walk(animal, PHASE, "walk")[0], animal_walk(animal, PHASE, "trot")[0])
    with pytest.raises(InputError, match="gait must be one of walk, trot, gallop"):
        animal_walk(animal, PHASE, "swim")
    with pytest.raises(InputError, match="must have a part called 'pelvis'"):
        person_walk(animal, PHASE)
    with pytest.raises(InputError, match="must have a part called 'chest'"):
        animal_walk(walker, PHASE)
