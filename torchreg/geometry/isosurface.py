"""Meshing the zero set of a scalar field by marching tetrahedra."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import permutations

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh

# Kuhn's six tetrahedra of a cube: the monotone paths from corner 0 to corner 7; they match across cube faces.
_TETRAHEDRA = [[0, 1 << a, (1 << a) | (1 << b), 7] for a, b, _ in permutations(range(3))]
# Offsets of the 8 corners: bit a of a corner's number is its step along axis a.
_CORNERS = [(c & 1, c >> 1 & 1, c >> 2 & 1) for c in range(8)]
# Per number of inside corners (which come first): triangles as three (inside, outside) edges, with normals towards the
# outside where the four corners are right-handed.
_TRIANGLES = {
    1: [((0, 1), (0, 2), (0, 3))],
    2: [((0, 2), (0, 3), (1, 2)), ((1, 2), (0, 3), (1, 3))],
    3: [((0, 3), (1, 3), (2, 3))],
}
_MAX_GRID_POINTS = 50_000_000
_CHUNK = 65_536


def isosurface(
    field: Callable[[Tensor], Tensor], lower: Tensor, upper: Tensor, spacing: float, *, chunk: int = _CHUNK
) -> TriangleMesh:
    """Return the triangle mesh on which a field is zero, oriented from negative to positive values.

    Marching tetrahedra: the field is linear on each tetrahedron of a cubic grid. The mesh is closed where the surface
    stays inside the box.

    Args:
        field: (n, 3) points to (n,) values.
        lower: (3,) lower corner of the box.
        upper: (3,) upper corner of the box; the grid may reach up to one spacing beyond it.
        spacing: edge length of the grid's cubes, in the unit of the box.
        chunk: number of points the field is asked for at a time.

    Returns:
        the mesh; without faces if the field does not change sign on the grid.

    Raises:
        InputError: if the box is empty or would need more than 50 million grid points, or the field does not return
            one finite value per point.

    Differentiable: no.

    Cost: one evaluation of the field per grid point.

    References: Doi and Koide 1991.
    """
    grid = _Grid(as_float_tensor(lower, "lower"), as_float_tensor(upper, "upper"), spacing)
    with torch.no_grad():
        count = math.prod(grid.sizes)
        parts = [(start, min(start + chunk, count)) for start in range(0, count, chunk)]
        device = grid.lower.device
        values = torch.cat([_evaluate(field, grid.points(torch.arange(*part, device=device))) for part in parts])
        check_finite(values, "the field's values")
        return _march(grid, values)


class _Grid:
    """A cubic grid: flat indices to points, without holding the points."""

    def __init__(self, lower: Tensor, upper: Tensor, spacing: float) -> None:
        for name, corner in (("lower", lower), ("upper", upper)):
            check_shape(corner, name, (3,))
            check_finite(corner, name)
        check_positive(spacing, "spacing")
        if not bool((upper > lower).all()):
            raise InputError(f"upper must be above lower on every axis, got {upper.tolist()} and {lower.tolist()}")
        self.lower = lower
        self.spacing = spacing
        self.sizes = [math.ceil(extent / spacing) + 1 for extent in (upper - lower).tolist()]
        if math.prod(self.sizes) > _MAX_GRID_POINTS:
            raise InputError(
                f"spacing {spacing} gives a grid of {self.sizes} points, over {_MAX_GRID_POINTS}; choose a larger one"
            )

    def steps(self, index: Tensor) -> Tensor:
        """Return the (..., 3) steps along the axes of flat indices."""
        rows = index // self.sizes[2]
        return torch.stack([rows // self.sizes[1], rows % self.sizes[1], index % self.sizes[2]], dim=-1)

    def points(self, index: Tensor) -> Tensor:
        """Return the (..., 3) points of flat indices."""
        return self.lower + self.spacing * self.steps(index).to(self.lower.dtype)


def _evaluate(field: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    values = field(points)
    check_shape(values, "the field's values", (len(points),))
    return values


def _march(grid: _Grid, values: Tensor) -> TriangleMesh:
    corners = _cut_cubes(values, grid.sizes)
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
    return TriangleMesh(_crossings(grid, values, edges), faces.reshape(-1, 3))


def _crossings(grid: _Grid, values: Tensor, edges: Tensor) -> Tensor:
    """Return the zeros of the field, linear along (inside, outside) edges; the corner itself for a doubled corner."""
    inner, outer = values[edges].unbind(-1)
    span = inner - outer
    share = torch.where(span == 0, 0.0, inner / torch.where(span == 0, 1.0, span))
    start, end = grid.points(edges).unbind(1)
    return start + share.unsqueeze(-1).to(start.dtype) * (end - start)


def _left_handed(grid: _Grid, tetrahedra: Tensor) -> Tensor:
    """Return whether the corners of tetrahedra (T, 4) are left-handed; on integer steps, so never in doubt."""
    steps = grid.steps(tetrahedra)
    a, b, c = (steps[:, 1:] - steps[:, :1]).unbind(1)
    return (torch.linalg.cross(a, b) * c).sum(-1) < 0


def _cut_cubes(values: Tensor, sizes: list[int]) -> Tensor:
    """Return the (C, 8) flat corner indices of every cube in which the field changes sign."""
    negative = (values < 0).reshape(sizes)
    shape = [size - 1 for size in sizes]
    some = torch.zeros(shape, dtype=torch.bool, device=values.device)
    every = torch.ones_like(some)
    for x, y, z in _CORNERS:
        corner = negative[x : x + shape[0], y : y + shape[1], z : z + shape[2]]
        some |= corner
        every &= corner
    first = (some & ~every).nonzero()
    strides = torch.tensor([sizes[1] * sizes[2], sizes[2], 1], device=values.device)
    offsets = torch.tensor(_CORNERS, device=values.device)
    return ((first.unsqueeze(1) + offsets) * strides).sum(-1)
