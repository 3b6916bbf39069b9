"""Soups of triangles with shared vertices: sharp edges stay, round surfaces become smooth."""

import torch

from torchreg.geometry.creases import welded
from torchreg.geometry.mesh import TriangleMesh, unit_sphere


def soup(mesh):
    return mesh.vertices[mesh.faces].reshape(-1, 3), torch.arange(mesh.faces.numel()).reshape(-1, 3)


def cube():
    corners = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return TriangleMesh(corners, torch.tensor(faces))


def test_a_round_surface_is_smooth_again():
    mesh = unit_sphere(3)
    vertices, faces = soup(mesh)
    kept, indexed, normals = welded(vertices, faces)
    assert len(kept) == mesh.num_vertices
    torch.testing.assert_close(vertices[kept][indexed], vertices[faces])
    assert float((normals.float() * vertices[kept]).sum(-1).min()) > 0.995


def test_edges_of_a_cube_stay_sharp():
    vertices, faces = soup(cube())
    kept, indexed, normals = welded(vertices, faces)
    assert len(kept) == 24  # each corner with the normals of its three sides
    torch.testing.assert_close(vertices[kept][indexed], vertices[faces])
    assert bool((normals.abs().amax(-1) == 1).all())
