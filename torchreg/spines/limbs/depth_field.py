"""The depth of points inside a surface, on a grid, and curves moved to a depth of their own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from itertools import product

import torch
from torch import Tensor

from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.voxels import voxelize


@dataclass(frozen=True)
class DepthDescent:
    """How curves move into a body."""

    border: int = 8  # empty voxels around the surface, so that points outside still have a gradient
    depth_gain: float = 0.5  # share of the missing depth that a point makes up in a step
    stiffness: float = 0.25  # share of its offset from the mean of its neighbors that a point gives up in a step
    num_steps: int = 60  # at most
    atol: float = 0.02  # largest motion in a step that ends the descent, voxels
    min_depth: float = 0.5  # of points at the end, voxels


_DESCENT = DepthDescent()


class DepthField:
    """The signed distance to a surface on a grid, positive inside, computed for voxels as they are needed."""

    def __init__(self, mesh: TriangleMesh, resolution: int = 96) -> None:
        grid, border = voxelize(mesh, resolution, touching=False), _DESCENT.border
        if not bool(grid.filled.any()):
            grid = voxelize(mesh, resolution, touching=True)
        inside = torch.nn.functional.pad(grid.filled.cpu(), (border,) * 6)
        self.spacing = grid.spacing
        self.origin = grid.origin.detach().cpu().double() - border * grid.spacing
        self._sizes = torch.tensor(inside.shape)
        self._limit = self._sizes.double() - 1 - 1e-6
        self._strides = torch.tensor(inside.stride())
        corners = torch.tensor(list(product((0, 1), repeat=3))).flip(-1)  # of a cell, x first
        self._corners = corners @ self._strides
        # The nearest voxel on the other side of the surface is next to one on this side.
        last = _beside_others(inside)
        self._opposite = {side: NeighborTree((last & (inside != side)).nonzero()) for side in (True, False)}
        self._inside = inside.reshape(-1)
        self._depths = torch.full(self._inside.shape, torch.nan, dtype=torch.float64)

    def __call__(self, points: Tensor) -> Tensor:
        """Return the depths (...,) of points (..., 3), in their unit; far outside, that of the border of the grid."""
        position = (points.detach().cpu().double() - self.origin) / self.spacing
        position = torch.minimum(position.clamp_min(0), self._limit)
        cell = position.floor().long()
        share = position - cell
        x, y, z = torch.stack((1 - share, share), dim=-1).unbind(-2)
        weights = x[..., None, None, :] * y[..., None, :, None] * z[..., :, None, None]
        depths = self._voxel_depths((cell * self._strides).sum(-1, keepdim=True) + self._corners)
        return reduce(torch.add, (weights.flatten(-3) * depths).unbind(-1)).to(points.dtype)

    def gradient(self, points: Tensor) -> Tensor:
        """Return the gradients (..., 3) of the depth at points (..., 3), over two voxels along each axis."""
        return self.with_gradient(points)[1]

    def with_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the depths (...,) and their gradients (..., 3) at points (..., 3), see `gradient`."""
        steps = self.spacing * torch.eye(3, dtype=points.dtype)
        depths = self(points.unsqueeze(-2) + torch.cat((torch.zeros(1, 3, dtype=points.dtype), steps, -steps)))
        return depths[..., 0], (depths[..., 1:4] - depths[..., 4:]) / (2 * self.spacing)

    def _voxel_depths(self, voxels: Tensor) -> Tensor:
        """Return the depths of voxels (...,), given by their numbers."""
        depths = self._depths[voxels]
        unknown = voxels[depths.isnan()].unique()
        if not len(unknown):
            return depths
        for side, tree in self._opposite.items():
            some = unknown[self._inside[unknown] == side]
            distance = tree.nearest(some[:, None] // self._strides % self._sizes)[1] - 0.5
            self._depths[some] = self.spacing * (distance if side else -distance)
        return self._depths[voxels]


def _beside_others(inside: Tensor) -> Tensor:
    """Return a mask (X, Y, Z) of the voxels with a neighbor along an axis on the other side of a surface."""
    at_surface = torch.zeros_like(inside)
    for axis, size in enumerate(inside.shape):
        changes = inside.narrow(axis, 1, size - 1) != inside.narrow(axis, 0, size - 1)
        at_surface.narrow(axis, 1, size - 1).logical_or_(changes)
        at_surface.narrow(axis, 0, size - 1).logical_or_(changes)
    return at_surface


def move_inside(
    field: DepthField, curves: Tensor, radii: Tensor, free: Tensor, stiffness: float = _DESCENT.stiffness
) -> Tensor:
    """Return curves (..., S, 3) whose ``free`` points moved to their depths ``radii`` or the middle of the body."""
    movable = free.any(-1)  # other curves stay as they are
    moved, radii, mask = curves[movable], radii.expand(free.shape)[movable], free[movable].unsqueeze(-1)
    if not len(moved):
        return curves
    for _ in range(_DESCENT.num_steps):
        depth, gradient = field.with_gradient(moved)
        inwards = _DESCENT.depth_gain * (radii - depth).clamp_min(0).unsqueeze(-1) * gradient
        smoothing = torch.zeros_like(moved)
        smoothing[..., 1:-1, :] = 0.5 * (moved[..., :-2, :] + moved[..., 2:, :]) - moved[..., 1:-1, :]
        step = torch.where(mask, inwards + stiffness * smoothing, 0.0)
        moved = moved + step
        if float(step.abs().max()) < _DESCENT.atol * field.spacing:
            break
    # Points that smoothing holds outside move in without it.
    for _ in range(_DESCENT.num_steps):
        depth, gradient = field.with_gradient(moved)
        outside = mask[..., 0] & (depth < _DESCENT.min_depth * field.spacing)
        if not bool(outside.any()):
            break
        moved = moved + torch.where(outside, field.spacing - depth, 0.0).clamp_min(0).unsqueeze(-1) * gradient
    found = curves.clone()
    found[movable] = moved
    return found
