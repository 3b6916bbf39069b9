"""Arms as balls along bent axes, and the surfaces of many balls, meshed from voxels on randomly shifted grids."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.marching_cubes import marching_cubes
from torchreg.geometry.mesh import TriangleMesh


@dataclass(frozen=True)
class _Painting:
    """Filling of voxels."""

    reach: int = 3  # voxels outside of the surface up to which the field is known
    batch: int = 24  # balls of nearly one radius that are painted at a time


_PAINTING = _Painting()


def bent_axes(along: Tensor, across: Tensor, elevations: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Return axes (..., S, 3) of arms that begin at the origin and bend, and their directions (..., S, 3).

    Cosines and sines of the azimuths and the elevations (radians) are (..., S) at even steps along each axis.
    """
    flat = elevations.cos()
    directions = torch.stack((flat * along, flat * across, elevations.sin()), dim=-1)
    steps = (lengths / (elevations.shape[-1] - 1))[..., None, None]
    steps = 0.5 * (directions[..., 1:, :] + directions[..., :-1, :]) * steps
    return torch.nn.functional.pad(steps.cumsum(-2), (0, 0, 1, 0)), directions


def ball_surface(
    balls: Tensor, sizes: Tensor, resolution: int, noise: float, generator: torch.Generator, dtype: torch.dtype
) -> TriangleMesh:
    """Return the surface around balls with centers (N, 3) and radii (N,), meshed on a randomly shifted grid.

    The noise of the field at each voxel is in voxels; the resolution is that of the longest side of the box.
    """
    lower, upper = (balls - sizes[:, None]).amin(0), (balls + sizes[:, None]).amax(0)
    spacing = float((upper - lower).max()) / resolution
    origin = lower - spacing * (2 + torch.rand(3, generator=generator, dtype=lower.dtype))
    counts = ((upper - origin) / spacing).ceil().long() + 3
    # In steps of the grid: numbers of one size, so that float32 serves.
    centers, widths = ((balls - origin) / spacing).to(dtype), (sizes / spacing).to(dtype)
    field = torch.full(tuple(counts.tolist()), float(_PAINTING.reach), dtype=dtype)
    for part in widths.argsort().split(_PAINTING.batch):
        _paint(field, centers[part], widths[part])
    if noise:
        shaken = torch.randn(field.shape, generator=generator, dtype=torch.float64).to(dtype)
        inner = (slice(1, -1),) * 3  # the border stays outside
        field[inner] += noise * shaken[inner] * (field[inner] < 1 + 3 * noise)
    return marching_cubes(field, origin.to(dtype), spacing)


def _paint(field: Tensor, centers: Tensor, radii: Tensor) -> None:
    """Lower a field (X, Y, Z), in place, to the signed distance to balls (N, 3), up to the reach outside of them."""
    half = math.ceil(float(radii.max())) + _PAINTING.reach
    reach = torch.arange(-half, half + 1)
    offsets = torch.stack(torch.meshgrid(reach, reach, reach, indexing="ij"), -1).reshape(-1, 3)
    cells = centers.round().long().unsqueeze(1) + offsets
    distance = (cells - centers.unsqueeze(1)).norm(dim=-1) - radii.unsqueeze(-1)
    sizes = torch.tensor(field.shape)
    within = ((cells >= 0) & (cells < sizes)).all(-1)
    flat = cells[within] @ torch.tensor([field.shape[1] * field.shape[2], field.shape[2], 1])
    field.view(-1).scatter_reduce_(0, flat, distance[within], "amin")
