"""Limbs of a deformation graph: what lies around its tips, and how one is laid where something else is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph
from torchreg.geometry.rigid import transform_points
from torchreg.registration.dense.deformation_graph import DeformationGraph
from torchreg.registration.dense.graph_fit import GraphMatches, fit_graph

# No more of a limb than this is laid elsewhere, and only on what has its tip within this: lengths.
LONGEST, FARTHEST = 0.45, 0.45
# Points of a limb, and of what it is laid on, at least.
_LEAST_POINTS = 10
# Width of what counts as equally far from the tip, length.
_LEVEL = 0.04
# How a graph is taken to where a limb is laid: stiffness and Gauss-Newton steps.
_STIFFNESS, _FITS = 0.01, 2


@dataclass(frozen=True, eq=False)
class Limbs:
    """Tips of a graph, nodes that are farther from all others, in the mean, than those around them.

    Args:
        graph: the graph, of S samples.
        tips: (K,) nodes.
        between: (K, K) distances of the tips from each other along the graph.
        levels: (K, S) those of the samples from each tip.
    """

    graph: DeformationGraph
    tips: Tensor
    between: Tensor
    levels: Tensor

    @classmethod
    def of(cls, graph: DeformationGraph) -> Limbs:
        """Return the limbs of a graph."""
        one, other = graph.centers[graph.edges].unbind(1)
        steps = Graph.from_edges(graph.edges, (one - other).norm(dim=-1), graph.num_nodes)
        ways = finite_ways(steps.distances())
        mean = ways.mean(1)
        tips = (mean >= torch.where(graph.within(2), mean, 0.0).amax(1)).nonzero()[:, 0]
        return cls(graph, tips, ways[tips][:, tips], ways[tips][:, graph.dense_weights.argmax(1)])

    def places(self, transforms: Tensor) -> Tensor:
        """Return where motions (J, 4, 4) take the tips, (K, 3)."""
        return transform_points(transforms[self.tips], self.graph.centers[self.tips].unsqueeze(1)).squeeze(1)

    def laid(self, transforms: Tensor, places: Tensor) -> Tensor:
        """Return motions (J, 4, 4) that take samples roughly to places (S, 3)."""
        return fit_graph(self.graph, transforms, GraphMatches.of_places(places), _STIFFNESS, _FITS).transforms


def finite_ways(ways: Tensor) -> Tensor:
    """Return distances along a graph, between its pieces twice the longest."""
    return ways.nan_to_num(posinf=2 * float(ways[ways.isfinite()].max()))


def shift_onto(points: Tensor, levels: Tensor, others: Tensor, other_levels: Tensor, length: float) -> Tensor | None:
    """Return by how much to shift points (P, 3) to lay a limb on another one; none if there is too little of one.

    Both are cut into levels equally far from their tips. What is shifted is what lies between the middles of a level,
    ever less towards the root.

    Args:
        points: (P, 3) among which the limb is.
        levels: (P,) how far they are from its tip, along the surface.
        others: (Q, 3) among which the other limb is.
        other_levels: (Q,) the same of its tip.
        length: of both limbs.

    Returns:
        (P, 3), zero beyond the limb.
    """
    limb, other = levels < length, other_levels < length
    if min(int(limb.sum()), int(other.sum())) < _LEAST_POINTS:
        return None
    at = levels[limb]
    apart = _middles(at, other_levels[other], others[other]) - _middles(at, at, points[limb])
    shift = torch.zeros_like(points)
    shift[limb] = (1 - at / length).sqrt().unsqueeze(1) * apart
    return shift


def _middles(at: Tensor, levels: Tensor, points: Tensor) -> Tensor:
    """Return the mean places (A, 3) of points about as far from the tip as asked for."""
    weights = torch.softmax(-0.5 * ((at.unsqueeze(1) - levels) / _LEVEL).square(), dim=1)
    return weights @ points
