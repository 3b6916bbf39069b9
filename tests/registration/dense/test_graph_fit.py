"""Gauss-Newton steps of a deformation graph: against a dense one and autograd, and what they reach."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.blend import turn_about
from torchreg.registration.dense.graph_fit import GraphMatches, fit_graph

F64 = torch.float64


@pytest.fixture(scope="module")
def graph(graph_of):
    points = torch.rand(80, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    return graph_of(points, torch.nn.functional.normalize(points - 0.5, dim=-1), 6)


def problem(graph, seed=1):
    generator = torch.Generator().manual_seed(seed)

    def random(*size):
        return torch.randn(*size, generator=generator, dtype=F64)

    normals = torch.nn.functional.normalize(random(40, 3), dim=-1)
    targets = graph.points[20:60] + 0.1 * random(40, 3)
    return se3_exp(0.2 * random(6, 6)), GraphMatches(torch.arange(20, 60), targets, random(40).abs(), normals, 0.3)


def energy(graph, transforms, matches, stiffness):
    """Return the energy as the docstring has it, for autograd."""
    offset = graph(transforms, matches.which) - matches.targets
    metric = matches.normals.unsqueeze(-1) * matches.normals.unsqueeze(-2) + matches.tangential_weight * torch.eye(
        3, dtype=F64
    )
    residual = (matches.weights * (offset.unsqueeze(-2) @ metric @ offset.unsqueeze(-1))[:, 0, 0]).mean()
    smoothness = (graph.edge_weights * graph.edge_gaps(transforms).square().sum((-1, -2))).sum() / graph.num_nodes
    return residual, smoothness, residual + stiffness * smoothness


@pytest.mark.parametrize("each", [False, True])
def test_steps_are_those_of_a_dense_gauss_newton(graph, each):
    transforms, matches = problem(graph)
    tangential_weight = torch.linspace(0, 0.6, 40, dtype=F64) if each else torch.full((40,), 0.3, dtype=F64)
    matches = replace(matches, tangential_weight=tangential_weight if each else 0.3)
    middles = transform_points(transforms, graph.centers.unsqueeze(1)).squeeze(1)

    def residuals(twists):
        moved = turn_about(transforms, twists.view(-1, 6), middles)
        offset = graph(moved, matches.which) - matches.targets
        root = (matches.weights / 40).sqrt().unsqueeze(-1)
        across = root * (offset * matches.normals).sum(-1, keepdim=True)
        gap = graph.edge_gaps(moved).flatten(1) * (0.7 / 6 * graph.edge_weights).sqrt().unsqueeze(-1)
        return torch.cat(
            [
                across.reshape(-1),
                (root * tangential_weight.sqrt().unsqueeze(-1) * offset).reshape(-1),
                gap.reshape(-1),
            ]
        )

    zero = torch.zeros(36, dtype=F64)
    jacobian = torch.autograd.functional.jacobian(residuals, zero)
    twists = torch.linalg.lstsq(jacobian, -residuals(zero)[:, None]).solution.view(6, 6)
    expected = turn_about(transforms, twists, middles)
    fit = fit_graph(graph, transforms, matches, 0.7)
    torch.testing.assert_close(fit.transforms, expected, rtol=1e-6, atol=1e-7)
    reported = torch.tensor([fit.residual, fit.smoothness], dtype=F64)
    matches = replace(matches, tangential_weight=tangential_weight[:, None, None])
    torch.testing.assert_close(reported, torch.stack(energy(graph, transforms, matches, 0.7)[:2]))


def test_sets_of_matches_add_up_each_by_its_own_mean(graph):
    transforms, matches = problem(graph)
    others = GraphMatches(slice(0, 30), graph.points[:30] + 0.05, torch.linspace(0, 2, 30, dtype=F64), None, 0.4)
    both = GraphMatches(
        torch.cat([matches.which, torch.arange(30)]),
        torch.cat([matches.targets, others.targets]),
        torch.cat([matches.weights / 40, others.weights / 30]) * 70,
        torch.cat([matches.normals, torch.zeros(30, 3, dtype=F64)]),
        torch.cat([torch.full((40,), 0.3), torch.full((30,), 0.4)]).to(F64),
    )
    one, two = fit_graph(graph, transforms, both, 0.7), fit_graph(graph, transforms, [matches, others], 0.7)
    torch.testing.assert_close(two.transforms, one.transforms, rtol=1e-9, atol=1e-9)
    assert two.residual == pytest.approx(one.residual)


def test_steps_end_where_the_gradient_vanishes(graph):
    transforms, matches = problem(graph)
    fitted = fit_graph(graph, transforms, matches, 0.05, num_steps=30).transforms
    middles = transform_points(fitted, graph.centers.unsqueeze(1)).squeeze(1)
    twists = torch.zeros(6, 6, dtype=F64, requires_grad=True)
    total = energy(graph, turn_about(fitted, twists, middles), matches, 0.05)[2]
    (slope,) = torch.autograd.grad(total, twists)
    assert float(slope.abs().max()) < 1e-7
    assert float(total.detach()) < float(energy(graph, transforms, matches, 0.05)[2])


def test_rigid_motions_are_found_whatever_the_stiffness(graph):
    whole = se3_exp(torch.tensor([0.2, -0.1, 0.3, 0.4, 0.2, -0.3], dtype=F64))
    targets = transform_points(whole, graph.points)
    matches = GraphMatches(slice(None), targets, torch.ones(80, dtype=F64))
    fitted = fit_graph(graph, graph.rest(), matches, 100.0, num_steps=15).transforms
    torch.testing.assert_close(graph(fitted), targets, rtol=0, atol=1e-6)


def test_turning_everything_turns_the_answer(graph, graph_of):
    transforms, matches = problem(graph)
    whole = se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.4, 0.8, -0.3], dtype=F64))
    turned = graph_of(transform_points(whole, graph.points), graph.normals @ whole[:3, :3].mT, 6)
    targets, normals = transform_points(whole, matches.targets), matches.normals @ whole[:3, :3].mT
    moved = replace(matches, targets=targets, normals=normals)
    start = whole @ transforms @ torch.linalg.inv(whole)
    expected = transform_points(whole, graph(fit_graph(graph, transforms, matches, 0.3, 3).transforms))
    torch.testing.assert_close(turned(fit_graph(turned, start, moved, 0.3, 3).transforms), expected, rtol=0, atol=1e-8)


def test_samples_without_weight_leave_nodes_with_their_neighbors(graph):
    targets = graph.points + torch.tensor([0.1, 0.0, 0.0], dtype=F64)
    weights = torch.zeros(80, dtype=F64)
    weights[:10] = 1
    fitted = fit_graph(graph, graph.rest(), GraphMatches(slice(None), targets, weights), 1.0, 5).transforms
    torch.testing.assert_close(graph(fitted), targets, rtol=0, atol=1e-4)
    none = fit_graph(graph, graph.rest(), GraphMatches(slice(None), targets, torch.zeros(80, dtype=F64)), 0.0)
    torch.testing.assert_close(none.transforms, graph.rest())


def test_edges_that_give_count_less(graph):
    transforms, matches = problem(graph)
    gap = graph.edge_gaps(transforms).square().sum(-1).mean(-1)
    fit = fit_graph(graph, transforms, matches, 0.7, edge_scale=0.05)
    expected = (graph.edge_weights / (1 + gap / 0.05**2) * 2 * gap).sum() / graph.num_nodes
    assert fit.smoothness == pytest.approx(float(expected))


def test_pieces_that_hardly_anything_holds_are_not_flung_away(graph_of):
    generator = torch.Generator().manual_seed(0)
    piece = torch.rand(60, 3, generator=generator, dtype=F64)
    # Two samples of the second piece nearly touch, and are pulled apart: a turn without end would do.
    piece[1] = piece[0] + torch.tensor([0.01, 0, 0], dtype=F64)
    points = torch.cat((piece, piece + torch.tensor([6.0, 0, 0], dtype=F64)))
    normals = torch.nn.functional.normalize(points - points.mean(0), dim=-1)
    graph = graph_of(points, normals, 12)
    which = torch.cat((torch.arange(60), torch.tensor([60, 61])))
    targets = points[which]
    targets[60:, 1] += torch.tensor([0.1, -0.1], dtype=F64)
    size = (points.amax(0) - points.amin(0)).norm()
    for steps in (1, 6):
        matches = GraphMatches(which, targets, torch.ones(len(which), dtype=F64))
        moved = graph(fit_graph(graph, graph.rest(), matches, 0.1, steps).transforms)
        assert float((moved - points).norm(dim=-1).max()) < size
        torch.testing.assert_close(moved[:60], points[:60], rtol=0, atol=1e-3)


def test_what_is_far_away_is_reached_all_the_same(graph):
    motion = se3_exp(torch.tensor([0.1, -0.2, 0.3, 0.4, 0.1, -0.3], dtype=F64))
    for places, tolerance in ((graph.points + torch.tensor([30.0, 0, 0], dtype=F64), 1e-4),
                              (transform_points(motion, graph.points[:20]), 1e-6)):  # fmt: skip
        matches = GraphMatches.of_places(places)
        moved = graph(fit_graph(graph, graph.rest(), matches, 0.1, 15).transforms)
        torch.testing.assert_close(moved[: len(places)], places, rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stiffness": -1.0}, "stiffness must be"),
        ({"stiffness": 1.0, "edge_scale": 0.0}, "edge_scale must be positive"),
        ({"stiffness": 1.0, "num_steps": 0}, "num_steps must be at least 1"),
    ],
)
def test_bad_input_is_named(graph, change, message):
    with pytest.raises(tr.errors.InputError, match=message):
        fit_graph(graph, *problem(graph), **change)
