"""Marching cubes against closed manifolds, volumes of known solids, and the invariances of a grid."""

import math

import pytest
import torch

from torchreg.geometry.marching_cubes import marching_cubes
from torchreg.geometry.mesh import TriangleMesh


def sphere_values(size, radius, dtype=torch.float64):
    axis = torch.linspace(-1, 1, size, dtype=dtype)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return points.norm(dim=-1) - radius, torch.tensor([-1.0, -1.0, -1.0], dtype=dtype), 2 / (size - 1)


def volume(mesh):
    return float(torch.linalg.det(mesh.vertices[mesh.faces]).sum() / 6)


def is_closed_manifold(mesh):
    """Every directed edge once, and its reverse once."""
    faces = mesh.faces
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, count = edges.unique(dim=0, return_counts=True)
    return bool((count == 1).all()) and torch.equal(there, edges.flip(1).unique(dim=0))


@pytest.mark.parametrize("seed", range(8))
def test_noise_of_every_case_gives_a_closed_manifold(seed):
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(9, 10, 11, generator=generator, dtype=torch.float64)
    values = torch.nn.functional.pad(values, (1,) * 6, value=1.0)
    mesh = marching_cubes(values, torch.zeros(3), 1.0)
    assert is_closed_manifold(mesh)
    assert float(mesh.face_areas().min()) > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_sphere_has_its_volume_and_faces_outwards(dtype):
    mesh = marching_cubes(*sphere_values(40, 0.8, dtype))
    assert mesh.vertices.dtype == dtype
    assert volume(mesh) == pytest.approx(4 / 3 * math.pi * 0.8**3, rel=0.01)
    torch.testing.assert_close(mesh.vertices.norm(dim=-1), torch.full_like(mesh.vertices[:, 0], 0.8), rtol=0, atol=2e-3)
    outward = (mesh.face_normals() * mesh.vertices[mesh.faces].mean(1)).sum(-1)
    assert bool((outward > 0).all())
    assert mesh.num_vertices - mesh.num_faces // 2 == 2  # Euler's formula


def test_a_plane_is_met_exactly():
    axis = torch.arange(6, dtype=torch.float64)
    values = (axis[:, None, None] + 0.5 * axis[:, None] - axis - 1.3).expand(6, 6, 6)
    mesh = marching_cubes(values, torch.zeros(3), 1.0)
    x, y, z = mesh.vertices.unbind(-1)
    torch.testing.assert_close(x + 0.5 * y - z, torch.full_like(x, 1.3))


def test_negating_turns_the_faces_only_where_no_face_of_a_cube_is_ambiguous():
    values, origin, spacing = sphere_values(20, 0.7)
    there, back = marching_cubes(values, origin, spacing), marching_cubes(-values, origin, spacing)
    assert volume(there) == pytest.approx(-volume(back), rel=1e-3)


def test_diagonal_neighbors_stay_apart():
    values = torch.ones(4, 5, 5)
    values[1, 1, 1] = values[1, 2, 2] = -1
    mesh = marching_cubes(values, torch.zeros(3), 1.0)
    assert mesh.num_vertices - mesh.num_faces // 2 == 4  # two spheres


def test_origin_and_spacing_move_the_vertices():
    values, _, _ = sphere_values(12, 0.6)
    plain = marching_cubes(values, torch.zeros(3), 1.0)
    moved = marching_cubes(values, torch.tensor([1.0, 2.0, 3.0]), 0.5)
    torch.testing.assert_close(moved.vertices, 0.5 * plain.vertices + torch.tensor([1.0, 2.0, 3.0]).double())
    assert torch.equal(moved.faces, plain.faces)


def test_no_change_of_sign_gives_no_faces():
    assert isinstance(marching_cubes(torch.ones(3, 3, 3), torch.zeros(3), 1.0), TriangleMesh)
    assert marching_cubes(torch.ones(3, 3, 3), torch.zeros(3), 1.0).num_faces == 0
