import math

import pytest
import torch

from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere


def grid(rows, columns, wiggle=0.0):
    """Return a sheet of triangles over [0, 1]^2, its inner vertices moved at random."""
    y, x = torch.meshgrid(torch.linspace(0, 1, rows), torch.linspace(0, 1, columns), indexing="ij")
    flat = torch.stack((x, y, torch.zeros_like(x)), dim=-1).double()
    shift = wiggle * (torch.rand(rows - 2, columns - 2, 2, generator=torch.Generator().manual_seed(0)) - 0.5)
    flat[1:-1, 1:-1, :2] += shift / columns
    corner = (torch.arange(rows - 1)[:, None] * columns + torch.arange(columns - 1)).reshape(-1)
    lower = torch.stack((corner, corner + 1, corner + columns), dim=1)
    upper = torch.stack((corner + 1, corner + columns + 1, corner + columns), dim=1)
    return TriangleMesh(flat.reshape(-1, 3), torch.cat((lower, upper)))


def surface_distances(mesh, sources):
    return GeodesicGraph.from_mesh(mesh).distances(sources)


def error(found, exact, least):
    ratio = (found / exact)[exact > least]
    return float(ratio.mean()) - 1, float(ratio.min())


def test_distances_on_a_sphere_are_great_circles():
    mesh = unit_sphere(5, dtype=torch.float64)
    sources = [0, 100, 5000]
    exact = (mesh.vertices[sources] @ mesh.vertices.T).clamp(-1, 1).acos()
    mean, least = error(surface_distances(mesh, sources), exact, 0.1)
    assert 0 < mean < 0.02
    assert least > 0.99


def test_distances_on_an_uneven_sheet_and_on_a_cylinder_rolled_from_it():
    sheet = grid(61, 61, wiggle=0.9)
    exact = (sheet.vertices - sheet.vertices[1860]).norm(dim=1)
    flat = surface_distances(sheet, [1860])[0]
    mean, least = error(flat, exact, 0.1)
    assert 0 < mean < 0.025
    assert least > 1 - 1e-9
    # Half a turn, so that the way around the back is no shorter; a fine polygon is a little shorter than its circle.
    turn = math.pi * sheet.vertices[:, 0]
    rolled = torch.stack((turn.cos() / math.pi, turn.sin() / math.pi, sheet.vertices[:, 1]), dim=1)
    assert torch.allclose(surface_distances(TriangleMesh(rolled, sheet.faces), [1860])[0], flat, rtol=0.01)


def test_a_regular_grid_is_the_worst_case():
    sheet = grid(31, 31)
    exact = (sheet.vertices - sheet.vertices[480]).norm(dim=1)
    assert 0.02 < error(surface_distances(sheet, [480])[0], exact, 0.2)[0] < 0.04


def test_lines_across_two_edges_are_straight_also_around_a_fold():
    places = torch.tensor([[0.0, 0, 0], [1, -0.8, 0], [1, 0, 0], [1, 0.8, 0], [0.4, 1.0, 0]], dtype=torch.float64)
    fan = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    straight = float((places[1] - places[4]).norm())
    assert float(surface_distances(TriangleMesh(places, fan), [1])[0, 4]) == pytest.approx(straight)
    fold = places[3] / places[3].norm()
    along = (places[4] @ fold) * fold
    folded = places.clone()
    folded[4] = along + (places[4] - along).norm() * torch.tensor([0.0, 0, 1.0], dtype=torch.float64)
    assert float(surface_distances(TriangleMesh(folded, fan), [1])[0, 4]) == pytest.approx(straight)


def test_chords_that_leave_the_triangles_are_left_out():
    # A dart: the line between the far corners passes beside the shared edge.
    places = torch.tensor([[0.0, 0, 0], [0, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=torch.float64)
    dart = TriangleMesh(places, torch.tensor([[0, 1, 2], [1, 0, 3]]))
    assert float(surface_distances(dart, [2])[0, 3]) == pytest.approx(2 * math.sqrt(2))


def test_rigid_motion_scale_and_numbering_change_nothing_else():
    mesh = unit_sphere(2, dtype=torch.float64)
    turned = TriangleMesh(7 * mesh.vertices[:, [1, 2, 0]] + 5, mesh.faces.flip(1))
    assert torch.allclose(surface_distances(turned, [4]), 7 * surface_distances(mesh, [4]))
    order = torch.randperm(162, generator=torch.Generator().manual_seed(0))
    moved = TriangleMesh(mesh.vertices[order], order.argsort()[mesh.faces])
    assert torch.allclose(
        surface_distances(moved, [int(order.argsort()[4])])[0], surface_distances(mesh, [4])[0, order]
    )


def test_no_path_leads_from_one_component_to_another():
    ball = unit_sphere(2, dtype=torch.float64)
    far = TriangleMesh(0.5 * ball.vertices + torch.tensor([3.0, 0, 0]), ball.faces)
    mesh = concatenate([ball, far])
    kept = GeodesicGraph.from_mesh(mesh)
    assert torch.isfinite(kept.distances([0])[0]).sum() == 162
    assert kept.components().bincount().tolist() == [162, 162]
    assert torch.equal(kept.nearest([0])[1], torch.cat((torch.zeros(162), -torch.ones(162))).long())


def test_open_and_non_manifold_meshes_are_accepted():
    sheet = grid(5, 5)
    fin = TriangleMesh(
        torch.cat((sheet.vertices, torch.tensor([[0.5, 0.5, 1.0]], dtype=torch.float64))),
        torch.cat((sheet.faces, torch.tensor([[12, 13, 25], [12, 13, 25]]))),
    )
    assert float(surface_distances(fin, [25])[0, 12]) == pytest.approx(1.0)


def test_paths_through_points():
    mesh = unit_sphere(4, dtype=torch.float64)
    graph = GeodesicGraph.from_points(mesh.vertices, 24)
    exact = (mesh.vertices[:1] @ mesh.vertices.T).clamp(-1, 1).acos()
    assert abs(error(graph.distances([0]), exact, 0.3)[0]) < 0.03
