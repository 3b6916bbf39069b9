"""Placing limbs on data: fingers, arms on a spine, jaws, slides and balls are found; limits and priors hold."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import TIPS, generator, hinge, joint, off, problem_of, shape_of, solid
from torchreg.alignment.search.limb_search import Effort, LimbSearch
from torchreg.alignment.search.multi_start import distinct_first

THOROUGH = Effort(
    num_data=400, width=0.05, beam=80, configurations=30, refine_widths=(0.04, 0.03, 0.025), score_width=0.02,
    combinations=6, exchanged=2,
)  # fmt: skip


def rod(length, radius=0.03):
    """A capsule from the frame's origin along its z."""
    return solid("capsule", (length / 2, radius), 0, 0, length / 2)


def block(*radii):
    return solid("ellipsoid", radii)


# Hands


@pytest.fixture(scope="module")
def hand_limbs(plain_hand):
    return LimbSearch(plain_hand)


@pytest.fixture(scope="module")
def truths(plain_hand):
    """Two hands, turned, every finger bent by its own share of its range."""
    poses = plain_hand.rest_pose().repeat(2, 1)
    shares = 0.6 * torch.rand(2, 21, generator=generator(3))
    poses[:, 6:] = shares * plain_hand.upper[6:].clamp_min(0)
    poses[:, :6] = torch.tensor([[0.0, 0.02, 0.01, 0.3, -0.4, 0.2], [0.01, 0.0, -0.02, -1.4, 0.5, 0.9]])
    return poses


@pytest.fixture(scope="module")
def stretched(truths):
    """The true places of the palm, all fingers stretched."""
    return torch.cat([truths[:, :6], torch.zeros(2, 21)], dim=-1)


@pytest.fixture(scope="module")
def hands(plain_hand_skin, truths, stretched):
    return problem_of(plain_hand_skin, plain_hand_skin(truths), stretched)


@pytest.fixture(scope="module")
def placed(hand_limbs, hands, stretched):
    return hand_limbs(hands, stretched, THOROUGH, generator())


def tip_errors(hand, poses, truths):
    return off(hand, poses, truths)[..., TIPS]


def test_fingers_are_found_on_a_true_palm(plain_hand, placed, truths, stretched):
    assert placed.shape == (2, 6, 27)
    assert float(tip_errors(plain_hand, stretched, truths).mean()) > 0.025
    found = tip_errors(plain_hand, placed[:, 0], truths)
    assert float(found.mean()) < 0.004
    assert float(found.max()) < 0.012


def test_the_trunk_stays_and_all_is_within_the_limits(plain_hand, placed, stretched):
    torch.testing.assert_close(placed[..., :6], stretched[:, None, :6].expand(2, 6, 6), rtol=0, atol=0)
    assert bool(((placed >= plain_hand.lower) & (placed <= plain_hand.upper)).all())


def test_the_best_combination_explains_most(plain_hand, hands, placed):
    """Counted here with a hard threshold, on the surface of the whole hand."""
    explained = plain_hand.distance(hands.data.unsqueeze(1), placed).abs() < 0.004
    counts = explained.sum(-1)
    assert bool((counts[:, 0] >= 0.95 * counts.amax(-1)).all())
    assert bool((counts[:, 0] > 360).all())


def test_a_hidden_finger_stays_near_the_mean_of_the_prior(plain_hand, hand_limbs, hands, truths):
    little = [dof for dof, name in enumerate(plain_hand.dof_names) if name.startswith("little")]
    others = sorted(set(range(6, 27)) - set(little))
    start = truths.clone()
    start[:, little] = torch.tensor([0.0, 0.3, 0.3, 0.3])
    start[:, others] = 0.1
    mean = start.clone()
    hidden = plain_hand.part_distances(hands.data, truths).argmin(-1) >= 13
    assert int(hidden.sum(-1).min()) > 12
    one_sided = problem_of(hands.skin, hands.data, mean, ~hidden)
    found = hand_limbs(one_sided, start, THOROUGH, generator())[:, 0]
    assert float((found - start)[:, little].abs().max()) < 0.4
    assert float(tip_errors(plain_hand, found, truths)[:, :4].mean()) < 0.004


def test_a_batch_is_a_loop(hand_limbs, hands, stretched, placed):
    """All data are drawn, so that the draws do not differ."""
    for row in range(2):
        index = torch.tensor([row])
        single = hand_limbs(hands.rows(index), stretched[index], THOROUGH, generator(row))
        torch.testing.assert_close(single[0, 0], placed[row, 0], rtol=0, atol=2e-3)


def test_data_that_do_not_count_change_nothing(hand_limbs, hands, stretched, placed):
    """Padding where fingers might be, as dense as fingers."""
    padded = replace(
        hands,
        data=torch.cat([hands.data, hands.skin(stretched)[:, :100]], dim=1),
        valid=torch.arange(500).expand(2, 500) < 400,
    )
    found = hand_limbs(padded, stretched, replace(THOROUGH, num_data=500), generator())
    torch.testing.assert_close(found[:, 0], placed[:, 0], rtol=0, atol=2e-3)


# Other shapes


def found_joints(shape, values, effort=THOROUGH, std=None, start=None):
    """Return the joints found from zeros on exact data of the given joints (B, d), and the errors (B,)."""
    skin = tr.sample_skin(shape, 300)
    truths = shape.rest_pose().repeat(len(values), 1)
    truths[:, 6:] = torch.tensor(values)
    starts = shape.rest_pose().repeat(len(values), 1)
    if start is not None:
        starts[:, 6:] = torch.tensor(start)
    problem = problem_of(skin, skin(truths), starts, prior_std=std)
    found = LimbSearch(shape)(problem, starts, effort, generator())
    assert bool(((found >= shape.lower) & (found <= shape.upper)).all())
    return found, (found[:, 0, 6:] - truths[:, 6:]).abs().amax(-1)


def test_limbs_on_limbs_are_found():
    """Two arms with elbows on a spine that bends."""
    names = ["pelvis", "chest", "left", "left_elbow", "right", "right_elbow"]
    joints = [
        joint("pelvis", -1, (0, 0, 0)),
        joint("chest", 0, (0, 0, 0.1), *hinge((0.0, 1.0, 0.0))),
        joint("left", 1, (0.1, 0, 0.4), *hinge()),
        joint("left_elbow", 2, (0, 0, 0.3), *hinge()),
        joint("right", 1, (-0.1, 0, 0.4), *hinge()),
        joint("right_elbow", 4, (0, 0, 0.3), *hinge()),
    ]
    solids = [block(0.15, 0.1, 0.08), rod(0.4, 0.06), *[rod(0.3), rod(0.25)] * 2]
    shape = shape_of(joints, solids, names)
    assert [limb.level for limb in LimbSearch(shape).limbs] == [0, 1, 1]
    _, errors = found_joints(shape, [[0.6, 1.2, 0.9, -1.0, -0.7], [-0.4, -1.4, 0.5, 0.8, 1.1]])
    assert float(errors.max()) < 0.12


def test_a_gripper_is_found_on_an_arm_and_its_jaws_close_as_one():
    """Both jaws slide, one follows: the data of both count for the one degree of freedom."""
    names = ["base", "arm", "jaw", "other", "pad"]
    joints = [
        joint("base", -1, (0, 0, 0)),
        joint("arm", 0, (0, 0, 0.1), *hinge()),
        joint("jaw", 1, (0.02, 0, 0.4), "prismatic", (1.0, 0.0, 0.0), 0.0, 0.15),
        joint("other", 1, (-0.02, 0, 0.4), "prismatic", (1.0, 0.0, 0.0), mimic=(2, -1.0, 0.0)),
        joint("pad", 3, (0, 0, 0.15), "revolute", (1.0, 0.0, 0.0), mimic=(1, 0.5, 0.0)),
    ]
    solids = [block(0.15, 0.1, 0.08), rod(0.35, 0.05), rod(0.15, 0.015), rod(0.1, 0.015), block(0.02, 0.03, 0.04)]
    shape = shape_of(joints, solids, names, nu=0.01)
    search = LimbSearch(shape)
    assert [limb.parts for limb in search.limbs] == [[1], [2]]
    # The pad follows the arm, the jaw that carries it follows the other jaw; both are moved by the first jaw's limb.
    assert [search.parts[limb] for limb in search.limbs] == [[1], [2, 3, 4]]
    found, _ = found_joints(shape, [[0.7, 0.11], [-0.5, 0.03]])
    torch.testing.assert_close(found[:, 0, 6:], torch.tensor([[0.7, 0.11], [-0.5, 0.03]]), rtol=0, atol=0.03)


def arm_with_a_ball():
    """A shoulder that is a ball without limits, and an elbow."""
    joints = [
        joint("body", -1, (0, 0, 0)),
        joint("x", 0, (0, 0, 0.1), "revolute", (1.0, 0.0, 0.0)),
        joint("y", 1, (0, 0, 0), "revolute", (0.0, 1.0, 0.0)),
        joint("z", 2, (0, 0, 0), "revolute", (0.0, 0.0, 1.0)),
        joint("elbow", 3, (0, 0, 0.3), "revolute", (1.0, 0.0, 0.0), 0.0, 2.4),
    ]
    return shape_of(joints, [block(0.15, 0.1, 0.1), rod(0.3), rod(0.25)], ["body", "z", "elbow"])


def test_balls_are_found():
    """By the places of the parts: three angles may say the same turn in two ways."""
    shape = arm_with_a_ball()
    truth = shape.rest_pose().repeat(2, 1)
    truth[:, 6:] = torch.tensor([[0.8, -0.6, 0.5, 1.4], [-0.9, 0.4, -0.3, 0.9]])
    found, _ = found_joints(shape, truth[:, 6:].tolist(), std=1.0)
    end = torch.tensor([0.0, 0.0, 0.25, 1.0])
    places = [(shape.part_transforms(pose)[:, 1:] @ end)[..., :3] for pose in (found[:, 0], truth)]
    assert float((places[0] - places[1]).norm(dim=-1).max()) < 0.03


@pytest.mark.parametrize(
    ("limits", "span"),
    [
        ((), (-math.pi, math.pi)),
        ((0.5,), (0.5, 0.5 + 2 * math.pi)),
        ((-math.inf, 1.0), (1.0 - 2 * math.pi, 1.0)),
        ((-0.2, 0.3), (-0.2, 0.3)),
        ((0.4, 0.4), (0.4, 0.4)),
    ],
)
def test_joints_are_tried_over_their_range_or_one_turn(limits, span):
    joints = [joint("body", -1, (0, 0, 0)), joint("arm", 0, (0, 0, 0.1), "revolute", (1.0, 0, 0), *limits)]
    search = LimbSearch(shape_of(joints, [rod(0.1)] * 2))
    values = search.samples[search.limbs[0].bodies[0]][:, 0]
    assert bool(((values >= span[0] - 1e-5) & (values <= span[1] + 1e-5)).all())
    assert float(values.mean()) == pytest.approx(sum(span) / 2, abs=1e-4)
    step = (span[1] - span[0]) / len(values)
    assert float(values.min()) == pytest.approx(span[0] + step / 2, abs=1e-4)
    assert step <= math.radians(17)


def test_joints_that_turn_freely_are_found_all_around():
    """Far joints too, of which a wide beam can try a part of the samples only."""
    joints = [joint("plate", -1, (0, 0, 0))]
    joints += [
        joint(f"link{number}", number, (0, 0.05, 0.05 if number == 0 else 0.2), "revolute", (0.0, 1.0, 0.0))
        for number in range(3)
    ]
    shape = shape_of(joints, [block(0.15, 0.1, 0.05), *[rod(0.2, 0.02)] * 3])
    wide = replace(THOROUGH, beam=123)
    values = [[2.9, 1.0, 2.6], [-2.8, -1.2, -2.5]]
    _, errors = found_joints(shape, values, wide)
    assert float(errors.max()) < 0.1


def test_a_shape_without_joints_is_left_as_it_is():
    shape = shape_of([joint("stone", -1)], [block(0.1, 0.05, 0.03)])
    search = LimbSearch(shape)
    poses = torch.randn(3, 6, generator=generator())
    problem = problem_of(tr.sample_skin(shape, 50), torch.randn(3, 20, 3, generator=generator()), poses)
    assert search.limbs == []
    torch.testing.assert_close(search(problem, poses, THOROUGH, generator()), poses.unsqueeze(1), rtol=0, atol=0)


# Parts


def test_what_is_close_to_something_better_comes_last():
    values = torch.tensor([[0.0, 0.1, 0.15, 1.0, 0.25, 1.05]])
    close = (values.unsqueeze(2) - values.unsqueeze(1)).abs() < 0.2
    # 0.25 is close to 0.1 and 0.15 only, which are not kept themselves.
    assert distinct_first(close).tolist() == [[0, 3, 4, 1, 2, 5]]
    assert distinct_first(torch.eye(4, dtype=torch.bool).unsqueeze(0)).tolist() == [[0, 1, 2, 3]]
    assert distinct_first(torch.ones(1, 3, 3, dtype=torch.bool)).tolist() == [[0, 1, 2]]
