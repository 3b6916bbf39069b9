import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.graphs import Graph
from torchreg.registration.dense.node_graph import build_node_graph, spread_weights


def line(count):
    """Return a chain of samples, one apart."""
    edges = torch.stack((torch.arange(count - 1), torch.arange(1, count)), dim=1)
    return Graph.from_edges(edges, torch.ones(count - 1), count)


def test_nodes_spread_along_the_surface():
    graph = build_node_graph(line(17), 0, 5, 2)
    assert sorted(graph.nodes.tolist()) == [0, 4, 8, 12, 16]


def test_weights_fall_with_distance():
    graph = build_node_graph(line(17), 0, 5, 2)
    torch.testing.assert_close(graph.weights.sum(1), torch.ones(17, dtype=torch.float64))
    # Sample 5 is 1, 3 and 5 from the nodes at 4, 8 and 0.
    assert graph.nodes[graph.nearest[5]].tolist() == [4, 8]
    shares = torch.tensor([(1 - 1 / 5) ** 2, (1 - 3 / 5) ** 2], dtype=torch.float64)
    torch.testing.assert_close(graph.weights[5], shares / shares.sum())
    dense = graph.dense_weights()
    torch.testing.assert_close(dense[5, graph.nearest[5]], graph.weights[5])
    torch.testing.assert_close(dense.sum(1), torch.ones(17, dtype=torch.float64))


@pytest.mark.parametrize("apart", [0.0, 50.0])
@pytest.mark.parametrize("num_nearest", [1, 4, 20])
def test_nodes_and_weights_follow_from_all_distances(num_nearest, apart):
    """Distances are looked for near nodes alone; nothing may be missed, with two islands either."""
    points = torch.randn(150, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    points[:60, 0] += apart
    ways = GeodesicGraph.from_points(points, 6)
    graph = build_node_graph(ways, 3, 12, num_nearest)
    every = ways.distances()
    nodes = [3]
    while len(nodes) < 12:
        nodes.append(int(every[nodes].amin(0).argmax()))
    assert graph.nodes.tolist() == nodes
    ordered = every[nodes].mT.sort(dim=1, stable=True)
    few = min(num_nearest, 11)
    share = (1 - ordered.values[:, :few] / ordered.values[:, few : few + 1]).nan_to_num(0.0).clamp_min(1e-6).square()
    assert torch.equal(graph.nearest, ordered.indices[:, :few])
    torch.testing.assert_close(graph.weights, share / share.sum(1, keepdim=True))


def test_neighbors_share_samples():
    graph = build_node_graph(line(33), 0, 9, 2)
    places = graph.nodes[graph.edges]
    assert bool((graph.edges[:, 0] < graph.edges[:, 1]).all())
    gap = (places[:, 0] - places[:, 1]).abs()
    assert {4} <= set(gap.tolist()) <= {4, 8}
    torch.testing.assert_close(graph.edge_weights, raised(graph))


def shares(graph):
    """Return what the ends of edges carry in common, one in the mean."""
    dense = graph.dense_weights()
    shared = (dense.mT @ dense)[graph.edges[:, 0], graph.edges[:, 1]]
    return shared / shared.mean()


def raised(graph):
    """Return weights of edges by what they share, those raised that alone hold two sides together, edge by edge."""
    shared = shares(graph)
    count, weights = len(graph.nodes), shared.clone()
    for number in range(len(shared)):
        # It alone holds its ends together if no way around it consists of stronger edges.
        reach = torch.arange(count)
        for one, other in graph.edges[shared > shared[number]].tolist():
            reach[reach == reach[other]] = reach[one].clone()
        one, other = graph.edges[number]
        if reach[one] != reach[other]:
            weights[number] = shared[number].clamp(min=1)
    return weights


def test_islands_are_held_as_firmly_as_the_rest():
    """Two chains of samples with a long link between them, on whose sides samples share next to nothing."""
    edges = torch.stack((torch.arange(32), torch.arange(1, 33)), dim=1)
    lengths = torch.ones(32)
    lengths[20] = 12.0
    graph = build_node_graph(Graph.from_edges(edges, lengths, 33), 0, 9, 4)
    side = graph.nodes[graph.edges] > 20
    across = side[:, 0] != side[:, 1]
    assert 0 < float(shares(graph)[across].max()) < 0.5
    assert float(graph.edge_weights[across].max()) == 1
    torch.testing.assert_close(graph.edge_weights, raised(graph))


@pytest.mark.parametrize(("count", "nodes"), [(1, 4), (2, 4), (3, 1)])
def test_few_samples_have_few_nodes(count, nodes):
    graph = build_node_graph(line(count), 0, nodes, 4)
    assert len(graph.nodes) == min(count, nodes)
    torch.testing.assert_close(graph.weights.sum(1), torch.ones(count, dtype=torch.float64))
    assert bool(graph.weights.isfinite().all())


def test_bad_input_is_named():
    with pytest.raises(InputError, match="start must be one of 3"):
        build_node_graph(line(3), 3, 2)
    with pytest.raises(InputError, match="num_nodes must be at least 1"):
        build_node_graph(line(3), 0, 0)


def test_points_at_samples_take_over_their_weights():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(points, dim=-1)
    weights = torch.rand(20, 6, generator=generator, dtype=torch.float64).softmax(1)
    torch.testing.assert_close(
        spread_weights(points, normals, points, normals, weights, 0.1), weights, rtol=0, atol=1e-6
    )
    between = spread_weights((points[:1] + points[1:2]) / 2, normals[:1], points[:2], normals[:2], weights[:2], 0.0)
    torch.testing.assert_close(between[0], weights[:2].mean(0))


def test_normals_tell_front_from_back():
    weights = torch.eye(2, dtype=torch.float64)
    samples = torch.tensor([[0.0, 0, 0], [0.0, 0, 0.02]], dtype=torch.float64)
    normals = torch.tensor([[0.0, 0, -1], [0.0, 0, 1]], dtype=torch.float64)
    point = torch.tensor([[0.0, 0, 0.008]], dtype=torch.float64)
    near = spread_weights(point, normals[1:], samples, normals, weights, 0.0)[0]
    assert float(near[0]) > 0.5
    same_side = spread_weights(point, normals[1:], samples, normals, weights, 0.1)[0]
    assert float(same_side[1]) > 0.5
