"""Minimum cuts, and labelings of graphs by alpha-expansion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from torch import Tensor

from torchreg.errors import SolverError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class _Reduction:
    """Rounds that fix nodes of plain side before the maximum flow."""

    max_rounds: int = 12
    # Share of open nodes fixed in a round below which further rounds do not pay.
    worthwhile_share: float = 0.02


_REDUCTION = _Reduction()


@dataclass(frozen=True)
class Labeling:
    """Labels (N,) int64 and their energy; ``converged`` where no expansion lowers it any more."""

    labels: Tensor
    energy: float
    num_sweeps: int
    converged: bool


def alpha_expansion(
    unary: Tensor,
    edges: Tensor,
    weights: Tensor,
    *,
    positions: Tensor | None = None,
    position_weights: Tensor | None = None,
    label_costs: Tensor | None = None,
    initial: Tensor | None = None,
    max_sweeps: int = 20,
) -> Labeling:
    """Return labels that lower ``sum_i U_i(f_i) + sum_ij V_ij(f_i, f_j) + sum_l h_l [l is used]``.

    ``V_ij(a, b) = w_ij [a != b] + t_ij min(|p_ij(a) - p_ij(b)|, 1)``: a Potts term, and the distance between the
    positions p (E, L, D) to which two labels move the edge, in units of the distance at which the cost saturates.

    Each expansion is one minimum cut; the energy never rises. Two labels end in the least energy, more labels, without
    label costs and with ``U >= 0``, within ``2 max V_ij / min V_ij`` times the least (2 for Potts; Boykov, Veksler and
    Zabih 2001; Kolmogorov and Zabih 2004; Delong et al. 2012 for label costs; Kwatra et al. 2003 for seams).
    """
    num_labels = unary.shape[1]
    seams = None
    if positions is not None:
        scale = np.ones(len(edges)) if position_weights is None else _float64_array(position_weights)
        seams = _Seams(positions=_float64_array(positions), weights=scale)
    energy = _LabelingEnergy(
        unary=_float64_array(unary),
        edges=edges.detach().cpu().long().numpy(),
        weights=_float64_array(weights),
        label_costs=np.zeros(num_labels) if label_costs is None else _float64_array(label_costs),
        seams=seams,
    )
    labels = energy.unary.argmin(1) if initial is None else initial.detach().cpu().long().numpy().copy()
    return _sweep(energy, labels, max_sweeps, unary.device)


def _float64_array(values: Tensor) -> Floats:
    array: Floats = values.detach().cpu().double().numpy()
    return array


@dataclass(frozen=True)
class _Seams:
    """Costs of two labels that move an edge to different positions."""

    positions: Floats
    weights: Floats

    def __call__(self, first: Integers, second: Integers) -> Floats:
        """Return the costs (E,) of labels (E,) at the first and the second ends of the edges."""
        every = np.arange(len(self.positions))
        offset = self.positions[every, first] - self.positions[every, second]
        costs: Floats = self.weights * np.minimum(np.sqrt(np.einsum("ed,ed->e", offset, offset)), 1.0)
        return costs


@dataclass(frozen=True)
class _LabelingEnergy:
    """An energy over labelings, in float64, see `alpha_expansion`."""

    unary: Floats
    edges: Integers
    weights: Floats
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
        gain = gain + _node_sums(self.edges[:, 0], 0.5 * (first_moves - stay - second_moves), num_nodes)
        gain = gain + _node_sums(self.edges[:, 1], 0.5 * (second_moves - stay - first_moves), num_nodes)
        extra, extra_edges, extra_arcs = self._label_nodes(labels, alpha)
        moved, _ = min_cut(
            np.concatenate([gain, extra]),
            np.concatenate([self.edges, extra_edges]),
            np.concatenate([arc, extra_arcs]),
            np.concatenate([arc, np.zeros_like(extra_arcs)]),
        )
        return np.where(moved[:num_nodes], alpha, labels)

    def _between(self, first: Integers, second: Integers) -> Floats:
        """Return the costs (E,) of labels (E,) at the first and the second ends of the edges."""
        costs: Floats = self.weights * (first != second)
        return costs if self.seams is None else costs + self.seams(first, second)

    def _label_nodes(self, labels: Integers, alpha: int) -> tuple[Floats, Integers, Floats]:
        """Return terminal costs, edges and arcs of an auxiliary node per label whose cost a move can save or incur."""
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


def _sweep(energy: _LabelingEnergy, labels: Integers, max_sweeps: int, device: torch.device) -> Labeling:
    """Return the labeling after expansions of all labels in turn, skipping those since whose turn nothing changed."""
    unchanged = np.zeros(len(energy.label_costs), dtype=np.bool_)
    value, num_sweeps = energy(labels), 0
    while num_sweeps < max_sweeps and not unchanged.all():
        num_sweeps += 1
        for alpha in range(len(unchanged)):
            if unchanged[alpha]:
                continue
            moved = energy.expanded(labels, alpha)
            lower = energy(moved)
            if lower < value:
                labels, value = moved, lower
                unchanged[:] = False
            unchanged[alpha] = True
    return Labeling(torch.from_numpy(labels).to(device), value, num_sweeps, bool(unchanged.all()))


def min_cut(unary: Floats, edges: Integers, forward: Floats, backward: Floats) -> tuple[Flags, float]:
    """Return the least cut, ``min_x sum_i u_i x_i + sum_ij (1 - x_i) x_j c_ij + x_i (1 - x_j) r_ij``, of N nodes.

    That is a mask (N,) of the nodes on the sink's side, the smallest of several least cuts, and a bound on its excess:
    capacities are rounded to 32-bit integers, after nodes whose side follows from their own costs are fixed (Boykov and
    Kolmogorov 2004; Hammer, Hansen and Simeone 1984).
    """
    fixed, unary, alive = _plain_sides(unary, edges, forward, backward)
    nodes = np.flatnonzero(fixed < 0)
    side = fixed > 0
    if not len(nodes):
        return side, 0.0
    number = np.empty(len(unary), dtype=np.int64)
    number[nodes] = np.arange(len(nodes))
    first, second = number[edges[alive]].T
    terminal = unary[nodes]
    origin, target = len(nodes), len(nodes) + 1
    from_source, to_sink = np.flatnonzero(terminal > 0), np.flatnonzero(terminal < 0)
    rows = np.concatenate([first, second, np.full(len(from_source), origin), to_sink])
    columns = np.concatenate([second, first, from_source, np.full(len(to_sink), target)])
    capacities = np.concatenate([forward[alive], backward[alive], terminal[from_source], -terminal[to_sink]])
    if not capacities.any():
        return side, 0.0
    arcs, error = _integers(capacities)
    graph = csr_matrix((arcs, (rows, columns)), shape=(target + 1, target + 1), dtype=np.int32)
    flow = maximum_flow(graph, origin, target)
    # Nodes that can still reach the sink lie on its side: the smallest side of several least cuts.
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
    """Return sides (1 sink, 0 source, -1 open) of the nodes, costs that count fixed neighbors, and open edges."""
    num_nodes = len(unary)
    fixed = np.full(num_nodes, -1, dtype=np.int8)
    alive = np.flatnonzero((forward > 0) | (backward > 0))
    for _ in range(_REDUCTION.max_rounds):
        first, second = edges[alive].T
        ahead, back = forward[alive], backward[alive]
        leaving = _node_sums(first, ahead, num_nodes) + _node_sums(second, back, num_nodes)
        arriving = _node_sums(second, ahead, num_nodes) + _node_sums(first, back, num_nodes)
        new_source = (fixed < 0) & (unary >= leaving)
        new_sink = (fixed < 0) & (-unary > arriving)
        num_new = np.count_nonzero(new_source) + np.count_nonzero(new_sink)
        fixed[new_source], fixed[new_sink] = 0, 1
        # Arcs to fixed neighbors add to the costs of the open nodes.
        of_first, of_second = fixed[first], fixed[second]
        to_second = np.where(of_first == 0, ahead, np.where(of_first == 1, -back, 0.0))
        to_first = np.where(of_second == 0, back, np.where(of_second == 1, -ahead, 0.0))
        unary = unary + _node_sums(second, to_second, num_nodes)
        unary = unary + _node_sums(first, to_first, num_nodes)
        alive = alive[(of_first < 0) & (of_second < 0)]
        if num_new <= _REDUCTION.worthwhile_share * np.count_nonzero(fixed < 0):
            break
    return fixed, unary, alive


def _integers(capacities: Floats) -> tuple[NDArray[np.int32], float]:
    """Return capacities times a power of two, rounded so that their sum fits 32 bits, and the sum of the roundings."""
    # Beyond 2^31 in sum, flows or residuals can overflow; a single such capacity even gives a silent flow of zero.
    largest = np.iinfo(np.int32).max - len(capacities)
    exponent = math.floor(math.log2(largest / capacities.sum()))
    arcs = np.rint(np.ldexp(capacities, exponent))
    return arcs.astype(np.int32), float(np.abs(np.ldexp(arcs, -exponent) - capacities).sum())


def _node_sums(index: Integers, values: Floats, size: int) -> Floats:
    """Return the sums (N,) of the values of each node."""
    sums: Floats = np.bincount(index, weights=values, minlength=size).astype(np.float64, copy=False)
    return sums
