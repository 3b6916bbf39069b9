"""Rigid fits of groups of matched points from their moments, which add up when groups are joined."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.rigid import rigid_matrix


@dataclass(frozen=True)
class RigidMoments:
    """Sufficient statistics for rigid fits of G groups of matched points; those of two groups add up when joined."""

    sums: Tensor  # (..., G, 17) weighted sums of 1, x, y, ``|x|^2 + |y|^2`` and ``y x^T``, about the origins
    source_origin: Tensor  # (..., 3) subtracted from the points before summing, against cancellation
    target_origin: Tensor  # (..., 3) subtracted from the matches

    @property
    def num_groups(self) -> int:
        """G."""
        return self.sums.shape[-2]

    @property
    def mass(self) -> Tensor:
        """Total weight (..., G) of each group."""
        return self.sums[..., 0]

    def cost(self) -> Tensor:
        """Return the least ``sum_i w_i |T x_i - y_i|^2`` (..., G) over rigid motions T, of each group."""
        return least_cost(self.sums)

    def motions(self) -> Tensor:
        """Return the best rigid motions (..., G, 4, 4); the identity for a group without mass."""
        mass, source, target, covariance, _ = _central(self.sums)
        u, _, vh = torch.linalg.svd(covariance)
        sign = torch.where(torch.linalg.det(u @ vh) < 0, -1.0, 1.0).to(mass)
        u = torch.cat([u[..., :2], sign[..., None, None] * u[..., 2:]], dim=-1)
        identity = torch.eye(3, dtype=mass.dtype, device=mass.device)
        rotation = torch.where(mass[..., None, None] > 0, u @ vh, identity)
        source, target = source + self.source_origin.unsqueeze(-2), target + self.target_origin.unsqueeze(-2)
        shift = target - (rotation @ source.unsqueeze(-1)).squeeze(-1)
        return rigid_matrix(rotation, torch.where(mass[..., None] > 0, shift, 0.0))

    def joined(self, group: Tensor, count: int) -> RigidMoments:
        """Return the moments of ``count`` joined groups, given the joined group (G,) of each group."""
        blank = self.sums.new_zeros(*self.sums.shape[:-2], count, self.sums.shape[-1])
        sums = blank.index_add(-2, group, self.sums)
        return RigidMoments(sums, self.source_origin, self.target_origin)


def rigid_moments(source: Tensor, target: Tensor, weights: Tensor, labels: Tensor, count: int) -> RigidMoments:
    """Return the moments of groups of source points (N, 3) and matches (..., N, 3), by labels (N,) (Horn 1987)."""
    source_origin, target_origin = source.mean(-2), target.mean(-2)
    x, y = (source - source_origin).expand(target.shape), target - target_origin.unsqueeze(-2)
    square = (x.square() + y.square()).sum(-1, keepdim=True)
    cross = (y.unsqueeze(-1) * x.unsqueeze(-2)).flatten(-2)
    rows = weights.unsqueeze(-1) * torch.cat([torch.ones_like(square), x, y, square, cross], dim=-1)
    sums = rows.new_zeros(*rows.shape[:-2], count, rows.shape[-1]).index_add(-2, labels, rows)
    return RigidMoments(sums, source_origin, target_origin)


def least_cost(sums: Tensor) -> Tensor:
    """Return the least cost (...) of sums (..., 17), see `RigidMoments.cost`."""
    _, _, _, covariance, spread = _central(sums)
    size = torch.linalg.svdvals(covariance)
    sign = torch.where(torch.linalg.det(covariance) < 0, -1.0, 1.0).to(sums)
    # The trace of the best rotation's product with the covariance; a mirror image costs twice the least value.
    trace = size[..., 0] + size[..., 1] + sign * size[..., 2]
    return (spread - 2 * trace).clamp_min(0.0)


def _central(sums: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return mass, means of source and target, covariance ``sum w (y - my) (x - mx)^T``, and both spreads' sum."""
    mass = sums[..., 0]
    safe = mass.clamp_min(torch.finfo(sums.dtype).tiny).unsqueeze(-1)
    source, target = sums[..., 1:4] / safe, sums[..., 4:7] / safe
    spread = sums[..., 7] - mass * (source.square() + target.square()).sum(-1)
    outer = mass[..., None, None] * target.unsqueeze(-1) * source.unsqueeze(-2)
    return mass, source, target, sums[..., 8:].unflatten(-1, (3, 3)) - outer, spread
