"""Isosurfaces against spheres, tori and boxes, and trimesh's view of their topology."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.errors import InputError
from torchreg.geometry import isosurface as isosurface_module
from torchreg.geometry.budget import Budget
from torchreg.geometry.isosurface import isosurface

D = torch.float64


def sphere(points):
    return points.norm(dim=-1) - 1


def torus(points):
    return ((points[:, :2].norm(dim=-1) - 1).square() + points[:, 2].square()).sqrt() - 0.4


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


def test_a_torus_has_one_hole():
    seen = view(isosurface(torus, *cube(1.6), 0.1))
    assert seen.is_watertight
    assert seen.is_winding_consistent
    assert seen.euler_number == 0
    assert seen.volume == pytest.approx(2 * math.pi**2 * 0.16, rel=0.02)


def test_two_bodies_and_a_hollow():
    centers = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]], dtype=D)
    two = view(isosurface(lambda p: torch.cdist(p, centers).amin(-1) - 0.6, *cube(1.8), 0.13))
    assert two.is_watertight
    assert two.body_count == 2
    shell = view(isosurface(lambda p: (p.norm(dim=-1) - 1).abs() - 0.3, *cube(1.5), 0.11))
    assert shell.is_winding_consistent
    assert shell.volume == pytest.approx(4 / 3 * math.pi * (1.3**3 - 0.7**3), rel=0.02)


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


def test_normals_point_to_positive_values():
    mesh = isosurface(lambda p: -sphere(p), *cube(1.3), 0.1)
    assert view(mesh).volume == pytest.approx(-4 / 3 * math.pi, rel=0.01)


def test_a_linear_field_is_met_exactly_and_cut_at_the_box():
    normal = torch.tensor([1.0, 2.0, -1.0], dtype=D)
    mesh = isosurface(lambda p: p @ normal - 0.3, *cube(1.0), 0.17)
    assert (mesh.vertices @ normal - 0.3).abs().max() < 1e-12
    torch.testing.assert_close(mesh.face_normals()[0], normal / normal.norm())
    assert not view(mesh).is_watertight


def test_the_grid_covers_a_box_that_the_spacing_does_not_divide(monkeypatch):
    monkeypatch.setattr(isosurface_module, "BUDGET", Budget(field_points=7))
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


def test_no_change_of_sign_gives_no_faces():
    mesh = isosurface(lambda p: p.norm(dim=-1) + 1, *cube(1.0), 0.5)
    assert mesh.num_faces == 0
    assert mesh.num_vertices == 0


def test_a_field_with_parameters_leaves_no_graph():
    radius = torch.tensor(1.0, dtype=D, requires_grad=True)
    assert not isosurface(lambda p: p.norm(dim=-1) - radius, *cube(1.2), 0.4).vertices.requires_grad


def test_a_grid_that_would_be_too_large_is_refused():
    with pytest.raises(InputError, match="choose a larger one"):
        isosurface(sphere, *cube(1.0), 1e-3)
