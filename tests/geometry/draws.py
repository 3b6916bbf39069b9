"""Seeded draws, and small meshes, for the tests of several rooms."""

import torch

from torchreg.geometry.mesh import TriangleMesh

D = torch.float64


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def randn(*shape, seed=0, dtype=D):
    return torch.randn(*shape, generator=seeded(seed), dtype=dtype)


def rand(*shape, seed=0, dtype=D):
    return torch.rand(*shape, generator=seeded(seed), dtype=dtype)


def directions(count, seed=0, dtype=D):
    return torch.nn.functional.normalize(randn(count, 3, seed=seed, dtype=dtype), dim=-1)


def sheet_faces(rows, columns):
    """Triangles of a grid of points, row by row."""
    corner = (torch.arange(rows - 1)[:, None] * columns + torch.arange(columns - 1)).reshape(-1)
    right, below = corner + 1, corner + columns
    return torch.cat((torch.stack((corner, right, below), 1), torch.stack((right, below + 1, below), 1)))


def box_mesh(sides=(1.0, 1.0, 1.0), dtype=D):
    """A box with a corner at the origin, its faces outwards."""
    corners = torch.cartesian_prod(*(torch.tensor([0.0, side], dtype=dtype) for side in sides))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return TriangleMesh(corners, torch.tensor([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]))


def volume(mesh):
    return float(torch.linalg.det(mesh.vertices[mesh.faces]).sum() / 6)


def is_closed(mesh):
    """Whether every directed edge is met as often as its reverse."""
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    (forth, often), (back, again) = (way.unique(dim=0, return_counts=True) for way in (edges, edges.flip(1)))
    return torch.equal(forth, back) and torch.equal(often, again)
