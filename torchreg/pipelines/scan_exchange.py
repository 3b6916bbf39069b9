"""Limbs that may have been taken for one another: starts in which two of them change places."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.rigid import transform_points
from torchreg.models.deformation_graph import DeformationGraph
from torchreg.pipelines.graph_fit import GraphMatches, fit_graph
from torchreg.pipelines.scan_align_problem import ScanAlignProblem

# Limbs whose tips are farther apart than this are not exchanged, and no more of a limb than this: lengths.
_FARTHEST, _LONGEST = 0.45, 0.45
# Pairs of limbs at most, those with the nearest tips, and samples of a limb at least.
_MOST_PAIRS, _LEAST_SAMPLES = 8, 10
# Width of what counts as equally far from the tip, length.
_LEVEL = 0.04
# How a graph is taken to where limbs have changed places: stiffness and Gauss-Newton steps.
_STIFFNESS, _FITS = 0.01, 2


def exchanged_limbs(problem: ScanAlignProblem, transforms: Tensor) -> list[Tensor]:
    """Return motions of the nodes, in each of which two limbs lie roughly where the other one lay.

    Legs that pass each other between two scans end on each other's places, which nearest matches do not mend. A limb is
    what is nearer to its tip, along the graph, than half the way to the other limb's tip; tips are nodes that are
    farther from all others, in the mean, than those around them. Samples are shifted by what lies between the middles
    of both limbs equally far from the tips, ever less towards the roots.

    Args:
        problem: the scans.
        transforms: (J, 4, 4) to change.

    Returns:
        motions (J, 4, 4), those of limbs whose tips are nearest to each other first; none without two limbs.

    Cost: 10 ms for each pair of limbs of a graph of 60 nodes.
    """
    graph, ways = problem.graph, _ways(problem.graph)
    tips, moved = _tips(graph, ways), graph(transforms)
    levels = ways[tips][:, graph.dense_weights.argmax(1)]
    places = transform_points(transforms[tips], graph.centers[tips].unsqueeze(1)).squeeze(1)
    apart = torch.cdist(places, places)
    pairs = torch.combinations(torch.arange(len(tips)))
    pairs = pairs[apart[pairs[:, 0], pairs[:, 1]] < _FARTHEST]
    pairs = pairs[apart[pairs[:, 0], pairs[:, 1]].argsort(stable=True)[:_MOST_PAIRS]]
    targets = [_swapped(moved, levels[pair], float(ways[tuple(tips[pair])])) for pair in pairs]
    matches = [GraphMatches.of_places(there) for there in targets if there is not None]
    return [fit_graph(graph, transforms, each, _STIFFNESS, _FITS).transforms for each in matches]


def _ways(graph: DeformationGraph) -> Tensor:
    """Return distances (J, J) between nodes along the graph; between its pieces twice the longest."""
    one, other = graph.centers[graph.edges].unbind(1)
    ways = GeodesicGraph.from_steps(graph.edges, (one - other).norm(dim=-1), graph.num_nodes).distances()
    return ways.nan_to_num(posinf=2 * float(ways[ways.isfinite()].max()))


def _tips(graph: DeformationGraph, ways: Tensor) -> Tensor:
    """Return the nodes (K,) farthest from all others, in the mean, among those within two edges."""
    mean = ways.mean(1)
    return (mean >= torch.where(graph.within(2), mean, 0.0).amax(1)).nonzero()[:, 0]


def _swapped(moved: Tensor, levels: Tensor, between: float) -> Tensor | None:
    """Return places (S, 3) of samples with two limbs exchanged, none if there is too little of one.

    Args:
        moved: (S, 3) where they are.
        levels: (2, S) their distances from both tips along the graph.
        between: that of the tips from each other.
    """
    length = min(between / 2, _LONGEST)
    limbs = [(level < length).nonzero()[:, 0] for level in levels]
    if min(len(limb) for limb in limbs) < _LEAST_SAMPLES:
        return None
    targets = moved.clone()
    for one, other in ((0, 1), (1, 0)):
        at = levels[one, limbs[one]]
        here, there = (_middles(at, levels[side, limbs[side]], moved[limbs[side]]) for side in (one, other))
        targets[limbs[one]] += (1 - at / length).sqrt().unsqueeze(1) * (there - here)
    return targets


def _middles(at: Tensor, levels: Tensor, points: Tensor) -> Tensor:
    """Return the mean places (A, 3) of points about as far from the tip as asked for."""
    weights = torch.softmax(-0.5 * ((at.unsqueeze(1) - levels) / _LEVEL).square(), dim=1)
    return weights @ points
