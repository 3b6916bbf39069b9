"""Names of tips over time, on trees made from the true axes of creatures: shuffled, bent, with limbs lost and added."""

import pytest
import torch

from torchreg.datasets.creatures import OCTOPUS, STARFISH, creature_sequence
from torchreg.geometry.skeleton import build_skeleton
from torchreg.spines.tip_tracking import has_loops, most_frequent_count, name_tips

FRAMES = 8


@pytest.fixture(scope="module")
def creatures():
    return {form.num_arms: creature_sequence(form, FRAMES, resolution=24) for form in (STARFISH, OCTOPUS)}


def tree(curves, order, extra=None, notes=()):
    """A star whose tips come in the given order; arms left out of it are missing."""
    limbs = [curves[arm].flip(0)[::4] for arm in order]
    if extra is not None:
        limbs.append(torch.stack((extra, curves[0, 0])))
    eye = torch.eye(3)
    rows = [(limb, torch.full((len(limb),), 0.1), eye.expand(len(limb), 3, 3)) for limb in limbs]
    return build_skeleton(rows, [(k, 99) for k in range(len(rows))], notes)


def shuffled(count, seed):
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed)).tolist()


def arms_named(names, orders):
    """Which arm has each name in each frame; -1 for none."""
    return [
        [order[k] if 0 <= k < len(order) else -1 for k in row]
        for row, order in zip(names.index.tolist(), orders, strict=True)
    ]


@pytest.mark.parametrize("count", [5, 8])
def test_every_arm_keeps_its_name(creatures, count):
    curves = creatures[count].curves
    orders = [shuffled(count, frame) for frame in range(FRAMES)]
    names = name_tips([tree(curves[frame], orders[frame]) for frame in range(FRAMES)])
    named = arms_named(names, orders)
    assert all(row == named[0] for row in named)
    assert names.reference == (FRAMES - 1) // 2
    assert float(names.costs.max()) < 0.1


def test_a_lost_arm_is_missing_and_a_new_one_has_no_name(creatures):
    curves = creatures[5].curves
    orders = [shuffled(5, frame) for frame in range(FRAMES)]
    orders[2] = [arm for arm in orders[2] if arm != 3]
    skeletons = [tree(curves[frame], orders[frame]) for frame in range(FRAMES)]
    skeletons[6] = tree(curves[6], orders[6], extra=curves[6, 0, 0] + torch.tensor([0.2, 0.1, 0.6]))
    names = name_tips(skeletons)
    named = arms_named(names, orders)
    full = named[names.reference]
    assert [row for frame, row in enumerate(named) if frame != 2] == [full] * 7
    assert named[2] == [arm if arm != 3 else -1 for arm in full]
    assert int(names.index[6].max()) <= 5


def test_running_time_backwards_names_alike(creatures):
    curves = creatures[5].curves
    orders = [shuffled(5, frame) for frame in range(FRAMES)]
    skeletons = [tree(curves[frame], orders[frame]) for frame in range(FRAMES)]
    there, back = name_tips(skeletons), name_tips(skeletons[::-1])
    first, second = arms_named(there, orders), arms_named(back, orders[::-1])[::-1]
    match = [second[0].index(arm) for arm in first[0]]
    assert all([row[k] for k in match] == other for row, other in zip(second, first, strict=True))


def test_frames_in_which_arms_touch_are_no_references(creatures):
    curves = creatures[5].curves
    notes = [("1 loop(s) cut",) if 1 <= frame <= 5 else () for frame in range(FRAMES)]
    skeletons = [tree(curves[frame], range(5), notes=notes[frame]) for frame in range(FRAMES)]
    assert [has_loops(skeleton) for skeleton in skeletons] == [1 <= frame <= 5 for frame in range(FRAMES)]
    assert name_tips(skeletons).reference == 6


def test_k_is_the_most_frequent_number_or_what_was_asked_for(creatures):
    assert most_frequent_count([5, 4, 5, 6]) == 5
    assert most_frequent_count([4, 5, 4, 5]) == 5
    curves = creatures[5].curves
    skeletons = [tree(curves[frame], range(5)) for frame in range(3)]
    names = name_tips(skeletons, 3)
    assert names.index.shape == (3, 3)
    assert all(row == names.index[0].tolist() for row in names.index.tolist())
    alone = name_tips(skeletons[:1])
    assert alone.index.tolist() == [[0, 1, 2, 3, 4]]
