"""A made-up depth camera: what it measures of a mesh, with noise, missing pixels and the true place of every point."""

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

# The size of a pixel is found from a picture of this many pixels along the longer side.
_FIRST_LOOK = 128


@dataclass(frozen=True, eq=False)
class SurfaceScan:
    """A range scan, and where on the mesh each of its points was measured.

    Args:
        scan: N points.
        face: (N,) face of the mesh.
        barycentric: (N, 3) float64 weights of its corners at the true, noiseless place.
    """

    scan: RangeScan
    face: Tensor
    barycentric: Tensor

    def carried(self, values: Tensor, faces: Tensor) -> Tensor:
        """Return values (N, C) at the points from values (V, C) at the vertices: true places in any pose, or weights.

        Args:
            values: (V, C) in the dtype to be returned.
            faces: (F, 3) of the mesh that was scanned.
        """
        return interpolate(values, faces, self.face, self.barycentric.to(values))


@dataclass(frozen=True)
class DepthScanner:
    """A depth camera at the origin that looks along +z with -y up.

    Args:
        num_points: about how many points the first frame is to give; the pixels are made as large as that needs.
        noise: standard deviation of a depth z as a multiple of z^2, 1/m: 2e-4 is 1.8 mm at 3 m, a good stereo camera.
        max_slant: no depth is measured where the ray meets the surface at more than this from its normal, radians.
        num_holes: round patches without data at random places of the surface.
        hole_radius: of those, as a share of the diagonal of the mesh.

    Raises:
        InputError: if a number is out of range.
    """

    num_points: int = 4500
    noise: float = 2e-4
    max_slant: float = math.radians(80)
    num_holes: int = 2
    hole_radius: float = 0.02

    def __post_init__(self) -> None:
        check_count(self.num_points, "num_points", 3)
        check_positive(self.noise, "noise", allow_zero=True)
        check_positive(self.max_slant, "max_slant")
        if self.max_slant > math.pi / 2:
            raise InputError(f"max_slant must be at most pi / 2, got {self.max_slant}")
        check_count(self.num_holes, "num_holes", 0)
        check_positive(self.hole_radius, "hole_radius", allow_zero=True)

    def view(self, mesh: TriangleMesh, reach: float) -> View:
        """Return the camera and its pixels, made for one frame and good for all others.

        Args:
            mesh: the first frame, before the camera.
            reach: largest tangent of an angle to the axis of the camera that it has to see.

        Raises:
            InputError: if the camera sees nothing of the mesh.
        """
        check_positive(reach, "reach")
        first = _centered_view(2 * reach / _FIRST_LOOK, reach)
        seen = int(self._measurable(mesh, first)[1].sum())
        if not seen:
            raise InputError("mesh must lie before the camera, which looks along +z, and face it; it sees nothing")
        return _centered_view(first.pitch * math.sqrt(seen / self.num_points), reach)

    def scan(self, mesh: TriangleMesh, view: View, generator: torch.Generator, dtype: torch.dtype) -> SurfaceScan:
        """Return what the camera measures of a closed mesh.

        Args:
            mesh: faces outwards.
            view: see `view`.
            generator: of noise and holes.
            dtype: of the scan.

        Raises:
            InputError: if the camera sees nothing of the mesh.
        """
        raster, valid = self._measurable(mesh, view)
        pixel = valid.nonzero()
        row, column = pixel.unbind(-1)
        if not len(pixel):
            raise InputError("mesh must lie before the camera, which looks along +z, and face it; it sees nothing")
        places = interpolate(mesh.vertices.double(), mesh.faces, raster.face_index[valid], raster.barycentric[valid])
        error = self.noise * torch.randn(len(pixel), generator=generator, dtype=torch.float64)
        depth = torch.where(self._in_holes(places, mesh, generator), 0.0, places[:, 2] * (1 + error * places[:, 2]))
        image = torch.zeros_like(raster.depth).index_put((row, column), depth)
        center = (-view.corner / view.pitch - 0.5).tolist()
        scan = RangeScan.from_depth(image.to(dtype), (1 / view.pitch, 1 / view.pitch, *center))
        # However noisy, points stay on the ray of their pixel.
        column, row = view.project(scan.points)[0].long().unbind(-1)
        return SurfaceScan(scan, raster.face_index[row, column], raster.barycentric[row, column])

    def _measurable(self, mesh: TriangleMesh, view: View) -> tuple[Raster, Tensor]:
        """Return what every pixel shows, and where (H, W) that is not too slanted to be measured."""
        raster = rasterize(mesh, view, cull_back=True)
        shown = raster.face_index >= 0
        face = raster.face_index[shown]
        corners = mesh.vertices[mesh.faces[face]].double()
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # Faces are small: the ray to one corner stands for all.
        facing = -torch.nn.functional.cosine_similarity(corners[:, 0], normals, dim=-1)
        return raster, shown.index_put((shown,), facing > math.cos(self.max_slant))

    def _in_holes(self, places: Tensor, mesh: TriangleMesh, generator: torch.Generator) -> Tensor:
        """Return which places (N, 3) lie in one of the holes, which are centered at some of them."""
        if self.num_holes == 0:
            return torch.zeros(len(places), dtype=torch.bool)
        lower, upper = mesh.bounds().double()
        centers = places[torch.randint(len(places), (self.num_holes,), generator=generator)]
        return (torch.cdist(places, centers) < self.hole_radius * (upper - lower).norm()).any(-1)


def _centered_view(pitch: float, reach: float) -> View:
    """Return a square camera at the origin that sees tangents up to ``reach`` on each side of its axis."""
    side = max(1, math.ceil(2 * reach / pitch))
    corner = torch.full((2,), -0.5 * side * pitch, dtype=torch.float64)
    return View(torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64), corner, pitch, side, side)
