"""Limbs from rings: the best tree's rings, without those of the junctions, as smooth curves with frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.spines.curves import arc_lengths, binomial_smoothing, curve_frames
from torchreg.spines.labeled_tree import Tips
from torchreg.spines.skeleton.tip_trees import TipTree


@dataclass(frozen=True)
class LimbSmoothing:
    """How curves and their frames are smoothed along a limb."""

    passes: int = 4  # of 1-2-1 averages over the points
    stiffness: float = 8.0  # resistance of the major axes to rotation from point to point; a flat ring's weight is 1
    damping: float = 1e-6  # added to the Hessian, which is singular where all rings are round
    newton_steps: int = 12  # of the fit of the angles


_SMOOTHING = LimbSmoothing()


@dataclass(frozen=True, eq=False)
class JunctionBall:
    """A ball inside the surface: rings with their center in it belong to the junction, not to a limb."""

    center: Tensor
    radius: float


@dataclass(frozen=True, eq=False)
class Rings:
    """A stretch of n rings, in order; ``costs`` (n,) are C of eq. 4 over the largest of all skeletons."""

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
    return max(float(tree.sets.widths[branch.rings].max()) ** 2 for tree in trees for branch in tree.branches)


def best_rings(
    tips: Tips, trees: Sequence[TipTree], start: JunctionBall | None, end: JunctionBall | None, cost: float
) -> Rings:
    """Return the rings of a limb, outside the balls at its ends, from the tree of best quality (eqs. 4 and 5)."""
    every = frozenset(range(len(trees)))
    best = Rings(torch.zeros(0, 3).double(), torch.zeros(0, 3, 3).double(), torch.zeros(0).double())
    for tree in trees:
        outwards = tree.root not in tips
        for branch in tree.branches:
            if branch.tips != (tips if outwards else every - tips):
                continue
            covariances = tree.sets.covariances[branch.rings]
            costs = covariances.diagonal(dim1=1, dim2=2).sum(-1) / cost
            rings = Rings(tree.sets.centers[branch.rings], covariances, costs)
            rings = _outside(rings if outwards else rings.flip(), start)
            rings = _outside(rings.flip(), end).flip()
            if rings.quality > best.quality:
                best = rings
    return best


def _outside(rings: Rings, ball: JunctionBall | None) -> Rings:
    """Return the rings from where they leave a ball that they start in, or near which they pass at first."""
    if ball is None or len(rings) == 0:
        return rings
    distance = (rings.centers - ball.center).norm(dim=-1)
    # Far along the limb it may come near again: an arm that is crossed over the chest.
    early = arc_lengths(rings.centers) <= 2 * distance[0] + ball.radius
    nearest = int(torch.where(early, distance, torch.inf).argmin())
    outside = (distance[nearest:] > ball.radius).nonzero()
    return rings[nearest + int(outside[0]) :] if len(outside) else rings[:0]


def limb_curve(start: Tensor, rings: Rings, end: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Return a limb as points (n, 3) at equal steps, and frames (n, 3, 3).

    Convention: the columns of a frame are the major and minor axis of the ring across the limb, and, right-handed to
    them, the direction of the limb; signs are continued along the limb. Axes count by how elongated the rings are, in
    double angles, so that they neither jump nor spin.
    """
    points, index = _resampled(torch.cat((start[None], rings.centers, end[None])), spacing)
    points, _ = _resampled(binomial_smoothing(points, _SMOOTHING.passes), spacing)
    padded = torch.cat((torch.zeros(1, 3, 3).double(), rings.covariances, torch.zeros(1, 3, 3).double()))
    nearest = index.round().long()
    nearest = nearest[torch.linspace(0, len(nearest) - 1, len(points), dtype=torch.float32).round().long()]
    return points, _along_major_axes(curve_frames(points), padded[nearest])


def _resampled(points: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Return a polyline (n, 3) at equal steps (m, 3), and the fractional index (m,) of each in the old points."""
    along = arc_lengths(points)
    count = max(3, round(float(along[-1]) / spacing) + 1)
    lengths = torch.linspace(0, 1, count, dtype=points.dtype) * along[-1]
    after = torch.searchsorted(along, lengths).clamp(1, len(points) - 1)
    step = along[after] - along[after - 1]
    share = ((lengths - along[after - 1]) / torch.where(step > 0, step, 1.0)).clamp(0, 1)
    return points[after - 1] + share[:, None] * (points[after] - points[after - 1]), after - 1 + share


def _along_major_axes(frames: Tensor, covariances: Tensor) -> Tensor:
    """Return frames (n, 3, 3) turned about their third columns so that the first are the major axes of the rings."""
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
    """Return smooth angles (n,), radians, near given ones by weight and up to full turns.

    Newton steps down ``sum w_k (1 - cos(x_k - a_k)) + s sum (x_k+1 - x_k)^2 / 2``, from the unwrapped angles.
    """
    stiffness = _SMOOTHING.stiffness
    step = torch.remainder(angles[1:] - angles[:-1] + torch.pi, 2 * torch.pi) - torch.pi
    smooth = torch.cat((angles[:1], angles[0] + step.cumsum(0)))
    eye = torch.eye(len(angles), dtype=angles.dtype)
    steps = (torch.diag(torch.ones(len(angles) - 1, dtype=angles.dtype), 1) - eye)[:-1]
    hessian = stiffness * steps.mT @ steps + _SMOOTHING.damping * eye
    for _ in range(_SMOOTHING.newton_steps):
        residual = smooth - angles
        gradient = weights * residual.sin() + stiffness * steps.mT @ (steps @ smooth)
        curvature = hessian + torch.diag(weights * residual.cos().clamp(min=0))
        smooth = smooth - torch.linalg.solve(curvature, gradient)
    return smooth
