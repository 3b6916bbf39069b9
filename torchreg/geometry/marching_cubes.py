"""Meshing a sampled volume by marching cubes; the table of cases is derived such that meshes close unambiguously."""

from __future__ import annotations

from functools import cache
from itertools import combinations

import torch
from torch import Tensor

from torchreg.geometry.mesh import TriangleMesh

# Edges as (lower corner, axis); bit a of a corner's number is its step along axis a.
_EDGES = tuple((corner, axis) for axis in range(3) for corner in range(8) if not corner >> axis & 1)
# Least distance of a vertex from the ends of its edge, as a share of the edge, so that no triangle collapses.
_MARGIN = 1e-3


def marching_cubes(values: Tensor, origin: Tensor, spacing: float) -> TriangleMesh:
    """Return the mesh where samples (X, Y, Z) are zero, oriented from negative to positive (Lorensen and Cline 1987).

    Closed and manifold if all samples on the faces of the volume have one sign: where the corners of a cube's face
    alternate in sign, both cubes keep negative ones apart. ``origin`` is the position of sample (0, 0, 0).
    """
    with torch.no_grad():
        negative = values < 0
        keys, vertices = _crossings(values, negative)
        cubes, cases = _cut_cubes(negative)
        faces = torch.searchsorted(keys, _case_triangles(cubes, cases, values.shape).reshape(-1)).reshape(-1, 3)
        return TriangleMesh(origin.to(values) + spacing * vertices, faces)


def _crossings(values: Tensor, negative: Tensor) -> tuple[Tensor, Tensor]:
    """Return sorted keys of the grid's edges on which the sign changes, and positions of the zeros in grid steps."""
    count, keys, points = values.numel(), [], []
    strides = torch.tensor([values.shape[1] * values.shape[2], values.shape[2], 1], device=values.device)
    flat = values.reshape(-1)
    for axis in range(3):
        size = values.shape[axis] - 1
        changes = negative.narrow(axis, 0, size) != negative.narrow(axis, 1, size)
        steps = changes.nonzero()
        lower = steps @ strides
        start, end = flat[lower], flat[lower + int(strides[axis])]
        zeros = steps.to(values)
        zeros[:, axis] += (start / (start - end)).clamp(_MARGIN, 1 - _MARGIN)
        keys.append(axis * count + lower)
        points.append(zeros)
    return torch.cat(keys), torch.cat(points)


def _cut_cubes(negative: Tensor) -> tuple[Tensor, Tensor]:
    """Return the steps (C, 3) of the cubes in which the sign changes, and their case numbers (C,)."""
    x, y, z = (size - 1 for size in negative.shape)
    code = torch.zeros((x, y, z), dtype=torch.uint8, device=negative.device)
    bits = negative.to(torch.uint8)
    for corner in range(8):
        a, b, c = corner & 1, corner >> 1 & 1, corner >> 2 & 1
        code += bits[a : a + x, b : b + y, c : c + z] << corner
    cubes = ((code > 0) & (code < 255)).nonzero()
    return cubes, code[cubes[:, 0], cubes[:, 1], cubes[:, 2]].long()


def _case_triangles(cubes: Tensor, cases: Tensor, shape: torch.Size) -> Tensor:
    """Return the keys (F, 3) of the edges that carry the vertices of each triangle."""
    table, first, count = (part.to(cases.device) for part in _table())
    strides = torch.tensor([shape[1] * shape[2], shape[2], 1], device=cases.device)
    corners = torch.tensor([[corner >> axis & 1 for axis in range(3)] for corner, _ in _EDGES], device=cases.device)
    axes = torch.tensor([axis for _, axis in _EDGES], device=cases.device)
    offsets = axes * shape.numel() + corners @ strides
    number = count[cases]
    owner = torch.arange(len(cases), device=cases.device).repeat_interleave(number)
    within = torch.arange(len(owner), device=cases.device) - (number.cumsum(0) - number)[owner]
    edges = table[first[cases][owner] + within]
    return (cubes @ strides)[owner].unsqueeze(-1) + offsets[edges]


@cache
def _table() -> tuple[Tensor, Tensor, Tensor]:
    """Return the triangles (N, 3) of all 256 cases as edge indices, and per case its first triangle and their count."""
    rows = [[triangle for loop in _loops(case) for triangle in _triangulated(loop)] for case in range(256)]
    count = torch.tensor([len(row) for row in rows])
    return torch.tensor([triangle for row in rows for triangle in row]), count.cumsum(0) - count, count


def _loops(case: int) -> list[list[int]]:
    """Return the closed polygons of crossed edges that separate negative from positive corners of a cube."""
    follows: dict[int, int] = {}
    for corners in _cube_faces():
        inside = [bool(case >> corner & 1) for corner in corners]
        for k in range(4):
            if inside[k] and not inside[k - 1]:  # a run of negative corners begins: cut it off where it ends
                end = next(j for j in range(k + 1, k + 4) if not inside[j % 4])
                entering = _edge_index(corners[k - 1], corners[k])
                follows[entering] = _edge_index(corners[(end - 1) % 4], corners[end % 4])
    loops = []
    while follows:
        loop = [next(iter(follows))]
        while (after := follows.pop(loop[-1])) != loop[0]:
            loop.append(after)
        loops.append(loop)
    return loops


def _cube_faces() -> list[list[int]]:
    """Return the four corners of each face of a cube, counterclockwise as seen from outside."""
    faces = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        faces.append([1 << axis, 1 << axis | u, 1 << axis | u | v, 1 << axis | v])
        faces.append([0, v, u | v, u])
    return faces


def _edge_index(start: int, end: int) -> int:
    return _EDGES.index((min(start, end), (start ^ end).bit_length() - 1))


def _triangulated(loop: list[int]) -> list[tuple[int, int, int]]:
    """Return triangles of a polygon without diagonals in a face of the cube, where the next cube could have one too."""
    if len(loop) == 3:
        return [(loop[0], loop[1], loop[2])]
    count = len(loop)
    start, end = next(
        (k, m) for k, m in combinations(range(count), 2) if 1 < m - k < count - 1 and not _share_face(loop[k], loop[m])
    )
    return _triangulated(loop[start : end + 1]) + _triangulated(loop[end:] + loop[: start + 1])


def _share_face(first: int, second: int) -> bool:
    corners = {corner | bit for corner, axis in (_EDGES[first], _EDGES[second]) for bit in (0, 1 << axis)}
    return any(corners <= set(face) for face in _cube_faces())
