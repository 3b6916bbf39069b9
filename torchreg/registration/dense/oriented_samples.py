"""Samples of a scan with all that tells whether two of them match: place, normal and boundary."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._checks import check_same_kind, check_shape


@dataclass(frozen=True, eq=False)
class OrientedSamples:
    """Samples of a surface, spread evenly; each first few of them are too.

    Args:
        points: (S, 3), any unit.
        normals: (S, 3) unit vectors.
        boundary: (S,) bool, where the scan ends.
    """

    points: Tensor
    normals: Tensor
    boundary: Tensor

    def __post_init__(self) -> None:
        check_shape(self.points, "points", ("S", 3))
        check_shape(self.normals, "normals", tuple(self.points.shape))
        check_shape(self.boundary, "boundary", (len(self.points),))
        check_same_kind(self.normals, "normals", self.points, "points")

    def __len__(self) -> int:
        return len(self.points)

    def first(self, count: int) -> OrientedSamples:
        """Return the first ``count`` samples."""
        return OrientedSamples(*(value[:count] for value in (self.points, self.normals, self.boundary)))

    def moved(self, points: Tensor, normals: Tensor) -> OrientedSamples:
        """Return the samples at other places."""
        return replace(self, points=points, normals=normals)

    def embedded(self, normal_scale: float) -> Tensor:
        """Return (S, 6) numbers whose distance squared is the sum of those of places and normals.

        Args:
            normal_scale: what one unit of normals counts as, in the unit of the points.
        """
        return torch.cat((self.points, normal_scale * self.normals), dim=1)
