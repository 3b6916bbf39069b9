"""Tips keep their names: under motion, among strangers, with some missing, and where a creature is symmetric."""

import math

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_exp
from torchreg.spines.tip_matching import TipReference, match_tips


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
    match = match_tips([TipReference(known)], tips)
    assert torch.equal(order[match.index], torch.arange(count))
    assert match.cost < 0.05


@pytest.mark.parametrize("angle", [math.pi, 2.0])
def test_far_turns_are_found_where_nothing_holds_them_back(angle):
    known, order = random(6, 3), shuffled(6, 2)
    turn = so3_exp(torch.tensor([0.0, angle, 0.0], dtype=torch.float64))
    match = match_tips([TipReference(known, turn=0.0)], known[order] @ turn.mT)
    assert torch.equal(order[match.index], torch.arange(6))
    assert match.cost < 1e-9


def test_no_mapping_costs_less_and_scale_and_common_motion_change_nothing():
    known, tips = random(4, 3), random(5, 3, seed=4)
    match = match_tips([TipReference(known)], tips)
    turn = so3_exp(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64))
    moved = match_tips([TipReference(3 * known @ turn.mT + 1)], 3 * tips @ turn.mT - 7)
    assert torch.equal(moved.index, match.index)
    assert moved.cost == pytest.approx(match.cost)


@pytest.mark.parametrize("count", [5, 9])
def test_strangers_are_left_out_and_missing_tips_are_named(count):
    known = random(count, 3, seed=count)
    keep = torch.arange(count) != 2
    strangers = torch.tensor([[6.0, 0.0, 0.0]], dtype=torch.float64)
    tips = torch.cat((strangers, known[keep] + 0.02))
    match = match_tips([TipReference(known)], tips)
    assert match.index.tolist() == [1, 2, -1, *range(3, count)]
    assert match.cost == pytest.approx(0.5 / count, abs=1e-3)


def test_a_symmetric_creature_has_not_turned_in_a_moment():
    known = star(5)
    bent = known + 0.1 * random(5, 3, seed=3)
    order = shuffled(5, 4)
    assert torch.equal(order[match_tips([TipReference(known)], bent[order]).index], torch.arange(5))


def test_lengths_tell_limbs_apart_that_places_do_not():
    known = star(4)
    long = torch.tensor([1.0, 1.3, 1.7, 3.0], dtype=torch.float64)
    lengths = long + long[:, None] - 2 * torch.diag(long)
    order = torch.tensor([3, 0, 1, 2])
    tips = star(4)  # the long limb is curled up, and all have turned by a quarter
    match = match_tips([TipReference(known, lengths, turn=0.0)], tips, lengths[order][:, order])
    assert torch.equal(order[match.index], torch.arange(4))


def test_the_roots_of_limbs_tell_which_end_is_which_where_ends_have_passed_each_other():
    roots = torch.tensor([[-1.0, 0, 0], [1, 0, 0], [0, 0, 4]], dtype=torch.float64)
    before = torch.tensor([[-0.1, -3, 0.8], [0.1, -3, -0.8], [0, 0, 5]], dtype=torch.float64)
    after = torch.tensor([[0.1, -3, -0.8], [-0.1, -3, 0.8], [0, 0, 5]], dtype=torch.float64)
    share = torch.linspace(0, 1, 6, dtype=torch.float64)[:, None]
    known, curves = (tip[:, None] + share * (roots - tip)[:, None] for tip in (before, after))
    assert match_tips([TipReference(known[:, 0])], curves[:, 0]).index.tolist() == [1, 0, 2]
    wide = torch.tensor([3.0, 1.0, 1.0], dtype=torch.float64)
    assert match_tips([TipReference(known * wide)], curves * wide).index.tolist() == [0, 1, 2]


def test_references_are_added_by_their_shares():
    first, second = random(5, 3), random(5, 3, seed=1)
    near = match_tips([TipReference(first), TipReference(second, share=1e-6)], first)
    assert torch.equal(near.index, torch.arange(5))
    other = match_tips([TipReference(first, share=1e-6), TipReference(second[shuffled(5, 1)])], second)
    assert torch.equal(other.index, shuffled(5, 1))


def test_no_tips_at_all_and_tips_in_one_place_are_answered():
    known = random(4, 3)
    assert match_tips([TipReference(known)], torch.zeros(0, 3)).index.tolist() == [-1] * 4
    assert match_tips([TipReference(torch.zeros(3, 3))], torch.zeros(3, 3)).cost == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: match_tips([], torch.zeros(3, 3)), "references must hold"),
        (lambda: match_tips([TipReference(torch.zeros(3, 2))], torch.zeros(3, 3)), r"references\[0\].tips must have"),
        (
            lambda: match_tips([TipReference(torch.zeros(3, 3)), TipReference(torch.zeros(4, 3))], torch.zeros(3, 3)),
            "same number of tips",
        ),
        (lambda: match_tips([TipReference(torch.zeros(3, 3))], torch.zeros(3)), "tips must have shape"),
        (lambda: match_tips([TipReference(torch.zeros(3, 3))], torch.zeros(3, 2, 3)), "as many points each"),
        (lambda: match_tips([TipReference(torch.eye(3))], torch.eye(3), torch.zeros(2, 2)), "lengths must have shape"),
        (lambda: match_tips([TipReference(torch.eye(3))], torch.eye(3), missing=0.0), "missing must be positive"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(InputError, match=message):
        call()
