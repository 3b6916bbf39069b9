"""Heads of pose networks: there and back, limits, gradients, sizes, a network that learns a turn."""

import math

import pytest
import torch
from torch.autograd import gradcheck

from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.hand import Hand
from torchreg.shapes.pose_head import PoseHead

D = torch.float64
KINDS = [(rotation, joints) for rotation in ("6d", "quaternion", "vector") for joints in ("free", "sigmoid")]


@pytest.fixture(scope="module")
def hand():
    return Hand(dtype=D).requires_grad_(False)


def some_poses(hand, count=5):
    generator = torch.Generator().manual_seed(0)
    poses = torch.randn(count, hand.num_dofs, generator=generator, dtype=D)
    share = 0.01 + 0.98 * torch.rand(count, 21, generator=generator, dtype=D)
    poses[:, 6:] = hand.lower[6:] + share * (hand.upper - hand.lower)[6:]
    poses[0, 3:6] = 0
    poses[1, 3:6] = torch.tensor([0.0, 0.0, math.pi], dtype=D)
    return poses


@pytest.mark.parametrize(("rotation", "joints"), KINDS)
def test_features_and_poses_go_there_and_back(hand, rotation, joints):
    head = PoseHead(hand, rotation=rotation, joints=joints).double()
    poses = some_poses(hand)
    features = head.features(poses)
    assert features.shape == (5, head.num_features)
    back = head(features)
    torch.testing.assert_close(so3_exp(back[:, 3:6]), so3_exp(poses[:, 3:6]), atol=1e-13, rtol=0)
    torch.testing.assert_close(back[:, [0, 1, 2, *range(6, 27)]], poses[:, [0, 1, 2, *range(6, 27)]])
    torch.testing.assert_close(head(features.reshape(5, 1, -1))[:, 0], back)


@pytest.mark.parametrize("rotation", ["6d", "quaternion"])
def test_gradients_of_keypoints_hold_at_zero_and_half_turns(hand, rotation):
    head = PoseHead(hand, rotation=rotation, joints="sigmoid")
    features = head.features(some_poses(hand, 2)).requires_grad_()
    assert gradcheck(lambda x: hand.keypoints(head(x)), features, fast_mode=True)


def test_no_features_leave_the_limits(hand):
    head = PoseHead(hand, joints="sigmoid")
    joints = head(50 * torch.randn(100, head.num_features, generator=torch.Generator().manual_seed(1), dtype=D))[:, 6:]
    assert bool(((joints >= hand.lower[6:] - 1e-12) & (joints <= hand.upper[6:] + 1e-12)).all())
    at_limit = hand.rest_pose()
    at_limit[6:] = hand.upper[6:]
    assert head.features(at_limit).isfinite().all()
    assert (head(head.features(at_limit))[6:] - hand.upper[6:]).abs().max() < 3e-3


def test_descent_finds_a_half_turn_from_none(hand):
    head = PoseHead(hand)
    target = hand.rest_pose()
    target[3:6] = torch.tensor([0.0, math.pi, 0.0], dtype=D)
    start = hand.rest_pose()
    start[3:6] = torch.tensor([0.1, 0.05, 0.2], dtype=D)
    place, turn, joints = head.features(start).split([3, 6, 21])
    optimizer = torch.optim.SGD([turn.requires_grad_()], 0.1)
    for _ in range(200):
        optimizer.zero_grad()
        pose = head(torch.cat([place, turn, joints]))
        loss = (so3_exp(pose[3:6]) - so3_exp(target[3:6])).square().sum()
        loss.backward()
        optimizer.step()
    assert loss < 1e-4


def test_bad_input_is_told(hand):
    with pytest.raises(InputError, match="rotation must be one of"):
        PoseHead(hand, rotation="euler")
    with pytest.raises(InputError, match="joints must be one of"):
        PoseHead(hand, joints="clamp")
    with pytest.raises(InputError, match="features must have shape"):
        PoseHead(hand)(torch.zeros(27, dtype=D))
    with pytest.raises(InputError, match="pose must have shape"):
        PoseHead(hand).features(torch.zeros(26, dtype=D))
