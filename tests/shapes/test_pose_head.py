"""Heads of pose networks: there and back, limits, gradients, sizes, a network that learns a turn."""

import math

import pytest
import torch
from torch.autograd import gradcheck

import torchreg as tr
from tests.shapes.kinds import D, compare, poses_of, seeded
from torchreg.geometry.rotation import so3_exp

KINDS = [(rotation, joints) for rotation in ("6d", "quaternion", "vector") for joints in ("free", "sigmoid")]
OTHERS = [0, 1, 2, *range(6, 27)]


def some_poses(hand, count=5):
    poses = poses_of(hand, count)
    poses[:2, 3:6] = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, math.pi]], dtype=D)
    return poses


@pytest.mark.parametrize(("rotation", "joints"), KINDS)
def test_features_and_poses_go_there_and_back(hand, rotation, joints):
    head = tr.PoseHead(hand, rotation=rotation, joints=joints).double()
    poses = some_poses(hand)
    features = head.features(poses)
    assert features.shape == (5, head.num_features)
    back = head(features)
    compare((so3_exp(back[:, 3:6]), back[:, OTHERS]), (so3_exp(poses[:, 3:6]), poses[:, OTHERS]))
    compare([head(features.reshape(5, 1, -1))[:, 0]], [back])


@pytest.mark.parametrize("rotation", ["6d", "quaternion"])
def test_gradients_of_keypoints_hold_at_zero_and_half_turns(hand, rotation):
    head = tr.PoseHead(hand, rotation=rotation, joints="sigmoid")
    features = head.features(some_poses(hand, 2)).requires_grad_()
    assert gradcheck(lambda x: hand.keypoints(head(x)), features, fast_mode=True)


def test_no_features_leave_the_limits(hand):
    head = tr.PoseHead(hand, joints="sigmoid")
    joints = head(50 * seeded(100, head.num_features))[:, 6:]
    assert bool(((joints >= hand.lower[6:] - 1e-12) & (joints <= hand.upper[6:] + 1e-12)).all())
    at_limit = hand.rest_pose()
    at_limit[6:] = hand.upper[6:]
    assert head.features(at_limit).isfinite().all()
    assert (head(head.features(at_limit))[6:] - hand.upper[6:]).abs().max() < 3e-3
