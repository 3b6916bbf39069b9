import math

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.spines.level_sets import Surface, level_sets


def test_rings_of_a_sphere_are_circles():
    mesh = unit_sphere(5, dtype=torch.float64)
    sets = level_sets(mesh, mesh.vertices[:, 2], 0.1)
    height = 0.1 * sets.levels.double()
    inner = height.abs() < 0.95
    assert sets.levels[inner].sort().values.tolist() == list(range(-9, 10))
    radius = (1 - height**2).sqrt()
    assert (sets.centers[inner] - torch.stack((0 * height, 0 * height, height), 1)[inner]).abs().max() < 1e-3
    assert torch.allclose(sets.lengths[inner], (2 * math.pi * radius)[inner], rtol=3e-3)
    expected = torch.diag_embed(torch.stack((radius**2 / 2, radius**2 / 2, 0 * radius), 1))
    assert torch.allclose(sets.covariances[inner], expected[inner], atol=3e-3)


def test_rings_do_not_depend_on_how_dense_the_vertices_are():
    # A tube with many vertices on one side: the mean of the vertices is off by a third of the radius.
    turn = torch.cat((torch.linspace(0, math.pi, 60)[:-1], torch.linspace(math.pi, 2 * math.pi, 20)[:-1])).double()
    count, rows = len(turn), 12
    ring = torch.stack((turn.cos(), turn.sin()), dim=1)
    places = torch.cat((ring.repeat(rows, 1), torch.arange(rows).double().repeat_interleave(count)[:, None]), dim=1)
    here, row = torch.arange(count).repeat(rows - 1), torch.arange(rows - 1).repeat_interleave(count) * count
    after = (here + 1) % count
    faces = torch.stack((row + here, row + after, row + count + here), dim=1)
    faces = torch.cat((faces, torch.stack((row + after, row + count + after, row + count + here), dim=1)))
    sets = level_sets(TriangleMesh(places, faces), places[:, 2], 0.7)
    assert len(sets) == 15
    assert sets.centers[:, :2].abs().max() < 0.005
    assert ring.mean(0).norm() > 0.2


def test_rings_join_bands_in_a_tree_on_a_sphere_and_in_a_loop_on_a_torus():
    for mesh, loops in ((unit_sphere(3, dtype=torch.float64), 0), (torus(), 1)):
        sets = level_sets(mesh, mesh.vertices[:, 0], 0.21)
        assert len(sets) - sets.num_bands + 1 == loops
        steps = torch.floor(mesh.vertices[:, 0] / 0.21).long()
        for band, level in ((sets.lower, sets.levels - 1), (sets.upper, sets.levels)):
            for one, step in zip(band.tolist(), level.tolist(), strict=True):
                assert set(steps[sets.vertex_bands == one].tolist()) <= {step}


def torus(rows=48, columns=24, radius=0.35):
    u = (torch.arange(rows) * 2 * math.pi / rows).double()[:, None]
    v = (torch.arange(columns) * 2 * math.pi / columns).double()[None]
    out = 1 + radius * v.cos()
    places = torch.stack((out * u.cos(), out * u.sin(), radius * v.sin().expand(rows, -1)), dim=-1).reshape(-1, 3)
    a = torch.arange(rows)[:, None] * columns + torch.arange(columns)
    b, c = a.roll(-1, 0), a.roll(-1, 1)
    d = b.roll(-1, 1)
    faces = torch.cat((torch.stack((a, b, c), -1).reshape(-1, 3), torch.stack((b, d, c), -1).reshape(-1, 3)))
    return TriangleMesh(places, faces)


def test_triangles_that_span_many_levels_have_a_ring_on_each():
    mesh = unit_sphere(0, dtype=torch.float64)
    sets = level_sets(mesh, mesh.vertices[:, 2], 0.01)
    # The uppermost ring is a point: the pole itself.
    assert len(sets) == 200
    assert sets.num_bands == 201
    assert torch.equal(sets.levels.sort().values, torch.arange(-99, 101))
    assert sets.centers[:, :2].abs().max() < 1e-6
    assert torch.allclose(sets.centers[:, 2], 0.01 * sets.levels.double())


def test_faces_of_a_ring_are_those_that_it_passes_through():
    mesh = unit_sphere(3, dtype=torch.float64)
    sets = level_sets(Surface(mesh), mesh.vertices[:, 2], 0.3)
    ring = int((sets.levels == 1).nonzero())
    corners = mesh.vertices[mesh.faces[sets.faces[sets.face_rings == ring]], 2]
    assert bool(((corners.amin(1) < 0.3) & (corners.amax(1) >= 0.3)).all())


def test_pieces_and_fins_are_fine():
    ball = unit_sphere(2, dtype=torch.float64)
    mesh = concatenate([ball, TriangleMesh(ball.vertices + 3, ball.faces)])
    faces = torch.cat((mesh.faces, mesh.faces[:1, [0, 1, 0]] * 0 + torch.tensor([[0, 1, 200]])))
    sets = level_sets(TriangleMesh(mesh.vertices, faces), mesh.vertices[:, 2], 0.5)
    assert len(sets) > 6


def test_wrong_values_are_refused():
    mesh = unit_sphere(0, dtype=torch.float64)
    with pytest.raises(InputError, match="values must have shape"):
        level_sets(mesh, torch.zeros(3), 0.1)
    with pytest.raises(InputError, match="values must be finite"):
        level_sets(mesh, torch.full((12,), torch.inf), 0.1)
    with pytest.raises(InputError, match="spacing must be positive"):
        level_sets(mesh, torch.zeros(12), 0.0)
    assert len(level_sets(mesh, torch.zeros(12), 1.0)) == 0
