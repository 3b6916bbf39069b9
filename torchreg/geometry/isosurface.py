"""Meshing the zero set of a scalar field by marching tetrahedra."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations

import torch
from torch import Tensor

from torchreg._checks import check_shape
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh

# Kuhn's six tetrahedra of a cube: the monotone paths from corner 0 to corner 7; they match across cube faces.
_TETRAHEDRA = [[0, 1 << a, (1 << a) | (1 << b), 7] for a, b, _ in permutations(range(3))]
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
        upper: (3,) upper corner of the box.
        spacing: edge length of the grid's cubes, in the unit of the box.
        chunk: number of points the field is asked for at a time.

    Returns:
        the mesh; without faces if the field does not change sign on the grid.

    Raises:
        InputError: if the box is empty or would need more than 50 million grid points.

    Differentiable: no.

    Cost: one evaluation of the field per grid point.
    """
    check_shape(lower, "lower", (3,))
    check_shape(upper, "upper", (3,))
    if not spacing > 0 or not bool((upper > lower).all()):
        raise InputError(f"spacing must be positive and upper above lower, got {spacing}, {lower.tolist()}, {upper.tolist()}")
    sizes = [int(n) for n in ((upper - lower) / spacing).ceil().long() + 1]
    if sizes[0] * sizes[1] * sizes[2] > _MAX_GRID_POINTS:
        raise InputError(f"spacing {spacing} gives a grid of {sizes} points, over {_MAX_GRID_POINTS}; choose a larger one")
    with torch.no_grad():
        axes = [lower[a] + spacing * torch.arange(n, dtype=lower.dtype, device=lower.device) for a, n in enumerate(sizes)]
        points = torch.cartesian_prod(*axes)
        values = torch.cat([field(part) for part in points.split(chunk)])
        return _march(points, values, sizes)


def _march(points: Tensor, values: Tensor, sizes: list[int]) -> TriangleMesh:
    corners = _cut_cubes(values, sizes)
    tetrahedra = corners[:, torch.tensor(_TETRAHEDRA, device=values.device)].reshape(-1, 4)
    inside = values[tetrahedra] < 0
    count = inside.sum(-1)
    # Inside corners first: then only the number of inside corners decides the triangles.
    tetrahedra = tetrahedra.gather(-1, inside.long().argsort(dim=-1, descending=True, stable=True))
    edges = []
    for number, triangles in _TRIANGLES.items():
        chosen = tetrahedra[count == number]
        edges += [torch.stack([chosen[:, list(pair)] for pair in triangle], dim=1) for triangle in triangles]
    ends = torch.cat(edges) if edges else tetrahedra.new_zeros(0, 3, 2)
    flat, inverse = ends.reshape(-1, 2).unique(dim=0, return_inverse=True)
    inner, outer = values[flat[:, 0]], values[flat[:, 1]]
    share = (inner / (inner - outer)).unsqueeze(-1)
    vertices = points[flat[:, 0]] + share * (points[flat[:, 1]] - points[flat[:, 0]])
    faces = inverse.reshape(-1, 3)
    return TriangleMesh(vertices, _oriented(vertices, faces, points, ends))


# Per number of inside corners (which come first): triangles as three (inside, outside) edges.
_TRIANGLES = {
    1: [((0, 1), (0, 2), (0, 3))],
    2: [((0, 2), (0, 3), (1, 2)), ((1, 2), (0, 3), (1, 3))],
    3: [((0, 3), (1, 3), (2, 3))],
}


def _cut_cubes(values: Tensor, sizes: list[int]) -> Tensor:
    """Return the 8 corner indices of every cube in which the field changes sign."""
    index = torch.arange(values.numel(), device=values.device).reshape(sizes)
    corners = torch.stack(
        [
            index[x : sizes[0] - 1 + x, y : sizes[1] - 1 + y, z : sizes[2] - 1 + z].reshape(-1)
            for x, y, z in ((c & 1, c >> 1 & 1, c >> 2 & 1) for c in range(8))
        ],
        dim=-1,
    )
    signs = values[corners] < 0
    return corners[signs.any(-1) & ~signs.all(-1)]


def _oriented(vertices: Tensor, faces: Tensor, points: Tensor, ends: Tensor) -> Tensor:
    """Return the faces with normals that point from the inside ends of their edges to the outside ends."""
    a, b, c = vertices[faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    outwards = (points[ends[:, :, 1]] - points[ends[:, :, 0]]).sum(1)
    flip = (normal * outwards).sum(-1) < 0
    faces = torch.where(flip.unsqueeze(-1), faces[:, [0, 2, 1]], faces)
    # A corner value of exactly zero collapses triangles to a point.
    return faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
