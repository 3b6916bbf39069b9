"""Gauss-Newton steps of a deformation graph towards matches, all nodes at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.geometry.rigid import transform_points
from torchreg.registration.blend import turn_about
from torchreg.registration.dense.blend_sums import upper_triangles
from torchreg.registration.dense.deformation_graph import DeformationGraph
from torchreg.solvers.robust import cauchy_weight

# Relative damping: nodes that carry no match follow their neighbors; alone they stay. More is added where a step goes
# too far: a piece of the graph that hardly any match holds could turn about it, and fly off along the tangent.
_DAMPINGS = (1e-9, 1e-7, 1e-5, 1e-3)


@dataclass(frozen=True)
class GraphMatches:
    """Where samples should go.

    Args:
        which: (n,) samples of the graph, or a slice of them.
        targets: (n, 3).
        weights: (n,) how much each counts, not negative.
        normals: (n, 3) of the targets, or None for targets that hold in all directions alike.
        tangential_weight: how much a residual along the surface counts against one across it, squared; one number, or
            (n,) of each; without normals, in all directions.
    """

    which: Tensor | slice
    targets: Tensor
    weights: Tensor
    normals: Tensor | None = None
    tangential_weight: float | Tensor = 1.0

    @classmethod
    def of_places(cls, places: Tensor) -> GraphMatches:
        """Return matches of the first samples with places (n, 3), that all count alike."""
        return cls(slice(0, len(places)), places, torch.ones_like(places[:, 0]))


@dataclass(frozen=True)
class GraphFit:
    """The result of Gauss-Newton steps.

    Args:
        transforms: (J, 4, 4).
        residual: weighted mean squared residual before the last step.
        smoothness: weighted sum of squared gaps between neighbors, over the number of nodes, before the last step.
    """

    transforms: Tensor
    residual: float
    smoothness: float


def fit_graph(
    graph: DeformationGraph,
    transforms: Tensor,
    matches: GraphMatches | Sequence[GraphMatches],
    stiffness: float,
    num_steps: int = 1,
    *,
    edge_scale: float | None = None,
) -> GraphFit:
    """Return the motions after Gauss-Newton steps on matches and stiffness.

    ``E = mean_i w_i (d_i^T (n_i n_i^T + t I) d_i) + stiffness / J sum_e w_e |gap_e|^2``, d_i a sample's residual, t the
    tangential weight, and gap_e how far neighboring nodes disagree about each other, see `DeformationGraph.edge_gaps`.
    With an ``edge_scale``, w_e is divided by ``1 + r_e^2 / edge_scale^2`` before each step, r_e the root mean square of
    the edge's two gaps: parts stay rigid, and what they do not share, joints take up. No step shifts a node by more
    than the diagonal of the samples or the largest residual. Several sets of matches add up, each by its own mean.

    ``num_steps``: linear systems, at least one, none of them tested: the caller finds new matches before long.
    ``edge_scale``: see above, in the unit of the points; None for edges that are never let go.

    References: Sumner, Schmid and Pauly 2007, section 4; Chang and Zwicker 2009, eq. 5, for the steps on twists.
    """
    check_count(num_steps, "num_steps", 1)
    check_positive(stiffness, "stiffness", allow_zero=True)
    if edge_scale is not None:
        check_positive(edge_scale, "edge_scale")
    several = [matches] if isinstance(matches, GraphMatches) else matches
    residual = smoothness = 0.0
    size = float((graph.points.amax(0) - graph.points.amin(0)).norm())
    for _ in range(num_steps):
        middles = transform_points(transforms, graph.centers.unsqueeze(1)).squeeze(1)
        metrics, weighted_residuals, residual, smoothness, farthest = _costs(
            graph, graph.sums.places(transforms), several, stiffness, edge_scale
        )
        twists = _solved(
            *graph.sums.normal_equations(transforms, middles, metrics, weighted_residuals), max(size, farthest)
        )
        transforms = turn_about(transforms, twists, middles)
    return GraphFit(transforms, residual, smoothness)


def _costs(
    graph: DeformationGraph, places: Tensor, matches: Sequence[GraphMatches], stiffness: float, edge_scale: float | None
) -> tuple[Tensor, Tensor, float, float, float]:
    """Return metrics (S + 2 E, 6), weighted residuals (S + 2 E, 3), costs of samples and gaps, the largest residual."""
    count, residual, farthest = len(graph.points), 0.0, 0.0
    metrics, weighted_residuals = places.new_zeros(len(places), 6), places.new_zeros(len(places), 3)
    for each in matches:
        shares, off = each.weights / max(1, len(each.weights)), places[:count][each.which] - each.targets
        weighted = torch.as_tensor(each.tangential_weight).to(off).reshape(-1, 1) * off
        if each.normals is not None:
            weighted = weighted + each.normals * (each.normals * off).sum(-1, keepdim=True)
        weighted = shares.unsqueeze(1) * weighted
        metric = upper_triangles(shares, each.normals, each.tangential_weight)
        for sums, part in ((metrics, metric), (weighted_residuals, weighted)):
            if isinstance(each.which, slice):
                sums[:count][each.which] += part
            else:
                sums.index_add_(0, each.which, part)
        residual += float((off * weighted).sum())
        farthest = max(farthest, float(off.norm(dim=-1).max())) if len(off) else farthest
    gap = places[count:].view(-1, 2, 3)
    apart = gap.square().sum((1, 2))
    weights = (
        graph.edge_weights if edge_scale is None else graph.edge_weights * cauchy_weight(apart / (2 * edge_scale**2))
    )
    held = (stiffness / graph.num_nodes * weights).repeat_interleave(2)
    metrics[count:] = upper_triangles(held, None, 1.0)
    weighted_residuals[count:] = held.unsqueeze(1) * places[count:]
    return metrics, weighted_residuals, residual, float((weights * apart).sum()) / graph.num_nodes, farthest


def _solved(gradient: Tensor, matrix: Tensor, farthest: float) -> Tensor:
    """Return the twists (J, 6) of a step that shifts no node by more than ``farthest``; none where there is no such."""
    diagonal = matrix.diagonal()
    mean = diagonal.mean()
    for damping in _DAMPINGS:
        diagonal += damping * mean + torch.finfo(matrix.dtype).tiny
        factor, info = torch.linalg.cholesky_ex(matrix)
        if int(info):
            continue
        twists = -torch.cholesky_solve(gradient.reshape(-1, 1), factor).view_as(gradient)
        if bool(twists[:, :3].norm(dim=-1).max() <= farthest):
            return twists
    return torch.zeros_like(gradient)
