"""Nodes and weights from all geodesic distances, and the deformation of a graph in loops."""

import pytest
import torch

import torchreg as tr
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.dense.deformation_graph import DeformationGraph
from torchreg.registration.dense.node_graph import build_node_graph
from torchreg.registration.dense.sample_graph import sample_graph

F64 = torch.float64


def line(count, gap=0.0):
    """Return a chain of samples, one apart, the second half farther by a gap."""
    along = torch.arange(count, dtype=F64)
    along[(count + 1) // 2 :] += gap
    points = torch.nn.functional.pad(along[:, None], (0, 2))
    return sample_graph(points, torch.arange(count), num_neighbors=min(2, max(count - 1, 1)), bridge=1.0)


def test_nodes_are_far_apart_and_weights_fall_with_distance():
    graph = build_node_graph(line(17), 0, 5, 2)
    assert sorted(graph.nodes.tolist()) == [0, 4, 8, 12, 16]
    # Sample 5 is 1, 3 and 5 from the nodes at 4, 8 and 0.
    assert graph.nodes[graph.nearest[5]].tolist() == [4, 8]
    shares = torch.tensor([(1 - 1 / 5) ** 2, (1 - 3 / 5) ** 2], dtype=F64)
    torch.testing.assert_close(graph.weights[5], shares / shares.sum())
    dense = graph.dense_weights()
    torch.testing.assert_close(dense[5, graph.nearest[5]], graph.weights[5])
    torch.testing.assert_close(dense.sum(1), torch.ones(17, dtype=F64))


@pytest.mark.parametrize("apart", [0.0, 50.0])
@pytest.mark.parametrize("num_nearest", [1, 4, 20])
def test_nodes_and_weights_follow_from_all_distances(num_nearest, apart):
    """Distances are looked for near nodes alone; nothing may be missed, with two islands either."""
    points = torch.randn(150, 3, generator=torch.Generator().manual_seed(7), dtype=F64)
    points[:60, 0] += apart
    joined = sample_graph(points, torch.arange(150), num_neighbors=6)
    graph, every = build_node_graph(joined, 3, 12, num_nearest), joined.distances()
    nodes = [3]
    while len(nodes) < 12:
        nodes.append(int(every[nodes].amin(0).argmax()))
    assert graph.nodes.tolist() == nodes
    ordered = every[nodes].mT.sort(dim=1, stable=True)
    few = min(num_nearest, 11)
    share = (1 - ordered.values[:, :few] / ordered.values[:, few : few + 1]).nan_to_num(0.0).clamp_min(1e-6).square()
    assert torch.equal(graph.nearest, ordered.indices[:, :few])
    torch.testing.assert_close(graph.weights, share / share.sum(1, keepdim=True))


def shared(graph):
    """Return what the ends of edges carry in common, one in the mean."""
    dense = graph.dense_weights()
    common = (dense.mT @ dense)[graph.edges[:, 0], graph.edges[:, 1]]
    return common / common.mean()


@pytest.mark.parametrize("gap", [0.0, 11.0])
def test_edges_weigh_what_ends_share_and_those_that_alone_hold_two_sides_at_least_one(gap):
    graph = build_node_graph(line(33, gap), 0, 9, 4 if gap else 2)
    weights = shared(graph)
    expected = weights.clone()
    for number, (first, second) in enumerate(graph.edges.tolist()):
        # It alone holds its ends together if no way around it consists of stronger edges.
        reach = torch.arange(len(graph.nodes))
        for one, other in graph.edges[weights > weights[number]].tolist():
            reach[reach == reach[other]] = reach[one].clone()
        if reach[first] != reach[second]:
            expected[number] = weights[number].clamp(min=1)
    torch.testing.assert_close(graph.edge_weights, expected)
    side = graph.nodes[graph.edges] > 16
    across = side[:, 0] != side[:, 1]
    assert float(graph.edge_weights[across].max()) >= 1
    assert gap == 0 or float(weights[across].max()) < 0.5


@pytest.mark.parametrize(("count", "nodes"), [(1, 4), (2, 4), (3, 1)])
def test_few_samples_have_few_nodes(count, nodes):
    graph = build_node_graph(line(count), 0, nodes, 4)
    assert len(graph.nodes) == min(count, nodes)
    torch.testing.assert_close(graph.weights.sum(1), torch.ones(count, dtype=F64))


@pytest.fixture(scope="module")
def graph(graph_of):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(60, 3, generator=generator, dtype=F64)
    return graph_of(
        points, torch.nn.functional.normalize(torch.randn(60, 3, generator=generator, dtype=F64), dim=-1), 8
    )


def motions(graph, size=0.5, batch=(), seed=1):
    generator = torch.Generator().manual_seed(seed)
    return se3_exp(size * torch.randn(*batch, graph.num_nodes, 6, generator=generator, dtype=F64))


def test_samples_follow_their_nodes(graph):
    transforms = motions(graph)
    loop = torch.zeros_like(graph.points)
    for sample in range(60):
        for node, weight in zip(graph.nearest[sample].tolist(), graph.weights[sample], strict=True):
            loop[sample] += weight * transform_points(transforms[node], graph.points[sample : sample + 1])[0]
    torch.testing.assert_close(graph(transforms), loop)
    torch.testing.assert_close(graph(transforms, torch.tensor([3, 1])), loop[[3, 1]])
    torch.testing.assert_close(graph.move_with_normals(transforms, slice(0, 5))[0], loop[:5])


@pytest.mark.parametrize("size", [0.0, 0.5])
def test_rigid_motions_turn_normals_and_bend_nothing(graph, size):
    whole = motions(graph, size)[:1].expand(graph.num_nodes, 4, 4)
    moved, normals = graph.move_with_normals(whole)
    torch.testing.assert_close(moved, transform_points(whole[0], graph.points))
    torch.testing.assert_close(normals, graph.normals @ whole[0, :3, :3].mT)
    assert float(graph.smoothness(whole)) < 1e-12


def test_smoothness_is_the_mean_gap_where_neighbors_disagree(graph):
    transforms = motions(graph)
    first, second = graph.edges.unbind(1)
    ends = graph.centers[torch.stack([first, second], 1)]
    gaps = transform_points(transforms[first], ends) - transform_points(transforms[second], ends)
    torch.testing.assert_close(graph.edge_gaps(transforms), gaps)
    expected = (graph.edge_weights * gaps.norm(dim=-1).sum(-1)).sum() / len(graph.edges)
    torch.testing.assert_close(graph.smoothness(transforms), expected)


def test_nodes_within_some_edges(graph):
    steps = {node: {node} for node in range(graph.num_nodes)}
    for first, second in graph.edges.tolist():
        steps[first].add(second)
        steps[second].add(first)
    reached = {node: {node} for node in steps}
    for num_edges in range(4):
        near = graph.within(num_edges)
        assert [set(row.nonzero()[:, 0].tolist()) for row in near] == [reached[node] for node in steps]
        reached = {node: set().union(*(steps[each] for each in reached[node])) for node in steps}


def test_batches_are_loops_and_gradients_are_right(graph):
    transforms = motions(graph, batch=(2,))
    torch.testing.assert_close(graph.edge_gaps(transforms)[1], graph.edge_gaps(transforms[1]))
    torch.testing.assert_close(graph(transforms)[1], graph(transforms[1]))
    torch.testing.assert_close(graph.move_with_normals(transforms)[1][1], graph.move_with_normals(transforms[1])[1])
    torch.testing.assert_close(graph.smoothness(transforms)[1], graph.smoothness(transforms[1]))
    transforms = transforms[0].requires_grad_()
    assert torch.autograd.gradcheck(lambda value: graph(value, slice(0, 4)), transforms)
    assert torch.autograd.gradcheck(graph.edge_gaps, transforms)


def test_one_node_has_no_neighbors(graph_of):
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    graph = graph_of(points, points, 1, 4)
    assert graph.edges.shape == (0, 2)
    assert float(graph.smoothness(graph.rest())) == 0


NODES = build_node_graph(line(3), 0, 2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda points: build_node_graph(line(3), 3, 2), "start must be one of 3"),
        (lambda points: build_node_graph(line(3), 0, 0), "num_nodes must be at least 1"),
        (lambda points: DeformationGraph(points[:2], points[:2], NODES), "points must be the 3 samples"),
        (lambda points: DeformationGraph(points, points[:2], NODES), "normals must have shape"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(tr.errors.InputError, match=message):
        call(torch.eye(3, dtype=F64))
