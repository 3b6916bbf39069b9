"""Rotations at every angle: exponential, logarithm, composition, and representations for networks."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck
from torch.func import jacfwd, jacrev

from tests.geometry.draws import D, directions, randn
from torchreg.geometry import rotation_representations as representations
from torchreg.geometry.rotation import (
    compose_rotation_vectors,
    left_jacobian,
    rotation_between,
    skew,
    so3_exp,
    so3_log,
    wrap_rotation_vector,
)

# torch's own forward mode compiles its decompositions with a deprecated call on first use.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

AXIS = torch.tensor([1.0, 2.0, -3.0], dtype=D) / math.sqrt(14)
# Zero, both sides of the switch to the series (0.01), a half turn, a whole turn and beyond.
ANGLES = [0.0, 1e-9, 1e-5, 9.99e-3, 1.001e-2, 0.3, 2.0, math.pi - 1e-7, math.pi, 4.0, 2 * math.pi, 9.0]
numbers = st.floats(-4.0, 4.0, allow_nan=False, width=64)
vectors = st.tuples(numbers, numbers, numbers).map(lambda v: torch.tensor(v, dtype=D))


def central_jacobian(function, at, step=1e-6):
    columns = [(function(at + step * e) - function(at - step * e)) / (2 * step) for e in torch.eye(3, dtype=at.dtype)]
    return torch.stack(columns, dim=-1)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential_in_both_dtypes(angle):
    vector = angle * AXIS
    rotation = so3_exp(vector)
    np.testing.assert_allclose(rotation, expm(skew(vector).numpy()), atol=1e-14)
    torch.testing.assert_close(so3_exp(vector.float()).double(), rotation, atol=3e-6, rtol=0)


@pytest.mark.parametrize("angle", [a for a in ANGLES if a != math.pi])
def test_left_jacobian_is_the_derivative_of_exp(angle):
    vector = angle * AXIS
    back = Rotation.from_rotvec(vector.numpy()).inv()
    expected = central_jacobian(lambda w: torch.as_tensor((Rotation.from_rotvec(w.numpy()) * back).as_rotvec()), vector)
    torch.testing.assert_close(left_jacobian(vector), expected, atol=1e-8, rtol=0)


@pytest.mark.parametrize("function", [so3_exp, left_jacobian, lambda w: so3_log(so3_exp(w)), wrap_rotation_vector])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 5e-3, 1.0, 3.0])
def test_derivatives_agree_in_every_mode_also_at_zero(function, angle):
    vector = angle * AXIS
    forward, reverse = jacfwd(function)(vector), jacrev(function)(vector)
    torch.testing.assert_close(forward, reverse, atol=1e-12, rtol=0)
    torch.testing.assert_close(forward, central_jacobian(function, vector), atol=1e-8, rtol=0)
    assert torch.autograd.gradcheck(function, vector.clone().requires_grad_())


def test_second_derivatives_of_exp_at_zero():
    zero = torch.zeros(3, dtype=D, requires_grad=True)
    assert torch.autograd.gradgradcheck(so3_exp, zero, atol=1e-6)
    second = jacfwd(jacrev(so3_exp))(zero.detach())
    # R = I + [w] + [w]^2 / 2: the second derivative is that of [w]^2 / 2.
    expected = jacfwd(jacrev(lambda w: 0.5 * torch.outer(w, w) - 0.5 * (w @ w) * torch.eye(3, dtype=D)))(zero.detach())
    torch.testing.assert_close(second, expected, atol=1e-14, rtol=0)


@settings(max_examples=50, deadline=None)
@given(vectors, vectors)
def test_exp_log_and_composition_agree_with_scipy(first, second):
    np.testing.assert_allclose(so3_exp(first), Rotation.from_rotvec(first.numpy()).as_matrix(), atol=1e-14)
    torch.testing.assert_close(so3_exp(so3_log(so3_exp(first))), so3_exp(first), atol=1e-12, rtol=0)
    composed = compose_rotation_vectors(first, second)
    expected = Rotation.from_rotvec(first.numpy()) * Rotation.from_rotvec(second.numpy())
    assert composed.norm() <= math.pi + 1e-12
    assert (Rotation.from_rotvec(composed.numpy()).inv() * expected).magnitude() < 1e-12


@pytest.mark.parametrize("angle", ANGLES)
def test_wrapping_and_logarithms_keep_the_rotation(angle):
    for wrapped in (wrap_rotation_vector(angle * AXIS), so3_log(so3_exp(angle * AXIS))):
        assert wrapped.norm() <= math.pi + 1e-12
        torch.testing.assert_close(so3_exp(wrapped), so3_exp(angle * AXIS), atol=1e-12, rtol=0)
        if angle < math.pi - 1e-6:
            torch.testing.assert_close(wrapped, angle * AXIS, atol=1e-12, rtol=0)


@pytest.mark.parametrize("function", [so3_exp, left_jacobian, wrap_rotation_vector, lambda w: so3_log(so3_exp(w))])
def test_batches_of_any_shape_are_loops(function):
    batch = 2 * randn(6, 3)
    together = function(batch.reshape(2, 3, 3))
    torch.testing.assert_close(together.flatten(0, 1), torch.stack([function(w) for w in batch]))
    assert function(batch[:0]).shape[0] == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", ANGLES)
def test_without_derivatives_the_result_is_the_same(angle, dtype):
    vector, other = (angle * AXIS).to(dtype), 2 * randn(3, dtype=dtype)
    for function in (so3_exp, wrap_rotation_vector, lambda w: compose_rotation_vectors(w, other)):
        expected = function(vector)
        with torch.inference_mode():
            found = function(vector)
        # Half a turn to the left is half a turn to the right.
        found = found if expected.ndim == 2 or float(found @ expected) >= 0 else -found
        torch.testing.assert_close(found, expected, atol=50 * torch.finfo(dtype).eps, rtol=0)


VECTORS = [angle * AXIS for angle in ANGLES if angle <= math.pi] + [math.pi * axis for axis in torch.eye(3, dtype=D)]


def test_six_numbers_of_any_length_give_the_rotation_of_gram_schmidt():
    columns = randn(50, 6)
    rotation = representations.rotation_from_6d(columns)
    q, r = np.linalg.qr(columns.reshape(50, 2, 3).mT.numpy())
    first_two = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    np.testing.assert_allclose(rotation[..., :2], first_two, atol=1e-14)
    torch.testing.assert_close(torch.det(rotation), torch.ones(50, dtype=D))
    torch.testing.assert_close(representations.rotation_from_6d(columns * 1e-9), rotation)
    torch.testing.assert_close(representations.rotation_from_6d(representations.rotation_to_6d(rotation)), rotation)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (D, 1e-13)])
def test_columns_that_point_nowhere_still_give_rotations_and_finite_gradients(dtype, tolerance):
    zero, x = torch.zeros(3, dtype=D), AXIS
    rows = [[zero, zero], [x, zero], [zero, x], [x, 2 * x], [x, -x], [x, x + 1e-7 * x.roll(1)], [1e-30 * x, x.roll(1)]]
    columns = torch.stack([torch.cat(row) for row in rows]).to(dtype).requires_grad_()
    rotation = representations.rotation_from_6d(columns)
    eye = torch.eye(3, dtype=dtype)
    torch.testing.assert_close(rotation @ rotation.mT, eye.expand(7, 3, 3), atol=tolerance, rtol=0)
    torch.testing.assert_close(torch.det(rotation), torch.ones(7, dtype=dtype), atol=tolerance, rtol=0)
    (gradient,) = torch.autograd.grad((representations.rotation_vector_from_6d(columns) * x.to(dtype)).sum(), columns)
    assert gradient.isfinite().all()
    assert not gradient[0].any()
    torch.testing.assert_close(rotation[0], eye)
    torch.testing.assert_close(rotation[1, :, 0], x.to(dtype))


@pytest.mark.parametrize("vector", VECTORS)
def test_all_conversions_agree_with_scipy(vector):
    truth = torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix())
    quaternion = representations.quaternion_from_rotation_vector(vector)
    theirs = Rotation.from_rotvec(vector).as_quat(scalar_first=True)
    np.testing.assert_allclose(quaternion.abs(), np.abs(theirs), atol=1e-15)
    found = [representations.rotation_from_quaternion(scale * quaternion) for scale in (1.0, -0.01, 1e5)]
    back = [representations.rotation_vector_from_quaternion(scale * quaternion) for scale in (1.0, -0.01, 1e5)]
    back.append(representations.rotation_vector_from_rotation(truth))
    back.append(representations.rotation_vector_from_6d(representations.rotation_vector_to_6d(vector)))
    for rotation in (*found, *map(so3_exp, back)):
        torch.testing.assert_close(rotation, truth, atol=1e-14, rtol=0)
    assert all(vector.norm() <= math.pi + 1e-12 for vector in back)
    if vector.norm() < math.pi - 1e-6:
        torch.testing.assert_close(back[2], vector, atol=1e-14, rtol=1e-12)


@pytest.mark.parametrize("vector", VECTORS)
def test_gradients_of_the_represented_rotation_hold_at_every_angle(vector):
    quaternion = 1.7 * representations.quaternion_from_rotation_vector(vector)
    columns = representations.rotation_vector_to_6d(vector) * torch.tensor([2.0, 2, 2, 0.5, 0.5, 0.5], dtype=D)
    assert gradcheck(representations.rotation_from_quaternion, quaternion.requires_grad_())
    assert gradcheck(representations.rotation_from_6d, columns.requires_grad_())
    assert gradcheck(lambda q: so3_exp(representations.rotation_vector_from_quaternion(q)), quaternion)
    assert gradcheck(lambda c: so3_exp(representations.rotation_vector_from_6d(c)), columns)


def test_the_zero_quaternion_is_no_rotation_and_takes_no_gradient():
    zero = torch.zeros(4, dtype=D, requires_grad=True)
    torch.testing.assert_close(representations.rotation_from_quaternion(zero).detach(), torch.eye(3, dtype=D))
    vector = representations.rotation_vector_from_quaternion(zero)
    assert not vector.any()
    assert not torch.autograd.grad(vector.sum() + representations.rotation_from_quaternion(zero).sum(), zero)[0].any()


def test_the_smallest_rotation_takes_one_vector_to_the_other_also_to_the_opposite_one():
    eye = torch.eye(3, dtype=D)
    start = torch.cat((directions(50, 1), eye, eye))
    end = torch.cat((directions(50, 2), -eye, eye))
    turn = rotation_between(start, end)
    torch.testing.assert_close((turn @ start.unsqueeze(-1)).squeeze(-1), end)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(56, dtype=D))
    cosine = 0.5 * (turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
    torch.testing.assert_close(cosine, (start * end).sum(-1))
