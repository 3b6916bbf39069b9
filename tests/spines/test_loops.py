import math

import pytest
import torch

from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.surface_graph import unique_edges
from torchreg.spines.loops import open_loops


def tori(centers, thin=0.12, thick=0.3):
    """Return rings of radius 1 in the plane z = 0, thinnest at their largest x, that may overlap."""

    def field(points):
        parts = []
        for x in centers:
            flat = points[:, :2] - torch.tensor([x, 0.0], dtype=points.dtype)
            radius = flat.norm(dim=1)
            share = 0.5 + 0.5 * flat[:, 0] / radius.clamp(min=1e-9)
            around = torch.stack((radius - 1, points[:, 2]), dim=1).norm(dim=1)
            parts.append(around - (thick + (thin - thick) * share**4))
        return torch.stack(parts).amin(0)

    low, high = min(centers) - 1.5, max(centers) + 1.5
    lower, upper = torch.tensor([low, -1.5, -0.5]).double(), torch.tensor([high, 1.5, 0.5]).double()
    return isosurface(field, lower, upper, 0.1)


def euler_number(mesh):
    return mesh.num_vertices - len(unique_edges(mesh.faces)[0]) + mesh.num_faces


def test_a_ring_is_cut_where_it_is_thinnest():
    mesh = tori([0.0])
    assert euler_number(mesh) == 0
    opened = open_loops(mesh, 0.1)
    assert euler_number(opened.mesh) == 2
    assert opened.stumps.shape == (1, 2, 3)
    middle = opened.stumps.mean(1)[0]
    assert math.atan2(float(middle[1]), float(middle[0])) == pytest.approx(0, abs=0.35)
    assert middle.norm() == pytest.approx(1.0, abs=0.1)
    assert float(opened.radii) == pytest.approx(math.pi * 0.12, rel=0.3)


def test_every_long_loop_is_cut():
    mesh = tori([0.0, 2.0])
    assert euler_number(mesh) == -2
    opened = open_loops(mesh, 0.1)
    assert euler_number(opened.mesh) == 2
    assert len(opened.stumps) == 2


def test_short_loops_and_surfaces_without_any_stay_as_they_are():
    mesh = tori([0.0])
    assert open_loops(mesh, 3.0).mesh is mesh
    ball = unit_sphere(2, dtype=torch.float64)
    opened = open_loops(TriangleMesh(ball.vertices, ball.faces), 0.1)
    assert opened.mesh.faces is ball.faces
    assert opened.stumps.shape == (0, 2, 3)
