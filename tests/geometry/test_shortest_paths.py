"""Shortest paths and trees of graphs against slow oracles, and paths along surfaces against exact ones."""

import math
from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import D, rand, sheet_faces
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.graphs import Graph, component_links, connected_components, minimum_spanning_forest, rooted
from torchreg.geometry.mesh import TriangleMesh, unit_sphere


@st.composite
def networks(draw, most_nodes=7, most_edges=9, least_length=-3):
    """Return edges in any direction and order, among them loops and parallels, their lengths and the nodes' number."""
    count = draw(st.integers(1, most_nodes))
    node = st.integers(0, count - 1)
    edges = draw(st.lists(st.tuples(node, node), max_size=most_edges))
    lengths = draw(st.lists(st.integers(least_length, 4), min_size=len(edges), max_size=len(edges)))
    return torch.tensor(edges, dtype=torch.int64).reshape(-1, 2), torch.tensor(lengths, dtype=torch.float64), count


def relaxed(edges, lengths, count):
    """Return all distances, by going along every edge as often as a path can have edges."""
    distance = torch.full((count, count), math.inf, dtype=torch.float64).fill_diagonal_(0)
    for _ in range(count):
        for (a, b), length in zip(edges.tolist(), lengths.tolist(), strict=True):
            distance[:, b] = torch.minimum(distance[:, b], distance[:, a] + length)
            distance[:, a] = torch.minimum(distance[:, a], distance[:, b] + length)
    return distance


def groups(edges, count):
    """Return the set of nodes to which each node is connected."""
    joined = [{node} for node in range(count)]
    for a, b in edges:
        both = joined[a] | joined[b]
        for node in both:
            joined[node] = both
    return [frozenset(group) for group in joined]


@settings(max_examples=60, deadline=None)
@given(networks(least_length=0))
def test_distances_are_those_of_relaxing_all_edges(network):
    edges, lengths, count = network
    graph = Graph.from_edges(edges, lengths, count)
    exact = relaxed(edges, lengths, count)
    torch.testing.assert_close(graph.distances(), exact)
    torch.testing.assert_close(graph.distances([count - 1, 0]), exact[[count - 1, 0]])
    sources = list(range(0, count, 2))
    distance, which = graph.nearest(sources)
    torch.testing.assert_close(distance, exact[sources].amin(0))
    reached = distance.isfinite()
    assert torch.equal(which >= 0, reached)
    torch.testing.assert_close(exact[sources].gather(0, which.clamp(min=0)[None])[0][reached], distance[reached])


@settings(max_examples=60, deadline=None)
@given(networks(least_length=1))
def test_paths_lead_back_over_edges_as_long_as_told(network):
    edges, lengths, count = network
    distance, before = Graph.from_edges(edges, lengths, count).shortest_paths(0)
    torch.testing.assert_close(distance, relaxed(edges, lengths, count)[0])
    steps = {}
    for (a, b), length in zip(edges.tolist(), lengths.tolist(), strict=True):
        for pair in ((a, b), (b, a)):
            steps[pair] = min(length, steps.get(pair, math.inf))
    for node, previous in enumerate(before.tolist()):
        if node == 0 or math.isinf(distance[node]):
            assert previous == -1
        else:
            assert float(distance[node]) == pytest.approx(float(distance[previous]) + steps[previous, node])


def test_graphs_return_their_edges_take_more_and_look_no_farther_than_asked():
    edges = torch.tensor([[0, 1], [1, 2], [3, 2], [0, 3]])
    graph = Graph.from_edges(edges, torch.tensor([1.0, 2.0, 4.0, 9.0]), 5)
    found, lengths = graph.edges()
    assert found.tolist() == [[0, 1], [0, 3], [1, 2], [2, 3]]
    assert lengths.tolist() == [1.0, 9.0, 2.0, 4.0]
    assert graph.distances([0], limit=3.0)[0].tolist() == [0.0, 1.0, 3.0, math.inf, math.inf]
    more = graph.with_edges(torch.tensor([[4, 0]]), torch.tensor([1.0]))
    assert more.distances([4])[0].tolist() == [1.0, 2.0, 4.0, 8.0, 0.0]


@settings(max_examples=60, deadline=None)
@given(networks())
def test_components_are_what_edges_join(network):
    edges, lengths, count = network
    expected = groups(edges.tolist(), count)
    for found in (connected_components(edges, count), Graph.from_edges(edges, lengths, count).components()):
        assert found.dtype == torch.int64
        assert sorted(found.unique().tolist()) == list(range(len(set(expected))))
        assert [frozenset((found == label).nonzero()[:, 0].tolist()) for label in found] == expected


@settings(max_examples=80, deadline=None)
@given(networks())
def test_no_forest_of_all_is_shorter(network):
    edges, lengths, count = network
    forest = minimum_spanning_forest(edges, lengths, count)
    whole = groups(edges.tolist(), count)
    size = count - len(set(whole))
    spanning = [
        chosen
        for chosen in combinations(range(len(edges)), size)
        if groups([edges[edge].tolist() for edge in chosen], count) == whole
    ]
    assert tuple(forest.chosen().tolist()) in spanning
    assert float(lengths[forest.chosen()].sum()) == min(float(lengths[list(chosen)].sum()) for chosen in spanning)
    for node in range(count):
        tree = whole[node]
        assert forest.trees[node] == forest.trees[min(tree)]
        parent, edge = int(forest.parents[node]), int(forest.edges[node])
        assert (parent < 0) == (edge < 0) == (node == min(tree))
        if parent >= 0:
            assert sorted(edges[edge].tolist()) == sorted((node, parent))


def test_of_equally_long_edges_the_first_is_taken():
    edges = torch.tensor([[0, 1], [0, 2], [1, 2], [1, 2]])
    assert minimum_spanning_forest(edges, torch.ones(4), 3).chosen().tolist() == [0, 1]
    assert minimum_spanning_forest(edges, torch.tensor([2, 1, 1, 1]), 3).chosen().tolist() == [1, 2]
    assert minimum_spanning_forest(edges, -torch.tensor([2.0, 1, 1, 1]), 3).chosen().tolist() == [0, 1]


@settings(max_examples=40, deadline=None)
@given(networks(), st.randoms())
def test_forests_hang_on_any_roots(network, random):
    edges, lengths, count = network
    forest = edges[minimum_spanning_forest(edges, lengths, count).chosen()]
    trees = sorted(set(groups(forest.tolist(), count)), key=min)
    roots = [random.choice(sorted(tree)) for tree in trees]
    left_out, roots = trees[0], roots[1:]
    parents, order = rooted(forest, torch.tensor(roots, dtype=torch.int64), count)
    pairs = {frozenset(edge) for edge in forest.tolist()}
    assert sorted(order.tolist()) == sorted(set(range(count)) - left_out)
    place = {node: number for number, node in enumerate(order.tolist())}
    for node, parent in enumerate(parents.tolist()):
        if node in left_out or node in roots:
            assert parent == -1
        else:
            assert frozenset((node, parent)) in pairs
            assert place[parent] < place[node]


def slowly(places, piece, count):
    """Return the links as sets, by trying all pairs of points for every piece."""
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    grown, found = [int(np.bincount(piece).argmax())], []
    while len(grown) <= piece.max():
        inside = np.isin(piece, grown)
        gap = np.where(inside[:, None] & ~inside, apart, np.inf)
        following = piece[gap.min(0).argmin()]
        members = np.flatnonzero(piece == following)
        nearest = sorted(members, key=lambda point: gap[:, point].min())[:count]
        found += [frozenset((int(point), int(gap[:, point].argmin()))) for point in nearest]
        grown.append(int(following))
    return found


@pytest.mark.parametrize(("count", "seed"), [(1, 0), (3, 1), (3, 2), (50, 3)])
def test_links_are_those_of_a_slow_search(count, seed):
    generator = np.random.default_rng(seed)
    piece = generator.integers(0, 6, 60)
    places = generator.normal(size=(60, 3)) + 8 * generator.normal(size=(6, 3))[piece]
    links, lengths = component_links(torch.from_numpy(places), torch.from_numpy(piece), count)
    assert [frozenset(pair) for pair in links.tolist()] == slowly(places, piece, count)
    np.testing.assert_allclose(lengths, np.linalg.norm(np.diff(places[links.numpy()], axis=1)[:, 0], axis=1))
    assert bool((links[:, 0] < links[:, 1]).all())


def grid(rows, columns, wiggle=0.0):
    """A sheet of triangles over [0, 1]^2, its inner vertices moved at random."""
    flat = torch.cartesian_prod(torch.linspace(0, 1, rows), torch.linspace(0, 1, columns), torch.zeros(1)).double()
    flat = flat[:, [1, 0, 2]].reshape(rows, columns, 3)
    flat[1:-1, 1:-1, :2] += wiggle * (rand(rows - 2, columns - 2, 2) - 0.5) / columns
    return TriangleMesh(flat.reshape(-1, 3), sheet_faces(rows, columns))


def surface_distances(mesh, sources):
    return GeodesicGraph.from_mesh(mesh).distances(sources)


def error(found, exact, least):
    ratio = (found / exact)[exact > least]
    return float(ratio.mean()) - 1, float(ratio.min())


def test_distances_on_a_sphere_are_great_circles_also_through_points_alone():
    mesh = unit_sphere(5, dtype=D)
    sources = [0, 100, 5000]
    exact = (mesh.vertices[sources] @ mesh.vertices.T).clamp(-1, 1).acos()
    mean, least = error(surface_distances(mesh, sources), exact, 0.1)
    assert 0 < mean < 0.02
    assert least > 0.99
    found = GeodesicGraph.from_points(mesh.vertices, 24).distances(sources[:1])
    assert abs(error(found, exact[:1], 0.3)[0]) < 0.03


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


def test_chords_across_edges_are_straight_also_around_a_fold_and_stay_in_the_triangles():
    corners = torch.tensor([[0.0, 0, 0], [1, -0.8, 0], [1, 0, 0], [1, 0.8, 0], [0.4, 1.0, 0]], dtype=D)
    fan = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    straight = float((corners[1] - corners[4]).norm())
    fold = corners[3] / corners[3].norm()
    along = (corners[4] @ fold) * fold
    folded = corners.clone()
    folded[4] = along + (corners[4] - along).norm() * torch.tensor([0.0, 0, 1.0], dtype=D)
    for shape in (corners, folded):
        assert float(surface_distances(TriangleMesh(shape, fan), [1])[0, 4]) == pytest.approx(straight)
    # A dart: the line between the far corners passes outside the shared edge.
    dart = torch.tensor([[0.0, 0, 0], [0, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=D)
    found = surface_distances(TriangleMesh(dart, torch.tensor([[0, 1, 2], [1, 0, 3]])), [2])
    assert float(found[0, 3]) == pytest.approx(2 * math.sqrt(2))
