"""Curves against circles and helices of known length and bend, and gradients also where curves degenerate."""

import math

import pytest
import torch

from torchreg.geometry.rotation import so3_exp
from torchreg.spines.curves import (
    align_frames,
    bend_angles,
    curve_frames,
    curve_lengths,
    moving_average,
    points_along,
    tangents,
)


def circle(count=65, radius=2.0, angle=math.pi):
    t = torch.linspace(0, angle, count, dtype=torch.float64)
    return radius * torch.stack((t.cos(), t.sin(), torch.zeros_like(t)), -1)


def random(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_half_circle_has_its_length_bend_and_directions():
    curve = circle()
    assert float(curve_lengths(curve)) == pytest.approx(2 * math.pi, rel=1e-3)
    torch.testing.assert_close(bend_angles(curve), torch.full((63,), math.pi / 64, dtype=torch.float64))
    inner = tangents(curve)[1:-1]
    torch.testing.assert_close((inner * curve[1:-1]).sum(-1), torch.zeros(63, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(inner.norm(dim=-1), torch.ones(63, dtype=torch.float64))


def test_batches_equal_loops_and_rigid_motion_changes_nothing_but_directions():
    curves = random(3, 4, 9, 3)
    turn = so3_exp(torch.tensor([0.3, -1.0, 0.5], dtype=torch.float64))
    moved = 2.5 * curves @ turn.mT + 7
    for function, factor in ((curve_lengths, 2.5), (bend_angles, 1.0)):
        batched = function(curves)
        torch.testing.assert_close(batched[1, 2], function(curves[1, 2]))
        torch.testing.assert_close(function(moved), factor * batched)
    torch.testing.assert_close(tangents(moved), tangents(curves) @ turn.mT)


def test_frames_are_rotations_along_the_curve_without_twist():
    curve = torch.cat((circle(), circle()[-1:] + torch.tensor([[0.0, -1.0, 0.5]])))
    frames = curve_frames(curve)
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3, dtype=torch.float64).expand(66, 3, 3))
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(66, dtype=torch.float64))
    torch.testing.assert_close(frames[..., 2], tangents(curve))
    # Around a plane curve the normal of the plane stays where it is in the frame.
    local = frames[:60].mT @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(local, local[:1].expand(60, 3))


def test_aligned_frames_keep_what_lies_on_the_axis_of_rotation():
    frames = so3_exp(random(5, 3))
    direction = torch.nn.functional.normalize(random(5, 3, seed=3), dim=-1)
    moved = align_frames(frames, direction)
    torch.testing.assert_close(moved[..., 2], direction)
    axis = torch.linalg.cross(frames[..., 2], direction)
    torch.testing.assert_close(
        (moved.mT @ axis.unsqueeze(-1)).squeeze(-1), (frames.mT @ axis.unsqueeze(-1)).squeeze(-1)
    )


def test_points_that_fall_together_have_the_direction_around_them_and_no_gradient_of_their_own():
    curve = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 1, 0]], dtype=torch.float64)
    assert bool(tangents(curve).isfinite().all())
    torch.testing.assert_close(tangents(torch.zeros(4, 3))[:, 0], torch.ones(4))
    curve.requires_grad_()
    (curve_lengths(curve) + bend_angles(curve).sum() + tangents(curve).sum()).backward()
    assert bool(curve.grad.isfinite().all())


def test_gradients_are_right():
    curves = random(2, 6, 3).requires_grad_()
    for function in (curve_lengths, bend_angles, tangents, curve_frames):
        assert torch.autograd.gradcheck(function, (curves,))


def test_points_along_a_curve_lie_at_their_lengths():
    curve = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 2, 0]], dtype=torch.float64)
    found = points_along(curve, torch.tensor([[0.0, 0.5, 1.0], [2.0, 3.0, 9.0]], dtype=torch.float64))
    right = torch.tensor([[[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0]], [[1, 1, 0], [1, 2, 0], [1, 2, 0]]]).double()
    torch.testing.assert_close(found, right)
    torch.testing.assert_close(points_along(curve[:1], torch.tensor([0.0, 1.0]).double()), torch.zeros(2, 3).double())


def test_smoothing_keeps_ends_and_straight_lines_and_takes_the_zigzag_out():
    line = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0, -1.0])
    smooth = moving_average(line, 0.3, 65)
    assert torch.equal(smooth[[0, -1]], line[[0, -1]])
    torch.testing.assert_close(smooth, torch.linspace(0, 1, 65, dtype=torch.float64)[:, None] * line[-1])
    zigzag = line + 0.1 * torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64).repeat(20, 1)
    assert float(curve_lengths(zigzag)) > 2 * float(curve_lengths(line))
    assert float(curve_lengths(moving_average(zigzag, 0.3, 65))) < 1.15 * float(curve_lengths(line))
    torch.testing.assert_close(moving_average(circle(), 0.05, 65), circle(), rtol=0, atol=0.02)
