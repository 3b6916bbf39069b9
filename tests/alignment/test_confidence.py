"""The confidence in poses: rivals, near outliers, limbs without data, ends known by the covariance."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import generator, joint, problem_of, shape_of, solid
from torchreg.alignment.evidence.confidence import is_misfit, known_ends, pose_confidence

SURE = torch.tensor([1e6])


@pytest.fixture(scope="module")
def pose(plain_hand):
    pose = plain_hand.rest_pose()
    pose[3:6], pose[6:] = torch.tensor([2.9, 0.3, -0.4]), 0.2 * plain_hand.upper[6:].clamp_min(0)
    return pose.unsqueeze(0)


@pytest.fixture(scope="module")
def problem(plain_hand, plain_hand_skin, pose):
    """Points of the skin with 1 mm of noise."""
    points = tr.sample_skin(plain_hand, 500, seed=3)(pose)
    return problem_of(plain_hand_skin, points + 0.001 * torch.randn(points.shape, generator=generator()), pose)


def without(hand, problem, pose, fingers):
    """Return the problem without the data of some fingers."""
    parts = hand.part_distances(problem.data, pose).argmin(-1)
    hidden = torch.tensor([part for tip in fingers for part in (tip - 2, tip - 1, tip)], dtype=torch.long)
    return replace(problem, valid=~torch.isin(parts, hidden))


def test_the_more_fingers_are_without_data_the_lower_is_the_confidence(plain_hand, problem, pose):
    tips = plain_hand.fingertip_parts
    found = [float(pose_confidence(without(plain_hand, problem, pose, tips[:count]), pose, SURE)) for count in range(4)]
    assert found[0] > 0.9
    assert found[1] < 0.8
    assert found[2] < 0.5
    assert found == sorted(found, reverse=True)
    shown = without(plain_hand, problem, pose, tips[:1])
    assert float(known_ends(shown, pose)) < float(known_ends(problem, pose))
    # A tighter prior knows more of what is hidden.
    tight = replace(shown, prior=replace(shown.prior, precision=100 * shown.prior.precision))
    assert float(known_ends(tight, pose)) > 0.95


def test_a_near_rival_lowers_the_confidence(problem, pose):
    found = torch.cat([pose_confidence(problem, pose, torch.tensor([lead])) for lead in (0.0, 1.0, 4.0, 20.0)])
    assert found[0] == 0
    assert bool((found.diff() > 0).all())
    torch.testing.assert_close(found[2], found[3] * (1 - torch.tensor(-1.0).exp()), rtol=0.02, atol=0)


def test_near_outliers_are_a_misfit_and_far_ones_are_not(problem, pose):
    wrong = pose.clone()
    wrong[:, 6:] += 0.25
    far = problem.data.clone()
    far[:, ::10] += 0.3
    cases = ((problem, pose), (problem, wrong), (replace(problem, data=far), pose))
    assert [bool(is_misfit(*case)) for case in cases] == [False, True, False]
    assert float(pose_confidence(problem, wrong, SURE)) < 0.75 * float(pose_confidence(problem, pose, SURE))


def test_hidden_ends_spread_as_the_prior_does():
    """One hinge without data: its end lies within the tolerance as often as in draws from the prior."""
    joints = [joint("body", -1), joint("arm", 0, (0, 0, 0), "revolute", (1.0, 0.0, 0.0), -1.5, 1.5)]
    solids = [solid("ellipsoid", (0.05, 0.03, 0.06)), solid("ellipsoid", (0.01, 0.01, 0.05), 0, 0, 0.15)]
    shape = shape_of(joints, solids, nu=0.004)
    skin, pose, std = tr.sample_skin(shape, 300), shape.rest_pose().unsqueeze(0), 0.05
    problem = problem_of(skin, skin(pose)[:, skin.weights.argmax(-1) == 0], pose, prior_std=std)
    lever = skin.points[:, 1:].norm(dim=-1).max()
    expected = 1 - torch.exp(-((0.04 * problem.size / (lever * std)) ** 2))
    torch.testing.assert_close(known_ends(problem, pose), expected[None], rtol=0.1, atol=0)


def test_clouds_of_a_batch_and_padding_change_nothing(problem, pose):
    both = problem.rows(torch.tensor([0, 0]))
    both.valid[1, 200:] = False
    alone = replace(problem, data=problem.data[:, :200], valid=problem.valid[:, :200])
    together = pose_confidence(both, pose.expand(2, -1), SURE.expand(2))
    for row, each in enumerate((problem, alone)):
        torch.testing.assert_close(together[row : row + 1], pose_confidence(each, pose, SURE), rtol=1e-4, atol=1e-6)
    empty = replace(problem, valid=torch.zeros_like(problem.valid))
    loose = replace(empty, prior=replace(empty.prior, precision=torch.zeros_like(empty.prior.precision)))
    for bare in (empty, loose):
        assert 0 <= float(pose_confidence(bare, pose, SURE)) < 0.1
