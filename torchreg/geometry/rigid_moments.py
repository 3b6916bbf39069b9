"""Rigid motions of groups of matched points from sums that add up, so that groups can be joined and tried cheaply."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_same_kind, check_shape
from torchreg.geometry.rigid import rigid_matrix


@dataclass(frozen=True)
class RigidMoments:
    """What a rigid fit asks of the matched points of G groups; moments of two groups add up to those of both.

    Args:
        sums: (..., G, 17) weighted sums of 1, x, y, ``|x|^2 + |y|^2`` and ``y x^T``, about the origins.
        source_origin: (..., 3) subtracted from the points before summing, against cancellation.
        target_origin: (..., 3) of the matches.
    """

    sums: Tensor
    source_origin: Tensor
    target_origin: Tensor

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
        """Return the best rigid motions (..., G, 4, 4); a group without mass stays where it is."""
        mass, source, target, covariance, _ = _central(self.sums)
        left, _, right = torch.linalg.svd(covariance)
        sign = torch.where(torch.linalg.det(left @ right) < 0, -1.0, 1.0).to(mass)
        left = torch.cat([left[..., :2], sign[..., None, None] * left[..., 2:]], dim=-1)
        identity = torch.eye(3, dtype=mass.dtype, device=mass.device)
        rotation = torch.where(mass[..., None, None] > 0, left @ right, identity)
        source, target = source + self.source_origin.unsqueeze(-2), target + self.target_origin.unsqueeze(-2)
        shift = target - (rotation @ source.unsqueeze(-1)).squeeze(-1)
        return rigid_matrix(rotation, torch.where(mass[..., None] > 0, shift, 0.0))

    def joined(self, group: Tensor, count: int) -> RigidMoments:
        """Return the moments of ``count`` groups, of which ``group`` (G,) names the one that each joins."""
        blank = self.sums.new_zeros(*self.sums.shape[:-2], count, self.sums.shape[-1])
        sums = blank.index_add(-2, group, self.sums)
        return RigidMoments(sums, self.source_origin, self.target_origin)


def rigid_moments(source: Tensor, target: Tensor, weights: Tensor, labels: Tensor, count: int) -> RigidMoments:
    """Return the moments of groups of matched points, in every pose of a batch.

    Args:
        source: (N, 3).
        target: (..., N, 3) the matches.
        weights: (..., N) not negative.
        labels: (N,) int64, the group of each.
        count: G.

    Raises:
        InputError: if a shape does not fit.
        InputTypeError: if dtypes or devices differ.

    Differentiable: in ``source``, ``target`` and ``weights``.

    References: Horn 1987, for what a rigid fit depends on.
    """
    check_count(count, "count", 1)
    check_shape(source, "source", ("N", 3))
    check_shape(target, "target", tuple(source.shape), batch=True)
    check_same_kind(target, "target", source, "source")
    check_shape(weights, "weights", tuple(target.shape[:-1]))
    check_shape(labels, "labels", (len(source),))
    here, there = source.mean(-2), target.mean(-2)
    x, y = (source - here).expand(target.shape), target - there.unsqueeze(-2)
    square = (x.square() + y.square()).sum(-1, keepdim=True)
    cross = (y.unsqueeze(-1) * x.unsqueeze(-2)).flatten(-2)
    rows = weights.unsqueeze(-1) * torch.cat([torch.ones_like(square), x, y, square, cross], dim=-1)
    sums = rows.new_zeros(*rows.shape[:-2], count, rows.shape[-1]).index_add(-2, labels, rows)
    return RigidMoments(sums, here, there)


def least_cost(sums: Tensor) -> Tensor:
    """Return what `RigidMoments.cost` does, of sums (..., 17)."""
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
