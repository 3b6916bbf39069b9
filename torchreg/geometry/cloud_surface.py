"""A closed surface around points of a surface, without normals, by morphological closing."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.distance_transform import fill_holes, signed_distance
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import distinct_positions, k_nearest_others
from torchreg.geometry.voxels import VoxelGrid


@dataclass(frozen=True)
class CloudClosing:
    """How gaps between points are closed."""

    min_points: int = 100  # different ones: fewer show no limb
    neighbors: int = 6  # around a point on a surface: gaps are no wider than the distance to the last of them
    quantile: float = 0.95  # of these distances over all points
    radii: tuple[float, ...] = (0.7, 1.0, 1.5, 2.5)  # in these gaps: the least one that makes a body is taken
    voxels: float = 2.0  # in a radius
    max_resolution: int = 192  # voxels along the longest side; bounds memory and time
    min_inside: float = 0.02  # share of the closed body that lies deeper than the points, or they enclose nothing


CLOSING = CloudClosing()


@dataclass(frozen=True, eq=False)
class CloudSurface:
    """A closed surface one voxel outside of points; ``encloses``: they surround a body, not one side of it."""

    mesh: TriangleMesh
    encloses: bool


def cloud_surface(points: Tensor, name: str = "points") -> CloudSurface:
    """Return the surface of the body that points (N, 3) lie on, in any order (morphological closing, Serra 1982)."""
    places = enough_places(points, name)
    gap = float(k_nearest_others(places, CLOSING.neighbors)[1][:, -1].quantile(CLOSING.quantile))
    for radius in CLOSING.radii:
        grid, encloses = _closed(places, radius * gap)
        if encloses:
            break
    return CloudSurface(mesh=replace(grid, origin=grid.origin.to(points)).mesh(), encloses=encloses)


def enough_places(points: Tensor, name: str) -> Tensor:
    """Return the different ones of points (N, 3), float64 on the CPU, at least 100."""
    places = distinct_positions(points.detach().cpu().double())[0]
    if len(places) < CLOSING.min_points:
        raise InputError(f"{name} must hold {CLOSING.min_points} different points or more, got {len(places)}")
    return places


def _closed(places: Tensor, radius: float) -> tuple[VoxelGrid, bool]:
    """Return the closing of points (N, 3) by balls of a radius, and whether they enclose more than the balls."""
    low, high = places.amin(0), places.amax(0)
    spacing = max(radius / CLOSING.voxels, float((high - low).max()) / CLOSING.max_resolution)
    border = math.ceil(radius / spacing) + 2
    origin = low - border * spacing
    size = ((high - low) / spacing).round().long() + 2 * border + 1
    x, y, z = ((places - origin) / spacing).round().long().unbind(1)
    shown = torch.zeros(*size.tolist(), dtype=torch.bool)
    shown[x, y, z] = True
    shell = signed_distance(shown) <= radius / spacing
    body = fill_holes(shell)
    inside = float((body & ~shell).sum()) / float(body.sum())
    shrunk = signed_distance(body) < 1 - radius / spacing
    return VoxelGrid(shrunk | shown, origin, spacing), inside > CLOSING.min_inside
