"""How surely poses are right: rivals, data beside the surface, limbs that no data show, ends known by covariance."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.alignment.confidence import beside_share, is_misfit, known_ends, limb_ends, pose_confidence
from torchreg.alignment.problem import centered_problem
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.primitives import Primitive

TIPS = [4, 8, 12, 16, 20]
SURE = torch.tensor([1e6])


@pytest.fixture(scope="module")
def truth(plain_hand):
    pose = plain_hand.rest_pose()
    pose[3:6], pose[6:] = torch.tensor([2.9, 0.3, -0.4]), 0.2 * plain_hand.upper[6:].clamp_min(0)
    return pose.unsqueeze(0)


@pytest.fixture(scope="module")
def problem(plain_hand, plain_hand_skin, truth):
    """The skin's own points with 1 mm of noise."""
    points = tr.sample_skin(plain_hand, 500, seed=3)(truth)
    return problem_of(plain_hand_skin, noisy(points), truth)


def noisy(points):
    return points + 0.001 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0)).to(points)


def problem_of(skin, points, pose, prior_std=0.4):
    valid = torch.ones_like(points[..., 0], dtype=torch.bool)
    return centered_problem(
        skin, points, valid, pose, torch.zeros_like(points[:, 0]), prior_std=prior_std, pose_atol=0.0
    )


def without(hand, problem, pose, fingers):
    """Return the problem without the data of some fingers."""
    parts = hand.part_distances(problem.data, pose).argmin(-1)
    hidden = torch.tensor([part for tip in fingers for part in (tip - 2, tip - 1, tip)], dtype=torch.long)
    return replace(problem, valid=~torch.isin(parts, hidden))


def test_limbs_that_no_data_show_make_unsure(plain_hand, problem, truth):
    """The more fingers are without data, the less is known of where they end."""
    tips = plain_hand.fingertip_parts
    told = [
        float(pose_confidence(without(plain_hand, problem, truth, tips[:count]), truth, SURE)) for count in (0, 1, 2, 3)
    ]
    assert told[0] > 0.9
    assert told[1] < 0.8
    assert told[2] < 0.5
    assert told == sorted(told, reverse=True)


def test_a_near_rival_makes_unsure(problem, truth):
    leads = torch.tensor([0.0, 1.0, 4.0, 20.0])
    told = torch.cat([pose_confidence(problem, truth, lead[None]) for lead in leads])
    assert told[0] == 0
    assert bool((told.diff() > 0).all())
    torch.testing.assert_close(told[2], told[3] * (1 - torch.tensor(-1.0).exp()), rtol=0.02, atol=0)


def test_data_beside_the_surface_are_a_misfit(plain_hand, problem, truth):
    assert not bool(is_misfit(problem, truth))
    assert float(beside_share(problem, truth)) < 0.015
    wrong = truth.clone()
    wrong[:, 6:] += 0.25
    assert bool(is_misfit(problem, wrong))
    assert float(beside_share(problem, wrong)) > 0.03
    # Far outliers, as many, are none.
    far = problem.data.clone()
    far[:, ::10] += 0.3
    assert not bool(is_misfit(replace(problem, data=far), truth))
    assert float(pose_confidence(problem, wrong, SURE)) < 0.75 * float(pose_confidence(problem, truth, SURE))


def test_ends_are_known_as_well_as_posteriors_say(plain_hand, plain_hand_skin, problem, truth):
    """Of fits to other noise the ends scatter as the covariance says: within a factor, by drawing."""
    shown = without(plain_hand, problem, truth, plain_hand.fingertip_parts[:1])
    assert float(known_ends(shown, truth)) < float(known_ends(problem, truth))
    # A tighter prior knows more of what is hidden.
    tight = replace(shown, prior=replace(shown.prior, precision=100 * shown.prior.precision))
    assert float(known_ends(tight, truth)) > 0.95


def test_hidden_ends_spread_as_the_prior_does():
    """One hinge without data: its end lies within the tolerance as often as in draws from the prior."""
    tree = KinematicTree((
        Joint("body", -1, torch.eye(4, dtype=torch.float64)),
        Joint("arm", 0, torch.eye(4, dtype=torch.float64), "revolute", (1.0, 0.0, 0.0), -1.5, 1.5),
    ))  # fmt: skip
    far = torch.eye(4, dtype=torch.float64)
    far[2, 3] = 0.15
    solids = [
        Primitive("ellipsoid", (0.05, 0.03, 0.06), torch.eye(4, dtype=torch.float64)),
        Primitive("ellipsoid", (0.01, 0.01, 0.05), far),
    ]
    shape = tr.ArticulatedShape(tree, ["body", "arm"], solids, nu=0.004).requires_grad_(False)
    skin, pose = tr.sample_skin(shape, 300), shape.rest_pose().unsqueeze(0)
    points = skin(pose)[:, skin.weights.argmax(-1) == 0]
    std = 0.05
    problem = problem_of(skin, points, pose, prior_std=std)
    (end,) = limb_ends(skin).tolist()
    lever = float(skin.points[end, 1:].norm())
    expected = 1 - torch.exp(-(torch.tensor(0.04 * problem.size / (lever * std)) ** 2))
    torch.testing.assert_close(known_ends(problem, pose), expected[None], rtol=0.1, atol=0)


def test_clouds_of_a_batch_and_padding_change_nothing(plain_hand, problem, truth):
    index = torch.tensor([0, 0])
    both = problem.rows(index)
    both.valid[1, 200:] = False
    poses = truth.expand(2, -1)
    alone = replace(problem, data=problem.data[:, :200], valid=problem.valid[:, :200])
    together = pose_confidence(both, poses, SURE.expand(2))
    torch.testing.assert_close(together[:1], pose_confidence(problem, truth, SURE), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(together[1:], pose_confidence(alone, truth, SURE), rtol=1e-4, atol=1e-6)
