"""Rotations: rotation vectors, matrices, and the maps between them, sound at every angle."""

from __future__ import annotations

import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from kornia.geometry.liegroup import So3
from torch import Tensor

# Below this squared angle the series to fourth order is exact to float64 rounding.
_SMALL_SQUARED_ANGLE = 1e-4


def skew(vector: Tensor) -> Tensor:
    """Return the matrix ``[v]x`` with ``[v]x u = v x u``.

    Args:
        vector: (..., 3).

    Returns:
        (..., 3, 3) antisymmetric matrices.

    Differentiable: in ``vector``.
    """
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def so3_exp(rotation_vector: Tensor) -> Tensor:
    """Return the rotation matrix of a rotation vector, ``R = I + a [w]x + b [w]x^2``.

    Convention: angle in radians times unit axis; column vectors, right-hand rule.

    Args:
        rotation_vector: (..., 3), radians.

    Returns:
        (..., 3, 3) rotation matrices.

    Differentiable: in ``rotation_vector``, to any order, also at zero.
    """
    square = rotation_vector.square().sum(-1, keepdim=True).unsqueeze(-1)
    small = square < _SMALL_SQUARED_ANGLE
    safe = torch.where(small, 1.0, square)
    angle = safe.sqrt()
    a = torch.where(small, 1 - square / 6 * (1 - square / 20), angle.sin() / angle)
    b = torch.where(small, 0.5 - square / 24 * (1 - square / 30), (1 - angle.cos()) / safe)
    generator = skew(rotation_vector)
    identity = torch.eye(3, dtype=rotation_vector.dtype, device=rotation_vector.device)
    return identity + a * generator + b * (generator @ generator)


def so3_log(rotation: Tensor) -> Tensor:
    """Return the rotation vector of a rotation matrix, with an angle in [0, pi].

    Args:
        rotation: (..., 3, 3) rotation matrices.

    Returns:
        (..., 3) rotation vectors, radians.

    Differentiable: in ``rotation``, at angles below pi.
    """
    return rotation_matrix_to_axis_angle(rotation)


def left_jacobian(rotation_vector: Tensor) -> Tensor:
    """Return J with ``exp(w + dw) = exp(J dw) exp(w)`` to first order.

    Args:
        rotation_vector: (..., 3), radians.

    Returns:
        (..., 3, 3).

    Differentiable: in ``rotation_vector``, also at zero.
    """
    return So3.left_jacobian(rotation_vector.reshape(-1, 3)).reshape(*rotation_vector.shape, 3)


def compose_rotation_vectors(first: Tensor, second: Tensor) -> Tensor:
    """Return the rotation vector of ``exp(first) exp(second)``, wrapped to an angle of at most pi.

    The product is taken on unit quaternions, which are exact at half turns where the matrix logarithm is not.

    Args:
        first: (..., 3), applied last.
        second: (..., 3), applied first.

    Returns:
        (..., 3), radians.

    Differentiable: in both, where the resulting angle is below pi.
    """
    w1, v1 = _unit_quaternion(first)
    w2, v2 = _unit_quaternion(second)
    v1, v2 = torch.broadcast_tensors(v1, v2)
    scalar = w1 * w2 - (v1 * v2).sum(-1, keepdim=True)
    vector = w1 * v2 + w2 * v1 + torch.linalg.cross(v1, v2)
    return _quaternion_log(scalar, vector)


def wrap_rotation_vector(rotation_vector: Tensor) -> Tensor:
    """Return the rotation vector of the same rotation with an angle of at most pi.

    Args:
        rotation_vector: (..., 3), radians.

    Returns:
        (..., 3), radians.

    Differentiable: in ``rotation_vector``, except at odd multiples of pi.
    """
    scalar, vector = _unit_quaternion(rotation_vector)
    return _quaternion_log(scalar, vector)


def _unit_quaternion(rotation_vector: Tensor) -> tuple[Tensor, Tensor]:
    square = rotation_vector.square().sum(-1, keepdim=True)
    small = square < _SMALL_SQUARED_ANGLE
    angle = torch.where(small, 1.0, square).sqrt()
    cosine = torch.where(small, 1 - square / 8 * (1 - square / 48), (angle / 2).cos())
    sine = torch.where(small, 0.5 - square / 48 * (1 - square / 80), (angle / 2).sin() / angle)
    return cosine, sine * rotation_vector


def _quaternion_log(scalar: Tensor, vector: Tensor) -> Tensor:
    """Return the rotation vector of a unit quaternion; half the operations of the general one, which solvers feel."""
    square = vector.square().sum(-1, keepdim=True)
    sign = torch.where(scalar < 0, -1.0, 1.0).to(vector.dtype)
    small = square < _SMALL_SQUARED_ANGLE / 4
    sine = torch.where(small, 1.0, square).sqrt()
    # asin(s) / s to fourth order, where the angle is small.
    factor = torch.where(small, 2 + square / 3 * (1 + 9 * square / 20), 2 * torch.atan2(sine, scalar * sign) / sine)
    return sign * factor * vector
