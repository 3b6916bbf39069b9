"""Graph cuts: cuts and labelings against trying them all and linear programs, ties, roundings."""

import math
from itertools import product

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

import torchreg.solvers.graph_cut as module
from tests.geometry.draws import D, rand, seeded
from torchreg.errors import SolverError
from torchreg.solvers.graph_cut import alpha_expansion, min_cut

SEEDS = st.integers(0, 10_000)
EDGES = torch.tensor([[0, 1], [1, 2]])


def cut(source, sink, edges, capacities, reverse=None):
    """A cut's side, its value summed from the capacities as given, and the bound on its rounding."""
    reverse = torch.zeros_like(capacities) if reverse is None else reverse
    source, sink, forward, backward = (values.double().numpy() for values in (source, sink, capacities, reverse))
    side, error = min_cut(source - sink, edges.numpy(), forward, backward)
    return side.tolist(), cut_cost(side, source, sink, edges, capacities, backward), error


def random_graph(seed, num_nodes, num_edges):
    """Distinct pairs of different nodes (E, 2), and the generator."""
    generator = seeded(seed)
    pairs = torch.combinations(torch.arange(num_nodes))
    pairs = pairs[torch.randperm(len(pairs), generator=generator)[:num_edges]]
    flip = torch.rand(len(pairs), generator=generator) < 0.5
    return torch.where(flip[:, None], pairs.flip(1), pairs), generator


def cut_cost(side, source, sink, edges, capacities, reverse):
    """The cost of a cut, from the definition."""
    total = sum(float(source[i]) if on_sink else float(sink[i]) for i, on_sink in enumerate(side))
    for (i, j), c, r in zip(edges.tolist(), capacities.tolist(), reverse.tolist(), strict=True):
        total += c if side[j] and not side[i] else r if side[i] and not side[j] else 0.0
    return total


def energy_of(labels, unary, edges, weights, label_costs=None, positions=None, position_weights=None):
    """The energy of a labeling, from the definition."""
    total = sum(float(unary[i, label]) for i, label in enumerate(labels))
    total += sum(w for (i, j), w in zip(edges.tolist(), weights.tolist(), strict=True) if labels[i] != labels[j])
    if positions is not None:
        for (i, j), table, t in zip(edges.tolist(), positions.tolist(), position_weights.tolist(), strict=True):
            total += t * min(math.dist(table[labels[i]], table[labels[j]]), 1.0)
    return total + (0 if label_costs is None else sum(float(label_costs[label]) for label in set(labels)))


def labeling_problem(seed, num_nodes=6, num_labels=3, num_edges=9):
    edges, generator = random_graph(seed, num_nodes, num_edges)
    unary = torch.rand(num_nodes, num_labels, generator=generator, dtype=D)
    return unary, edges, torch.rand(len(edges), generator=generator, dtype=D)


def seam_problem(edges, num_labels, seed):
    """Positions whose distances are partly below and partly above one, and weights."""
    positions = 1.2 * rand(len(edges), num_labels, 2, seed=seed)
    return {"positions": positions, "position_weights": rand(len(edges), seed=seed + 1)}


@given(SEEDS, st.integers(1, 7), st.sampled_from([1.0, 1e-6, 1e9]))
@settings(max_examples=60, deadline=None)
def test_a_cut_costs_the_least_of_all_cuts(seed, num_nodes, scale):
    edges, generator = random_graph(seed, num_nodes, 12)
    terminals = torch.rand(2, num_nodes, generator=generator, dtype=D) * scale
    capacities = torch.rand(2, len(edges), generator=generator, dtype=D) * scale
    _, value, error = cut(*terminals, edges, *capacities)
    least = min(cut_cost(s, *terminals, edges, *capacities) for s in product([False, True], repeat=num_nodes))
    assert value <= least + error + 1e-12 * scale
    assert error <= 1e-6 * scale


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_integers_are_exact_and_a_tie_puts_the_fewest_nodes_at_the_sink(seed):
    edges, generator = random_graph(seed, 6, 10)
    terminals = torch.randint(0, 4, (2, 6), generator=generator)
    capacities = torch.randint(0, 3, (2, len(edges)), generator=generator)
    side, value, error = cut(*terminals, edges, *capacities)
    costs = {s: cut_cost(s, *terminals, edges, *capacities) for s in product([False, True], repeat=6)}
    assert (value, error) == (min(costs.values()), 0)
    assert sum(side) == min(sum(s) for s, cost in costs.items() if cost == value)


def test_large_small_and_missing_capacities_do_not_lose_the_flow():
    # Neither side is plain before the flow, and scipy's maximum flow takes such capacities for none at all.
    big = 2.0**33
    capacities = torch.tensor([2 * big])
    found = cut(torch.tensor([big, 0.0]), torch.tensor([0.0, 0.75 * big]), EDGES[:1], capacities, capacities)
    assert found == ([False, False], 0.75 * big, 0)
    none = EDGES[:0], torch.zeros(0)
    assert cut(torch.zeros(0), torch.zeros(0), *none)[1] == 0
    alone = cut(torch.tensor([1.0, 2.0, 0.0]), torch.tensor([2.0, 1.0, 0.0]), *none)
    assert alone[:2] == ([True, False, False], 2)
    # Huge terminals leave the resolution of tiny edges as it is.
    edges, generator = random_graph(3, 8, 14)
    source, sink = torch.rand(2, 8, generator=generator, dtype=D)
    source[0], sink[1] = 1e15, 1e15
    capacities = rand(len(edges))
    assert cut(source, sink, edges, capacities, capacities)[2] < 1e-6


def test_a_flow_that_differs_from_the_cut_is_an_error(monkeypatch):
    def silent(graph, source, sink):
        result = maximum_flow(graph, source, sink)
        result.flow_value = 0
        return result

    maximum_flow, two = module.maximum_flow, torch.tensor([2.0])
    monkeypatch.setattr(module, "maximum_flow", silent)
    with pytest.raises(SolverError, match="maximum flow is 0 but the cut carries"):
        cut(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 0.9]), EDGES[:1], two, two)


@given(SEEDS, st.booleans(), st.booleans())
@example(237, True, False)  # leaves open nodes that nothing holds on either side
@settings(max_examples=60, deadline=None)
def test_no_expansion_of_any_label_lowers_the_energy_and_the_bound_holds(seed, costly, seams):
    problem = labeling_problem(seed)
    more = {"label_costs": rand(3, seed=seed)} if costly else {}
    more |= seam_problem(problem[1], 3, seed) if seams else {}
    result = alpha_expansion(*problem, **more)
    labels = result.labels.tolist()
    assert result.converged
    assert result.energy == pytest.approx(energy_of(labels, *problem, **more), rel=1e-12)
    if not costly and not seams:
        assert result.energy <= 2 * min(energy_of(f, *problem) for f in product(range(3), repeat=6))
    for alpha in range(3):
        for moves in product([False, True], repeat=6):
            moved = [alpha if move else label for move, label in zip(moves, labels, strict=True)]
            assert energy_of(moved, *problem, **more) >= result.energy - 1e-7


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_two_labels_end_in_the_least_energy_from_any_start(seed):
    unary, edges, weights = labeling_problem(seed, num_labels=2)
    initial = torch.randint(0, 2, (6,), generator=seeded(seed))
    least = min(energy_of(f, unary, edges, weights) for f in product(range(2), repeat=6))
    assert alpha_expansion(unary, edges, weights, initial=initial).energy == pytest.approx(least, abs=1e-7)
    assert cut(unary[:, 1], unary[:, 0], edges, weights, weights)[1] == pytest.approx(least, abs=1e-7)


def test_the_energy_never_rises_over_sweeps_and_sweeps_can_be_continued():
    unary, edges, weights = labeling_problem(1, num_nodes=60, num_labels=6, num_edges=200)
    labels, last = torch.randint(0, 6, (60,), generator=seeded()), float("inf")
    for _ in range(6):
        result = alpha_expansion(unary, edges, 0.3 * weights, initial=labels, max_sweeps=1)
        assert result.energy <= last
        assert result.num_sweeps == 1
        labels, last = result.labels, result.energy
    assert result.converged
    assert last == alpha_expansion(unary, edges, 0.3 * weights, initial=labels).energy


def test_labels_follow_a_permutation_of_nodes_and_a_common_scale():
    unary, edges, weights = labeling_problem(5, num_nodes=40, num_labels=4, num_edges=120)
    result, order = alpha_expansion(unary, edges, 0.2 * weights), torch.randperm(40, generator=seeded(1))
    permuted = alpha_expansion(unary[order], order.argsort()[edges], 0.2 * weights)
    assert torch.equal(permuted.labels, result.labels[order])
    scaled = alpha_expansion(unary * 1e-9, edges, 0.2e-9 * weights)
    assert torch.equal(scaled.labels, result.labels)
    assert scaled.energy == pytest.approx(1e-9 * result.energy)
    # Strong smoothness and label costs leave one label.
    best = [int(unary.sum(0).argmin())] * 40
    assert alpha_expansion(unary, edges, 100 + weights).labels.tolist() == best
    costs = torch.full((4,), 50.0)
    assert alpha_expansion(unary, edges[:0], weights[:0], label_costs=costs).labels.tolist() == best


def test_seams_depend_on_distances_alone_and_are_potts_beyond_one():
    unary, edges, weights = labeling_problem(5, num_nodes=40, num_labels=4, num_edges=120)
    seams, turn = seam_problem(edges, 4, 3), torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=D)
    far = 5.0 * torch.arange(4, dtype=D)[None, :, None].expand(120, 4, 1)
    turned = seams | {"positions": seams["positions"] @ turn + 7.0}
    apart = {"positions": far, "position_weights": torch.full((120,), 0.2)}
    for first, second in (
        (alpha_expansion(unary, edges, 0.1 * weights, **seams), alpha_expansion(unary, edges, 0.1 * weights, **turned)),
        (alpha_expansion(unary, edges, 0.1 * weights + 0.2), alpha_expansion(unary, edges, 0.1 * weights, **apart)),
    ):
        assert torch.equal(first.labels, second.labels)
        assert first.energy == pytest.approx(second.energy)
    ones = alpha_expansion(unary, edges, weights, positions=far, position_weights=torch.ones(120))
    assert alpha_expansion(unary, edges, weights, positions=far).energy == ones.energy


@pytest.mark.parametrize("agree", [0, 3, 7])
def test_a_seam_runs_where_labels_agree(agree):
    # A chain whose ends want different labels, and whose middle does not care.
    unary = torch.full((9, 2), 1.0)
    unary[0, 0] = unary[8, 1] = -9.0
    edges, positions = torch.stack([torch.arange(8), torch.arange(1, 9)], dim=1), torch.zeros(8, 2, 3)
    positions[:, 1, 0] = 0.1 + 0.1 * (torch.arange(8) - agree).abs()
    labels = alpha_expansion(unary, edges, torch.full((8,), 0.01), positions=positions).labels
    assert labels.tolist() == [0] * (agree + 1) + [1] * (8 - agree)
