"""Samples of a scan with all that tells whether two of them match: place, normal, boundary and features."""

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
        features: (S, D) what motion leaves as it is; the squared distance of two samples at random is two.
        boundary: (S,) bool, where the scan ends.

    Raises:
        InputError: if a shape does not fit.
        InputTypeError: if dtypes or devices differ.
    """

    points: Tensor
    normals: Tensor
    features: Tensor
    boundary: Tensor

    def __post_init__(self) -> None:
        check_shape(self.points, "points", ("S", 3))
        check_shape(self.normals, "normals", tuple(self.points.shape))
        check_shape(self.features, "features", (len(self.points), "D"))
        check_shape(self.boundary, "boundary", (len(self.points),))
        check_same_kind(self.normals, "normals", self.points, "points")
        check_same_kind(self.features, "features", self.points, "points")

    def __len__(self) -> int:
        return len(self.points)

    def first(self, count: int) -> OrientedSamples:
        """Return the first ``count`` samples."""
        values = (self.points, self.normals, self.features, self.boundary)
        return OrientedSamples(*(value[:count] for value in values))

    def moved(self, points: Tensor, normals: Tensor) -> OrientedSamples:
        """Return the samples at other places."""
        return replace(self, points=points, normals=normals)

    def embedded(self, normal_scale: float, feature_scale: float) -> Tensor:
        """Return (S, 6 + D) numbers whose distance squared is the sum of those of places, normals and features.

        Args:
            normal_scale: what one unit of normals counts as, in the unit of the points.
            feature_scale: the same of features.
        """
        return torch.cat((self.points, normal_scale * self.normals, feature_scale * self.features), dim=1)


def scaled_together(source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return features (S, D) and (T, D) divided such that two samples at random are two apart, squared, in the mean.

    Every dimension counts alike; one that is constant does not count.
    """
    both = torch.cat((source, target))
    spread = both.std(dim=0, correction=0)
    flat = spread <= 1e-9 * spread.max().clamp_min(1e-9)
    factor = torch.where(flat, 0.0, 1 / spread.masked_fill(flat, 1.0)) / both.shape[1] ** 0.5
    return source * factor, target * factor
