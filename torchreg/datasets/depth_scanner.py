"""A made-up depth camera: scans of a mesh, with noise, missing pixels and the true position of every point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, interpolate
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.visibility import Raster, View, rasterize


@dataclass(frozen=True, eq=False)
class SurfaceScan:
    """A range scan, and where its points truly lie on the mesh: face (N,) and barycentric weights (N, 3)."""

    scan: RangeScan
    face: Tensor
    barycentric: Tensor

    def transferred(self, values: Tensor, faces: Tensor) -> Tensor:
        """Return values (N, C) at the points from values (V, C) at the vertices of the scanned mesh, in their dtype."""
        return interpolate(values, faces, self.face, self.barycentric.to(values))


@dataclass(frozen=True)
class DepthScanner:
    """A depth camera at the origin that looks along +z with -y up."""

    num_points: int = 4500  # approximate number of points of the first frame, which determines the size of the pixels
    noise: float = 2e-4  # standard deviation of a depth z over z^2, 1/m: 2e-4 is 1.8 mm at 3 m, a good stereo camera
    max_slant: float = math.radians(80)  # of a ray to the normal of a surface that is measured, radians
    num_holes: int = 2  # round patches without data at random positions on the surface
    hole_radius: float = 0.02  # of those, as a share of the diagonal of the mesh

    def __post_init__(self) -> None:
        check_count(self.num_points, "num_points", 3)
        check_positive(self.noise, "noise", allow_zero=True)
        check_positive(self.max_slant, "max_slant")
        if self.max_slant > math.pi / 2:
            raise InputError(f"max_slant must be at most pi / 2, got {self.max_slant}")
        check_count(self.num_holes, "num_holes", 0)
        check_positive(self.hole_radius, "hole_radius", allow_zero=True)

    def view(self, mesh: TriangleMesh, reach: float) -> View:
        """Return camera and pixels for all frames, from the first; ``reach`` is the tangent of half the view."""
        check_positive(reach, "reach")
        first = _centered_view(2 * reach / 128, reach)  # 128 pixels a side, to measure the visible area
        pixels = int(self._measurable(mesh, first)[1].sum())
        if not pixels:
            raise InputError("mesh must lie before the camera, which looks along +z, and face it; it sees nothing")
        return _centered_view(first.pitch * math.sqrt(pixels / self.num_points), reach)

    def scan(self, mesh: TriangleMesh, view: View, generator: torch.Generator, dtype: torch.dtype) -> SurfaceScan:
        """Return the camera's scan of a closed mesh with faces outwards; InputError if it shows nothing of it."""
        raster, valid = self._measurable(mesh, view)
        pixel = valid.nonzero()
        row, column = pixel.unbind(-1)
        if not len(pixel):
            raise InputError("mesh must lie before the camera, which looks along +z, and face it; it sees nothing")
        points = interpolate(mesh.vertices.double(), mesh.faces, raster.face_index[valid], raster.barycentric[valid])
        error = self.noise * torch.randn(len(pixel), generator=generator, dtype=torch.float64)
        depth = torch.where(self._in_holes(points, mesh, generator), 0.0, points[:, 2] * (1 + error * points[:, 2]))
        image = torch.zeros_like(raster.depth).index_put((row, column), depth)
        center = (-view.corner / view.pitch - 0.5).tolist()
        scan = RangeScan.from_depth(image.to(dtype), (1 / view.pitch, 1 / view.pitch, *center))
        # However noisy, points stay on the ray of their pixel.
        column, row = view.project(scan.points)[0].long().unbind(-1)
        return SurfaceScan(scan, raster.face_index[row, column], raster.barycentric[row, column])

    def _measurable(self, mesh: TriangleMesh, view: View) -> tuple[Raster, Tensor]:
        """Return the faces that the pixels show, and the mask (H, W) of those not too slanted to be measured."""
        raster = rasterize(mesh, view, cull_back=True)
        shown = raster.face_index >= 0
        face = raster.face_index[shown]
        corners = mesh.vertices[mesh.faces[face]].double()
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # Faces are small: the ray to their first corner is used.
        facing = -torch.nn.functional.cosine_similarity(corners[:, 0], normals, dim=-1)
        return raster, shown.index_put((shown,), facing > math.cos(self.max_slant))

    def _in_holes(self, points: Tensor, mesh: TriangleMesh, generator: torch.Generator) -> Tensor:
        """Return the mask (N,) of points in holes, whose centers are drawn from the points (N, 3)."""
        if self.num_holes == 0:
            return torch.zeros(len(points), dtype=torch.bool)
        lower, upper = mesh.bounds().double()
        centers = points[torch.randint(len(points), (self.num_holes,), generator=generator)]
        return (torch.cdist(points, centers) < self.hole_radius * (upper - lower).norm()).any(-1)


def _centered_view(pitch: float, reach: float) -> View:
    """Return a square camera at the origin that sees tangents up to ``reach`` on each side of its axis."""
    side = max(1, math.ceil(2 * reach / pitch))
    corner = torch.full((2,), -0.5 * side * pitch, dtype=torch.float64)
    return View(torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64), corner, pitch, side, side)
