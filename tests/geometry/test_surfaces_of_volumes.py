"""Surfaces of fields and volumes: closed, oriented, in the right position, by tetrahedra, cubes and voxels."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.geometry import isosurface as isosurface_module
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.marching_cubes import marching_cubes
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.voxels import VoxelGrid, voxelize

D = torch.float64


def sphere(points):
    return points.norm(dim=-1) - 1


def box(points):
    return points.abs().amax(-1) - 0.5


def cube(size, dtype=D):
    return torch.full((3,), -size, dtype=dtype), torch.full((3,), size, dtype=dtype)


def view(mesh):
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_a_sphere_is_watertight_outward_and_right_to_second_order(dtype):
    errors = []
    for spacing in (0.2, 0.1):
        mesh = isosurface(sphere, *cube(1.23, dtype), spacing)
        assert mesh.vertices.dtype == dtype
        seen = view(mesh)
        assert seen.is_watertight
        assert seen.is_winding_consistent
        assert seen.euler_number == 2
        errors.append((4 / 3 * math.pi - seen.volume, 4 * math.pi - seen.area))
        # The field is linear along edges to second order.
        assert sphere(mesh.vertices).abs().max() < 0.5 * spacing**2
    volumes, areas = zip(*errors, strict=True)
    assert volumes[0] / volumes[1] == pytest.approx(4, rel=0.15)
    assert areas[0] / areas[1] == pytest.approx(4, rel=0.15)
    assert 0 < volumes[1] < 0.024
    assert 0 < areas[1] < 0.04


def test_grid_corners_on_the_surface_are_single_vertices():
    for field, size, spacing in ((sphere, 2.0, 0.25), (box, 1.0, 0.25)):
        mesh = isosurface(field, *cube(size), spacing)
        seen = view(mesh)
        assert seen.is_watertight
        assert seen.is_winding_consistent
        assert seen.euler_number == 2
        assert seen.area_faces.min() > 1e-6
        assert len(torch.unique(mesh.vertices, dim=0)) == mesh.num_vertices
    # A box is outside where it touches the corners, so its straight edges alone are cut.
    assert seen.volume == pytest.approx(1, rel=0.2)
    np.testing.assert_allclose(seen.bounds, [[-0.5] * 3, [0.5] * 3])


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_random_blobs_are_closed_oriented_and_have_no_stray_vertices(seed):
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(4, 3, generator=generator, dtype=D) - 0.5

    # Rounded values hit zero at corners often.
    def field(points):
        return ((torch.cdist(points, centers).amin(-1) - 0.35) * 8).round() / 8

    mesh = isosurface(field, *cube(1.0), 0.1)
    seen = view(mesh)
    directed = np.concatenate([seen.faces[:, [0, 1]], seen.faces[:, [1, 2]], seen.faces[:, [2, 0]]])
    there = np.unique(directed, axis=0, return_counts=True)
    back = np.unique(directed[:, ::-1], axis=0, return_counts=True)
    np.testing.assert_array_equal(there[0], back[0])
    np.testing.assert_array_equal(there[1], back[1])
    assert set(seen.faces.ravel()) == set(range(mesh.num_vertices))
    assert seen.volume > 0


def test_a_linear_field_is_met_exactly_and_cut_at_the_box():
    normal = torch.tensor([1.0, 2.0, -1.0], dtype=D)
    mesh = isosurface(lambda p: p @ normal - 0.3, *cube(1.0), 0.17)
    assert (mesh.vertices @ normal - 0.3).abs().max() < 1e-12
    torch.testing.assert_close(mesh.face_normals()[0], normal / normal.norm())
    assert not view(mesh).is_watertight


def test_the_grid_covers_a_box_that_the_spacing_does_not_divide(monkeypatch):
    monkeypatch.setattr(isosurface_module, "BUDGET", replace(isosurface_module.BUDGET, field_points=7))
    low, high = torch.tensor([0.0, 0, 0], dtype=D), torch.tensor([1.0, 0.5, 0.25], dtype=D)
    asked = []

    def field(points):
        asked.append(points)
        return points[:, 0] - 0.9

    mesh = isosurface(field, low, high, 0.3)
    points = torch.cat(asked)
    assert max(len(part) for part in asked) == 7
    assert len(points) == 5 * 3 * 2
    assert bool((points.amax(0) >= high - 1e-12).all())
    assert bool((points.amax(0) < high + 0.3).all())
    assert (mesh.vertices[:, 0] - 0.9).abs().max() < 1e-12


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


def test_diagonal_neighbors_stay_apart():
    values = torch.ones(4, 5, 5)
    values[1, 1, 1] = values[1, 2, 2] = -1
    mesh = marching_cubes(values, torch.zeros(3), 1.0)
    assert mesh.num_vertices - mesh.num_faces // 2 == 4  # two spheres


SPHERE = unit_sphere(3, dtype=torch.float64)


def filled_volume(grid):
    return int(grid.filled.sum()) * grid.spacing**3


def open_sphere(share=0.06):
    """The sphere without a cap."""
    keep = SPHERE.vertices[SPHERE.faces].mean(1)[:, 0] < 1 - 2 * share
    return TriangleMesh(SPHERE.vertices, SPHERE.faces[keep])


def box_mesh(sides):
    signs = torch.tensor([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)], dtype=torch.float64)
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    faces = torch.tensor([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])
    return TriangleMesh(signs * torch.tensor(sides, dtype=torch.float64), faces)


@pytest.mark.parametrize(
    "mesh",
    [
        SPHERE,
        TriangleMesh(SPHERE.vertices, SPHERE.faces.flip(1)),
        open_sphere(),
        TriangleMesh(SPHERE.vertices.float(), SPHERE.faces),
        concatenate([SPHERE, TriangleMesh(0.6 * SPHERE.vertices, SPHERE.faces)]),
    ],
    ids=["plain", "inside out", "open", "float32", "overlapping"],
)
def test_a_sphere_is_filled(mesh):
    grid = voxelize(mesh, 40)
    assert filled_volume(grid) == pytest.approx(4 / 3 * math.pi, rel=0.02)
    assert not bool(grid.filled[0].any() | grid.filled[-1].any())


def test_a_box_whose_faces_lie_on_the_grid_is_filled_exactly():
    grid = voxelize(box_mesh([1.0, 0.5, 0.25]), 16)
    assert tuple(grid.filled.shape) == (18, 10, 6)
    assert int(grid.filled.sum()) == 16 * 8 * 4


def test_every_point_of_the_inside_is_contained():
    turn = so3_exp(torch.tensor([0.3, -0.5, 0.9], dtype=torch.float64))
    mesh = box_mesh([1.0, 0.6, 0.4])
    grid = voxelize(TriangleMesh(mesh.vertices @ turn.mT, mesh.faces), 50)
    inner = 0.1 + torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.2
    assert bool(grid.contains(inner @ turn.mT).all())
    assert not bool(grid.contains((inner + torch.tensor([2.0, 0.0, 0.0])) @ turn.mT).any())


def test_touching_keeps_what_is_thinner_than_a_voxel():
    thin = box_mesh([1.0, 1.0, 1e-3])
    thin = TriangleMesh(thin.vertices @ so3_exp(torch.tensor([0.2, 0.3, 0.0]).double()).mT, thin.faces)
    grid = voxelize(thin, 20, touching=True)
    assert int(voxelize(thin, 20).filled.sum()) < 50
    assert bool(grid.contains(thin.vertices).all())
    assert int(grid.filled.sum()) > 20 * 20


@pytest.mark.parametrize("smoothing", [0, 1, 3])
def test_meshed_anew_the_surface_is_closed_and_holds_the_same_voxels(smoothing):
    grid = voxelize(open_sphere(), 32)
    mesh = grid.mesh(smoothing)
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    assert torch.equal(edges.unique(dim=0), edges.flip(1).unique(dim=0))
    assert volume(mesh) == pytest.approx(4 / 3 * math.pi, rel=0.05)
    again = voxelize(mesh, 32)
    assert int((grid.filled.sum() - again.contains(grid.centers()).sum()).abs()) <= 0.01 * int(grid.filled.sum())


def test_a_thread_of_single_voxels_survives_smoothing():
    filled = torch.zeros(20, 3, 3, dtype=torch.bool)
    filled[1:-1, 1, 1] = True
    mesh = VoxelGrid(filled, torch.zeros(3), 1.0).mesh(2)
    assert mesh.num_vertices - mesh.num_faces // 2 == 2
    assert float(mesh.vertices[:, 0].max() - mesh.vertices[:, 0].min()) > 17
