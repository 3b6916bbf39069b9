"""Minimum cuts, and labelings of graphs by alpha-expansion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from torch import Tensor

from torchreg._checks import as_float_tensor, as_tensor, check_count, check_finite, check_shape
from torchreg.errors import InputError, InputTypeError, SolverError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

_MAX_CAPACITY = 2**31 - 1
# Rounds that fix nodes whose side is plain before the flow sees them, and the share below which they stop paying.
_MAX_ROUNDS = 12
_WORTHWHILE_SHARE = 0.02
# A triangle inequality may fail by this share of the largest entry, from rounding.
_METRIC_SLACK = 1e-6
_OWNERS = {"N": "node", "E": "edge", "L": "label"}


@dataclass(frozen=True)
class MinCut:
    """A cut of least capacity.

    Args:
        sink_side: (N,) True for nodes on the side of the sink; of several least cuts the one with the fewest of them.
        value: capacity of the cut, summed from the capacities as given.
        error: most by which the cut can exceed the least one, from rounding capacities to integers.
    """

    sink_side: Tensor
    value: float
    error: float


@dataclass(frozen=True)
class Labeling:
    """A labeling of a graph.

    Args:
        labels: (N,) int64.
        energy: of the labels.
        num_sweeps: sweeps over all labels that were begun.
        converged: whether no expansion of any label lowers the energy any more.
    """

    labels: Tensor
    energy: float
    num_sweeps: int
    converged: bool


def min_cut(
    source: Tensor, sink: Tensor, edges: Tensor, capacities: Tensor, reverse_capacities: Tensor | None = None
) -> MinCut:
    """Return the least cut, ``min_x sum_i x_i a_i + (1 - x_i) b_i + sum_ij (1 - x_i) x_j c_ij + x_i (1 - x_j) r_ij``.

    Nodes whose side is plain from their own capacities are set first. What is left goes to a maximum flow over 32-bit
    integers: capacities are multiplied by the largest power of two for which their sum still fits, and rounded, so
    that integers whose sum is below 2^31 stay exact. The cut exceeds the least one by ``error`` at most, the sum of
    the roundings, itself at most ``n^2 2^-31`` of the mean capacity of n arcs. Flow and cut are checked to be equal.

    Args:
        source: (N,) a, paid by nodes on the side of the sink, not negative.
        sink: (N,) b, paid by nodes on the side of the source, not negative.
        edges: (E, 2) integers, pairs of nodes; pairs may repeat.
        capacities: (E,) c, paid when the first node is on the source's side and the second is not, not negative.
        reverse_capacities: (E,) r, paid in the opposite case; zero by default.

    Returns:
        a `MinCut`, on the device of ``source``.

    Raises:
        InputError: if a capacity is negative or not finite, an edge joins no two different nodes, or sizes differ.
        SolverError: if flow and cut differ.

    Differentiable: no.

    References: Boykov and Kolmogorov 2004; Hammer, Hansen and Simeone 1984 for the nodes set first.
    """
    source = as_float_tensor(source, "source")
    check_shape(source, "source", ("N",))
    to_sink = _not_negative(sink, "sink", ("N",), len(source))
    to_source = _not_negative(source, "source", ("N",), len(source))
    pairs = _edges(edges, len(source))
    forward = _not_negative(capacities, "capacities", ("E",), len(pairs))
    backward = np.zeros_like(forward)
    if reverse_capacities is not None:
        backward = _not_negative(reverse_capacities, "reverse_capacities", ("E",), len(pairs))
    side, error = _cut(to_source - to_sink, pairs, forward, backward)
    first, second = side[pairs[:, 0]], side[pairs[:, 1]]
    value = to_source[side].sum() + to_sink[~side].sum()
    value += forward[~first & second].sum() + backward[first & ~second].sum()
    return MinCut(torch.from_numpy(side).to(source.device), float(value), error)


def alpha_expansion(
    unary: Tensor,
    edges: Tensor,
    weights: Tensor,
    *,
    metric: Tensor | None = None,
    places: Tensor | None = None,
    place_weights: Tensor | None = None,
    label_costs: Tensor | None = None,
    initial: Tensor | None = None,
    max_sweeps: int = 20,
    generator: torch.Generator | None = None,
) -> Labeling:
    """Return labels that lower ``sum_i U_i(f_i) + sum_ij V_ij(f_i, f_j) + sum_l h_l [l is used]``.

    ``V_ij(a, b) = w_ij V(a, b) + t_ij min(|p_ij(a) - p_ij(b)|, 1)``: what all edges have in common, and how far apart
    two labels take a place on the edge, as seams between pictures are judged.

    Each move lets every node keep its label or take one label, alpha, in the best way, by a minimum cut. Labels take
    turns until none of them brings the energy down; it never rises. Two labels end in the least energy, to the rounding
    of `min_cut`; more labels, without label costs and with ``U >= 0``, within ``2 max V_ij / min V_ij`` times the least
    (of different labels, at the edge where that is most; 2 for Potts).

    Args:
        unary: (N, L) U.
        edges: (E, 2) integers, pairs of nodes, each pair once.
        weights: (E,) w, not negative.
        metric: (L, L) V, a metric; 1 for different labels (Potts) by default.
        places: (E, L, D) p, where each label takes a place on the edge, in units of the distance up to which they
            count; without them that is left out.
        place_weights: (E,) t, not negative; ones by default.
        label_costs: (L,) h, not negative; zero by default.
        initial: (N,) labels to start from; the least U of each node by default.
        max_sweeps: most rounds in which every label has its turn.
        generator: draws the order of the labels in each sweep; ascending without.

    Returns:
        a `Labeling`, on the device of ``unary``.

    Raises:
        InputError: if sizes differ, a number is not finite or negative where it must not be, an edge joins no two
            different nodes, ``metric`` is none, or ``initial`` names unknown labels.

    Differentiable: no.

    Cost: one minimum cut per label and sweep; labels are skipped while nothing changed since their last turn.

    References: Boykov, Veksler and Zabih 2001; Kolmogorov and Zabih 2004; Delong et al. 2012 for label costs; Kwatra
    et al. 2003 for seams.
    """
    unary = as_float_tensor(unary, "unary")
    check_shape(unary, "unary", ("N", "L"))
    check_finite(unary, "unary", "forbid a label by a large cost instead")
    check_count(max_sweeps, "max_sweeps", 1)
    num_nodes, num_labels = unary.shape
    if num_labels == 0:
        raise InputError("unary must have at least one label, got shape (N, L) with L = 0")
    pairs = _edges(edges, num_nodes)
    energy = _Energy(
        unary.detach().cpu().double().numpy(),
        pairs,
        _not_negative(weights, "weights", ("E",), len(pairs)),
        _metric(metric, num_labels),
        np.zeros(num_labels) if label_costs is None else _not_negative(label_costs, "label_costs", ("L",), num_labels),
        _seams(places, place_weights, len(pairs), num_labels),
    )
    labels = energy.unary.argmin(1) if initial is None else _initial(initial, num_nodes, num_labels)
    return _sweep(energy, labels, max_sweeps, generator, unary.device)


@dataclass(frozen=True)
class _Seams:
    """What it costs that two labels take the place on an edge apart."""

    places: Floats
    weights: Floats

    def __call__(self, first: Integers, second: Integers) -> Floats:
        """Return the costs (E,) of labels (E,) at the first and the second ends of the edges."""
        every = np.arange(len(self.places))
        offset = self.places[every, first] - self.places[every, second]
        costs: Floats = self.weights * np.minimum(np.sqrt(np.einsum("ed,ed->e", offset, offset)), 1.0)
        return costs


@dataclass(frozen=True)
class _Energy:
    """An energy over labelings, in float64."""

    unary: Floats
    edges: Integers
    weights: Floats
    metric: Floats
    label_costs: Floats
    seams: _Seams | None = None

    def __call__(self, labels: Integers) -> float:
        """Return the energy of labels (N,)."""
        first, second = labels[self.edges].T
        used = np.bincount(labels, minlength=len(self.label_costs)) > 0
        smooth = self._between(first, second).sum()
        return float(self.unary[np.arange(len(labels)), labels].sum() + smooth + self.label_costs[used].sum())

    def expanded(self, labels: Integers, alpha: int) -> Integers:
        """Return the labels after the best move that gives ``alpha`` to any set of nodes, to the cut's rounding."""
        first, second = labels[self.edges].T
        all_alpha = np.full_like(first, alpha)
        stay, second_moves = self._between(first, second), self._between(first, all_alpha)
        first_moves = self._between(all_alpha, second)
        # Splitting the excess evenly over both directions leaves the least for the terminals to carry.
        arc = 0.5 * np.maximum(second_moves + first_moves - stay, 0.0)
        num_nodes = len(labels)
        gain = self.unary[:, alpha] - self.unary[np.arange(num_nodes), labels]
        gain = gain + _sums(self.edges[:, 0], 0.5 * (first_moves - stay - second_moves), num_nodes)
        gain = gain + _sums(self.edges[:, 1], 0.5 * (second_moves - stay - first_moves), num_nodes)
        extra, extra_edges, extra_arcs = self._label_nodes(labels, alpha)
        moved, _ = _cut(
            np.concatenate([gain, extra]),
            np.concatenate([self.edges, extra_edges]),
            np.concatenate([arc, extra_arcs]),
            np.concatenate([arc, np.zeros_like(extra_arcs)]),
        )
        return np.where(moved[:num_nodes], alpha, labels)

    def _between(self, first: Integers, second: Integers) -> Floats:
        """Return what labels (E,) at the first and the second ends of the edges cost."""
        costs: Floats = self.weights * self.metric[first, second]
        return costs if self.seams is None else costs + self.seams(first, second)

    def _label_nodes(self, labels: Integers, alpha: int) -> tuple[Floats, Integers, Floats]:
        """Return terminal costs, edges and arcs of one more node per label whose cost a move can save or incur.

        A used label's node stays with the source, and pays, unless all of the label's nodes move; the node of an unused
        alpha joins the sink, and pays, as soon as one node moves.
        """
        used = np.bincount(labels, minlength=len(self.label_costs)) > 0
        costly = np.flatnonzero((self.label_costs > 0) & (used | (np.arange(len(used)) == alpha)))
        costly = costly[(costly != alpha) | ~used[alpha]]
        node_of = np.full(len(used), -1)
        node_of[costly] = len(labels) + np.arange(len(costly))
        terminal = np.where(costly == alpha, self.label_costs[costly], -self.label_costs[costly])
        holders = np.flatnonzero(node_of[labels] >= 0)
        edges, arcs = np.stack([holders, node_of[labels[holders]]], 1), self.label_costs[labels[holders]]
        if node_of[alpha] >= 0:
            nodes = np.arange(len(labels))
            edges = np.concatenate([edges, np.stack([np.full_like(nodes, node_of[alpha]), nodes], 1)])
            arcs = np.concatenate([arcs, np.full(len(nodes), self.label_costs[alpha])])
        return terminal, edges, arcs


def _sweep(
    energy: _Energy, labels: Integers, max_sweeps: int, generator: torch.Generator | None, device: torch.device
) -> Labeling:
    """Return where expansions in turn lead; a label is settled while nothing changed since its last turn."""
    num_labels = len(energy.label_costs)
    settled = np.zeros(num_labels, dtype=np.bool_)
    value, num_sweeps = energy(labels), 0
    while num_sweeps < max_sweeps and not settled.all():
        num_sweeps += 1
        for alpha in _order(num_labels, generator):
            if settled[alpha]:
                continue
            moved = energy.expanded(labels, alpha)
            lower = energy(moved)
            if lower < value:
                labels, value = moved, lower
                settled[:] = False
            settled[alpha] = True
    return Labeling(torch.from_numpy(labels).to(device), value, num_sweeps, bool(settled.all()))


def _order(num_labels: int, generator: torch.Generator | None) -> list[int]:
    if generator is None:
        return list(range(num_labels))
    order: list[int] = torch.randperm(num_labels, generator=generator, device=generator.device).tolist()
    return order


def _cut(unary: Floats, edges: Integers, forward: Floats, backward: Floats) -> tuple[Flags, float]:
    """Return which nodes (N,) lie on the sink's side, where they pay ``unary``, and the bound of the rounding."""
    fixed, unary, alive = _plain_sides(unary, edges, forward, backward)
    nodes = np.flatnonzero(fixed < 0)
    side = fixed > 0
    if not len(nodes):
        return side, 0.0
    number = np.empty(len(unary), dtype=np.int64)
    number[nodes] = np.arange(len(nodes))
    first, second = number[edges[alive]].T
    own = unary[nodes]
    origin, target = len(nodes), len(nodes) + 1
    payers, savers = np.flatnonzero(own > 0), np.flatnonzero(own < 0)
    rows = np.concatenate([first, second, np.full(len(payers), origin), savers])
    columns = np.concatenate([second, first, payers, np.full(len(savers), target)])
    capacities = np.concatenate([forward[alive], backward[alive], own[payers], -own[savers]])
    if not capacities.any():
        return side, 0.0
    arcs, error = _integers(capacities)
    graph = csr_matrix((arcs, (rows, columns)), shape=(target + 1, target + 1), dtype=np.int32)
    flow = maximum_flow(graph, origin, target)
    # Nodes that can still reach the sink lie on its side; in a tie, that is the fewest.
    residual = (graph - flow.flow).T.tocsr()
    residual.eliminate_zeros()
    on_sink = np.zeros(target + 1, dtype=np.bool_)
    on_sink[breadth_first_order(residual, target, return_predecessors=False)] = True
    cut = int(arcs[~on_sink[rows] & on_sink[columns]].sum(dtype=np.int64))
    if cut != flow.flow_value:
        raise SolverError(f"the maximum flow is {flow.flow_value} but the cut carries {cut}; please report the graph")
    side[nodes] = on_sink[:-2]
    return side, error


def _plain_sides(
    unary: Floats, edges: Integers, forward: Floats, backward: Floats
) -> tuple[NDArray[np.int8], Floats, Integers]:
    """Return nodes' sides (1 sink, 0 source, -1 open), costs with what fixed neighbors add, and edges still open.

    A node that pays more on one side than all its arcs could save there belongs to the other, whatever the rest does.
    """
    num_nodes = len(unary)
    fixed = np.full(num_nodes, -1, dtype=np.int8)
    alive = np.flatnonzero((forward > 0) | (backward > 0))
    for _ in range(_MAX_ROUNDS):
        first, second = edges[alive].T
        ahead, back = forward[alive], backward[alive]
        leaving = _sums(first, ahead, num_nodes) + _sums(second, back, num_nodes)
        arriving = _sums(second, ahead, num_nodes) + _sums(first, back, num_nodes)
        new_source = (fixed < 0) & (unary >= leaving)
        new_sink = (fixed < 0) & (-unary > arriving)
        num_new = np.count_nonzero(new_source) + np.count_nonzero(new_sink)
        fixed[new_source], fixed[new_sink] = 0, 1
        of_first, of_second = fixed[first], fixed[second]
        unary = unary + _sums(second, np.where(of_first == 0, ahead, np.where(of_first == 1, -back, 0.0)), num_nodes)
        unary = unary + _sums(first, np.where(of_second == 0, back, np.where(of_second == 1, -ahead, 0.0)), num_nodes)
        alive = alive[(of_first < 0) & (of_second < 0)]
        if num_new <= _WORTHWHILE_SHARE * np.count_nonzero(fixed < 0):
            break
    return fixed, unary, alive


def _integers(capacities: Floats) -> tuple[NDArray[np.int32], float]:
    """Return capacities times a power of two, rounded so that their sum fits 32 bits, and the sum of the roundings."""
    # Beyond 2^31 in sum, flows or residuals can overflow; a single such capacity even gives a silent flow of zero.
    exponent = math.floor(math.log2((_MAX_CAPACITY - len(capacities)) / capacities.sum()))
    arcs = np.rint(np.ldexp(capacities, exponent))
    return arcs.astype(np.int32), float(np.abs(np.ldexp(arcs, -exponent) - capacities).sum())


def _sums(index: Integers, values: Floats, size: int) -> Floats:
    sums: Floats = np.bincount(index, weights=values, minlength=size).astype(np.float64, copy=False)
    return sums


def _edges(edges: Any, num_nodes: int) -> Integers:
    """Return checked edges (E, 2)."""
    edges = as_tensor(edges, "edges", "integers")
    if edges.is_floating_point() or edges.is_complex() or edges.dtype == torch.bool:
        raise InputTypeError(f"edges must hold integers, got dtype {edges.dtype}")
    check_shape(edges, "edges", ("E", 2))
    pairs: Integers = edges.detach().cpu().long().numpy()
    if len(pairs) and (pairs.min() < 0 or pairs.max() >= num_nodes):
        raise InputError(f"edges must name nodes 0 to {num_nodes - 1}, got {pairs.min()} to {pairs.max()}")
    loops = int((pairs[:, 0] == pairs[:, 1]).sum())
    if loops:
        raise InputError(f"edges must join different nodes, got {loops} that join a node to itself; leave them out")
    return pairs


def _not_negative(values: Any, name: str, shape: tuple[str], size: int) -> Floats:
    """Return ``values`` as float64, checked to be finite, not negative and ``size`` long."""
    values = as_float_tensor(values, name)
    check_shape(values, name, shape)
    if len(values) != size:
        raise InputError(f"{name} must have {size} entries, one per {_OWNERS[shape[0]]}, got {len(values)}")
    check_finite(values, name)
    if bool((values < 0).any()):
        raise InputError(f"{name} must not be negative, got {float(values.min())}")
    array: Floats = values.detach().cpu().double().numpy()
    return array


def _seams(places: Any, weights: Any, num_edges: int, num_labels: int) -> _Seams | None:
    """Return the checked costs of places (E, L, D), if there are any."""
    if places is None:
        if weights is not None:
            raise InputError("place_weights are those of places; give both or neither")
        return None
    places = as_float_tensor(places, "places")
    check_shape(places, "places", (num_edges, num_labels, "D"))
    check_finite(places, "places")
    table: Floats = places.detach().cpu().double().numpy()
    if weights is None:
        return _Seams(table, np.ones(num_edges))
    return _Seams(table, _not_negative(weights, "place_weights", ("E",), num_edges))


def _metric(metric: Any, num_labels: int) -> Floats:
    """Return the checked metric (L, L), Potts by default."""
    if metric is None:
        return 1.0 - np.eye(num_labels)
    metric = as_float_tensor(metric, "metric")
    check_shape(metric, "metric", (num_labels, num_labels))
    check_finite(metric, "metric")
    table: Floats = metric.detach().cpu().double().numpy()
    slack = _METRIC_SLACK * np.abs(table).max()
    detours = table[:, :, None] + table[None, :, :]
    if (table < 0).any() or table.diagonal().any() or (np.abs(table - table.T) > slack).any():
        raise InputError("metric must be symmetric, not negative, and zero on the diagonal")
    if (table[:, None, :] > detours + slack).any():
        raise InputError("metric must obey the triangle inequality; expansion moves are not defined without it")
    return 0.5 * (table + table.T)


def _initial(initial: Any, num_nodes: int, num_labels: int) -> Integers:
    """Return checked initial labels (N,)."""
    initial = as_tensor(initial, "initial", "labels")
    if initial.is_floating_point() or initial.is_complex() or initial.dtype == torch.bool:
        raise InputTypeError(f"initial must hold integers, got dtype {initial.dtype}")
    check_shape(initial, "initial", (num_nodes,))
    labels: Integers = initial.detach().cpu().long().numpy().copy()
    if num_nodes and (labels.min() < 0 or labels.max() >= num_labels):
        raise InputError(f"initial must name labels 0 to {num_labels - 1}, got {labels.min()} to {labels.max()}")
    return labels
