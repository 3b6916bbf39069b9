"""Meshes to voxels and back: filled volumes of surfaces that need not be closed, and their remeshed surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.marching_cubes import marching_cubes
from torchreg.geometry.mesh import TriangleMesh, cross_2d


@dataclass(frozen=True)
class _Voxelization:
    """Numbers of filling voxels and of meshing them."""

    # Offsets of rays from voxel centers, in voxels: on the grid, no ray hits a vertex or an edge.
    offset_x: float = 3.1415926535e-5
    offset_y: float = 2.7182818284e-5
    # Share of edges with two triangles of opposite winding, from which orientation is ignored.
    twisted: float = 0.01
    # Least absolute value of a smoothed voxel, with its own sign.
    least_value: float = 0.05


_VOXELIZATION = _Voxelization()


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Cubic voxels (X, Y, Z), filled or empty; ``origin`` (3,) is the center of voxel (0, 0, 0)."""

    filled: Tensor
    origin: Tensor
    spacing: float

    def centers(self) -> Tensor:
        """Return the centers (N, 3) of the filled voxels."""
        return self.origin + self.spacing * self.filled.nonzero().to(self.origin)

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...,) of the points (..., 3) in filled voxels."""
        steps = ((points - self.origin) / self.spacing).round().long()
        sizes = torch.tensor(self.filled.shape, device=steps.device)
        within = ((steps >= 0) & (steps < sizes)).all(-1)
        x, y, z = torch.where(within.unsqueeze(-1), steps, 0).unbind(-1)
        return within & self.filled[x, y, z]

    def mesh(self, smoothing: int = 1) -> TriangleMesh:
        """Return the closed surface of the filled voxels, facing outwards."""
        # One more empty layer, so that the surface closes around what touches the border.
        filled = torch.nn.functional.pad(self.filled, (1, 1, 1, 1, 1, 1))
        field = 0.5 - filled.to(self.origin.dtype)
        for _ in range(smoothing):
            for axis in range(3):
                field = _averaged(field, axis)
        if smoothing:
            least = _VOXELIZATION.least_value
            field = torch.where(filled, field.clamp_max(-least), field.clamp_min(least))
        return marching_cubes(field, self.origin - self.spacing, self.spacing)


def voxelize(mesh: TriangleMesh, resolution: int = 128, *, touching: bool = False) -> VoxelGrid:
    """Return the voxels inside a surface, which may have holes, overlap itself or face inwards."""
    corners = mesh.vertices.detach().double()[mesh.faces]
    lower, upper = corners.amin((0, 1)), corners.amax((0, 1))
    spacing = float((upper - lower).max()) / resolution
    sizes = [math.ceil(side - 1e-6) + 2 for side in ((upper - lower) / spacing).tolist()]
    # The box is centered in its voxels.
    origin = 0.5 * (lower + upper) - 0.5 * spacing * (torch.tensor(sizes) - 1).to(lower)
    steps = (corners - origin) / spacing
    filled = _inside(steps, sizes, _are_oriented(mesh.faces))
    if touching:
        x, y, z = _samples(steps).round().long().unbind(-1)
        filled[x, y, z] = True
    return VoxelGrid(filled, origin.to(mesh.vertices), spacing)


def _inside(steps: Tensor, sizes: list[int], oriented: bool) -> Tensor:
    """Return the voxels (X, Y, Z) inside triangles (F, 3, 3) given in steps of the grid."""
    volume = torch.linalg.det(steps - steps.mean((0, 1))).sum()
    votes = torch.zeros(sizes, dtype=torch.int8, device=steps.device)
    for axis in range(3):
        rolled = torch.roll(steps, -1 - axis, -1)  # the axis of the rays comes last
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]
        below, total = _windings(rolled, [sizes[k] for k in order])
        if oriented:
            side = -1 if volume < 0 else 1
            cast = (side * below > 0).to(torch.int8) + (side * (below - total) > 0).to(torch.int8)
        else:
            cast = ((below & 1) + ((total - below) & 1)).to(torch.int8)
        votes += cast.permute([order.index(k) for k in range(3)])
    return votes > 3


def _windings(steps: Tensor, sizes: list[int]) -> tuple[Tensor, Tensor]:
    """Return the entries less exits of rays along the last axis before each voxel (X, Y, Z), and in total."""
    counts = torch.zeros(sizes[0] * sizes[1] * (sizes[2] + 1), dtype=torch.int32, device=steps.device)
    flat = steps[..., :2] - steps.new_tensor([_VOXELIZATION.offset_x, _VOXELIZATION.offset_y])
    first = flat.amin(1).ceil().long().clamp_min(0)
    span = (flat.amax(1).floor().long() - first + 1).clamp_min(0)
    number = span.prod(-1)
    owner = torch.arange(len(steps), device=steps.device).repeat_interleave(number)
    within = torch.arange(len(owner), device=steps.device) - (number.cumsum(0) - number)[owner]
    width = span[owner, 1]
    cell = first[owner] + torch.stack([within // width, within % width], -1)
    a, b, c = (flat[owner] - cell.unsqueeze(1)).unbind(1)
    areas = torch.stack([cross_2d(b, c), cross_2d(c, a), cross_2d(a, b)], -1)
    hit = (areas > 0).all(-1) | (areas < 0).all(-1)
    areas, owner, cell = areas[hit], owner[hit], cell[hit]
    depth = (areas * steps[owner, :, 2]).sum(-1) / areas.sum(-1)
    # Counted in the first voxel whose center lies behind the crossing.
    layer = depth.ceil().long().clamp(0, sizes[2])
    voxel = (cell[:, 0] * sizes[1] + cell[:, 1]) * (sizes[2] + 1) + layer
    # A triangle counterclockwise as seen from the end of the axis faces along it: the ray leaves there.
    counts.index_add_(0, voxel, -areas.sum(-1).sign().to(torch.int32))
    reached = counts.reshape(sizes[0], sizes[1], sizes[2] + 1).cumsum(-1, dtype=torch.int32)
    return reached[..., :-1], reached[..., -1:]


def _are_oriented(faces: Tensor) -> bool:
    """Return whether almost no edge has two triangles of opposite winding."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    return len(keys) - len(keys.unique()) <= _VOXELIZATION.twisted * len(keys)


def _samples(steps: Tensor) -> Tensor:
    """Return points (N, 3) of triangles (F, 3, 3), at most half a step apart."""
    sides = (steps - steps.roll(1, 1)).norm(dim=-1).amax(-1)
    parts = (2 * sides).ceil().long().clamp_min(1)
    number = (parts + 1) ** 2
    owner = torch.arange(len(steps), device=steps.device).repeat_interleave(number)
    within = torch.arange(len(owner), device=steps.device) - (number.cumsum(0) - number)[owner]
    rows = parts[owner] + 1
    u, v = (within // rows).to(steps) / parts[owner], (within % rows).to(steps) / parts[owner]
    keep = u + v <= 1 + 1e-9
    u, v, owner = u[keep].unsqueeze(-1), v[keep].unsqueeze(-1), owner[keep]
    a, b, c = steps.unbind(1)
    return a[owner] + u * (b - a)[owner] + v * (c - a)[owner]


def _averaged(field: Tensor, axis: int) -> Tensor:
    """Return a field averaged 1-2-1 along an axis; the border keeps its value."""
    size = field.shape[axis]
    step = torch.arange(size, device=field.device)
    before, after = (field.index_select(axis, (step + side).clamp(0, size - 1)) for side in (-1, 1))
    return 0.25 * (before + 2 * field + after)
