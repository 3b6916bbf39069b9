"""Views and their z-buffers: projected triangles, and the nearest of them at every pixel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.budget import BUDGET
from torchreg.geometry.mesh import TriangleMesh, cross_2d

# Negative barycentric weight up to which a pixel counts as inside a triangle, against rounding.
_EDGE_SLACK = 1e-7


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole or parallel camera and its grid of pixels; made by `aim`.

    Convention: camera coordinates are (right, down, forward); pixel (row i, column j) covers [j, j+1] x [i, i+1].
    """

    position: Tensor  # (3,) float64, the pinhole; for a parallel view any point of the image plane
    rotation: Tensor  # (3, 3) float64 ``R_camera_world``
    corner: Tensor  # (2,) float64 image-plane coordinates of the upper left corner of the grid
    pitch: float  # size of a pixel: metres for a parallel view, tangent of the angle else
    width: int
    height: int
    parallel: bool = False

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return pixel coordinates (..., N, 2) as (column, row), NaN behind a pinhole, and depths (..., N), float64."""
        local = (points.double() - self.position.to(points.device)) @ self.rotation.to(points.device).mT
        plane, depth = local[..., :2], local[..., 2]
        if not self.parallel:
            plane = plane / torch.where(depth > 0, depth, torch.nan).unsqueeze(-1)
        return (plane - self.corner.to(points.device)) / self.pitch, depth

    def nearness(self, depth: Tensor) -> Tensor:
        """Return a measure that grows towards the camera and is linear in pixels on a plane; it is its own inverse."""
        return -depth if self.parallel else 1 / depth

    def footprint(self, depth: Tensor) -> Tensor:
        """Return the width of a pixel at the given depths, metres."""
        return torch.full_like(depth, self.pitch) if self.parallel else self.pitch * depth


@dataclass(frozen=True, eq=False)
class Raster:
    """The z-buffer of a mesh: the nearest face at the center of every pixel."""

    face_index: Tensor  # (H, W) int64, -1 for none
    barycentric: Tensor  # (H, W, 3) float64 weights of that face's vertices, perspective-correct
    depth: Tensor  # (H, W) float64 along the view, infinite without a face


@dataclass(frozen=True, eq=False)
class FlatMesh:
    """A projected mesh: faces (F, 3), their corners' pixels (F, 3, 2) and depths (F, 3), and twice their areas (F,)."""

    faces: Tensor
    corners: Tensor
    depths: Tensor
    area: Tensor

    def drawn(self, cull_back: bool) -> Tensor:
        """Return the indices of faces with an area, which is negative for faces towards the camera: +y is down."""
        return ((self.area < 0) if cull_back else (self.area != 0)).nonzero()[:, 0]

    def weights(self, face: Tensor, pixels: Tensor) -> Tensor:
        """Return the (N, 3) barycentric weights of positions in the picture with respect to the given faces."""
        origin, second_corner, third_corner = self.corners[face].unbind(1)
        offset = pixels - origin
        areas = torch.stack((cross_2d(offset, third_corner - origin), cross_2d(second_corner - origin, offset)))
        second, third = (areas / self.area[face]).unbind()
        return torch.stack((1 - second - third, second, third), dim=-1)


def flatten(mesh: TriangleMesh, view: View) -> FlatMesh:
    """Return a mesh projected into a view; InputError if a vertex is not before a pinhole."""
    pixels, depth = view.project(mesh.vertices.detach())
    depths = depth[mesh.faces]
    if not view.parallel and bool((depths <= 0).any()):
        raise InputError(
            f"mesh must lie before the camera, got {int((depths <= 0).any(-1).sum())} faces beside or behind it"
        )
    corners = pixels[mesh.faces]
    area = cross_2d(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return FlatMesh(mesh.faces, corners, depths, area)


def draw(flat: FlatMesh, view: View, cull_back: bool) -> Raster:
    """Return the z-buffer of a projected mesh, without faces that face away from the camera if these are culled."""
    nearness = view.nearness(flat.depths)
    count = view.width * view.height
    best = torch.full((count,), -torch.inf, dtype=torch.float64, device=nearness.device)
    face_index = torch.full((count,), -1, device=nearness.device)
    weights = torch.zeros(count, 3, dtype=torch.float64, device=nearness.device)
    for face, pixel, barycentric in _covered(flat, flat.drawn(cull_back), view):
        near = (barycentric * nearness[face]).sum(-1)
        best.scatter_reduce_(0, pixel, near, "amax")
        first = (near >= best[pixel]).nonzero()[:, 0]
        winner = torch.full_like(face_index, -1).scatter_reduce_(0, pixel[first], first, "amax")
        hit = (winner >= 0).nonzero()[:, 0]
        face_index[hit], weights[hit] = face[winner[hit]], barycentric[winner[hit]]
    seen = face_index >= 0
    depth = torch.where(seen, view.nearness(best), torch.inf)
    if not view.parallel:
        weights = torch.where(seen.unsqueeze(-1), weights * nearness[face_index] * depth.unsqueeze(-1), 0.0)
    shape = (view.height, view.width)
    return Raster(face_index.reshape(shape), weights.reshape(*shape, 3), depth.reshape(shape))


def _covered(flat: FlatMesh, drawn: Tensor, view: View) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield faces, flat pixels and image-plane weights of all pixel centers inside the drawn faces, in chunks."""
    corners = flat.corners[drawn]
    limit = corners.new_tensor([view.width - 1, view.height - 1])
    lower = (corners.amin(1) - 0.5).ceil().clamp(min=0)
    upper = torch.minimum((corners.amax(1) - 0.5).floor(), limit)
    sides = (upper - lower + 1).clamp(min=0).long()
    counts = sides.prod(-1)
    lower = lower.long()
    groups = counts.cumsum(0) // BUDGET.raster_pixels
    for group in groups.unique().tolist():
        part = ((groups == group) & (counts > 0)).nonzero()[:, 0]
        which = part.repeat_interleave(counts[part])
        starts = (counts[part].cumsum(0) - counts[part]).repeat_interleave(counts[part])
        offset = torch.arange(len(which), device=which.device) - starts
        column = lower[which, 0] + offset % sides[which, 0]
        row = lower[which, 1] + offset // sides[which, 0]
        face = drawn[which]
        weights = flat.weights(face, torch.stack((column, row), dim=-1) + 0.5)
        inside = (weights.amin(-1) >= -_EDGE_SLACK).nonzero()[:, 0]
        yield face[inside], (row * view.width + column)[inside], weights[inside]
