"""Rigid motions of bones, and their blends, which points follow by the weights of several bones."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg._checks import check_finite
from torchreg.errors import InputError
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import skew, so3_exp
from torchreg.geometry.rotation_representations import quaternion_from_rotation


def turn_about(transforms: Tensor, twists: Tensor, centers: Tensor) -> Tensor:
    """Return rigid motions (..., 4, 4) updated by twists (..., 6), translation and rotation, about centers (..., 3).

    ``R <- exp(w) R``, ``t <- c + exp(w) (t - c) + v``: about a point near the bone, rotation and translation decouple.
    """
    turn = so3_exp(twists[..., 3:])
    arm = transforms[..., :3, 3] - centers
    shift = centers + (turn @ arm.unsqueeze(-1)).squeeze(-1) + twists[..., :3]
    return rigid_matrix(turn @ transforms[..., :3, :3], shift)


def blend_linear(points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Return points (..., N, 3) moved by ``sum_j w_j (R_j x + t_j)`` (Chang and Zwicker 2009, eq. 1)."""
    rows = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    return (rows[..., :3] @ points.unsqueeze(-1)).squeeze(-1) + rows[..., 3]


def blend_dual_quaternion(points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Return points moved by the normalized weighted sum of unit dual quaternions (Kavan et al. 2007, eqs. 16-17)."""
    real, dual, sign = _signed_quaternions(weights, transforms)
    signed = weights * sign
    return _move(points, signed @ real, signed @ dual)


def blend_linear_jacobian(points: Tensor, weights: Tensor, transforms: Tensor, centers: Tensor) -> Tensor:
    """Return the derivatives (..., N, 3, B, 6) of `blend_linear` by the bones' twists about centers (..., B, 3)."""
    moved = points.unsqueeze(-3) @ transforms[..., :3, :3].mT + transforms[..., None, :3, 3]
    arms = (moved - centers.unsqueeze(-2)).transpose(-2, -3)
    identity = torch.eye(3, dtype=arms.dtype, device=arms.device).expand(*arms.shape, 3)
    blocks = weights[..., None, None] * torch.cat([identity, -skew(arms)], dim=-1)
    return blocks.transpose(-2, -3)


def blend_dual_quaternion_jacobian(points: Tensor, weights: Tensor, transforms: Tensor, centers: Tensor) -> Tensor:
    """Return the derivatives (..., N, 3, B, 6) of `blend_dual_quaternion` by the bones' twists about centers."""
    real, dual, sign = _signed_quaternions(weights, transforms)
    share = (weights * sign).unsqueeze(-1)
    by_real, by_dual = _move_jacobian(
        points, (share * real.unsqueeze(-3)).sum(-2), (share * dual.unsqueeze(-3)).sum(-2)
    )
    # A twist (v, w) about c is the world twist (v + c x w, w); its half multiplies both parts from the left.
    turn_real, turn_dual = _left_products(real), _left_products(dual)
    shift = torch.cat([torch.zeros_like(turn_real), turn_real], dim=-2)
    turn = torch.cat([turn_real, turn_dual], dim=-2) + shift @ skew(centers)
    per_bone = 0.5 * torch.cat([shift, turn], dim=-1)
    by_both = torch.cat([by_real, by_dual], dim=-1)
    product = torch.einsum("...nxq,...bqk->...nxbk", by_both, per_bone)
    return product * share.unsqueeze(-3)


# The blends by name, each with its derivatives by the bones' twists. States hold their numbers: new ones come last.
BLENDS = {
    "linear": (blend_linear, blend_linear_jacobian),
    "dual_quaternion": (blend_dual_quaternion, blend_dual_quaternion_jacobian),
}


def _signed_quaternions(weights: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return real and dual parts (..., B, 4) of the bones, and the sign (..., N, B) that each takes at each point."""
    real = quaternion_from_rotation(transforms[..., :3, :3])
    scalar, vector = real[..., :1], real[..., 1:]
    shift = transforms[..., :3, 3]
    dual = 0.5 * torch.cat(
        [-(shift * vector).sum(-1, keepdim=True), scalar * shift + torch.linalg.cross(shift, vector)], dim=-1
    )
    with torch.no_grad():
        side = torch.where(real @ real.mT < 0, -1.0, 1.0).to(real.dtype)
        pivot = torch.nn.functional.one_hot(weights.argmax(-1), weights.shape[-1]).to(real.dtype)
        sign = pivot @ side
    return real, dual, sign


def _move(points: Tensor, real: Tensor, dual: Tensor) -> Tensor:
    """Return points moved by dual quaternions that need not have unit length; homogeneous of degree zero in them."""
    a, b = real[..., :1], dual[..., :1]
    points, u, d = torch.broadcast_tensors(points, real[..., 1:], dual[..., 1:])
    square = (real * real).sum(-1, keepdim=True)
    turned = torch.linalg.cross(u, torch.linalg.cross(u, points) + a * points)
    shift = a * d - b * u + torch.linalg.cross(u, d)
    return points + 2 * (turned + shift) / square


def _move_jacobian(points: Tensor, real: Tensor, dual: Tensor) -> tuple[Tensor, Tensor]:
    """Return the derivatives (..., N, 3, 4) of `_move` by the real and the dual part."""
    a, u, b, d = real[..., :1], real[..., 1:], dual[..., :1], dual[..., 1:]
    square = (real * real).sum(-1)[..., None, None]
    moved = _move(points, real, dual) - points
    x = points.expand(moved.shape)
    identity = torch.eye(3, dtype=x.dtype, device=x.device)
    by_a = torch.linalg.cross(u.expand(x.shape), x) + d
    # d(u x (u x x)) = (u . x) du + u (x . du) - 2 x (u . du); the rest is linear in u.
    outer = u.unsqueeze(-1) * x.unsqueeze(-2) - 2 * x.unsqueeze(-1) * u.unsqueeze(-2)
    by_u = (u * x).sum(-1)[..., None, None] * identity + outer - a.unsqueeze(-1) * skew(x)
    by_u = by_u - b.unsqueeze(-1) * identity - skew(d)
    by_real = 2 * torch.cat([by_a.unsqueeze(-1), by_u], dim=-1) - 2 * moved.unsqueeze(-1) * real.unsqueeze(-2)
    by_dual = 2 * torch.cat([-u.unsqueeze(-1), a.unsqueeze(-1) * identity + skew(u)], dim=-1)
    return by_real / square, by_dual.expand(by_real.shape) / square


def _left_products(quaternion: Tensor) -> Tensor:
    """Return (..., 4, 3): the products (0, e_k) q with the three units."""
    scalar, vector = quaternion[..., :1], quaternion[..., 1:]
    identity = torch.eye(3, dtype=quaternion.dtype, device=quaternion.device)
    return torch.cat([-vector.unsqueeze(-2), scalar.unsqueeze(-1) * identity - skew(vector)], dim=-2)


def check_rigid_motions(transforms: Tensor, name: str) -> None:
    """Raise InputError unless all of ``transforms`` (..., 4, 4) are rigid motions to single precision."""
    check_finite(transforms, name)
    rotation = transforms[..., :3, :3].detach().double()
    deviation = (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64, device=rotation.device)).abs()
    bottom = (transforms[..., 3, :].detach() - transforms.new_tensor([0.0, 0.0, 0.0, 1.0])).abs()
    if transforms.numel() and (
        float(deviation.max()) > 1e-3 or float(bottom.max()) > 1e-6 or bool((torch.linalg.det(rotation) < 0).any())
    ):
        raise InputError(
            f"{name} must hold rigid motions, got one with scale, shear, mirror or a last row other than 0 0 0 1 "
            f"(off by {max(float(deviation.max()), float(bottom.max())):.2g})"
        )
