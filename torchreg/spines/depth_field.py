"""The depth of points inside a surface, on a grid, and curves moved to a depth of their own."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from torchreg.geometry.distance_transform import signed_distance
from torchreg.geometry.mesh import TriangleMesh
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
    """The signed distance to a surface on a grid, positive inside; a hole does no harm, see `voxelize`.

    Args:
        mesh: the surface.
        resolution: voxels along its longest side; depths are right to about one voxel.

    Cost: 0.1 s at the default resolution on one CPU core.
    """

    def __init__(self, mesh: TriangleMesh, resolution: int = 96) -> None:
        grid, border = voxelize(mesh, resolution, touching=False), _DESCENT.border
        self.spacing = grid.spacing
        self.values = -grid.spacing * signed_distance(torch.nn.functional.pad(grid.filled.cpu(), (border,) * 6))
        self.origin = grid.origin.detach().cpu().double() - border * grid.spacing

    def __call__(self, points: Tensor) -> Tensor:
        """Return the depths (...,) of points (..., 3), in their unit; far outside, that of the border of the grid."""
        position = (points.detach().cpu().double() - self.origin) / self.spacing
        limit = torch.tensor(self.values.shape, dtype=torch.float64) - 1
        position = torch.minimum(position.clamp_min(0), limit - 1e-6)
        cell = position.floor().long()
        share = position - cell
        total = torch.zeros_like(share[..., 0])
        for z, y, x in product((0, 1), repeat=3):
            corner = torch.tensor((x, y, z))
            weight = torch.where(corner > 0, share, 1 - share).prod(-1)
            total = total + weight * self.values[tuple((cell + corner).unbind(-1))]
        return total.to(points.dtype)

    def gradient(self, points: Tensor) -> Tensor:
        """Return the gradients (..., 3) of the depth at points (..., 3), over two voxels along each axis."""
        steps = self.spacing * torch.eye(3, dtype=points.dtype)
        difference = self(points.unsqueeze(-2) + steps) - self(points.unsqueeze(-2) - steps)
        return difference / (2 * self.spacing)


def move_inside(
    field: DepthField, curves: Tensor, radii: Tensor, free: Tensor, stiffness: float = _DESCENT.stiffness
) -> Tensor:
    """Return curves moved by small steps until they lie at their depths, or in the middle, and are smooth.

    Args:
        field: of the surface.
        curves: (..., S, 3).
        radii: (..., S) depth that is enough; where the body is thinner, the curve stays in its middle.
        free: (..., S) bool, False for points that stay.
        stiffness: see `DepthDescent`; zero moves every point independently.
    """
    moved, mask = curves.clone(), free.unsqueeze(-1)
    for _ in range(_DESCENT.num_steps):
        missing = (radii - field(moved)).clamp_min(0).unsqueeze(-1)
        inwards = _DESCENT.depth_gain * missing * field.gradient(moved)
        smoothing = torch.zeros_like(moved)
        smoothing[..., 1:-1, :] = 0.5 * (moved[..., :-2, :] + moved[..., 2:, :]) - moved[..., 1:-1, :]
        step = torch.where(mask, inwards + stiffness * smoothing, 0.0)
        moved = moved + step
        if float(step.abs().max()) < _DESCENT.atol * field.spacing:
            break
    # Points that smoothing holds outside move in without it.
    for _ in range(_DESCENT.num_steps):
        depth = field(moved).unsqueeze(-1)
        outside = mask & (depth < _DESCENT.min_depth * field.spacing)
        if not bool(outside.any()):
            break
        moved = torch.where(outside, moved + (field.spacing - depth).clamp_min(0) * field.gradient(moved), moved)
    return moved
