"""Triangle meshes: validation, normals, sampling, spheres."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import D, box_mesh, directions, is_closed, randn, seeded, volume
from torchreg.geometry.mesh import TriangleMesh, even_samples, interpolate, sample_surface, unit_sphere


def bumpy(seed=0, dtype=D):
    sphere = unit_sphere(1, dtype=dtype)
    return TriangleMesh(sphere.vertices + 0.1 * randn(42, 3, seed=seed, dtype=dtype), sphere.faces)


def to_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (D, 1e-10)])
def test_areas_and_normals_agree_with_trimesh(dtype, tolerance):
    mesh = bumpy(dtype=dtype)
    oracle = to_trimesh(mesh)
    by_angle = trimesh.geometry.weighted_vertex_normals(42, oracle.faces, oracle.face_normals, oracle.face_angles)
    expected = (oracle.area_faces, oracle.face_normals, by_angle, oracle.bounds)
    found = (mesh.face_areas(), mesh.face_normals(), mesh.vertex_normals(), mesh.bounds())
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.dtype == dtype
        np.testing.assert_allclose(ours, theirs, atol=tolerance)


def test_vertex_normals_of_a_cube_corner_do_not_depend_on_the_triangulation():
    mesh = box_mesh()
    expected = torch.nn.functional.normalize(mesh.vertices - 0.5, dim=-1)
    torch.testing.assert_close(mesh.vertex_normals(), expected)
    assert not torch.allclose(mesh.vertex_normals("area"), expected)


def test_isolated_vertices_and_flat_faces_give_zero_and_finite_gradients():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [2, 0, 0]], dtype=D, requires_grad=True)
    mesh = TriangleMesh(vertices, torch.tensor([[0, 1, 2], [0, 1, 4], [1, 1, 1]]))
    assert mesh.face_normals()[1:].eq(0).all()
    normals = mesh.vertex_normals()
    torch.testing.assert_close(normals, torch.tensor([[0.0, 0, 1]] * 3 + [[0.0, 0, 0]] * 2, dtype=D))
    (normals.square().sum() + mesh.vertex_normals("area").sum() + mesh.face_areas().sum()).backward()
    assert torch.isfinite(vertices.grad).all()


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_normals_do_not_depend_on_scale_in_float32(scale):
    mesh = bumpy(dtype=torch.float32)
    scaled = TriangleMesh(mesh.vertices * scale, mesh.faces)
    torch.testing.assert_close(scaled.vertex_normals(), mesh.vertex_normals(), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(scaled.face_normals(), mesh.face_normals(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("quantity", ["face_areas", "face_normals", "vertex_normals"])
def test_gradients(quantity):
    sphere = unit_sphere(0, dtype=torch.float64)
    vertices = (sphere.vertices * torch.tensor([1.0, 1.3, 0.7], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: getattr(TriangleMesh(v, sphere.faces), quantity)(), (vertices,))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_normals_turn_with_the_mesh(seed):
    rotation = torch.linalg.qr(randn(3, 3, seed=seed)).Q
    rotation = rotation * rotation.det()
    mesh = bumpy(seed)
    turned = TriangleMesh(mesh.vertices @ rotation.mT + 3.0, mesh.faces)
    torch.testing.assert_close(turned.vertex_normals(), mesh.vertex_normals() @ rotation.mT)
    torch.testing.assert_close(turned.face_areas(), mesh.face_areas())


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
def test_sphere_is_closed_round_and_faces_outward(subdivisions):
    mesh = unit_sphere(subdivisions, dtype=D)
    assert mesh.num_vertices == 10 * 4**subdivisions + 2
    assert is_closed(mesh)
    assert 0 < 4 * math.pi / 3 - volume(mesh) < 2.0 / 3.5**subdivisions
    torch.testing.assert_close(mesh.vertices.norm(dim=-1), torch.ones(mesh.num_vertices, dtype=D))
    torch.testing.assert_close(mesh.vertex_normals(), mesh.vertices, atol=0.02, rtol=0)


def test_samples_lie_on_their_face_and_follow_the_area():
    triangles = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 0], [1, 0, 0], [0, 2, 0]], dtype=D)
    mesh = TriangleMesh(triangles, torch.tensor([[0, 1, 2], [3, 4, 5], [0, 0, 0]]))
    points, face, weights = sample_surface(mesh, 20_000, seeded(1))
    assert points.shape == (20_000, 3)
    assert abs(float((face == 0).double().mean()) - 0.75) < 4 * math.sqrt(0.75 * 0.25 / 20_000)
    assert int(face.max()) == 1
    torch.testing.assert_close(weights.sum(dim=-1), torch.ones(20_000, dtype=D))
    # Uniform on a triangle: the mean is the centroid and E[x^2] = side^2 / 6.
    first = points[face == 0]
    torch.testing.assert_close(first.mean(dim=0), torch.tensor([1.0, 2 / 3, 0], dtype=D), atol=0.03, rtol=0)
    assert abs(float(first[:, 0].square().mean()) - 9 / 6) < 0.05


def test_sampling_is_reproducible_and_leaves_the_global_generator_alone():
    mesh, state, generator = bumpy(dtype=torch.float32), torch.get_rng_state(), seeded(3)
    first = sample_surface(mesh, 50)[0]
    assert torch.equal(first, sample_surface(mesh, 50)[0])
    assert torch.equal(torch.get_rng_state(), state)
    assert not torch.equal(sample_surface(mesh, 50, generator)[0], sample_surface(mesh, 50, generator)[0])
    assert sample_surface(mesh, 0)[0].shape == (0, 3)
    assert first.dtype == torch.float32


def test_interpolation_reproduces_linear_fields():
    mesh, slope = bumpy(), randn(3, 2, 4)
    points, face, weights = sample_surface(mesh, 30)
    field, expected = (torch.einsum("vi,ijk->vjk", at, slope) for at in (mesh.vertices, points))
    torch.testing.assert_close(interpolate(field, mesh.faces, face, weights), expected)
    torch.testing.assert_close(interpolate(mesh.vertices[:, 0], mesh.faces, face, weights), points[:, 0])


def test_even_samples_follow_the_areas_and_leave_smaller_gaps_than_random_ones():
    mesh = unit_sphere(2, dtype=D)
    even, face = even_samples(mesh, 4000)
    shares = torch.bincount(face, minlength=mesh.num_faces) / 4000
    assert float((shares - mesh.face_areas() / mesh.face_areas().sum()).abs().max()) < 1.01 / 4000
    on_plane = (mesh.face_normals()[face] * (even - mesh.vertices[mesh.faces[face, 0]])).sum(-1)
    torch.testing.assert_close(on_plane, torch.zeros_like(on_plane))
    samples = (even, sample_surface(mesh, 4000)[0])
    gaps = [
        float(torch.cdist(directions(500, dtype=torch.float32).double(), points).amin(1).max()) for points in samples
    ]
    assert gaps[0] < 0.8 * gaps[1]
