"""Coordinates in which scans of any size, place and turn are alike."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import rescale_motions

# Root mean squared distance from the middle, over the diagonal of the bounding box, of people and animals; unlike the
# box it does not change with the frame.
_SPREAD = 0.23


@dataclass(frozen=True, eq=False)
class ScanUnit:
    """Coordinates about the middle of a scan, in units of about its diagonal, double precision on the CPU.

    Args:
        middle: (3,) of the scan.
        size: of the scan.
    """

    middle: Tensor
    size: float

    @classmethod
    def of(cls, samples: Tensor) -> ScanUnit:
        """Return the unit of evenly spread points (N, 3) of a scan, the same however the scan is turned."""
        places = samples.detach().cpu().double()
        middle = places.mean(0)
        return cls(middle, float((places - middle).square().sum(-1).mean().sqrt()) / _SPREAD)

    def of_points(self, points: Tensor) -> Tensor:
        """Return points (..., 3) of the user in these coordinates."""
        return (points.detach().cpu().double() - self.middle) / self.size

    def of_scan(self, scan: RangeScan) -> RangeScan:
        """Return a scan of the user in these coordinates."""
        motion = torch.eye(4, dtype=torch.float64) / self.size
        motion[:3, 3], motion[3, 3] = -self.middle / self.size, 1.0
        return scan.to(dtype=torch.float64, device="cpu").transformed(motion)

    def points_back(self, points: Tensor, like: Tensor) -> Tensor:
        """Return points in the coordinates of the user, in the dtype and on the device of ``like``."""
        return (self.middle + self.size * points).to(like)

    def transforms_back(self, transforms: Tensor) -> Tensor:
        """Return motions (..., 4, 4) in the coordinates of the user."""
        return rescale_motions(transforms, self.size, self.middle)
