"""Tips keep their names: under motion, with some missing or added, where a creature is symmetric, and over time."""

import math

import pytest
import torch

from torchreg.datasets.creatures import OCTOPUS, STARFISH, creature_sequence
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.skeleton import build_skeleton
from torchreg.spines.names.tip_matching import TipReference, rank_mappings
from torchreg.spines.names.tip_tracking import has_loops, most_frequent_count, track_tips

FRAMES = 8


def match(references, tips, lengths=None):
    """Return the best mapping (K,) and its cost."""
    maps, costs = rank_mappings(references, tips, lengths)
    return maps[0], float(costs[0])


def random(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def shuffled(count, seed):
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))


def star(count):
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    return torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)


@pytest.mark.parametrize("count", [3, 5, 6, 9, 12])
def test_tips_are_found_again_after_a_motion(count):
    known, order = random(count, 3, seed=count), shuffled(count, 1)
    turn = so3_exp(torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64))
    tips = (known + 0.05 * random(count, 3, seed=9))[order] @ turn.mT + 5
    index, cost = match([TipReference(known)], tips)
    assert torch.equal(order[index], torch.arange(count))
    assert cost < 0.05


@pytest.mark.parametrize("angle", [math.pi, 2.0])
def test_far_turns_are_found_where_nothing_holds_them_back(angle):
    known, order = random(6, 3), shuffled(6, 2)
    turn = so3_exp(torch.tensor([0.0, angle, 0.0], dtype=torch.float64))
    index, cost = match([TipReference(known)], known[order] @ turn.mT)
    assert torch.equal(order[index], torch.arange(6))
    assert cost < 1e-9


def test_no_mapping_costs_less_and_scale_and_common_motion_change_nothing():
    known, tips = random(4, 3), random(5, 3, seed=4)
    maps, costs = rank_mappings([TipReference(known)], tips)
    turn = so3_exp(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64))
    moved, moved_costs = rank_mappings([TipReference(3 * known @ turn.mT + 1)], 3 * tips @ turn.mT - 7)
    assert bool((costs[1:] >= costs[:-1]).all())
    assert torch.equal(moved[0], maps[0])
    torch.testing.assert_close(moved_costs, costs)


@pytest.mark.parametrize("count", [5, 9])
def test_added_tips_are_left_out_and_missing_ones_are_named(count):
    known = random(count, 3, seed=count)
    keep = torch.arange(count) != 2
    added = torch.tensor([[6.0, 0.0, 0.0]], dtype=torch.float64)
    tips = torch.cat((added, known[keep] + 0.02))
    index, cost = match([TipReference(known)], tips)
    assert index.tolist() == [1, 2, -1, *range(3, count)]
    assert cost == pytest.approx(0.5 / count, abs=1e-3)


def test_a_symmetric_creature_has_not_turned_in_a_moment():
    known = star(5)
    bent = known + 0.1 * random(5, 3, seed=3)
    order = shuffled(5, 4)
    index, _ = match([TipReference(known, rotation_weight=0.1)], bent[order])
    assert torch.equal(order[index], torch.arange(5))


def test_lengths_tell_limbs_apart_that_positions_do_not():
    known = star(4)
    long = torch.tensor([1.0, 1.3, 1.7, 3.0], dtype=torch.float64)
    lengths = long + long[:, None] - 2 * torch.diag(long)
    order = torch.tensor([3, 0, 1, 2])
    tips = star(4)  # the long limb is curled up, and all have turned by a quarter
    index, _ = match([TipReference(known, lengths)], tips, lengths[order][:, order])
    assert torch.equal(order[index], torch.arange(4))


def test_the_roots_of_limbs_tell_which_end_is_which_where_ends_have_passed_each_other():
    roots = torch.tensor([[-1.0, 0, 0], [1, 0, 0], [0, 0, 4]], dtype=torch.float64)
    before = torch.tensor([[-0.1, -3, 0.8], [0.1, -3, -0.8], [0, 0, 5]], dtype=torch.float64)
    after = torch.tensor([[0.1, -3, -0.8], [-0.1, -3, 0.8], [0, 0, 5]], dtype=torch.float64)
    share = torch.linspace(0, 1, 6, dtype=torch.float64)[:, None]
    known, curves = (tip[:, None] + share * (roots - tip)[:, None] for tip in (before, after))
    assert match([TipReference(known[:, 0], rotation_weight=0.1)], curves[:, 0])[0].tolist() == [1, 0, 2]
    wide = torch.tensor([3.0, 1.0, 1.0], dtype=torch.float64)
    assert match([TipReference(known * wide, rotation_weight=0.1)], curves * wide)[0].tolist() == [0, 1, 2]


def test_references_count_by_their_weights():
    first, second = random(5, 3), random(5, 3, seed=1)
    near, _ = match([TipReference(first), TipReference(second, weight=1e-6)], first)
    assert torch.equal(near, torch.arange(5))
    far, _ = match([TipReference(first, weight=1e-6), TipReference(second[shuffled(5, 1)])], second)
    assert torch.equal(far, shuffled(5, 1))


def test_no_tips_at_all_and_tips_in_one_place_are_answered():
    known = random(4, 3)
    assert match([TipReference(known)], torch.zeros(0, 3))[0].tolist() == [-1] * 4
    assert match([TipReference(torch.zeros(3, 3))], torch.zeros(3, 3))[1] == pytest.approx(0.0)


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


def tracked_arms(skeletons, orders):
    """Which arm has each label in each frame, -1 for none; and the reference."""
    names = track_tips(skeletons)
    arms = [
        [order[k] if 0 <= k < len(order) else -1 for k in row]
        for row, order in zip(names.labels.tolist(), orders, strict=True)
    ]
    return arms, names.reference


@pytest.mark.parametrize("count", [5, 8])
def test_every_arm_keeps_its_name(creatures, count):
    curves = creatures[count].curves
    orders = [shuffled(count, frame).tolist() for frame in range(FRAMES)]
    arms, reference = tracked_arms([tree(curves[frame], orders[frame]) for frame in range(FRAMES)], orders)
    assert all(row == arms[0] for row in arms)
    assert sorted(arms[0]) == list(range(count))
    assert reference == (FRAMES - 1) // 2


def test_a_lost_arm_is_missing_and_a_new_one_has_no_name(creatures):
    curves = creatures[5].curves
    orders = [shuffled(5, frame).tolist() for frame in range(FRAMES)]
    orders[2] = [arm for arm in orders[2] if arm != 3]
    skeletons = [tree(curves[frame], orders[frame]) for frame in range(FRAMES)]
    skeletons[6] = tree(curves[6], orders[6], extra=curves[6, 0, 0] + torch.tensor([0.2, 0.1, 0.6]))
    arms, reference = tracked_arms(skeletons, orders)
    full = arms[reference]
    assert sorted(full) == list(range(5))
    assert [row for frame, row in enumerate(arms) if frame != 2] == [full] * 7
    assert arms[2] == [arm if arm != 3 else -1 for arm in full]


def test_time_may_run_backwards(creatures):
    curves = creatures[5].curves
    orders = [shuffled(5, frame).tolist() for frame in range(FRAMES)]
    skeletons = [tree(curves[frame], orders[frame]) for frame in range(FRAMES)]
    forward, _ = tracked_arms(skeletons, orders)
    backward, _ = tracked_arms(skeletons[::-1], orders[::-1])
    match = [backward[-1].index(arm) for arm in forward[0]]
    assert [[row[k] for k in match] for row in backward[::-1]] == forward


def test_frames_in_which_arms_touch_are_no_references(creatures):
    curves = creatures[5].curves
    notes = [("1 loop(s) cut",) if 1 <= frame <= 5 else () for frame in range(FRAMES)]
    skeletons = [tree(curves[frame], range(5), notes=notes[frame]) for frame in range(FRAMES)]
    assert [has_loops(skeleton) for skeleton in skeletons] == [1 <= frame <= 5 for frame in range(FRAMES)]
    assert track_tips(skeletons).reference == 6


def test_k_is_the_most_frequent_number_or_what_was_asked_for(creatures):
    assert most_frequent_count([5, 4, 5, 6]) == 5
    assert most_frequent_count([4, 5, 4, 5]) == 5
    curves = creatures[5].curves
    skeletons = [tree(curves[frame], range(5)) for frame in range(3)]
    labels = track_tips(skeletons, 3).labels
    assert labels.shape == (3, 3)
    assert all(row == labels[0].tolist() for row in labels.tolist())
    assert track_tips(skeletons[:1]).labels.tolist() == [[0, 1, 2, 3, 4]]
