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
    """Return ``[[R, t], [0, 1]]`` (..., 4, 4)."""
    top = torch.cat([rotation, translation.unsqueeze(-1)], dim=-1)
    bottom = torch.eye(4, dtype=top.dtype, device=top.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def se3_exp(twist: Tensor) -> Tensor:
    """Return the rigid motion (..., 4, 4) of a twist (..., 6), which is (translation, rotation), metres and radians."""
    translation, rotation = twist[..., :3], twist[..., 3:]
    return rigid_matrix(so3_exp(rotation), (left_jacobian(rotation) @ translation.unsqueeze(-1)).squeeze(-1))


def se3_log(motion: Tensor) -> Tensor:
    """Return the twist (translation, rotation) of a rigid motion with a turn below pi (Barfoot 2017, eq. 7.95)."""
    turn = so3_log(motion[..., :3, :3])
    square = turn.square().sum(-1)[..., None, None]
    cross, eye = skew(turn), torch.eye(3, dtype=turn.dtype, device=turn.device)
    # (1 - (a/2) cot(a/2)) / a^2, whose series begins with 1/12 + a^2/720.
    half = 0.5 * torch.where(square > 1e-6, square, 1.0).sqrt()
    factor = torch.where(square > 1e-6, (1 - half / torch.tan(half)) / (4 * half.square()), 1 / 12 + square / 720)
    inverse = eye - 0.5 * cross + factor * cross @ cross
    return torch.cat([(inverse @ motion[..., :3, 3:]).squeeze(-1), turn], -1)


def adjoint(motion: Tensor) -> Tensor:
    """Return the (..., 6, 6) with ``T exp(x) T^-1 = exp(adjoint(T) x)``; twists are (translation, rotation)."""
    turn = motion[..., :3, :3]
    above = torch.cat([turn, skew(motion[..., :3, 3]) @ turn], -1)
    return torch.cat([above, torch.cat([torch.zeros_like(turn), turn], -1)], -2)


def invert_rigid(matrix: Tensor) -> Tensor:
    """Return the inverse of rigid motions (..., 4, 4), ``[[R^T, -R^T t], [0, 1]]``."""
    rotation = matrix[..., :3, :3].mT
    return rigid_matrix(rotation, -(rotation @ matrix[..., :3, 3:]).squeeze(-1))


def transform_points(matrix: Tensor, points: Tensor) -> Tensor:
    """Return ``R x + t`` for every point (..., N, 3), with broadcastable batch dimensions."""
    return points @ matrix[..., :3, :3].mT + matrix[..., None, :3, 3]


def fit_rigid(source: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the rigid motion (..., 4, 4) of least squares, ``argmin_T sum_i w_i |T x_i - y_i|^2`` (Umeyama 1991)."""
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
    """Return the same motions (..., 4, 4) in the coordinates ``x' = origin + scale x``."""
    rotation = transforms[..., :3, :3]
    shift = origin - (rotation @ origin.unsqueeze(-1)).squeeze(-1)
    return rigid_matrix(rotation, scale * transforms[..., :3, 3] + shift)
