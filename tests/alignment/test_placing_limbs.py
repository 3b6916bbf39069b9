"""Placing limbs on data, the base known: fingers, arms on a spine, jaws, slides and balls are found; limits hold."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import TIPS, hinge, joint, off, problem_of, shape_of, solid
from torchreg.alignment.evidence.confidence import explained_alone
from torchreg.alignment.search.limb_search import trunk_turns
from torchreg.geometry.rotation import so3_log

ONE = tr.FindPoseConfig(num_candidates=1, num_placed=1, num_searched=1, search_rounds=1)


def rod(length, radius=0.03):
    """A capsule from the frame's origin along its z."""
    return solid("capsule", (length / 2, radius), 0, 0, length / 2)


def block(*radii):
    return solid("ellipsoid", radii)


def placed(shape, data, mean, std=2.0, **options):
    """Return the poses found where the base is known and the joints are as in a mean, more or less."""
    sources = [lambda problem, _: problem.prior.mean.unsqueeze(1)]
    known = {"locked": "base", "prior": (mean, torch.full((shape.num_dofs,), std))}
    found = tr.find_pose(shape, data, sources=sources, config=ONE, **known, **options).best
    torch.testing.assert_close(found[..., :6], mean[..., :6], rtol=0, atol=1e-6)
    assert bool(((found >= shape.lower) & (found <= shape.upper)).all())
    return found


@pytest.fixture(scope="module")
def truths(plain_hand):
    """Two hands, turned, every finger bent by its own share of its range."""
    poses = plain_hand.rest_pose().repeat(2, 1)
    shares = 0.6 * torch.rand(2, 21, generator=torch.Generator().manual_seed(3))
    poses[:, 6:] = shares * plain_hand.upper[6:].clamp_min(0)
    poses[:, :6] = torch.tensor([[0.0, 0.02, 0.01, 0.3, -0.4, 0.2], [0.01, 0.0, -0.02, -1.4, 0.5, 0.9]])
    return poses


@pytest.fixture(scope="module")
def stretched(truths):
    """The true places of the palm, all fingers stretched."""
    return torch.cat([truths[:, :6], torch.zeros(2, 21)], dim=-1)


@pytest.fixture(scope="module")
def hands(plain_hand, plain_hand_skin, truths, stretched):
    """The exact data of both hands, and what is found in them."""
    data = plain_hand_skin(truths)
    return data, placed(plain_hand, data, stretched, 1.0, model_points=plain_hand_skin)


def test_fingers_are_found_on_a_true_palm(plain_hand, hands, truths, stretched):
    assert float(off(plain_hand, stretched, truths)[:, TIPS].mean()) > 0.025
    found = off(plain_hand, hands[1], truths)[:, TIPS]
    assert float(found.mean()) < 0.002
    assert float(found.max()) < 0.006


def test_a_hidden_finger_stays_near_the_mean_of_the_prior(plain_hand, plain_hand_skin, hands, truths):
    is_little = torch.tensor([name.startswith("little") for name in plain_hand.dof_names])
    start = torch.where(torch.arange(27) < 6, truths, torch.where(is_little, 0.3, 0.1))
    hidden = plain_hand.part_distances(hands[0], truths).argmin(-1) >= 13
    assert int(hidden.sum(-1).min()) > 12
    found = placed(plain_hand, hands[0], start, 0.4, mask=~hidden, model_points=plain_hand_skin)
    assert float((found - start)[:, is_little].abs().max()) < 0.4
    assert float(off(plain_hand, found, truths)[:, TIPS[:4]].mean()) < 0.004


FREE_ARM = [joint("plate", -1), *[joint(str(k), k, (0, 0.05, 0.2 if k else 0.05), "revolute", (0.0, 1.0, 0.0))
                                  for k in range(3)]]  # fmt: skip
SHAPES = {
    # Two arms with elbows on a spine that bends.
    "limbs on limbs": (
        [
            joint("pelvis", -1), joint("chest", 0, (0, 0, 0.1), *hinge((0.0, 1.0, 0.0))),
            joint("left", 1, (0.1, 0, 0.4), *hinge()), joint("left_elbow", 2, (0, 0, 0.3), *hinge()),
            joint("right", 1, (-0.1, 0, 0.4), *hinge()), joint("right_elbow", 4, (0, 0, 0.3), *hinge()),
        ],
        [block(0.15, 0.1, 0.08), rod(0.4, 0.06), *[rod(0.3), rod(0.25)] * 2], None,
        [[0.6, 1.2, 0.9, -1.0, -0.7], [-0.4, -1.4, 0.5, 0.8, 1.1]],
    ),
    # Both jaws slide, one follows, with a pad that follows the arm: the data of all count.
    "gripper": (
        [
            joint("base", -1), joint("arm", 0, (0, 0, 0.1), *hinge()),
            joint("jaw", 1, (0.02, 0, 0.4), "prismatic", (1.0, 0.0, 0.0), 0.0, 0.15),
            joint("other", 1, (-0.02, 0, 0.4), "prismatic", (1.0, 0.0, 0.0), mimic=(2, -1.0, 0.0)),
            joint("pad", 3, (0, 0, 0.15), "revolute", (1.0, 0.0, 0.0), mimic=(1, 0.5, 0.0)),
        ],
        [block(0.15, 0.1, 0.08), rod(0.35, 0.05), rod(0.15, 0.015), rod(0.1, 0.015), block(0.02, 0.03, 0.04)], None,
        [[0.7, 0.11], [-0.5, 0.03]],
    ),
    # A shoulder that is a ball without limits, and an elbow.
    "ball": (
        [
            joint("body", -1), joint("x", 0, (0, 0, 0.1), "revolute", (1.0, 0.0, 0.0)),
            joint("y", 1, (0, 0, 0), "revolute", (0.0, 1.0, 0.0)),
            joint("z", 2, (0, 0, 0), "revolute", (0.0, 0.0, 1.0)),
            joint("elbow", 3, (0, 0, 0.3), "revolute", (1.0, 0.0, 0.0), 0.0, 2.4),
        ],
        [block(0.15, 0.1, 0.1), rod(0.3), rod(0.25)], ["body", "z", "elbow"],
        [[0.8, -0.6, 0.5, 1.4], [-0.9, 0.4, -0.3, 0.9]],
    ),
    # Joints that turn freely, far ones too.
    "free": (FREE_ARM, [block(0.15, 0.1, 0.05), *[rod(0.2, 0.02)] * 3], None, [[2.9, 1.0, 2.6], [-2.8, -1.2, -2.5]]),
    "stone": ([joint("stone", -1)], [block(0.1, 0.05, 0.03)], None, [[], []]),
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_the_joints_of_any_shape_are_found_from_zeros(name):
    joints, solids, frames, values = SHAPES[name]
    shape = shape_of(joints, solids, frames)
    start, skin = shape.rest_pose().repeat(2, 1), tr.sample_skin(shape, 300)
    truths = start.clone()
    truths[:, 6:] = torch.tensor(values)
    found = placed(shape, skin(truths), start, model_points=skin)
    # By the places of the points: three angles of a ball may say the same turn in two ways.
    assert float((skin(found) - skin(truths)).norm(dim=-1).max()) < 0.02


@pytest.mark.parametrize("limits", [(), (0.5,), (-math.inf, 1.0), (-0.2, 0.3), (0.4, 0.4)])
def test_joints_are_tried_over_their_range_or_one_turn(limits):
    """Also where a fit from afar finds nothing, near both ends."""
    joints = [joint("body", -1), joint("arm", 0, (0, 0, 0.1), "revolute", (1.0, 0, 0), *limits)]
    shape = shape_of(joints, [block(0.1, 0.05, 0.03), rod(0.3)])
    skin, bounds = tr.sample_skin(shape, 200), shape.lower[6:].tolist() + shape.upper[6:].tolist()
    low = bounds[0] if math.isfinite(bounds[0]) else bounds[1] - math.tau if math.isfinite(bounds[1]) else -math.pi
    high = bounds[1] if math.isfinite(bounds[1]) else low + math.tau
    truths = shape.rest_pose().repeat(3, 1)
    truths[:, 6] = torch.tensor([low, 0.5 * (low + high), high]) + 0.2 * (high - low) * torch.tensor([1.0, 0, -1])
    start = shape.clamp(shape.rest_pose()).repeat(3, 1)
    found = placed(shape, skin(truths), start, model_points=skin)
    torch.testing.assert_close(found[:, 6].sin(), truths[:, 6].sin(), rtol=0, atol=0.02)
    torch.testing.assert_close(found[:, 6].cos(), truths[:, 6].cos(), rtol=0, atol=0.02)


def problem_on(shape, pose):
    """A problem of one point, of which the turns of a trunk do not depend."""
    return problem_of(tr.sample_skin(shape, 20), torch.zeros(len(pose), 1, 3), pose)


def test_a_trunk_turns_on_the_limb_that_it_hangs_on_and_all_else_stays():
    shape = shape_of(FREE_ARM, [block(0.1, 0.08, 0.03), rod(0.2), rod(0.2), rod(0.2)])
    pose = shape.rest_pose().repeat(2, 1)
    pose[:, :6] = torch.tensor([[0.3, -0.2, 0.1, 0.4, -1.0, 0.7], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    pose[:, 6:] = torch.tensor([[0.3, -0.2, 0.5], [1.0, 0.2, 0.0]])
    turned = trunk_turns(problem_on(shape, pose), pose)
    assert turned.shape[1] > 8
    before, after = shape.part_transforms(pose).unsqueeze(1), shape.part_transforms(turned)
    torch.testing.assert_close(after[:, :, 1:], before[:, :, 1:].expand_as(after[:, :, 1:]), rtol=0, atol=1e-5)
    # The trunk goes round the hinge as far as the joint turns back.
    turn = so3_log((before[:, :, 0, :3, :3].mT @ after[:, :, 0, :3, :3]).flatten(0, 1)).norm(dim=-1)
    expected = (turned[..., 6] - pose[:, None, 6]).abs().flatten()
    torch.testing.assert_close(turn, torch.minimum(expected, 2 * math.pi - expected), rtol=0, atol=1e-3)
    torch.testing.assert_close(turned[..., 7:], pose[:, None, 7:].expand_as(turned[..., 7:]), rtol=0, atol=0)
    torch.testing.assert_close(trunk_turns(problem_on(shape, pose[1:]), pose[1:]), turned[1:], rtol=0, atol=1e-6)


def test_a_trunk_with_several_limbs_or_known_does_not_turn(plain_hand):
    shape = shape_of(FREE_ARM, [block(0.1, 0.08, 0.03), rod(0.2), rod(0.2), rod(0.2)])
    pose = shape.rest_pose()[None]
    told = torch.zeros_like(pose)
    told[:, 2] = 1.0
    assert trunk_turns(replace(problem_on(shape, pose), prior_precision=told), pose).shape[1] == 0
    rest = plain_hand.rest_pose()[None]
    assert trunk_turns(problem_on(plain_hand, rest), rest).shape[1] == 0


def test_few_data_tell_of_a_trunk_alone():
    """Of samples of a surface its own count, but those beside another part; the whole is told by all."""
    shape = shape_of(FREE_ARM, [block(0.1, 0.08, 0.03), rod(0.2), rod(0.2), rod(0.2)])
    skin, pose = tr.sample_skin(shape, 600), shape.rest_pose()[None]
    pose[:, 6:] = torch.tensor([0.3, -0.6, 0.9])
    problem, part = problem_of(skin, skin(pose), pose), skin.weights.argmax(-1)
    told = explained_alone(problem, pose, [(0,), (3,), (0, 1, 2, 3)])[0]
    for count, number in zip(told[:2], (0, 3), strict=True):
        assert 0.6 < float(count) / int((part == number).sum()) < 1.05
    assert float(told[2]) == pytest.approx(600, rel=0.05)
