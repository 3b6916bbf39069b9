"""Tips, rings and handles of a surface: salient maxima of distance, its level sets, and loops cut at their thinnest."""

import math

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import sheet_faces
from tests.spines.bodies import circle, random, tube
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import concatenate, unit_sphere
from torchreg.spines.skeleton.level_sets import MeshEdges, level_sets
from torchreg.spines.skeleton.loops import open_loops
from torchreg.spines.skeleton.protrusions import average_geodesic_distance, find_protrusions


def brute_heights(graph, values):
    """Return the height of every maximum by flooding node by node."""
    starts, ends = graph.starts.tolist(), graph.ends.tolist()
    order = sorted(range(len(values)), key=lambda node: (-values[node], -node))
    rank = {node: number for number, node in enumerate(order)}
    owner, heights = {}, {}
    for node in order:
        tops = set()
        for neighbor in ends[starts[node] : starts[node + 1]]:
            while neighbor in owner and owner[neighbor] != neighbor:
                neighbor = owner[neighbor]
            tops |= {neighbor} & owner.keys()
        owner[node] = node
        for number, top in enumerate(sorted(tops, key=rank.get)):
            if number == 0:
                owner[node] = top
            else:
                heights[top] = values[top] - values[node]
                owner[top] = owner[node]
    heights[order[0]] = values[order[0]] - min(values)
    return {node: height for node, height in heights.items() if height > 0}


@pytest.mark.parametrize("seed", range(3))
def test_heights_are_those_of_a_flood(seed):
    graph = GeodesicGraph.from_mesh(unit_sphere(2, dtype=torch.float64))
    values = random(162, seed=seed)
    if seed == 2:
        values = (2 * values).round()
    found = find_protrusions(graph, values, 1e-9)
    expected = brute_heights(graph, values.tolist())
    assert found.heights.tolist() == pytest.approx(sorted(expected.values(), reverse=True))
    if seed < 2:
        assert dict(zip(found.tips.tolist(), found.heights.tolist(), strict=True)) == pytest.approx(expected)


def test_low_maxima_are_noise_and_the_highest_is_always_found():
    mesh = unit_sphere(3, dtype=torch.float64)
    graph = GeodesicGraph.from_mesh(mesh)
    noise = 0.1 * torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = find_protrusions(graph, mesh.vertices[:, 2].abs() + noise, 0.2)
    assert len(found.tips) == 2
    assert mesh.vertices[found.tips, 2].abs().min() > 0.85
    assert bool(((found.confidence > 0.9) & (found.confidence < 1)).all())
    assert len(find_protrusions(graph, torch.zeros(mesh.num_vertices).double(), 0.2).tips) == 1


def test_confidence_is_a_half_at_the_threshold():
    graph = GeodesicGraph.from_points(torch.arange(9.0)[:, None] * torch.tensor([1.0, 0, 0]), 2)
    values = torch.tensor([0.0, 1, 2, 3, 1.5, 3, 4, 5, 6], dtype=torch.float64)
    assert find_protrusions(graph, values, 2.0).tips.tolist() == [8]
    assert find_protrusions(graph, values, 0.5).heights.tolist() == [6.0, 1.5]
    found = find_protrusions(graph, values, 5.999)
    assert float(found.confidence[0]) == pytest.approx(0.5, abs=1e-3)


def test_average_distance_on_a_long_body_is_that_of_an_interval():
    # Averaged over [0, 1] the distance from x is x^2 - x + 1/2; vertices are three times as dense on the left.
    positions = torch.cat((torch.linspace(0, 0.5, 301)[:-1], torch.linspace(0.5, 1, 101))).double()
    points = torch.stack((positions, 0 * positions, 0 * positions), dim=1)
    graph = GeodesicGraph.from_points(points, 2)
    gaps = torch.cat((positions[1:] - positions[:-1], torch.zeros(1)))
    areas = 0.5 * (gaps + gaps.roll(1))
    average, largest = average_geodesic_distance(graph, areas, 40)
    assert torch.allclose(average, positions**2 - positions + 0.5, atol=5e-3)
    assert largest == pytest.approx(1.0)


def test_rings_of_a_sphere_are_circles():
    mesh = unit_sphere(5, dtype=torch.float64)
    sets = level_sets(MeshEdges(mesh), mesh.vertices[:, 2], 0.1)
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
    turn = torch.cat((torch.linspace(0, math.pi, 60)[:-1], torch.linspace(math.pi, 2 * math.pi, 20))).double()
    ring = torch.stack((turn.cos(), turn.sin()), dim=1)
    height = torch.arange(12).double().repeat_interleave(len(turn))[:, None]
    positions = torch.cat((ring.repeat(12, 1), height), dim=1)
    welded, faces = positions.mul(1e6).round().unique(dim=0, return_inverse=True)
    mesh = tr.TriangleMesh(welded / 1e6, faces[sheet_faces(12, len(turn))])
    sets = level_sets(MeshEdges(mesh), mesh.vertices[:, 2], 0.7)
    assert len(sets) == 15
    assert sets.centers[:, :2].abs().max() < 0.005
    assert ring.mean(0).norm() > 0.2


def test_rings_join_bands_in_a_tree_on_a_sphere_and_in_a_loop_on_a_torus():
    for mesh, loops in ((unit_sphere(3, dtype=torch.float64), 0), (tori([0.0]), 1)):
        x = mesh.vertices[:, 0]
        sets = level_sets(MeshEdges(mesh), x, 0.21)
        assert len(sets) - sets.num_bands + 1 == loops
        steps = torch.floor(x / 0.21).long()
        for band, level in ((sets.lower, sets.levels - 1), (sets.upper, sets.levels)):
            for number, step in zip(band.tolist(), level.tolist(), strict=True):
                assert set(steps[sets.vertex_bands == number].tolist()) <= {step}
        # The faces of a ring are those that it passes through.
        corners, level = x[mesh.faces[sets.faces]], 0.21 * sets.levels[sets.face_rings]
        assert bool(((corners.amin(1) < level) & (corners.amax(1) >= level)).all())
    # Triangles that span many levels have a ring on each; the uppermost is a point, the pole itself.
    coarse = unit_sphere(0, dtype=torch.float64)
    sets = level_sets(MeshEdges(coarse), coarse.vertices[:, 2], 0.01)
    assert (len(sets), sets.num_bands) == (200, 201)
    assert torch.equal(sets.levels.sort().values, torch.arange(-99, 101))
    middle = torch.stack((0 * sets.levels, 0 * sets.levels, sets.levels), 1) * 0.01
    torch.testing.assert_close(sets.centers, middle.double(), atol=1e-6, rtol=0)


def test_pieces_and_fins_are_fine_and_a_constant_function_has_no_rings():
    ball = unit_sphere(2, dtype=torch.float64)
    mesh = concatenate([ball, tr.TriangleMesh(ball.vertices + 3, ball.faces)])
    faces = torch.cat((mesh.faces, torch.tensor([[0, 1, 200]])))
    assert len(level_sets(MeshEdges(tr.TriangleMesh(mesh.vertices, faces)), mesh.vertices[:, 2], 0.5)) > 6
    assert len(level_sets(MeshEdges(mesh), 0 * mesh.vertices[:, 0], 1.0)) == 0


def tori(centers):
    """Rings of radius 1 in the plane z = 0, thinnest at their largest x, that may overlap."""
    ring = circle()[:-1]
    radii = 0.3 - 0.18 * (0.5 + 0.5 * ring[:, 0]) ** 4
    return tube(torch.cat([ring + torch.tensor([x, 0.0, 0.0]) for x in centers]), radii.repeat(len(centers)), 0.1)


def test_long_loops_are_cut_where_they_are_thinnest():
    for centers, euler in (([0.0], 0), ([0.0, 2.0], -2)):
        mesh = tori(centers)
        opened = open_loops(mesh, 0.1, 100)
        assert mesh.num_vertices - mesh.num_faces // 2 == euler
        assert opened.mesh.num_vertices - opened.mesh.num_faces // 2 == 2
        assert opened.stumps.shape == (len(centers), 2, 3)
        assert open_loops(mesh, 6.0, 100).mesh is mesh
        if len(centers) == 1:
            torch.testing.assert_close(opened.stumps.mean(1), torch.tensor([[1.0, 0, 0]]).double(), atol=0.35, rtol=0)
            assert float(opened.radii) == pytest.approx(math.pi * 0.12, rel=0.3)
    ball = unit_sphere(2, dtype=torch.float64)
    opened = open_loops(ball, 0.1, 100)
    assert opened.mesh.faces is ball.faces
    assert opened.stumps.shape == (0, 2, 3)
