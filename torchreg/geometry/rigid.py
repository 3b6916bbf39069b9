"""Rigid motions as 4 x 4 matrices acting on column vectors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.rotation import left_jacobian, skew, so3_exp, so3_log


@dataclass(frozen=True)
class RigidTolerance:
    """Largest entries of ``|R R^T - I|`` and of the last row's error that a rigid motion may have."""

    # Computed in float64.
    double: float = 1e-6
    # Computed in float32, or by a chain of products.
    single: float = 1e-4
    # Written by other programs with few digits.
    rounded: float = 1e-3


RIGID_TOLERANCE = RigidTolerance()


def rotation_error(matrices: Tensor) -> float:
    """Return the largest entry of ``|R R^T - I|`` over matrices (..., 3, 3), zero for rotations and mirror images."""
    identity = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    return float((matrices @ matrices.mT - identity).abs().max())


def rigid_matrix(rotation: Tensor, translation: Tensor) -> Tensor:
    """Return ``[[R, t], [0, 1]]``.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3), metres.

    Returns:
        (..., 4, 4).

    Differentiable: in both.
    """
    top = torch.cat([rotation, translation.unsqueeze(-1)], dim=-1)
    bottom = torch.eye(4, dtype=top.dtype, device=top.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def se3_exp(twist: Tensor) -> Tensor:
    """Return the rigid motion of a twist, the exponential map of SE(3).

    Convention: twists are (translation, rotation).

    Args:
        twist: (..., 6), metres and radians.

    Returns:
        (..., 4, 4).

    Differentiable: in ``twist``, also at zero.
    """
    translation, rotation = twist[..., :3], twist[..., 3:]
    return rigid_matrix(so3_exp(rotation), (left_jacobian(rotation) @ translation.unsqueeze(-1)).squeeze(-1))


def se3_log(motion: Tensor) -> Tensor:
    """Return the twist (..., 6) of a rigid motion (..., 4, 4), of which `se3_exp` is the motion; turns below pi.

    Convention: twists are (translation, rotation).

    Differentiable: in ``motion``, not at turns by pi.

    References: Barfoot 2017, eq. 7.95 for the inverse of the left Jacobian.
    """
    turn = so3_log(motion[..., :3, :3])
    square = turn.square().sum(-1)[..., None, None]
    cross, eye = skew(turn), torch.eye(3, dtype=turn.dtype, device=turn.device)
    # (1 - (a/2) cot(a/2)) / a^2, whose series begins with 1/12 + a^2/720.
    half = 0.5 * torch.where(square > 1e-6, square, 1.0).sqrt()
    factor = torch.where(square > 1e-6, (1 - half / torch.tan(half)) / (4 * half.square()), 1 / 12 + square / 720)
    inverse = eye - 0.5 * cross + factor * cross @ cross
    return torch.cat([(inverse @ motion[..., :3, 3:]).squeeze(-1), turn], -1)


def adjoint(motion: Tensor) -> Tensor:
    """Return the matrices (..., 6, 6) by which twists are seen from where motions (..., 4, 4) take their frame.

    ``T exp(x) T^-1 = exp(adjoint(T) x)``; twists are (translation, rotation).

    Differentiable: in ``motion``.
    """
    turn = motion[..., :3, :3]
    above = torch.cat([turn, skew(motion[..., :3, 3]) @ turn], -1)
    return torch.cat([above, torch.cat([torch.zeros_like(turn), turn], -1)], -2)


def invert_rigid(matrix: Tensor) -> Tensor:
    """Return the inverse of rigid motions, ``[[R^T, -R^T t], [0, 1]]``.

    Args:
        matrix: (..., 4, 4) rigid motions.

    Returns:
        (..., 4, 4).

    Differentiable: in ``matrix``.
    """
    rotation = matrix[..., :3, :3].mT
    return rigid_matrix(rotation, -(rotation @ matrix[..., :3, 3:]).squeeze(-1))


def transform_points(matrix: Tensor, points: Tensor) -> Tensor:
    """Return ``R x + t`` for every point.

    Args:
        matrix: (..., 4, 4).
        points: (..., N, 3), with broadcastable batch dimensions and the same dtype.

    Returns:
        (..., N, 3).

    Differentiable: in both.
    """
    return points @ matrix[..., :3, :3].mT + matrix[..., None, :3, 3]


def fit_rigid(source: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the rigid motion that takes ``source`` to ``target`` in the weighted least-squares sense.

    ``argmin_T sum_i w_i |T x_i - y_i|^2``, by SVD of the cross-covariance with det R = +1.

    Args:
        source: (..., N, 3).
        target: (..., N, 3), matched point by point.
        weights: (..., N), not negative; all ones by default.

    Returns:
        (..., 4, 4).

    Differentiable: in all, where the singular values of the cross-covariance differ.

    References: Umeyama 1991.
    """
    weights = torch.ones_like(source[..., 0]) if weights is None else weights
    weights = (weights / weights.sum(-1, keepdim=True).clamp_min(torch.finfo(source.dtype).tiny)).unsqueeze(-1)
    source_mean = (weights * source).sum(-2, keepdim=True)
    target_mean = (weights * target).sum(-2, keepdim=True)
    covariance = (weights * (target - target_mean)).mT @ (source - source_mean)
    u, _, vt = torch.linalg.svd(covariance)
    sign = torch.det(u @ vt).sign()
    flip = torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1))
    rotation = u @ flip @ vt
    translation = target_mean - source_mean @ rotation.mT
    return rigid_matrix(rotation, translation.squeeze(-2))


def rescale_motions(transforms: Tensor, scale: float, origin: Tensor) -> Tensor:
    """Return the same motions (..., 4, 4) in the coordinates ``x' = origin + scale x``.

    Args:
        transforms: (..., 4, 4) rigid motions in the coordinates x.
        scale: of the new coordinates, positive.
        origin: (3,) the old origin in the new coordinates.

    Returns:
        (..., 4, 4).

    Differentiable: in ``transforms`` and ``origin``.
    """
    rotation = transforms[..., :3, :3]
    shift = origin - (rotation @ origin.unsqueeze(-1)).squeeze(-1)
    return rigid_matrix(rotation, scale * transforms[..., :3, 3] + shift)
