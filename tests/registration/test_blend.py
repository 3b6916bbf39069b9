"""Blends of rigid motions: their definitions, one point and bone at a time, and analytic Jacobians."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.blend import (
    blend_dual_quaternion,
    blend_dual_quaternion_jacobian,
    blend_linear,
    blend_linear_jacobian,
    turn_about,
)

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
PAIRS = [(blend_linear, blend_linear_jacobian), (blend_dual_quaternion, blend_dual_quaternion_jacobian)]


def problem(*batch, seed=0, points=7, bones=4):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    weights = draw(points, bones).abs()
    return draw(points, 3), weights / weights.sum(-1, keepdim=True), se3_exp(1.2 * draw(*batch, bones, 6))


def test_linear_blend_is_equation_1():
    points, weights, transforms = problem()
    for x, row, found in zip(points, weights, blend_linear(points, weights, transforms), strict=True):
        expected = sum(w * (t[:3, :3] @ x + t[:3, 3]) for w, t in zip(row, transforms, strict=True))
        torch.testing.assert_close(found, expected)


def dual_quaternion_by_hand(x, row, transforms):
    """Kavan's algorithm with scipy's quaternions, scalar last."""
    real = Rotation.from_matrix(transforms[:, :3, :3].numpy()).as_quat()
    dual = []
    for q, t in zip(real, transforms[:, :3, 3].numpy(), strict=True):
        dual.append(0.5 * np.append(q[3] * t + np.cross(t, q[:3]), -t @ q[:3]))
    pivot = real[int(row.argmax())]
    total, total_dual = np.zeros(4), np.zeros(4)
    for w, q, d in zip(row.numpy(), real, dual, strict=True):
        sign = -1.0 if q @ pivot < 0 else 1.0
        total += w * sign * q
        total_dual += w * sign * d
    length = np.linalg.norm(total)
    total, total_dual = total / length, total_dual / length
    shift = 2 * (total[3] * total_dual[:3] - total_dual[3] * total[:3] + np.cross(total[:3], total_dual[:3]))
    return Rotation.from_quat(total).apply(x.numpy()) + shift


def test_dual_quaternion_blend_is_kavans():
    points, weights, transforms = problem(points=30)
    found = blend_dual_quaternion(points, weights, transforms)
    for x, row, at in zip(points, weights, found, strict=True):
        np.testing.assert_allclose(at.numpy(), dual_quaternion_by_hand(x, row, transforms), atol=1e-12)


@pytest.mark.parametrize("blend", [blend_linear, blend_dual_quaternion])
def test_one_bone_moves_its_points_rigidly(blend):
    points, _, transforms = problem()
    for bone in range(4):
        alone = torch.nn.functional.one_hot(torch.full((7,), bone), 4).double()
        torch.testing.assert_close(blend(points, alone, transforms), transform_points(transforms[bone], points))
    same = transforms[:1].expand(4, 4, 4)
    torch.testing.assert_close(blend(points, problem()[1], same), transform_points(transforms[0], points))


@pytest.mark.parametrize("blend", [blend_linear, blend_dual_quaternion])
def test_blends_follow_motions_of_both_sides(blend):
    points, weights, transforms = problem()
    first, second = se3_exp(torch.tensor([[1.0, 2, 3, 0.3, -1, 2], [-2.0, 0, 1, 1, 0.5, 0]], dtype=torch.float64))
    moved = blend(transform_points(second, points), weights, first @ transforms @ torch.linalg.inv(second))
    torch.testing.assert_close(moved, transform_points(first, blend(points, weights, transforms)))


def test_a_twisted_limb_keeps_its_girth_under_dual_quaternions():
    transforms = se3_exp(torch.tensor([[0.0] * 6, [0, 0, 0, 0.98 * math.pi, 0, 0]], dtype=torch.float64))
    rim, half = torch.tensor([[0.5, 1.0, 0.0]], dtype=torch.float64), torch.full((1, 2), 0.5, dtype=torch.float64)
    assert float(blend_linear(rim, half, transforms)[0, 1:].norm()) < 0.05
    assert float(blend_dual_quaternion(rim, half, transforms)[0, 1:].norm()) == pytest.approx(1)


@JACFWD
@pytest.mark.parametrize(("blend", "jacobian"), PAIRS)
def test_jacobians_equal_forward_mode(blend, jacobian):
    points, weights, transforms = problem(2)
    centers = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = jacobian(points, weights, transforms, centers)
    assert found.shape == (2, 7, 3, 4, 6)
    for k in range(2):

        def posed(twists, k=k):
            return blend(points, weights, turn_about(transforms[k], twists, centers[k]))

        expected = torch.func.jacfwd(posed)(torch.zeros(4, 6, dtype=torch.float64))
        torch.testing.assert_close(found[k], expected, atol=1e-12, rtol=1e-10)


@pytest.mark.parametrize(("blend", "jacobian"), PAIRS)
def test_gradients(blend, jacobian):
    points, weights, transforms = problem(points=3)
    inputs = tuple(value.clone().requires_grad_() for value in (points, weights, transforms))
    assert torch.autograd.gradcheck(blend, inputs, fast_mode=True)
    centers = torch.zeros(4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(jacobian, (*inputs, centers), fast_mode=True)


@pytest.mark.parametrize("blend", [blend_linear, blend_dual_quaternion])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_broadcast(blend, dtype):
    points, weights, transforms = (value.to(dtype) for value in problem(3, 2))
    found = blend(points, weights, transforms)
    assert found.shape == (3, 2, 7, 3)
    assert found.dtype == dtype
    torch.testing.assert_close(found[2, 1], blend(points, weights, transforms[2, 1]))
    apart = blend(points.expand(2, 7, 3), weights.expand(3, 1, 7, 4), transforms)
    torch.testing.assert_close(apart, found)


def test_turning_about_a_point_keeps_it_and_shifts_it():
    _, _, transforms = problem()
    twists = torch.randn(4, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    inside = torch.ones(4, 3, dtype=torch.float64)
    centers = transform_points(transforms, inside.unsqueeze(-2)).squeeze(-2)
    moved = turn_about(transforms, twists, centers)
    torch.testing.assert_close(transform_points(moved, inside.unsqueeze(-2)).squeeze(-2), centers + twists[:, :3])
    turn = Rotation.from_rotvec(twists[:, 3:].numpy()) * Rotation.from_matrix(transforms[:, :3, :3].numpy())
    np.testing.assert_allclose(moved[:, :3, :3].numpy(), turn.as_matrix(), atol=1e-12)
    zero = torch.zeros(4, 6, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(turn_about(transforms, zero, centers), transforms)
    assert torch.autograd.gradcheck(lambda z: turn_about(transforms, z, centers), (zero,))
