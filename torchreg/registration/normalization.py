"""Coordinates in which scans of any size, position and orientation are alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import rescale_motions


@dataclass(frozen=True, eq=False)
class Normalization:
    """Normalized coordinates ``(x - center) / scale``: about one diagonal long, double precision on the CPU."""

    # Root mean squared distance from the center over the bounding box's diagonal, for people and animals. Unlike the
    # box, that distance does not change when the points turn.
    SPREAD: ClassVar[float] = 0.23

    center: Tensor  # (3,) mean of the points, in the user's coordinates
    scale: float  # root mean squared distance from it over that of a scan whose bounding box has a diagonal of one

    @classmethod
    def from_points(cls, points: Tensor) -> Normalization:
        """Return the normalization of evenly spread points (N, 3), the same however they are turned."""
        points = points.detach().cpu().double()
        center = points.mean(0)
        return cls(center, float((points - center).square().sum(-1).mean().sqrt()) / cls.SPREAD)

    def normalize(self, points: Tensor) -> Tensor:
        """Return the user's points (..., 3) in normalized coordinates."""
        return (points.detach().cpu().double() - self.center) / self.scale

    def normalize_scan(self, scan: RangeScan) -> RangeScan:
        """Return the user's scan in normalized coordinates."""
        motion = torch.eye(4, dtype=torch.float64) / self.scale
        motion[:3, 3], motion[3, 3] = -self.center / self.scale, 1.0
        return scan.to(dtype=torch.float64, device="cpu").transformed(motion)

    def denormalize(self, points: Tensor, like: Tensor) -> Tensor:
        """Return normalized points (..., 3) in the user's coordinates, with the dtype and device of ``like``."""
        return (self.center + self.scale * points).to(like)

    def denormalize_motions(self, transforms: Tensor) -> Tensor:
        """Return motions (..., 4, 4) of normalized points as motions of the user's points."""
        return rescale_motions(transforms, self.scale, self.center)
