"""Tips keep their names: under motion, with some missing or added, where a creature is symmetric, and over time."""

import pytest
import torch

from tests.spines.bodies import arms_skeleton, circle, random, shuffled, similarity
from torchreg.datasets.creatures import OCTOPUS, STARFISH, creature_sequence
from torchreg.geometry.rotation import so3_exp
from torchreg.spines.names import tip_tracking
from torchreg.spines.names.tip_matching import TipReference, rank_mappings

FRAMES = 8


def match(references, tips, lengths=None):
    """Return the best mapping (K,) and its cost."""
    maps, costs = rank_mappings(references, tips, lengths)
    return maps[0], float(costs[0])


def star(count):
    return circle(count=count + 1)[:-1]


@pytest.mark.parametrize(
    ("count", "turn", "noise"),
    [(3, [0.3, -0.2, 0.4], 0.05), (5, [0.3, -0.2, 0.4], 0.05), (9, [0.3, -0.2, 0.4], 0.05),
     (12, [0.3, -0.2, 0.4], 0.05), (6, [0.0, torch.pi, 0.0], 0.0), (6, [0.0, 2.0, 0.0], 0.0)],
)  # fmt: skip
def test_tips_are_found_again_after_a_motion(count, turn, noise):
    known, order = random(count, 3, seed=count), shuffled(count, 1)
    tips = (known + noise * random(count, 3, seed=9))[order] @ so3_exp(torch.tensor(turn).double()).mT + 5
    index, cost = match([TipReference(known)], tips)
    assert torch.equal(order[index], torch.arange(count))
    assert cost < (0.05 if noise else 1e-9)


def test_mappings_are_ranked_and_scale_and_common_motion_change_nothing():
    known, tips = random(4, 3), random(5, 3, seed=4)
    maps, costs = rank_mappings([TipReference(known)], tips)
    turn = so3_exp(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64))
    moved, moved_costs = rank_mappings([TipReference(3 * known @ turn.mT + 1)], 3 * tips @ turn.mT - 7)
    assert bool((costs[1:] >= costs[:-1]).all())
    assert torch.equal(moved[0], maps[0])
    torch.testing.assert_close(moved_costs, costs)
    # No tips at all, and tips in one place.
    assert match([TipReference(known)], torch.zeros(0, 3))[0].tolist() == [-1] * 4
    assert match([TipReference(torch.zeros(3, 3))], torch.zeros(3, 3))[1] == pytest.approx(0.0)


@pytest.mark.parametrize("count", [5, 9])
def test_added_tips_are_left_out_and_missing_ones_are_named(count):
    known = random(count, 3, seed=count)
    tips = torch.cat((torch.tensor([[6.0, 0, 0]]).double(), known[torch.arange(count) != 2] + 0.02))
    index, cost = match([TipReference(known)], tips)
    assert index.tolist() == [1, 2, -1, *range(3, count)]
    assert cost == pytest.approx(0.5 / count, abs=1e-3)


def test_references_count_by_their_weights():
    first, second, order = random(5, 3), random(5, 3, seed=1), shuffled(5, 1)
    near, _ = match([TipReference(first), TipReference(second, weight=1e-6)], first)
    assert torch.equal(near, torch.arange(5))
    far, _ = match([TipReference(first, weight=1e-6), TipReference(second[order])], second)
    assert torch.equal(far, order)


def test_a_symmetric_creature_has_not_turned_in_a_moment():
    order, bent = shuffled(5, 4), star(5) + 0.1 * random(5, 3, seed=3)
    index, _ = match([TipReference(star(5), rotation_weight=0.1)], bent[order])
    assert torch.equal(order[index], torch.arange(5))


def test_lengths_tell_limbs_apart_that_positions_do_not():
    long = torch.tensor([1.0, 1.3, 1.7, 3.0], dtype=torch.float64)
    lengths = long + long[:, None] - 2 * torch.diag(long)
    order = torch.tensor([3, 0, 1, 2])  # the long limb is curled up, and all have turned by a quarter
    index, _ = match([TipReference(star(4), lengths)], star(4), lengths[order][:, order])
    assert torch.equal(order[index], torch.arange(4))


@pytest.fixture(scope="module")
def creatures():
    return {form.num_arms: creature_sequence(form, FRAMES, resolution=20) for form in (STARFISH, OCTOPUS)}


def tracked_arms(skeletons, orders):
    """Which arm has each label in each frame, -1 for none; and the reference."""
    names = tip_tracking.track_tips(skeletons)
    rows = zip(names.labels.tolist(), orders, strict=True)
    return [[order[k] if 0 <= k < len(order) else -1 for k in row] for row, order in rows], names.reference


@pytest.mark.parametrize("count", [5, 8])
def test_every_arm_keeps_its_name_also_backwards_in_time(creatures, count):
    orders = [shuffled(count, frame).tolist() for frame in range(FRAMES)]
    skeletons = [arms_skeleton(creatures[count], frame, orders[frame]) for frame in range(FRAMES)]
    arms, reference = tracked_arms(skeletons, orders)
    assert reference == (FRAMES - 1) // 2
    for rows in (arms, tracked_arms(skeletons[::-1], orders[::-1])[0]):
        assert all(row == rows[0] for row in rows)
        assert sorted(rows[0]) == list(range(count))


def test_a_lost_arm_is_missing_a_new_one_has_no_name_and_frames_in_which_arms_touch_are_no_references(creatures):
    sequence = creatures[5]
    orders = [shuffled(5, frame).tolist() for frame in range(FRAMES)]
    orders[2] = [arm for arm in orders[2] if arm != 3]
    skeletons = [arms_skeleton(sequence, frame, orders[frame]) for frame in range(FRAMES)]
    extra = sequence.curves[6, 0, 0] + torch.tensor([0.2, 0.1, 0.6])
    skeletons[6] = arms_skeleton(sequence, 6, orders[6], extra=extra)
    arms, reference = tracked_arms(skeletons, orders)
    full = arms[reference]
    assert sorted(full) == list(range(5))
    assert arms == [[arm if frame != 2 or arm != 3 else -1 for arm in full] for frame in range(FRAMES)]
    notes = [("1 loop(s) cut",) if 1 <= frame <= 5 else () for frame in range(FRAMES)]
    touching = [arms_skeleton(sequence, frame, notes=notes[frame]) for frame in range(FRAMES)]
    assert tip_tracking.track_tips(touching).reference == 6


def test_k_is_the_most_frequent_number_or_what_was_asked_for(creatures):
    assert [tip_tracking.most_frequent_count(row) for row in ([5, 4, 5, 6], [4, 5, 4, 5])] == [5, 5]
    skeletons = [arms_skeleton(creatures[5], frame) for frame in range(3)]
    labels = tip_tracking.track_tips(skeletons, 3).labels
    assert labels.shape == (3, 3)
    assert bool((labels == labels[0]).all())
    assert tip_tracking.track_tips(skeletons[:1]).labels.tolist() == [[0, 1, 2, 3, 4]]


@pytest.mark.parametrize("seed", range(4))
def test_eight_arms_in_any_order_are_named_by_a_prior_in_another_pose(creatures, seed):
    orders = torch.stack([shuffled(8, 10 * seed + frame) for frame in range(7)])
    skeletons = [arms_skeleton(creatures[8], frame, orders[frame]) for frame in range(6)]
    prior = arms_skeleton(creatures[8], 0, orders[6]).transformed(similarity(seed))
    labels = tip_tracking.track_tips(skeletons[1:], prior=prior).labels
    assert torch.equal(orders[1:6].gather(1, labels), orders[6].expand(5, 8))
