"""Limbs from rings: the best of several versions, freed of what belongs to the junctions, made even, with frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.spines.curves import curve_frames
from torchreg.spines.tip_trees import Tips, TipTree, ring_widths

# Passes of averaging a curve with its neighbors, 1-2-1.
_SMOOTH_PASSES = 4
# How hard axes resist turning from one point to the next, where a weight of 1 is a flat ring; and Newton steps.
_STIFFNESS, _FLOOR, _NEWTON_STEPS = 8.0, 1e-6, 12


@dataclass(frozen=True, eq=False)
class Ball:
    """What a junction takes up: rings with their center inside belong to it, not to a limb.

    Args:
        center: (3,).
        radius: of a ball inside the surface.
    """

    center: Tensor
    radius: float


@dataclass(frozen=True, eq=False)
class Rings:
    """A stretch of rings, in order.

    Args:
        centers: (n, 3).
        covariances: (n, 3, 3).
        costs: (n,) C of eq. 4 over the largest of all skeletons.
    """

    centers: Tensor
    covariances: Tensor
    costs: Tensor

    def __getitem__(self, part: slice | Tensor) -> Rings:
        return Rings(self.centers[part], self.covariances[part], self.costs[part])

    def __len__(self) -> int:
        return self.centers.shape[0]

    def flip(self) -> Rings:
        """Return the rings in the opposite order."""
        return self[torch.arange(len(self) - 1, -1, -1)]

    @property
    def widths(self) -> Tensor:
        """Root mean square distances (n,) to the centers."""
        return self.covariances.diagonal(dim1=1, dim2=2).sum(-1).sqrt()

    @property
    def quality(self) -> float:
        """Q of eq. 5: the number of rings less the sum of their costs."""
        return len(self) - float(self.costs.sum())


def largest_cost(trees: Sequence[TipTree]) -> float:
    """Return the largest C of eq. 4 over all rings of all trees: the mean squared distance to the center."""
    return max(float(ring_widths(tree.sets)[branch.rings].max()) ** 2 for tree in trees for branch in tree.branches)


def best_rings(tips: Tips, trees: Sequence[TipTree], start: Ball | None, end: Ball | None, cost: float) -> Rings:
    """Return the rings of a limb from the tree that has the best ones, freed of those in the balls at its ends.

    Args:
        tips: those beyond the limb.
        trees: one per tip.
        start: the junction at the side away from ``tips``; None where the limb ends in a tip.
        end: the junction at their side, or None.
        cost: the largest C, see `largest_cost`.

    Returns:
        rings from ``start`` to ``end``; none if no tree has the limb, or it lies in the balls.

    References: Brostow et al. 2004, eq. 4 and 5.
    """
    everything = frozenset(range(len(trees)))
    best = Rings(torch.zeros(0, 3).double(), torch.zeros(0, 3, 3).double(), torch.zeros(0).double())
    for tree in trees:
        outwards = tree.root not in tips
        for branch in tree.branches:
            if branch.tips != (tips if outwards else everything - tips):
                continue
            covariances = tree.sets.covariances[branch.rings]
            costs = covariances.diagonal(dim1=1, dim2=2).sum(-1) / cost
            rings = Rings(tree.sets.centers[branch.rings], covariances, costs)
            rings = _outside(rings if outwards else rings.flip(), start)
            rings = _outside(rings.flip(), end).flip()
            if rings.quality > best.quality:
                best = rings
    return best


def _outside(rings: Rings, ball: Ball | None) -> Rings:
    """Return the rings from where they leave a ball that they start in, or near which they pass at first."""
    if ball is None or len(rings) == 0:
        return rings
    apart = (rings.centers - ball.center).norm(dim=-1)
    steps = (rings.centers[1:] - rings.centers[:-1]).norm(dim=-1)
    along = torch.cat((steps.new_zeros(1), steps.cumsum(0)))
    # Far along the limb it may come near again: an arm that is crossed over the chest.
    early = along <= 2 * apart[0] + ball.radius
    nearest = int(torch.where(early, apart, torch.inf).argmin())
    out = (apart[nearest:] > ball.radius).nonzero()
    return rings[nearest + int(out[0]) :] if len(out) else rings[:0]


def limb_curve(start: Tensor, rings: Rings, end: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Return a limb as points (n, 3) at equal steps, and frames (n, 3, 3).

    Args:
        start: (3,) first point.
        rings: those between.
        end: (3,) last point.
        spacing: about the length of a step.

    Convention: the columns of a frame are the major and minor axis of the ring across the limb, turned so that the
    third, right-handed to them, is the direction of the limb; signs carry on along the limb. A round ring has no major
    axis: axes count by how elongated the rings are, in double angles, and resist turning, so that they neither jump nor
    spin.
    """
    polyline = torch.cat((start[None], rings.centers, end[None]))
    points, share = _even(polyline, spacing)
    for _ in range(_SMOOTH_PASSES):
        points = torch.cat((points[:1], 0.25 * (points[:-2] + 2 * points[1:-1] + points[2:]), points[-1:]))
    points, _ = _even(points, spacing)
    padded = torch.cat((torch.zeros(1, 3, 3).double(), rings.covariances, torch.zeros(1, 3, 3).double()))
    nearest = torch.cat([part.reshape(-1) for part in share]).round().long()
    nearest = nearest[torch.linspace(0, len(nearest) - 1, len(points)).round().long()]
    return points, _axes(curve_frames(points), padded[nearest])


def _even(points: Tensor, spacing: float) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return a polyline at equal steps, and which of the old points (n,) each lies at, as a fraction."""
    steps = (points[1:] - points[:-1]).norm(dim=-1)
    along = torch.cat((steps.new_zeros(1), steps.cumsum(0)))
    count = max(3, round(float(along[-1]) / spacing) + 1)
    wanted = torch.linspace(0, 1, count, dtype=points.dtype) * along[-1]
    after = torch.searchsorted(along, wanted).clamp(1, len(points) - 1)
    gap = along[after] - along[after - 1]
    share = ((wanted - along[after - 1]) / torch.where(gap > 0, gap, 1.0)).clamp(0, 1)
    mixed = points[after - 1] + share[:, None] * (points[after] - points[after - 1])
    return mixed, (after - 1 + share,)


def _axes(frames: Tensor, covariances: Tensor) -> Tensor:
    """Return frames (n, 3, 3) turned about their third columns so that the first ones are the rings' major axes."""
    across = frames[..., :2].mT @ covariances @ frames[..., :2]
    # The major axis at angle a is (cos 2a, sin 2a) in double angles, times how much longer it is.
    double = torch.stack((across[:, 0, 0] - across[:, 1, 1], 2 * across[:, 0, 1]), dim=-1)
    size = across.diagonal(dim1=1, dim2=2).sum(-1).clamp(min=torch.finfo(across.dtype).tiny)
    double = double / size[:, None]
    angle = _smooth_angles(torch.atan2(double[:, 1], double[:, 0]), double.norm(dim=1)) / 2
    cosine, sine, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1]
    return frames @ torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def _smooth_angles(angles: Tensor, weights: Tensor) -> Tensor:
    """Return angles (n,) near given ones, by weight and up to whole turns, that change little from one to the next.

    Newton steps down ``sum w_k (1 - cos(x_k - a_k)) + s sum (x_k+1 - x_k)^2 / 2``, from where steps are short.
    """
    step = torch.remainder(angles[1:] - angles[:-1] + torch.pi, 2 * torch.pi) - torch.pi
    found = torch.cat((angles[:1], angles[0] + step.cumsum(0)))
    chain = torch.diag(torch.ones(len(angles) - 1, dtype=angles.dtype), 1) - torch.eye(len(angles), dtype=angles.dtype)
    stiffness = _STIFFNESS * chain[:-1].mT @ chain[:-1] + _FLOOR * torch.eye(len(angles), dtype=angles.dtype)
    for _ in range(_NEWTON_STEPS):
        off = found - angles
        slope = weights * off.sin() + _STIFFNESS * chain[:-1].mT @ (chain[:-1] @ found)
        curvature = stiffness + torch.diag(weights * off.cos().clamp(min=0))
        found = found - torch.linalg.solve(curvature, slope)
    return found
