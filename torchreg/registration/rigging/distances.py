"""How far surfaces that share nothing are from each other."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.mesh import TriangleMesh, even_samples
from torchreg.geometry.neighbors import nearest_neighbor, sampling_distance
from torchreg.geometry.range_scan import RangeScan


@dataclass(frozen=True)
class _Sampling:
    """Samples of a surface."""

    count: int = 8000  # a mean over them is known to a hundredth of itself


_SAMPLING = _Sampling()


@dataclass(frozen=True)
class SurfaceSamples:
    """Even samples of a surface: points and unit normals (N, 3), and the distance between neighbors."""

    points: Tensor
    normals: Tensor
    spacing: float

    @classmethod
    def of_mesh(cls, mesh: TriangleMesh) -> SurfaceSamples:
        """Return samples of a mesh."""
        points, face = even_samples(mesh, _SAMPLING.count)
        area = float(mesh.face_areas().sum())
        return cls(points, mesh.face_normals()[face], (area / _SAMPLING.count) ** 0.5)

    @classmethod
    def of_scan(cls, scan: RangeScan) -> SurfaceSamples:
        """Return samples of a scan: of its triangles, or its points."""
        if scan.faces is not None:
            return cls.of_mesh(TriangleMesh(scan.points, scan.faces))
        index = scan.uniform_subsample(min(len(scan), _SAMPLING.count))
        return cls(scan.points[index], scan.normals[index], sampling_distance(scan.points[index]))

    def distances(self, points: Tensor) -> Tensor:
        """Return distances (M,) of points (M, 3) from the surface, see `surface_distances`."""
        index, _ = nearest_neighbor(points, self.points)
        return surface_distances(points - self.points[index], self.normals[index], self.spacing)


def two_way_distance(rig: SurfaceSamples, seen: SurfaceSamples, scan: RangeScan) -> float:
    """Return the mean distance of two surfaces, both ways alike; a rig beyond a scan's border counts one way alone."""
    border = scan.boundary[nearest_neighbor(rig.points, scan.points)[0]]
    forward, backward = seen.distances(rig.points[~border]), rig.distances(seen.points)
    parts = [part.mean() for part in (forward, backward) if len(part)]
    return float(torch.stack(parts).mean())


def surface_distances(offsets: Tensor, normals: Tensor, spacing: float) -> Tensor:
    """Return distances (N,) from a surface known by samples: offsets (N, 3) from the nearest, less what lies between.

    Within a spacing of the sample the surface goes on along its tangent plane.
    """
    height = (offsets * normals).sum(-1)
    beside = (offsets - height[:, None] * normals).norm(dim=-1)
    return (height.square() + (beside - spacing).clamp_min(0).square()).sqrt()
