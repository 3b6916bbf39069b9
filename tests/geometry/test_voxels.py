"""Voxels against solids of known volume, open, inverted, twisted and overlapping surfaces, and back to meshes."""

import math

import pytest
import torch

from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.voxels import VoxelGrid, voxelize

SPHERE = unit_sphere(3, dtype=torch.float64)


def volume(mesh):
    return float(torch.linalg.det(mesh.vertices.double()[mesh.faces]).sum() / 6)


def filled_volume(grid):
    return int(grid.filled.sum()) * grid.spacing**3


def open_sphere(share=0.06):
    """The sphere without a cap."""
    keep = SPHERE.vertices[SPHERE.faces].mean(1)[:, 0] < 1 - 2 * share
    return TriangleMesh(SPHERE.vertices, SPHERE.faces[keep])


def box(sides):
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


def test_faces_that_are_not_oriented_alike_are_filled_too():
    faces = SPHERE.faces.clone()
    faces[::3] = faces[::3].flip(1)
    assert torch.equal(voxelize(TriangleMesh(SPHERE.vertices, faces), 30).filled, voxelize(SPHERE, 30).filled)


def test_a_box_whose_faces_lie_on_the_grid_is_filled_exactly():
    grid = voxelize(box([1.0, 0.5, 0.25]), 16)
    assert tuple(grid.filled.shape) == (18, 10, 6)
    assert int(grid.filled.sum()) == 16 * 8 * 4


def test_every_point_of_the_inside_is_contained():
    turn = so3_exp(torch.tensor([0.3, -0.5, 0.9], dtype=torch.float64))
    mesh = box([1.0, 0.6, 0.4])
    grid = voxelize(TriangleMesh(mesh.vertices @ turn.mT, mesh.faces), 50)
    inner = 0.1 + torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.2
    assert bool(grid.contains(inner @ turn.mT).all())
    assert not bool(grid.contains((inner + torch.tensor([2.0, 0.0, 0.0])) @ turn.mT).any())


def test_touching_keeps_what_is_thinner_than_a_voxel():
    thin = box([1.0, 1.0, 1e-3])
    thin = TriangleMesh(thin.vertices @ so3_exp(torch.tensor([0.2, 0.3, 0.0]).double()).mT, thin.faces)
    grid = voxelize(thin, 20, touching=True)
    assert int(voxelize(thin, 20).filled.sum()) < 50
    assert bool(grid.contains(thin.vertices).all())
    assert int(grid.filled.sum()) > 20 * 20


def test_scale_and_shift_change_coordinates_only():
    there = voxelize(SPHERE, 24)
    moved = voxelize(TriangleMesh(1000 * SPHERE.vertices + 5000, SPHERE.faces), 24)
    assert torch.equal(there.filled, moved.filled)
    torch.testing.assert_close(moved.origin, 1000 * there.origin + 5000)


@pytest.mark.parametrize("smoothing", [0, 1, 3])
def test_meshed_anew_the_surface_is_closed_and_holds_the_same_voxels(smoothing):
    grid = voxelize(open_sphere(), 32)
    mesh = grid.mesh(smoothing)
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    assert torch.equal(edges.unique(dim=0), edges.flip(1).unique(dim=0))
    assert volume(mesh) == pytest.approx(4 / 3 * math.pi, rel=0.05)
    again = voxelize(mesh, 32)
    assert int((grid.filled.sum() - again.contains(grid.centers()).sum()).abs()) <= 0.01 * int(grid.filled.sum())


def test_smoothing_brings_the_surface_nearer_to_the_true_one():
    grid = voxelize(SPHERE, 32)
    rough, smooth = ((grid.mesh(k).vertices.norm(dim=-1) - 1).abs().mean() for k in (0, 1))
    assert float(smooth) < 0.7 * float(rough)


def test_a_thread_of_single_voxels_survives_smoothing():
    filled = torch.zeros(20, 3, 3, dtype=torch.bool)
    filled[1:-1, 1, 1] = True
    mesh = VoxelGrid(filled, torch.zeros(3), 1.0).mesh(2)
    assert mesh.num_vertices - mesh.num_faces // 2 == 2
    assert float(mesh.vertices[:, 0].max() - mesh.vertices[:, 0].min()) > 17


def test_voxels_at_the_border_are_closed():
    mesh = VoxelGrid(torch.ones(2, 2, 2, dtype=torch.bool), torch.zeros(3), 1.0).mesh(0)
    assert mesh.num_vertices - mesh.num_faces // 2 == 2
    assert float(mesh.vertices.min()) < 0
