"""Correspondences between two scans: the closest point whose normal is compatible, or none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.range_scan import RangeScan


@dataclass(frozen=True)
class CompatibleMatches:
    """The closest points of N points, with normals, and masks (N,) of matches that hold or why they were dropped."""

    targets: Tensor
    normals: Tensor
    kept: Tensor
    boundary: Tensor  # True where it was dropped because the target lies on a boundary of its scan
    far: Tensor  # True where it was dropped because of its distance alone
    turned: Tensor  # True where it was dropped because of its normals alone


class CompatibleMatcher:
    """The matches ``argmin_y |x - y|^2 + s^2 |n - n_y|^2`` in a target scan, by a tree over points and normals."""

    # Sampling distances of the target below which the largest distance of a match never falls.
    LEAST_SPACINGS: ClassVar[float] = 2.0

    def __init__(self, target: RangeScan, normal_scale: float) -> None:
        self.target, self._normal_scale = target, normal_scale
        self._least_distance = self.LEAST_SPACINGS * target.spacing
        self._tree = NeighborTree(self._features(target.points, target.normals))

    @torch.no_grad()
    def match(self, points: Tensor, normals: Tensor, *, max_distance: float, max_angle: float) -> CompatibleMatches:
        """Return the closest compatible points of points (N, 3) that were moved near the target.

        Dropped are matches on a boundary, farther than ``max_distance`` (at least two sampling distances) or whose
        normals differ by more than ``max_angle``, radians.
        """
        index, _ = self._tree.nearest(self._features(points, normals))
        targets, target_normals = self.target.points[index], self.target.normals[index]
        distances = torch.linalg.vector_norm(points - targets, dim=-1)
        cosine = (normals * target_normals).sum(-1)
        boundary = self.target.boundary[index]
        far = ~boundary & (distances > max(max_distance, self._least_distance))
        turned = ~boundary & ~far & (cosine < torch.cos(cosine.new_tensor(max_angle)))
        return CompatibleMatches(
            targets=targets,
            normals=target_normals,
            kept=~(boundary | far | turned),
            boundary=boundary,
            far=far,
            turned=turned,
        )

    def _features(self, points: Tensor, normals: Tensor) -> Tensor:
        return torch.cat([points.double(), self._normal_scale * normals.double()], dim=-1)
