"""Steps between poses: the inverse of retracting, on the manifold, in any batch."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.pose_algebra import difference, retract

D = torch.float64


def poses(seed, *batch, size=9):
    pose = torch.randn(*batch, size, generator=torch.Generator().manual_seed(seed), dtype=D)
    turn = pose[..., 3:6]
    pose[..., 3:6] = turn * (3.1 / turn.norm(dim=-1, keepdim=True)).clamp_max(1)
    return pose


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_a_difference_leads_from_one_pose_to_the_other(seed):
    start, end = poses(seed, 4), poses(seed + 1, 4)
    reached = retract(start, difference(start, end))
    torch.testing.assert_close(so3_exp(reached[..., 3:6]), so3_exp(end[..., 3:6]))
    torch.testing.assert_close(reached[..., :3], end[..., :3])
    torch.testing.assert_close(reached[..., 6:], end[..., 6:])


def test_the_turn_is_the_angle_between_rotations():
    start, end = poses(0, 20), poses(1, 20)
    between = so3_exp(end[:, 3:6]) @ so3_exp(start[:, 3:6]).mT
    angle = ((between.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()
    torch.testing.assert_close(difference(start, end)[:, 3:6].norm(dim=-1), angle)
    assert float(angle.max()) <= math.pi


def test_nothing_lies_between_a_pose_and_itself_or_its_other_rotation_vector():
    pose = poses(2, 5)
    assert float(difference(pose, pose).abs().max()) < 1e-14
    same = pose.clone()
    turn = pose[:, 3:6].norm(dim=-1, keepdim=True)
    same[:, 3:6] *= (turn - 2 * math.pi) / turn
    assert float(difference(pose, same).abs().max()) < 1e-14


def test_batches_broadcast_and_equal_loops():
    start, ends = poses(3), poses(4, 2, 3)
    both = difference(start, ends)
    for row in range(2):
        for column in range(3):
            torch.testing.assert_close(both[row, column], difference(start, ends[row, column]))


def test_derivatives():
    start, end = poses(5, 2).requires_grad_(), poses(6, 2).requires_grad_()
    assert torch.autograd.gradcheck(difference, (start, end))
    assert torch.autograd.gradcheck(lambda pose: difference(pose, pose + 1e-3), (start,))


def test_shapes_take_the_same_steps_and_know_what_slides(plain_hand, arm):
    assert plain_hand.is_sliding.tolist() == [True] * 3 + [False] * 24
    rest, step = arm.rest_pose(), 0.1 * poses(7, size=7)
    torch.testing.assert_close(arm.difference(rest, arm.retract(rest, step)), step)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtypes_stay(dtype):
    assert difference(poses(0).to(dtype), poses(1).to(dtype)).dtype == dtype
