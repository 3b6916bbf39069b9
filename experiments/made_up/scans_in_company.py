"""Scans of a thing among other things, and bare noisy clouds of it, as they are outside of studios."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rotation import so3_exp

from ..made_up.creature_parts import Draw


@dataclass(frozen=True)
class _Company:
    """What lies about a thing, and how a cloud is drawn; lengths are shares of the diagonal of its scan."""

    planes: float = 0.3  # share of the scans with company that lie on a table or before a wall, not beside a creature
    plane_radius: tuple[float, float] = (0.2, 0.6)
    size: tuple[float, float] = (0.4, 1.3)  # of another creature, as a share of the thing's
    gap: tuple[float, float] = (0.0, 0.06)  # between both, in half of the scans; in the others they touch
    samples: int = 300  # points of each that are looked at to bring both together
    steps: int = 40  # on the way together
    window: tuple[float, float] = (0.45, 0.75)  # radius of what is cut out about the thing
    off_center: float = 0.12  # of that
    least_kept: float = 0.7  # share of the thing's points in it
    num_points: tuple[int, int] = (350, 1600)  # of a bare cloud
    noise: float = 0.006  # of it
    outliers: float = 0.1  # largest share of them


_COMPANY = _Company()


@dataclass(frozen=True, eq=False)
class TrueScan:
    """A scan of N points, where they are on another scan (N, 3), and whether that shows them (N,)."""

    scan: RangeScan
    truth: Tensor
    visible: Tensor

    def roughened(self, other: RangeScan | None, draw: Draw, *, company: float, cloud: float) -> TrueScan:
        """Return the scan with company, or as a bare cloud, or both, by their chances; ``other``: the company."""
        found = self if other is None or not draw.chance(company) else self.among(other, draw)
        return found.as_cloud(draw) if draw.chance(cloud) else found

    def among(self, other: RangeScan, draw: Draw) -> TrueScan:
        """Return a window of the scan beside another creature, or on a plane; what is not of the thing is hidden."""
        points, normals, size = self.scan.points, self.scan.normals, self.scan.diagonal
        middle = points.mean(0)
        if draw.chance(_COMPANY.planes):
            more, facing = _plane(self.scan, draw)
        else:
            turn = so3_exp(draw.direction() * draw.uniform(0, math.pi)).to(points)
            scale = draw.uniform(*_COMPANY.size) * size / other.diagonal
            more, facing = scale * (other.points - other.points.mean(0)) @ turn.mT, other.normals @ turn.mT
            gap = draw.uniform(*_COMPANY.gap) * draw.chance(0.5) * size
            more = _brought_to(points, more, max(gap, self.scan.spacing), draw)
        center = middle + _COMPANY.off_center * draw.uniform(0, 1) * size * draw.direction().to(points)
        radius = draw.uniform(*_COMPANY.window) * size
        inside, seen = (points - center).norm(dim=-1) < radius, (more - center).norm(dim=-1) < radius
        if float(inside.double().mean()) < _COMPANY.least_kept or not bool(seen.any()):
            return self
        hidden = torch.zeros(int(seen.sum()), dtype=torch.bool)
        return TrueScan(
            RangeScan(torch.cat([points[inside], more[seen]]), normals=torch.cat([normals[inside], facing[seen]])),
            torch.cat([self.truth[inside], more[seen].to(self.truth)]),
            torch.cat([self.visible[inside], hidden]),
        )

    def as_cloud(self, draw: Draw) -> TrueScan:
        """Return fewer and noisier points without normals, some of them nowhere on the thing."""
        points, size = self.scan.points, self.scan.diagonal
        chosen = torch.randperm(len(points), generator=draw.generator)[: draw.count(*_COMPANY.num_points)]
        noise = _COMPANY.noise * draw.uniform(0, 1) * size * draw.normal(len(chosen), 3)
        count = int(draw.uniform(0, _COMPANY.outliers) * draw.chance(0.5) * len(chosen))
        lower, upper = points.amin(0), points.amax(0)
        share = torch.rand(count, 3, generator=draw.generator).to(points)
        stray = lower + share * (upper - lower)
        return TrueScan(
            RangeScan(torch.cat([points[chosen] + noise.to(points), stray])),
            torch.cat([self.truth[chosen], stray.to(self.truth)]),
            torch.cat([self.visible[chosen], torch.zeros(count, dtype=torch.bool)]),
        )


def _plane(scan: RangeScan, draw: Draw) -> tuple[Tensor, Tensor]:
    """Return points of a disk that a scan stands on, or leans against, as dense as the scan, and their normals."""
    points, up = scan.points, draw.direction().to(scan.points)
    radius = draw.uniform(*_COMPANY.plane_radius) * scan.diagonal
    # In a square lattice of random points the nearest one is half as far as the lattice is wide.
    count = min(3000, int(math.pi * radius**2 / (2 * scan.spacing) ** 2))
    across = torch.linalg.svd(up[None])[2][1:]
    angle = 2 * math.pi * torch.rand(count, generator=draw.generator).to(points)
    reach = radius * torch.rand(count, generator=draw.generator).to(points).sqrt()
    flat = torch.stack([reach * angle.cos(), reach * angle.sin()], dim=-1) @ across
    lowest = points[(points @ up).argmin()]
    noise = scan.spacing * 0.1 * torch.randn(count, 1, generator=draw.generator).to(points)
    return lowest + flat + noise * up, up.expand(count, 3)


def _brought_to(points: Tensor, others: Tensor, gap: float, draw: Draw) -> Tensor:
    """Return centered points (K, 3) moved from far off towards points (N, 3), until they are so near to them."""
    side, few = draw.direction().to(points), slice(None, None, max(1, len(others) // _COMPANY.samples))
    near = points[:: max(1, len(points) // _COMPANY.samples)]
    # Not head-on: past one another, so that they touch anywhere.
    aim = near[draw.count(0, len(near) - 1)]
    apart = float((near @ side).max() - (others @ side).min() - aim @ side) + gap
    ways = torch.linspace(apart, 0, _COMPANY.steps).to(points)
    moved = others[few] + aim + ways[:, None, None] * side
    free = torch.cdist(moved, near.expand(len(ways), -1, -1)).amin((-2, -1)) >= gap
    reached = int(free.long().cumprod(0).sum()) - 1
    return others + aim + ways[max(reached, 0)] * side
