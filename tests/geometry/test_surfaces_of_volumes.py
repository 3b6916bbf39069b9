"""Surfaces of fields and volumes: closed, oriented, in the right position, by tetrahedra, cubes and voxels."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import D, box_mesh, is_closed, rand, randn, volume
from torchreg.geometry import isosurface as isosurface_module
from torchreg.geometry.distance_transform import nearest_inside, signed_distance
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.marching_cubes import marching_cubes
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.voxels import VoxelGrid, voxelize

SPHERE = unit_sphere(3, dtype=D)
OPEN_SPHERE = TriangleMesh(SPHERE.vertices, SPHERE.faces[SPHERE.vertices[SPHERE.faces].mean(1)[:, 0] < 0.88])


def sphere(points):
    return points.norm(dim=-1) - 1


def box(points):
    return points.abs().amax(-1) - 0.5


def cube(size, dtype=D):
    return torch.full((3,), -size, dtype=dtype), torch.full((3,), size, dtype=dtype)


def by_cubes(field, lower, upper, spacing):
    """The surface of a field by marching cubes."""
    axes = [
        torch.arange(float(a), float(b) + spacing, spacing, dtype=lower.dtype)
        for a, b in zip(lower, upper, strict=True)
    ]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    return marching_cubes(field(points), lower, spacing)


def euler_number(mesh):
    return mesh.num_vertices - mesh.num_faces // 2


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("method", [isosurface, by_cubes])
def test_a_sphere_is_closed_outward_and_right_to_second_order(method, dtype):
    errors = []
    for spacing in (0.2, 0.1):
        mesh = method(sphere, *cube(1.23, dtype), spacing)
        assert mesh.vertices.dtype == dtype
        assert is_closed(mesh)
        assert euler_number(mesh) == 2
        errors.append((4 / 3 * math.pi - volume(mesh), 4 * math.pi - float(mesh.face_areas().sum())))
        # The field is linear along edges to second order.
        assert sphere(mesh.vertices).abs().max() < 0.5 * spacing**2
    (volumes, areas) = zip(*errors, strict=True)
    assert volumes[0] / volumes[1] == pytest.approx(4, rel=0.15)
    assert areas[0] / areas[1] == pytest.approx(4, rel=0.15)
    assert 0 < volumes[1] < 0.026
    assert 0 < areas[1] < 0.04


@pytest.mark.parametrize(("field", "size"), [(sphere, 2.0), (box, 1.0)])
def test_grid_corners_on_the_surface_are_single_vertices(field, size):
    mesh = isosurface(field, *cube(size), 0.25)
    assert is_closed(mesh)
    assert euler_number(mesh) == 2
    assert mesh.face_areas().min() > 1e-6
    assert len(torch.unique(mesh.vertices, dim=0)) == mesh.num_vertices
    if field is box:  # outside where it touches the corners, so its straight edges alone are cut
        assert volume(mesh) == pytest.approx(1, rel=0.2)
        torch.testing.assert_close(torch.stack(cube(0.5)), torch.stack((mesh.vertices.amin(0), mesh.vertices.amax(0))))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_random_blobs_are_closed_oriented_and_have_no_stray_vertices(seed):
    centers = rand(4, 3, seed=seed) - 0.5

    # Rounded values hit zero at corners often.
    def field(points):
        return ((torch.cdist(points, centers).amin(-1) - 0.35) * 8).round() / 8

    mesh = isosurface(field, *cube(1.0), 0.1)
    assert is_closed(mesh)
    assert torch.equal(mesh.faces.unique(), torch.arange(mesh.num_vertices))
    assert volume(mesh) > 0


def test_the_grid_covers_a_box_that_the_spacing_does_not_divide_and_meets_a_plane_exactly(monkeypatch):
    monkeypatch.setattr(isosurface_module, "BUDGET", replace(isosurface_module.BUDGET, field_points=7))
    low, high = torch.tensor([0.0, 0, 0], dtype=D), torch.tensor([1.0, 0.5, 0.25], dtype=D)
    normal, asked = torch.tensor([1.0, 0.2, -0.1], dtype=D), []

    def field(points):
        asked.append(points)
        return points @ normal - 0.9

    mesh = isosurface(field, low, high, 0.3)
    points = torch.cat(asked)
    assert max(len(part) for part in asked) == 7
    assert len(points) == 5 * 3 * 2
    assert bool((points.amax(0) >= high - 1e-12).all())
    assert bool((points.amax(0) < high + 0.3).all())
    assert (mesh.vertices @ normal - 0.9).abs().max() < 1e-12
    torch.testing.assert_close(mesh.face_normals()[0], normal / normal.norm())
    assert not is_closed(mesh)


@pytest.mark.parametrize("seed", range(8))
def test_noise_of_every_case_gives_a_closed_manifold(seed):
    mesh = marching_cubes(
        torch.nn.functional.pad(randn(9, 10, 11, seed=seed), (1,) * 6, value=1.0), torch.zeros(3), 1.0
    )
    assert is_closed(mesh)
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    assert len(edges.unique(dim=0)) == len(edges)
    assert float(mesh.face_areas().min()) > 0


def test_diagonal_neighbors_stay_apart():
    values = torch.ones(4, 5, 5)
    values[1, 1, 1] = values[1, 2, 2] = -1
    assert euler_number(marching_cubes(values, torch.zeros(3), 1.0)) == 4  # two spheres


@pytest.mark.parametrize(
    "mesh",
    [
        TriangleMesh(SPHERE.vertices, SPHERE.faces.flip(1)),
        OPEN_SPHERE,
        TriangleMesh(SPHERE.vertices.float(), SPHERE.faces),
        concatenate([SPHERE, TriangleMesh(0.6 * SPHERE.vertices, SPHERE.faces)]),
    ],
    ids=["inside out", "open", "float32", "overlapping"],
)
def test_a_sphere_is_filled(mesh):
    grid = voxelize(mesh, 40)
    assert int(grid.filled.sum()) * grid.spacing**3 == pytest.approx(4 / 3 * math.pi, rel=0.02)
    assert not bool(grid.filled[0].any() | grid.filled[-1].any())


def test_a_box_whose_faces_lie_on_the_grid_is_filled_exactly():
    grid = voxelize(box_mesh([1.0, 0.5, 0.25]), 16)
    assert tuple(grid.filled.shape) == (18, 10, 6)
    assert int(grid.filled.sum()) == 16 * 8 * 4


def test_every_point_of_the_inside_is_contained():
    turn, mesh = so3_exp(torch.tensor([0.3, -0.5, 0.9], dtype=D)), box_mesh([1.0, 0.6, 0.4])
    grid = voxelize(TriangleMesh(mesh.vertices @ turn.mT, mesh.faces), 50)
    inner = 0.1 + rand(500, 3) * 0.2
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
    grid = voxelize(OPEN_SPHERE, 32)
    mesh = grid.mesh(smoothing)
    assert is_closed(mesh)
    assert volume(mesh) == pytest.approx(4 / 3 * math.pi, rel=0.05)
    again = voxelize(mesh, 32)
    assert int((grid.filled.sum() - again.contains(grid.centers()).sum()).abs()) <= 0.01 * int(grid.filled.sum())


def test_a_thread_of_single_voxels_survives_smoothing():
    filled = torch.zeros(20, 3, 3, dtype=torch.bool)
    filled[1:-1, 1, 1] = True
    mesh = VoxelGrid(filled, torch.zeros(3), 1.0).mesh(2)
    assert euler_number(mesh) == 2
    assert float(mesh.vertices[:, 0].max() - mesh.vertices[:, 0].min()) > 17


@pytest.mark.parametrize("shape", [(9,), (7, 8), (4, 5, 6)])
@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_distances_are_those_to_the_nearest_cell_of_the_other_kind(shape, dtype):
    mask = rand(*shape, seed=len(shape)) < 0.3
    cells, flat = torch.ones(shape).nonzero().to(D), mask.flatten()
    apart = torch.cdist(cells, cells)
    expected = apart.masked_fill(flat[:, None] == flat, torch.inf).amin(1) - 0.5
    found = signed_distance(mask, dtype)
    assert found.dtype == dtype
    torch.testing.assert_close(found.flatten(), torch.where(flat, -expected, expected).to(dtype))
    number = nearest_inside(mask)
    assert number.shape == mask.shape
    assert torch.equal(number[mask], flat.nonzero()[:, 0])
    nearest = apart.gather(1, number.flatten()[:, None])[:, 0]
    torch.testing.assert_close(nearest, apart[:, flat].amin(1))


def test_without_a_border_it_is_infinitely_far():
    assert signed_distance(torch.ones(2, 3, dtype=torch.bool)).tolist() == [[-torch.inf] * 3] * 2
    assert signed_distance(torch.zeros(2, 1, dtype=torch.bool)).tolist() == [[torch.inf]] * 2
