"""Parts of a surface that move as bones do: neither rigidly with a neighbor nor as a blend of two."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rigid_moments import rigid_moments
from torchreg.geometry.sampling import farthest_points
from torchreg.registration.bones.rigid_parts import merge_rigid


@dataclass(frozen=True)
class _Candidates:
    """What may be a bone before blends are left out."""

    points: int = 12  # of a patch: a rigid motion has six unknowns, and a point on a surface shows one to three
    patches: int = 4  # of a candidate, on average, whose borders they are


_CANDIDATES = _Candidates()


def moving_parts(
    points: Tensor, edges: Tensor, moved: Tensor, weights: Tensor, *, most: int, cost: float
) -> tuple[Tensor, Tensor]:
    """Return the part (N,) of each point (N, 3) and the parts' motions (T, P, 4, 4), of points moved to (T, N, 3).

    Patches are merged to more parts than there are bones, as a rigid part cannot tell a bend from a bone. Then the part
    is left out, again and again, whose points the linear blends of two neighbors, each point with a share of its own,
    explain best, until that adds more to the mean squared residual with weights (T, N) than ``cost`` squared and what
    the motions of a bone take to describe in patches of that residual, and at most ``most`` are left (Schwarz 1978;
    Ward 1963; Le and Deng 2014, section 4, for bones that others explain).
    """
    weights = weights / weights.sum()
    length = (points[edges[:, 0]] - points[edges[:, 1]]).norm(dim=-1)
    count = max(1, len(points) // _CANDIDATES.points)
    seeds = farthest_points(points, count)
    patch = Graph.from_edges(edges, length, len(points)).nearest(seeds)[1]
    moments = rigid_moments(points, moved, weights, patch, len(seeds))
    part = merge_rigid(moments, patch[edges], max(1, count // _CANDIDATES.patches))
    motions = moments.joined(part, int(part.max()) + 1).motions()
    bones = _Bones(points, edges, moved, weights, part[patch], motions)
    bones.leave_out(most, cost**2)
    kept, part = bones.part.unique(return_inverse=True)
    return part, motions[:, kept]


class _Bones:
    """The part (N,) of each point while bones are left out, and the squared residual (N,) that each point has."""

    def __init__(
        self, points: Tensor, edges: Tensor, moved: Tensor, weights: Tensor, part: Tensor, motions: Tensor
    ) -> None:
        self._points, self._edges, self._moved, self._weights = points, edges, moved, weights
        self.part, self._motions = part.clone(), motions
        independent = 1 + len(points) // _CANDIDATES.points
        self._share = math.log(independent) / independent
        everywhere = torch.arange(len(points))
        self._residual = self._blended(everywhere, motions[:, part], motions[:, part])[0]

    def leave_out(self, most: int, cost: float) -> None:
        """Leave out bones, the cheapest first, until one costs more and few enough are left."""
        found = {bone: self._without(bone) for bone in self.part.unique().tolist()}
        while len(found) > 1:
            bone = min(found, key=lambda each: found[each][0])
            price, own, part, residual = found[bone]
            worth = cost + float(self._residual.sum()) * self._share
            if price == float("inf") or (price > worth and len(found) <= most):
                break
            around = self._neighbors(bone)
            self.part[own], self._residual[own] = part, residual
            del found[bone]
            found |= {other: self._without(other) for other in around}

    def _neighbors(self, bone: int) -> list[int]:
        ends = self.part[self._edges]
        return [other for other in ends[(ends == bone).any(1)].unique().tolist() if other != bone]

    def _without(self, bone: int) -> tuple[float, Tensor, Tensor, Tensor]:
        """Return what leaving out a bone adds, its points (n,), and the parts and residuals that these then have."""
        own, around = (self.part == bone).nonzero()[:, 0], self._neighbors(bone)
        pairs = list(combinations(around, 2)) or [(other, other) for other in around]
        if not pairs:
            return float("inf"), own, self.part[own], self._residual[own]
        first, second = torch.tensor(pairs).unbind(1)
        residual, share = self._blended(own, self._motions[:, first, None], self._motions[:, second, None])
        best = int(residual.sum(-1).argmin())
        part = torch.where(share[best] > 0.5, second[best], first[best])
        return float((residual[best] - self._residual[own]).sum()), own, part, residual[best]

    def _blended(self, index: Tensor, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residuals (..., n) of points (n,) by their best blends of two motions (T, ..., n or 1, 4, 4)."""
        points, weights = self._points[index], self._weights[:, index]
        one, other = (transform_points(motion, points.unsqueeze(-2)).squeeze(-2) for motion in (first, second))
        shape = (len(weights), *(1,) * (one.ndim - 3), len(index))
        target, weights = self._moved[:, index].reshape(*shape, 3), weights.reshape(*shape, 1)
        step = other - one
        along = (weights * step * (target - one)).sum((0, -1)) / (
            (weights * step * step).sum((0, -1)).clamp_min(torch.finfo(step.dtype).tiny)
        )
        share = along.clamp(0, 1)
        return (weights * (one + share[..., None] * step - target).square()).sum((0, -1)), share
