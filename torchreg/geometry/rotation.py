"""Rotations: rotation vectors, matrices, and the maps between them, sound at every angle."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Squared angle, radians^2, below which series to fourth order are exact to float64 rounding.
SMALL_SQUARED_ANGLE = 1e-4
# 1 + cosine below which two directions are opposite.
_OPPOSITE = 1e-6
# Square root of two, and the positive root of x^4 = x + 4.
_SPIRAL_STEPS = (math.sqrt(2), 1.533751168755204288118041)


def skew(vector: Tensor) -> Tensor:
    """Return the matrix (..., 3, 3) ``[v]x`` with ``[v]x u = v x u``."""
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return torch.linalg.cross(vector.unsqueeze(-1), identity.expand(*vector.shape, 3), dim=-2)


def so3_exp(rotation_vector: Tensor) -> Tensor:
    """Return the rotation matrix of a rotation vector (radians), ``R = I + 2 cos(angle / 2) [v]x + 2 [v]x^2``.

    v is ``sin(angle / 2) axis``, of the unit quaternion; column vectors, right-hand rule. Smooth at zero too.
    """
    scalar, vector = _exp_quaternion(rotation_vector)
    identity = torch.eye(3, dtype=rotation_vector.dtype, device=rotation_vector.device)
    generator = skew(vector)
    half = torch.addcmul(generator @ generator, scalar.unsqueeze(-1), generator)
    return torch.add(identity, half, alpha=2)


def so3_log(rotation: Tensor) -> Tensor:
    """Return the rotation vector (..., 3) of a rotation matrix, with an angle in [0, pi], radians."""
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    return rotation_matrix_to_axis_angle(rotation)


def left_jacobian(rotation_vector: Tensor) -> Tensor:
    """Return J (..., 3, 3) with ``exp(w + dw) = exp(J dw) exp(w)`` to first order."""
    from kornia.geometry.liegroup import So3

    return So3.left_jacobian(rotation_vector.reshape(-1, 3)).reshape(*rotation_vector.shape, 3)


def compose_rotation_vectors(first: Tensor, second: Tensor) -> Tensor:
    """Return the rotation vector of ``exp(first) exp(second)``; quaternions are exact at half turns."""
    # In one tensor, since the time of a solver's step goes into the number of such small operations.
    scalars, vectors = _exp_quaternion(torch.stack(torch.broadcast_tensors(first, second)))
    (w1, w2), (v1, v2) = scalars.unbind(), vectors.unbind()
    scalar = w1 * w2 - (v1 * v2).sum(-1, keepdim=True)
    vector = torch.addcmul(torch.linalg.cross(v1, v2), w1, v2)
    return _quaternion_log(scalar, torch.addcmul(vector, w2, v1))


def wrap_rotation_vector(rotation_vector: Tensor) -> Tensor:
    """Return the rotation vector of the same rotation with an angle of at most pi, radians."""
    scalar, vector = _exp_quaternion(rotation_vector)
    return _quaternion_log(scalar, vector)


def rotation_between(start: Tensor, end: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) of smallest angle from unit vectors ``start`` to ``end``."""
    start, end = torch.broadcast_tensors(start, end)
    cosine = (start * end).sum(-1, keepdim=True).unsqueeze(-1)
    opposite = cosine < _OPPOSITE - 1
    cross = skew(torch.linalg.cross(start, end, dim=-1))
    identity = torch.eye(3, dtype=start.dtype, device=start.device)
    rotation = identity + cross + cross @ cross / torch.where(opposite, 1.0, 1 + cosine)
    smallest = torch.nn.functional.one_hot(start.detach().abs().argmin(-1), 3).to(start)
    axis = torch.linalg.cross(start, smallest, dim=-1)
    axis = axis / axis.norm(dim=-1, keepdim=True)
    return torch.where(opposite, 2 * axis.unsqueeze(-1) * axis.unsqueeze(-2) - identity, rotation)


def spread_rotations(count: int) -> Tensor:
    """Return ``count`` rotation matrices (count, 3, 3), float64, spread evenly: super-Fibonacci spirals, Alexa 2022."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    inner, outer = (index / count).sqrt(), (1 - index / count).sqrt()
    first, second = (2 * math.pi * index / step for step in _SPIRAL_STEPS)
    x, y, z, w = inner * first.sin(), inner * first.cos(), outer * second.sin(), outer * second.cos()
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _exp_quaternion(rotation_vector: Tensor) -> tuple[Tensor, Tensor]:
    """Return scalar (..., 1) and vector (..., 3) of the unit quaternion of a rotation vector."""
    if not torch.compiler.is_compiling() and torch.is_inference_mode_enabled():
        # Without derivatives, half the operations do; sinc(x) is sin(pi x) / (pi x).
        angle = torch.linalg.vector_norm(rotation_vector, dim=-1, keepdim=True)
        return (0.5 * angle).cos(), torch.sinc(angle * (0.5 / math.pi)) * (0.5 * rotation_vector)
    square = (rotation_vector * rotation_vector).sum(-1, keepdim=True)
    small = square < SMALL_SQUARED_ANGLE
    angle = square.masked_fill(small, 1.0).sqrt()
    half = angle / 2
    cosine = torch.where(small, _series(square, 1, -1 / 8, 1 / 384), half.cos())
    sine = torch.where(small, _series(square, 1 / 2, -1 / 48, 1 / 3840), half.sin() / angle)
    return cosine, sine * rotation_vector


def _series(x: Tensor, first: float, second: float, third: float) -> Tensor:
    """Return ``first + second x + third x^2`` in the two operations that cost least on few numbers."""
    return torch.addcmul(torch.rsub(x, first, alpha=-second), x, x, value=third)


def _quaternion_log(scalar: Tensor, vector: Tensor) -> Tensor:
    """Return the rotation vector of a unit quaternion, in half the operations of the logarithm of any quaternion."""
    if not torch.compiler.is_compiling() and torch.is_inference_mode_enabled():
        sine = torch.linalg.vector_norm(vector, dim=-1, keepdim=True).clamp_min(torch.finfo(vector.dtype).tiny)
        half = torch.atan2(torch.where(scalar < 0, -sine, sine), scalar.abs())
        return (half / sine) * (vector + vector)
    square = (vector * vector).sum(-1, keepdim=True)
    small = square < SMALL_SQUARED_ANGLE / 4
    sine = square.masked_fill(small, 1.0).sqrt()
    # asin(s) / s to fourth order, where the angle is small.
    half = torch.where(small, _series(square, 1, 1 / 6, 0.075), torch.atan2(sine, scalar.abs()) / sine)
    return torch.where(scalar < 0, -half, half) * (vector + vector)
