"""Curves against circles and polylines of known length and bend, and gradients also where curves degenerate."""

import math

import pytest
import torch

from tests.spines.bodies import circle, line, moved, random, similarity
from torchreg.geometry.rotation import so3_exp
from torchreg.spines import curves

ARC = circle(2.0, 65, (0, 0.5))


def test_a_half_circle_has_its_length_bend_and_directions():
    assert float(curves.curve_lengths(ARC)) == pytest.approx(2 * math.pi, rel=1e-3)
    torch.testing.assert_close(curves.bend_angles(ARC), torch.full((63,), math.pi / 64).double())
    inner = curves.tangents(ARC)[1:-1]
    torch.testing.assert_close((inner * ARC[1:-1]).sum(-1), torch.zeros(63).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(inner.norm(dim=-1), torch.ones(63).double())


def test_batches_equal_loops_and_similarities_change_what_they_must():
    batch, matrix = random(3, 4, 9, 3), similarity(0, 2.5)
    for function, factor in ((curves.curve_lengths, 2.5), (curves.bend_angles, 1.0)):
        torch.testing.assert_close(function(batch)[1, 2], function(batch[1, 2]))
        torch.testing.assert_close(function(moved(batch, matrix)), factor * function(batch))
    turned = curves.tangents(batch) @ (matrix[:3, :3] / 2.5).mT
    torch.testing.assert_close(curves.tangents(moved(batch, matrix)), turned)


def test_frames_are_rotations_along_the_curve_without_twist():
    curve = torch.cat((ARC, ARC[-1:] + torch.tensor([[0.0, -1.0, 0.5]])))
    frames = curves.curve_frames(curve)
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3).double().expand(66, 3, 3))
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(66).double())
    torch.testing.assert_close(frames[..., 2], curves.tangents(curve))
    # Around a plane curve the normal of the plane stays where it is in the frame.
    local = frames[:60].mT @ torch.tensor([0.0, 0.0, 1.0]).double()
    torch.testing.assert_close(local, local[:1].expand(60, 3))


def test_aligned_frames_keep_the_axis_of_rotation():
    frames, direction = so3_exp(random(5, 3)), torch.nn.functional.normalize(random(5, 3, seed=3), dim=-1)
    aligned = curves.align_frames(frames, direction)
    torch.testing.assert_close(aligned[..., 2], direction)
    axis = torch.linalg.cross(frames[..., 2], direction).unsqueeze(-1)
    torch.testing.assert_close(aligned.mT @ axis, frames.mT @ axis)


def test_gradients_are_right_and_finite_where_points_fall_together():
    for function in (curves.curve_lengths, curves.bend_angles, curves.tangents, curves.curve_frames):
        assert torch.autograd.gradcheck(function, (random(2, 6, 3).requires_grad_(),))
    torch.testing.assert_close(curves.tangents(torch.zeros(4, 3))[:, 0], torch.ones(4))
    curve = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 1, 0]]).double().requires_grad_()
    (curves.curve_lengths(curve) + curves.bend_angles(curve).sum() + curves.tangents(curve).sum()).backward()
    assert bool(curve.grad.isfinite().all())


def test_points_along_a_curve_lie_at_their_lengths():
    curve = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 2, 0]], dtype=torch.float64)
    found = curves.points_along(curve, torch.tensor([[0.0, 0.5, 1.0], [2.0, 3.0, 9.0]]).double())
    right = torch.tensor([[[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0]], [[1, 1, 0], [1, 2, 0], [1, 2, 0]]]).double()
    torch.testing.assert_close(found, right)
    at_one = curves.points_along(curve[:1], torch.tensor([0.0, 1.0]).double())
    torch.testing.assert_close(at_one, torch.zeros(2, 3).double())


def test_smoothing_keeps_ends_and_straight_lines_and_takes_the_zigzag_out():
    straight = line([0.0, 0, 0], [1.0, 2.0, -1.0], 40)
    torch.testing.assert_close(curves.moving_average(straight, 0.3, 65), line([0.0, 0, 0], [1.0, 2.0, -1.0], 65))
    zigzag = straight + 0.1 * torch.tensor([[0.0, 0, 1], [0, 0, -1]]).double().repeat(20, 1)
    smooth = curves.moving_average(zigzag, 0.3, 65)
    length, before, after = (float(curves.curve_lengths(row)) for row in (straight, zigzag, smooth))
    assert before > 2 * length
    assert after < 1.15 * length
    torch.testing.assert_close(smooth[[0, -1]], zigzag[[0, -1]], rtol=0, atol=1e-12)
    torch.testing.assert_close(curves.moving_average(ARC, 0.05, 65), ARC, rtol=0, atol=0.02)
