"""Gauss-Newton steps of a deformation graph towards matches, all nodes at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.geometry.blend import turn_about
from torchreg.geometry.rigid import transform_points
from torchreg.models.deformation_graph import DeformationGraph
from torchreg.solvers.levenberg_marquardt import Linearization

# Relative damping: nodes that carry no match follow their neighbors; alone they stay.
_DAMPING = 1e-9
# Samples whose blocks are added in one go: in cache.
_CHUNK = 200


@dataclass(frozen=True)
class GraphMatches:
    """Where samples should go.

    Args:
        which: (n,) samples of the graph, or a slice of them.
        targets: (n, 3).
        weights: (n,) how much each counts, not negative.
        normals: (n, 3) of the targets, or None for targets that hold in all directions alike.
        slide: how much a miss along the surface counts against one across it, squared; one number, or (n,) of each; 1
            without normals.
    """

    which: Tensor | slice
    targets: Tensor
    weights: Tensor
    normals: Tensor | None = None
    slide: float | Tensor = 1.0


def joined(first: GraphMatches, *others: GraphMatches) -> GraphMatches:
    """Return matches that cost what several cost, all of them over the number of the first."""
    if not others:
        return first
    parts = zip(*(_tensors(matches) for matches in (first, *others)), strict=True)
    which, targets, weights, normals, slide = (torch.cat(values) for values in parts)
    # What is fitted is a mean over the matches.
    return GraphMatches(which, targets, weights * (len(which) / max(1, len(first.weights))), normals, slide)


def _tensors(matches: GraphMatches) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return samples, targets, weights, normals and slides of matches, one of each per match."""
    which, count = matches.which, len(matches.weights)
    if isinstance(which, slice):
        stop = count if which.stop is None else which.stop
        which = torch.arange(*which.indices(stop), device=matches.targets.device)
    normals = torch.zeros_like(matches.targets) if matches.normals is None else matches.normals
    slide = torch.as_tensor(matches.slide).to(matches.weights).expand(count)
    return which, matches.targets, matches.weights, normals, slide


@dataclass(frozen=True)
class GraphFit:
    """Where steps have led.

    Args:
        transforms: (J, 4, 4).
        misses: weighted mean squared miss before the last step.
        gaps: weighted sum of squared gaps between neighbors, over the number of nodes, before the last step.
    """

    transforms: Tensor
    misses: float
    gaps: float


def fit_graph(
    graph: DeformationGraph,
    transforms: Tensor,
    matches: GraphMatches,
    stiffness: float,
    num_steps: int = 1,
    *,
    give: float | None = None,
) -> GraphFit:
    """Return the motions after Gauss-Newton steps on matches and stiffness.

    ``E = mean_i w_i (d_i^T (n_i n_i^T + slide I) d_i) + stiffness / J sum_e w_e |gap_e|^2``, d_i a sample's miss and
    gap_e how far neighboring nodes disagree about each other, see `DeformationGraph.edge_gaps`. With a ``give``, w_e is
    divided by ``1 + r_e^2 / give^2`` before each step, r_e the root mean square of the edge's two gaps: parts stay
    rigid, and what they do not share, joints take up.

    Args:
        graph: what is moved, float64.
        transforms: (J, 4, 4) to start from.
        matches: see `GraphMatches`.
        stiffness: see above.
        num_steps: linear systems, at least one, none of them tested: the caller finds new matches before long.
        give: see above, in the unit of the points; None for edges that never give.

    Returns:
        a `GraphFit`.

    Differentiable: no.

    Cost: 4 ms a step for 1,200 samples on 4 of 60 nodes each, on one core.

    References: Sumner, Schmid and Pauly 2007, section 4; Chang and Zwicker 2009, eq. 5, for the steps on twists.
    """
    check_count(num_steps, "num_steps", 1)
    check_positive(stiffness, "stiffness", allow_zero=True)
    if give is not None:
        check_positive(give, "give")
    misses = gaps = 0.0
    for _ in range(num_steps):
        middles = transform_points(transforms, graph.centers.unsqueeze(1)).squeeze(1)
        one, other = _of_matches(graph, transforms, middles, matches), _of_edges(graph, transforms, middles, give)
        misses, gaps = 2 * float(one.cost), 2 * float(other.cost) / graph.num_nodes
        share = stiffness / graph.num_nodes
        twists = _solved(one.hessian + share * other.hessian, one.gradient + share * other.gradient)
        transforms = turn_about(transforms, twists, middles)
    return GraphFit(transforms, misses, gaps)


def _of_matches(graph: DeformationGraph, transforms: Tensor, middles: Tensor, matches: GraphMatches) -> Linearization:
    """Return the first term, its gradient (J, 6) and Hessian (J, J, 6, 6)."""
    nearest, weights = graph.nearest[matches.which], graph.weights[matches.which]
    points = graph.points[matches.which]
    count, few = nearest.shape
    # Where each node alone would take the sample.
    rows = transforms[:, :3].flatten(1)[nearest].unflatten(-1, (3, 4))
    ends = rows[..., 3]
    for axis in range(3):  # sums over three numbers are slow
        ends = torch.addcmul(ends, rows[..., axis], points[:, axis, None, None])
    miss = (weights.unsqueeze(-1) * ends).sum(1) - matches.targets
    blocks = _by_twists(ends - middles[nearest], weights).flatten(2)
    slide = torch.as_tensor(matches.slide).to(points).reshape(-1, 1)
    pulled = slide.unsqueeze(-1) * blocks
    pull = slide * miss
    if matches.normals is not None:
        normal = matches.normals.unsqueeze(-1)
        pulled = pulled + normal * (normal.mT @ blocks)
        pull = pull + matches.normals * (matches.normals * miss).sum(-1, keepdim=True)
    share = (matches.weights / count)[:, None, None]
    blocks = share * blocks
    slope = (blocks.mT @ pull.unsqueeze(-1)).reshape(-1, 6)
    size = graph.num_nodes
    pair = nearest.unsqueeze(2) * size + nearest.unsqueeze(1)
    hessian = points.new_zeros(size * size, 36)
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        square = (blocks[part].mT @ pulled[part]).unflatten(2, (few, 6)).unflatten(1, (few, 6)).transpose(2, 3)
        hessian.index_add_(0, pair[part].reshape(-1), square.reshape(-1, 36))
    gradient = points.new_zeros(size, 6).index_add_(0, nearest.reshape(-1), slope)
    cost = 0.5 * (share[:, 0] * miss * pull).sum()
    return Linearization(cost, gradient, hessian.view(size, size, 6, 6))


def _by_twists(arms: Tensor, weights: Tensor) -> Tensor:
    """Return derivatives (n, 3, K, 6) of weighted places by nodes' twists: shift by v, turn about the middle by w.

    Args:
        arms: (n, K, 3) of the places, from the nodes' middles.
        weights: (n, K) of the places.
    """
    x, y, z = (weights.unsqueeze(-1) * arms).unbind(-1)
    # Filled in: stacking matrices of three by three takes four times as long.
    blocks = arms.new_zeros(len(arms), 3, arms.shape[1], 6)
    blocks[:, 0, :, 0] = blocks[:, 1, :, 1] = blocks[:, 2, :, 2] = weights
    blocks[:, 0, :, 4], blocks[:, 1, :, 5], blocks[:, 2, :, 3] = z, x, y
    blocks[:, 0, :, 5], blocks[:, 1, :, 3], blocks[:, 2, :, 4] = -y, -z, -x
    return blocks


def _of_edges(graph: DeformationGraph, transforms: Tensor, middles: Tensor, give: float | None) -> Linearization:
    """Return the sum of squared gaps, its gradient (J, 6) and Hessian (J, J, 6, 6)."""
    size, ends = graph.num_nodes, graph.edges
    both, gap = graph.centers[ends], graph.edge_gaps(transforms)
    weight = graph.edge_weights[:, None, None]
    if give is not None:
        weight = weight / (1 + gap.square().sum((1, 2), keepdim=True) / (2 * give**2))
    # Derivatives of the two gaps (E, 6) by the twists of one node and, with the other sign, the other: (E, 6, 12).
    sides = []
    for node, sign in zip(ends.unbind(-1), (1.0, -1.0), strict=True):
        arms = transform_points(transforms[node], both) - middles[node].unsqueeze(1)
        sides.append(_by_twists(arms, arms.new_tensor(sign).expand(arms.shape[:-1])).transpose(1, 2).flatten(1, 2))
    blocks = torch.cat(sides, dim=-1)
    weighted = (weight * blocks).mT
    square = (weighted @ blocks).unflatten(2, (2, 6)).unflatten(1, (2, 6)).transpose(2, 3)
    pair = ends.unsqueeze(2) * size + ends.unsqueeze(1)
    hessian = transforms.new_zeros(size * size, 36).index_add_(0, pair.reshape(-1), square.reshape(-1, 36))
    slope = (weighted @ gap.flatten(1).unsqueeze(-1)).reshape(-1, 6)
    gradient = transforms.new_zeros(size, 6).index_add_(0, ends.reshape(-1), slope)
    cost = 0.5 * (weight * gap.square()).sum()
    return Linearization(cost, gradient, hessian.view(size, size, 6, 6))


def _solved(hessian: Tensor, gradient: Tensor) -> Tensor:
    """Return the twists (J, 6) of a step; none where the system has no Cholesky factor."""
    size = len(gradient)
    matrix = hessian.transpose(1, 2).reshape(6 * size, 6 * size)
    diagonal = matrix.diagonal()
    diagonal += _DAMPING * diagonal.mean() + torch.finfo(matrix.dtype).tiny
    factor, info = torch.linalg.cholesky_ex(matrix)
    if int(info):
        return torch.zeros_like(gradient)
    return -torch.cholesky_solve(gradient.reshape(-1, 1), factor).view(size, 6)
