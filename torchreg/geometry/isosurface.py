"""Meshing the zero set of a scalar field by marching tetrahedra."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import permutations

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.budget import BUDGET
from torchreg.geometry.mesh import TriangleMesh

# Kuhn's six tetrahedra of a cube: the monotone paths from corner 0 to corner 7; they match across cube faces.
_TETRAHEDRA = [[0, 1 << a, (1 << a) | (1 << b), 7] for a, b, _ in permutations(range(3))]
# Offsets of the 8 corners: bit a of a corner's number is its step along axis a.
_CORNERS = [(c & 1, c >> 1 & 1, c >> 2 & 1) for c in range(8)]
# Triangles per number of inside corners, which come first: three (inside, outside) edges each, with normals towards the
# outside where the four corners are right-handed.
_TRIANGLES = {
    1: [((0, 1), (0, 2), (0, 3))],
    2: [((0, 2), (0, 3), (1, 2)), ((1, 2), (0, 3), (1, 3))],
    3: [((0, 3), (1, 3), (2, 3))],
}


def isosurface(field: Callable[[Tensor], Tensor], lower: Tensor, upper: Tensor, spacing: float) -> TriangleMesh:
    """Return the mesh of the zeros of a field in a box, facing positive values (Doi and Koide 1991)."""
    grid = _Grid(lower, upper, spacing)
    with torch.no_grad():
        samples = torch.arange(math.prod(grid.sizes), device=lower.device).split(BUDGET.field_points)
        return _march(grid, torch.cat([field(grid.points(index)) for index in samples]))


class _Grid:
    """A cubic grid: flat indices to points, without holding the points."""

    def __init__(self, lower: Tensor, upper: Tensor, spacing: float) -> None:
        self.lower = lower
        self.spacing = spacing
        self.sizes = [math.ceil(extent / spacing) + 1 for extent in (upper - lower).tolist()]
        if math.prod(self.sizes) > BUDGET.volume_samples:
            raise InputError(
                f"spacing {spacing} gives a grid of {self.sizes} points, over {BUDGET.volume_samples}; choose a larger "
                f"one"
            )

    def steps(self, index: Tensor) -> Tensor:
        """Return the (..., 3) steps along the axes of flat indices."""
        rows = index // self.sizes[2]
        return torch.stack([rows // self.sizes[1], rows % self.sizes[1], index % self.sizes[2]], dim=-1)

    def points(self, index: Tensor) -> Tensor:
        """Return the (..., 3) points of flat indices."""
        return self.lower + self.spacing * self.steps(index).to(self.lower.dtype)


def _march(grid: _Grid, values: Tensor) -> TriangleMesh:
    corners = _mixed_cubes(values, grid.sizes)
    tetrahedra = corners[:, torch.tensor(_TETRAHEDRA, device=values.device)].reshape(-1, 4)
    inside = values[tetrahedra] < 0
    count = inside.sum(-1)
    # Inside corners first: then only the number of inside corners decides the triangles.
    tetrahedra = tetrahedra.gather(-1, inside.long().argsort(dim=-1, descending=True, stable=True))
    triangles = []
    for number, table in _TRIANGLES.items():
        chosen = tetrahedra[count == number]
        edges = torch.stack([chosen[:, torch.tensor(row, device=chosen.device)] for row in table], dim=1)
        triangles.append(torch.where(_left_handed(grid, chosen)[:, None, None, None], edges.flip(2), edges))
    ends = torch.cat([part.reshape(-1, 3, 2) for part in triangles])
    # A corner of value zero is one vertex for all its edges; the triangles that collapse there are dropped.
    ends = torch.where((values[ends[..., 1]] == 0).unsqueeze(-1), ends[..., 1:], ends)
    faces = ends[..., 0] * values.numel() + ends[..., 1]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    keys, faces = faces.unique(return_inverse=True)
    edges = torch.stack([keys // values.numel(), keys % values.numel()], dim=-1)
    return TriangleMesh(_edge_zeros(grid, values, edges), faces.reshape(-1, 3))


def _edge_zeros(grid: _Grid, values: Tensor, edges: Tensor) -> Tensor:
    """Return the zeros of the field, linear along (inside, outside) edges; the corner of an edge between equal ends."""
    inner, outer = values[edges].unbind(-1)
    span = inner - outer
    share = torch.where(span == 0, 0.0, inner / torch.where(span == 0, 1.0, span))
    start, end = grid.points(edges).unbind(1)
    return start + share.unsqueeze(-1).to(start.dtype) * (end - start)


def _left_handed(grid: _Grid, tetrahedra: Tensor) -> Tensor:
    """Return a mask of the tetrahedra (T, 4) with left-handed corners; on integer steps, so free of rounding."""
    steps = grid.steps(tetrahedra)
    a, b, c = (steps[:, 1:] - steps[:, :1]).unbind(1)
    return (torch.linalg.cross(a, b) * c).sum(-1) < 0


def _mixed_cubes(values: Tensor, sizes: list[int]) -> Tensor:
    """Return the (C, 8) flat corner indices of every cube in which the field changes sign."""
    negative = (values < 0).reshape(sizes)
    shape = [size - 1 for size in sizes]
    any_inside = torch.zeros(shape, dtype=torch.bool, device=values.device)
    all_inside = torch.ones_like(any_inside)
    for x, y, z in _CORNERS:
        corner = negative[x : x + shape[0], y : y + shape[1], z : z + shape[2]]
        any_inside |= corner
        all_inside &= corner
    first = (any_inside & ~all_inside).nonzero()
    strides = torch.tensor([sizes[1] * sizes[2], sizes[2], 1], device=values.device)
    offsets = torch.tensor(_CORNERS, device=values.device)
    return ((first.unsqueeze(1) + offsets) * strides).sum(-1)
