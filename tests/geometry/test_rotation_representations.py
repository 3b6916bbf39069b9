"""Rotations as networks give them against scipy and finite differences, where nothing points anywhere too."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.rotation_representations import (
    quaternion_from_rotation,
    quaternion_from_rotation_vector,
    rotation_from_6d,
    rotation_from_quaternion,
    rotation_to_6d,
    rotation_vector_from_6d,
    rotation_vector_from_quaternion,
    rotation_vector_from_rotation,
    rotation_vector_to_6d,
)

D = torch.float64
AXIS = torch.tensor([1.0, 2.0, -3.0], dtype=D) / math.sqrt(14)
ANGLES = [0.0, 1e-9, 1e-3, 9.99e-3, 0.0101, 0.7, 2.5, math.pi - 1e-7, math.pi]
VECTORS = [angle * AXIS for angle in ANGLES] + [math.pi * axis for axis in torch.eye(3, dtype=D)]


def randn(*size, seed=0, dtype=D):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=D).to(dtype)


def test_six_numbers_of_any_length_give_the_rotation_of_gram_schmidt():
    columns = randn(50, 6)
    rotation = rotation_from_6d(columns)
    q, r = np.linalg.qr(columns.reshape(50, 2, 3).mT.numpy())
    first_two = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    np.testing.assert_allclose(rotation[..., :2], first_two, atol=1e-14)
    torch.testing.assert_close(torch.det(rotation), torch.ones(50, dtype=D))
    torch.testing.assert_close(rotation_from_6d(columns * 1e-9), rotation)
    torch.testing.assert_close(rotation_from_6d(rotation_to_6d(rotation)), rotation)


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_columns_that_point_nowhere_still_give_rotations_and_finite_gradients(dtype):
    zero, x = torch.zeros(3, dtype=D), AXIS
    rows = [[zero, zero], [x, zero], [zero, x], [x, 2 * x], [x, -x], [x, x + 1e-7 * x.roll(1)], [1e-30 * x, x.roll(1)]]
    columns = torch.stack([torch.cat(row) for row in rows]).to(dtype).requires_grad_()
    rotation = rotation_from_6d(columns)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-13
    torch.testing.assert_close(
        rotation @ rotation.mT, torch.eye(3, dtype=dtype).expand(7, 3, 3), atol=tolerance, rtol=0
    )
    torch.testing.assert_close(torch.det(rotation), torch.ones(7, dtype=dtype), atol=tolerance, rtol=0)
    (gradient,) = torch.autograd.grad((rotation_vector_from_6d(columns) * x.to(dtype)).sum(), columns)
    assert gradient.isfinite().all()
    torch.testing.assert_close(rotation[0], torch.eye(3, dtype=dtype))
    torch.testing.assert_close(rotation[1, :, 0], x.to(dtype))
    assert not gradient[0].any()


@pytest.mark.parametrize("vector", VECTORS)
def test_all_ways_there_and_back_agree_with_scipy(vector):
    truth = torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix())
    quaternion = quaternion_from_rotation_vector(vector)
    np.testing.assert_allclose(
        quaternion.abs(), np.abs(Rotation.from_rotvec(vector).as_quat(scalar_first=True)), atol=1e-15
    )
    for length in (1.0, -0.01, 1e5):
        torch.testing.assert_close(rotation_from_quaternion(length * quaternion), truth, atol=1e-14, rtol=0)
        back = rotation_vector_from_quaternion(length * quaternion)
        assert back.norm() <= math.pi + 1e-12
        torch.testing.assert_close(so3_exp(back), truth, atol=1e-14, rtol=0)
    torch.testing.assert_close(so3_exp(rotation_vector_from_rotation(truth)), truth, atol=1e-14, rtol=0)
    torch.testing.assert_close(
        so3_exp(rotation_vector_from_6d(rotation_vector_to_6d(vector))), truth, atol=1e-14, rtol=0
    )
    if vector.norm() < math.pi - 1e-6:
        torch.testing.assert_close(back, vector, atol=1e-14, rtol=1e-12)


@pytest.mark.parametrize("vector", VECTORS)
def test_gradients_hold_at_every_angle_zero_and_half_turns_too(vector):
    """Through the vector to the rotation it stands for: there no angle is special."""
    quaternion = 1.7 * quaternion_from_rotation_vector(vector)
    columns = rotation_vector_to_6d(vector) * torch.tensor([2.0, 2, 2, 0.5, 0.5, 0.5], dtype=D)
    assert gradcheck(rotation_from_quaternion, quaternion.requires_grad_())
    assert gradcheck(rotation_from_6d, columns.requires_grad_())
    assert gradcheck(lambda q: so3_exp(rotation_vector_from_quaternion(q)), quaternion)
    assert gradcheck(lambda c: so3_exp(rotation_vector_from_6d(c)), columns)


@pytest.mark.parametrize("angle", [0.0, 9.99e-3, 0.7, 3.0])
def test_vectors_have_right_gradients_of_their_own_below_half_turns(angle):
    quaternion = (0.3 * quaternion_from_rotation_vector(angle * AXIS)).requires_grad_()
    assert gradcheck(rotation_vector_from_quaternion, quaternion)
    assert gradcheck(rotation_vector_from_6d, rotation_vector_to_6d(angle * AXIS).requires_grad_())
    assert gradcheck(quaternion_from_rotation_vector, (angle * AXIS).clone().requires_grad_())


def test_the_zero_quaternion_is_no_rotation_and_takes_no_gradient():
    zero = torch.zeros(4, dtype=D, requires_grad=True)
    torch.testing.assert_close(rotation_from_quaternion(zero).detach(), torch.eye(3, dtype=D))
    vector = rotation_vector_from_quaternion(zero)
    assert not vector.any()
    assert not torch.autograd.grad(vector.sum() + rotation_from_quaternion(zero).sum(), zero)[0].any()


def test_the_rotation_does_not_jump_where_the_vector_does():
    turns = torch.linspace(-math.pi, 3 * math.pi, 400, dtype=D).unsqueeze(-1)
    quaternions = torch.cat([(turns / 2).cos(), (turns / 2).sin() * AXIS], dim=-1)
    rotation = so3_exp(rotation_vector_from_quaternion(quaternions))
    assert rotation.diff(dim=0).abs().max() < 0.035
    torch.testing.assert_close(rotation, rotation_from_quaternion(quaternions), atol=1e-13, rtol=0)


def test_batches_of_any_shape_and_float32():
    columns = randn(2, 3, 6)
    batch = rotation_vector_from_6d(columns)
    assert batch.shape == (2, 3, 3)
    torch.testing.assert_close(batch[1, 2], rotation_vector_from_6d(columns[1, 2]))
    torch.testing.assert_close(rotation_vector_from_6d(columns.float()).double(), batch, atol=1e-5, rtol=0)
    assert quaternion_from_rotation(rotation_from_6d(columns)).shape == (2, 3, 4)
