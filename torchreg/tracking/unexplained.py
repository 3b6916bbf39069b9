"""Data that a fit leaves unexplained: clusters as dense as the surface, and whether a limb could be there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import CLUSTERS, OFF_SURFACE
from torchreg.alignment.search.multi_start import SEARCH_BUDGET
from torchreg.geometry.neighbors import nearest_neighbor, sampling_distance
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.shapes.limbs import Limb
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.results import TrackState


@dataclass(frozen=True)
class ClusterTest:
    """When data count as a cluster, and as one that was there before. Distances are shares of the model's size."""

    off_surface: float = OFF_SURFACE.noises  # standard deviations of residuals: data beyond are off the surface
    min_neighbors: int = CLUSTERS.neighbors  # of each datum of a cluster
    radius: float = CLUSTERS.radius  # within which they lie, in median distances between neighbors on the surface
    max_radius: float = CLUSTERS.max_radius  # the same, at most: on a sparse surface anything would be a cluster
    num_spacings: int = 100  # data on the surface whose nearest neighbors tell its density
    max_remembered: int = 300  # unexplained data in a state: more mark no more space
    num_poses: int = 512  # random poses that show what limbs reach: more fill no more cells


_TEST = ClusterTest()


class UnexplainedClusters:
    """Finds clusters of data off the surface, and separates limbs that a fit may have missed from background."""

    def __init__(self, skin: LinearBlendSkin, limbs: Sequence[Limb], size: float) -> None:
        self.size = size
        self._reach = LimbReach(skin, limbs, SEARCH_BUDGET.same * size)

    def find(self, data: Tensor, distance: Tensor, residual: Tensor) -> Tensor:
        """Return the data (K, 3) off the surface that lie as densely as those on it; most outliers are sparse.

        Distances (M,) are those of the data (M, 3) to the surface, the residual () is their standard deviation on it.
        """
        on_surface = distance.abs() < _TEST.off_surface * residual
        outliers, inliers = data[~on_surface], data[on_surface]
        if len(inliers) < 2 or not len(outliers):
            return outliers[:0]
        spacing = sampling_distance(inliers, inliers[:: max(1, len(inliers) // _TEST.num_spacings)])
        radius = min(_TEST.radius * spacing, _TEST.max_radius * self.size)
        # Every datum is within the radius of itself.
        return outliers[(torch.cdist(outliers, outliers) < radius).sum(-1) > _TEST.min_neighbors]

    def count_new(self, state: TrackState, clusters: Tensor, trunk: Tensor) -> int:
        """Return the number of data (K, 3) in reach of limbs and in no cluster that is known, for a trunk at (4, 4)."""
        known = transform_points(trunk, state.unexplained)
        new = nearest_distance(clusters, known) > SEARCH_BUDGET.same * self.size
        return int((new & self._reach(clusters, trunk)).sum())

    def remember(self, state: TrackState, clusters: Tensor, trunk: Tensor) -> Tensor:
        """Return the unexplained data (S, 3) to expect in the next frame, in the frame of the trunk at (4, 4)."""
        latest = transform_points(invert_rigid(trunk), clusters)
        # Where a cluster persists, its data of earlier frames show better how far it extends.
        persistent = nearest_distance(state.unexplained, latest) < SEARCH_BUDGET.same * self.size
        return torch.cat([latest, state.unexplained[persistent]])[: _TEST.max_remembered]


def nearest_distance(points: Tensor, targets: Tensor) -> Tensor:
    """Return the distances (N,) from points (N, 3) to the nearest of the targets (K, 3); infinite without any."""
    if not len(targets):
        return torch.full_like(points[:, 0], torch.inf)
    return nearest_neighbor(points, targets)[1]


class LimbReach:
    """The space that limbs can reach, as cells in the frame of the trunk, the first part; all space without any limb.

    Data out of reach belong to no limb that was missed.
    """

    def __init__(self, skin: LinearBlendSkin, limbs: Sequence[Limb], cell: float) -> None:
        shape = skin.shape
        self.cell = cell
        self.cells: Tensor | None = None
        parts = torch.tensor([part for limb in limbs for part in limb.parts], device=shape.rest.device)
        on_limbs = torch.isin(skin.weights.argmax(-1), parts)
        if not bool(on_limbs.any()):
            return
        low, high = shape.lower[6:].clamp_min(-math.pi), shape.upper[6:].clamp_max(math.pi)
        shares = (
            torch.quasirandom.SobolEngine(len(low), scramble=True, seed=0)
            .draw(_TEST.num_poses, dtype=torch.float32)
            .to(low)
        )
        poses = shape.rest.repeat(_TEST.num_poses, 1)
        poses[:, 6:] = low + (high - low) * shares
        to_trunk = invert_rigid(shape.part_transforms(poses)[:, 0])
        points = transform_points(to_trunk, skin(poses)[:, on_limbs]).flatten(0, 1)
        # A margin of one cell all around, which the dilation by one cell fills.
        self.low = points.amin(0) - 1.5 * cell
        index = ((points - self.low) / cell).long()
        cells = points.new_zeros((index.amax(0) + 2).tolist())
        cells[index.unbind(-1)] = 1.0
        self.cells = torch.nn.functional.max_pool3d(cells[None, None], 3, 1, 1)[0, 0] > 0

    def __call__(self, points: Tensor, trunk: Tensor) -> Tensor:
        """Return which points (N, 3) a limb may reach, (N,), for a trunk at (4, 4)."""
        if self.cells is None:
            return torch.ones_like(points[:, 0], dtype=torch.bool)
        local = transform_points(invert_rigid(trunk), points)
        index = ((local - self.low) / self.cell).floor().long()
        size = torch.tensor(self.cells.shape, device=index.device)
        inside = ((index >= 0) & (index < size)).all(-1)
        return inside & self.cells[torch.minimum(index.clamp_min(0), size - 1).unbind(-1)]
