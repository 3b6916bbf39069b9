"""Simple solids as distance fields, and their smooth union."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.mesh import TriangleMesh

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class RoundCone:
    """A ball that moves along a segment while its radius changes; a sphere if the segment has no length."""

    start: Vector
    end: Vector
    start_radius: float
    end_radius: float

    def distance(self, points: Tensor) -> Tensor:
        """Return signed distances (N,) of points (N, 3) to the ball with the nearest center, negative inside."""
        start, end = points.new_tensor(self.start), points.new_tensor(self.end)
        axis = end - start
        squared = axis.square().sum()
        along = (points - start) @ axis
        share = (along / squared).clamp(0, 1) if float(squared) > 0 else torch.zeros_like(along)
        radius = self.start_radius + share * (self.end_radius - self.start_radius)
        return (points - start - share.unsqueeze(-1) * axis).norm(dim=-1) - radius

    def bounds(self) -> tuple[Vector, Vector]:
        """Return the lower and upper corner of a box that holds the solid."""
        widest = max(self.start_radius, self.end_radius)
        pairs = [*zip(self.start, self.end, strict=True)]
        return _vector([min(pair) - widest for pair in pairs]), _vector([max(pair) + widest for pair in pairs])


@dataclass(frozen=True)
class RoundBox:
    """A box along the axes with rounded edges; ``half`` of its sides includes the rounding."""

    center: Vector
    half: Vector
    radius: float

    def distance(self, points: Tensor) -> Tensor:
        """Return exact signed distances (N,) of points (N, 3), negative inside."""
        excess = (points - points.new_tensor(self.center)).abs() - points.new_tensor(self.half) + self.radius
        return excess.clamp_min(0).norm(dim=-1) + excess.amax(-1).clamp_max(0) - self.radius

    def bounds(self) -> tuple[Vector, Vector]:
        """Return the lower and upper corner."""
        pairs = [*zip(self.center, self.half, strict=True)]
        return _vector([middle - half for middle, half in pairs]), _vector([middle + half for middle, half in pairs])


def ball(center: Vector, radius: float) -> RoundCone:
    """Return a ball."""
    return RoundCone(center, center, radius, radius)


class Solid(Protocol):
    """A distance field that is negative inside, and a box that holds all of that."""

    def distance(self, points: Tensor) -> Tensor: ...  # noqa: D102
    def bounds(self) -> tuple[Vector, Vector]: ...  # noqa: D102


def union_distance(solids: Sequence[Solid], points: Tensor, blend: float) -> Tensor:
    """Return signed distances (N,) to a union with seams of radius b, ``-b log sum_i exp(-d_i / b)``; 0: sharp."""
    distances = torch.stack([solid.distance(points) for solid in solids])
    return distances.amin(0) if blend == 0 else -blend * torch.logsumexp(-distances / blend, dim=0)


def mesh_of(solids: Sequence[Solid], spacing: float, blend: float = 0.0) -> TriangleMesh:
    """Return the closed surface of a union of solids, facing outwards, in float64, found on a grid of some spacing."""
    corners = [torch.tensor(corner, dtype=torch.float64) for solid in solids for corner in solid.bounds()]
    lower, upper = torch.stack(corners).amin(0), torch.stack(corners).amax(0)
    # A smooth union is a little larger than its solids.
    margin = 1.5 * spacing + blend * len(solids) ** 0.5
    field = partial(union_distance, solids, blend=blend)
    return isosurface(field, lower - margin, upper + margin, spacing)


def _vector(values: list[float]) -> Vector:
    x, y, z = values
    return x, y, z
