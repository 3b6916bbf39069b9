"""Scans of all sides: their normals point outward, and what of a body lies outside of them costs."""

import copy

import pytest
import torch
from torch.nn.functional import pad

import torchreg as tr
from tests.alignment.made import person_pose
from torchreg.alignment.shape.outside_term import OutsideTerm
from torchreg.alignment.shape.shape_fit import surface_skins
from torchreg.geometry.facing_normals import facing_normals
from torchreg.geometry.mesh import sample_surface
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.shaped import ShapedTree


@pytest.fixture(scope="module")
def mesh(person):
    generator = torch.Generator().manual_seed(2)
    return tr.TriangleMesh(person.vertices(person_pose(person, generator), torch.zeros(3)), person.surface.faces)


def cosines(mesh, points, normals):
    """Return the cosines of normals to those of the mesh, where points are on it."""
    index = nearest_neighbor(points, mesh.vertices.double())[0]
    return (normals * mesh.vertex_normals().double()[index]).sum(-1)


def test_normals_of_all_sides_point_outward_however_it_is_turned(mesh):
    points = sample_surface(mesh, 2000, generator=torch.Generator().manual_seed(0))[0].double()
    turn = so3_exp(torch.tensor([0.4, -1.0, 2.0], dtype=torch.float64))
    # A stray point far off neither takes memory nor spoils the others.
    for cloud, back in ((points, torch.eye(3).double()), (pad(points @ turn.mT, (0, 0, 0, 1), value=1e4), turn)):
        cosine = cosines(mesh, points, (facing_normals(cloud) @ back)[: len(points)])
        assert float((cosine > 0).double().mean()) > 0.9
        assert float((cosine < 0).double().mean()) < 0.04


def term_of(person, mesh, *, is_open=False):
    """Return a term of a scan of all sides, or of the one that looks along -y, and a state whose surface it is."""
    generator = torch.Generator().manual_seed(2)
    state = pad(person_pose(person, generator), (0, 3))[None]
    skin = surface_skins(ShapedTree(person, person.coefficient_space()), person.surface, 200, generator)[0]
    points = sample_surface(mesh, 2000, generator=generator)[0]
    normals = mesh.vertex_normals()[nearest_neighbor(points, mesh.vertices)[0]]
    kept = normals[:, 1] < 0 if is_open else torch.ones_like(points[:, 0], dtype=torch.bool)
    return OutsideTerm.of_scans(skin, points[None], kept[None], (normals * kept.unsqueeze(-1))[None], 1.0), state


def test_what_lies_outside_costs_as_many_data_as_it_stands_for(person, mesh):
    term, state = term_of(person, mesh)
    assert float(term.score(state, 0.02)) < 0.02 * 2000
    away = state.clone()
    away[:, 0] += 5
    # All that faces away from the scan is beyond a tangent plane.
    assert 0.3 * 2000 < float(term.score(away, 0.02)) <= 2001
    torch.testing.assert_close(term.score(torch.stack([state, away], 1), 0.02)[0, 1], term.score(away, 0.02)[0])
    halved = term.thinned(torch.tensor([2.0])).rows(torch.tensor([0, 0]))
    torch.testing.assert_close(halved.score(away.repeat(2, 1), 0.02), term.score(away, 0.02).repeat(2) / 2)
    smaller = state.clone()
    smaller[:, -3] -= 0.5  # its stature
    larger = 2 * state - smaller
    assert float(term.score(smaller, 0.02)) < float(term.score(larger, 0.02))
    assert float(term_of(person, mesh, is_open=True)[0].score(away, 0.02)) == 0


def test_the_term_is_the_gradient_of_its_cost(person, mesh):
    exact = copy.deepcopy(person).double()
    term, state = term_of(exact, tr.TriangleMesh(mesh.vertices.double(), mesh.faces))
    tree, state = term.skin.shape, state.double() + 0.05
    sigma, noise = state.new_tensor([0.1]), state.new_tensor([0.05])
    found = term.linearized(state, sigma, noise)
    assert float(found.cost) > 0
    torch.testing.assert_close(found.cost, term.cost(state, sigma, noise))
    # So small that no other datum becomes the nearest one.
    steps = 1e-7 * torch.eye(state.shape[1], dtype=state.dtype)
    ahead, back = (
        torch.stack([term.cost(tree.retract(state, sign * step[None]), sigma, noise)[0] for step in steps])
        for sign in (1, -1)
    )
    slope = (ahead - back) / 2e-7
    torch.testing.assert_close(found.gradient[0], slope, rtol=1e-3, atol=1e-3 * float(slope.abs().max()))
