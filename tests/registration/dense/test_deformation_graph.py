import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.dense.deformation_graph import DeformationGraph
from torchreg.registration.dense.node_graph import build_node_graph

F64 = torch.float64


@pytest.fixture
def graph():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(60, 3, generator=generator, dtype=F64)
    normals = torch.nn.functional.normalize(torch.randn(60, 3, generator=generator, dtype=F64), dim=-1)
    return DeformationGraph(points, normals, build_node_graph(GeodesicGraph.from_points(points, 8), 0, 8, 3))


def motions(graph, size=0.5, batch=(), seed=1):
    return se3_exp(
        size * torch.randn(*batch, graph.num_nodes, 6, generator=torch.Generator().manual_seed(seed), dtype=F64)
    )


def test_rest_moves_nothing(graph):
    moved, normals = graph.move_with_normals(graph.rest())
    torch.testing.assert_close(moved, graph.points)
    torch.testing.assert_close(normals, graph.normals)
    assert float(graph.smoothness(graph.rest())) == 0


def test_samples_follow_their_nodes(graph):
    transforms = motions(graph)
    loop = torch.zeros_like(graph.points)
    for sample in range(60):
        for node, weight in zip(graph.nearest[sample].tolist(), graph.weights[sample], strict=True):
            loop[sample] += weight * transform_points(transforms[node], graph.points[sample : sample + 1])[0]
    torch.testing.assert_close(graph(transforms), loop)
    torch.testing.assert_close(graph(transforms, torch.tensor([3, 1])), loop[[3, 1]])
    torch.testing.assert_close(graph.move_with_normals(transforms, slice(0, 5))[0], loop[:5])


def test_rigid_motions_turn_normals_and_bend_nothing(graph):
    whole = motions(graph)[:1].expand(graph.num_nodes, 4, 4)
    moved, normals = graph.move_with_normals(whole)
    torch.testing.assert_close(moved, transform_points(whole[0], graph.points))
    torch.testing.assert_close(normals, graph.normals @ whole[0, :3, :3].mT)
    assert float(graph.smoothness(whole)) < 1e-12
    assert float(graph.smoothness(motions(graph))) > 0.1


def test_smoothness_is_the_mean_gap(graph):
    transforms = motions(graph, 1e-3)
    gap = torch.linalg.vector_norm(graph.edge_gaps(transforms), dim=-1)
    expected = (graph.edge_weights * gap.sum(-1)).sum() / len(graph.edges)
    torch.testing.assert_close(graph.smoothness(transforms), expected)


def test_gaps_are_where_neighbors_disagree(graph):
    transforms = motions(graph)
    first, second = graph.edges[2].tolist()
    there = [transform_points(transforms[node], graph.centers[[first, second]]) for node in (first, second)]
    torch.testing.assert_close(graph.edge_gaps(transforms)[2], there[0] - there[1])


def test_nodes_within_some_edges(graph):
    steps = {node: {node} for node in range(graph.num_nodes)}
    for one, other in graph.edges.tolist():
        steps[one].add(other)
        steps[other].add(one)
    reached = {node: {node} for node in steps}
    for num_edges in range(4):
        near = graph.within(num_edges)
        assert [set(row.nonzero()[:, 0].tolist()) for row in near] == [reached[node] for node in steps]
        reached = {node: set().union(*(steps[each] for each in reached[node])) for node in steps}


def test_batches_are_loops(graph):
    transforms = motions(graph, batch=(2,))
    for both, one in zip(graph.edge_gaps(transforms), transforms, strict=True):
        torch.testing.assert_close(both, graph.edge_gaps(one))
    torch.testing.assert_close(graph(transforms)[1], graph(transforms[1]))
    torch.testing.assert_close(graph.move_with_normals(transforms)[1][1], graph.move_with_normals(transforms[1])[1])
    torch.testing.assert_close(graph.smoothness(transforms)[1], graph.smoothness(transforms[1]))


def test_gradients(graph):
    transforms = motions(graph).requires_grad_()
    assert torch.autograd.gradcheck(lambda value: graph(value, slice(0, 4)), transforms)
    assert torch.autograd.gradcheck(graph.edge_gaps, transforms)


def test_one_node_has_no_neighbors():
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    graph = DeformationGraph(points, points, build_node_graph(GeodesicGraph.from_points(points, 4), 0, 1))
    assert graph.edges.shape == (0, 2)
    assert float(graph.smoothness(graph.rest())) == 0


def test_bad_input_is_named(graph):
    nodes = build_node_graph(GeodesicGraph.from_points(graph.points, 8), 0, 4)
    with pytest.raises(InputError, match="points must be the 60 samples"):
        DeformationGraph(graph.points[:5], graph.normals[:5], nodes)
    with pytest.raises(InputError, match="normals must have shape"):
        DeformationGraph(graph.points, graph.normals[:5], nodes)
