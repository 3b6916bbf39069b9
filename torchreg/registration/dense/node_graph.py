"""Few nodes that carry a surface: spread evenly along it, each sample hung on the nearest ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_points
from torchreg.errors import InputError
from torchreg.geometry.graphs import Graph, minimum_spanning_forest
from torchreg.geometry.neighbors import k_nearest

# Two nodes are neighbors if what they carry in common weighs at least this many samples.
_LEAST_SHARED = 1e-3
# Weight by which any part of a graph is held to the rest, at least; that of an edge is one in the mean.
_LEAST_LINK = 1.0
# Shares below this count as this: a sample as far from its nearest node as from the next but four has any.
_LEAST_SHARE = 1e-6
# The few nodes nearest to a sample are mostly within so many times the distance of any sample from its nearest one.
_REACHES = 3.0


@dataclass(frozen=True, eq=False)
class NodeGraph:
    """Nodes, what hangs on them, and which of them are neighbors.

    Args:
        nodes: (J,) int64 samples that are nodes.
        nearest: (S, K) int64 nodes that each sample hangs on, the nearest first.
        weights: (S, K) float64 by how much; rows sum to one.
        edges: (E, 2) int64 neighbors, the smaller index first.
        edge_weights: (E,) float64, how much they carry in common, one in the mean; more where little else holds.
    """

    nodes: Tensor
    nearest: Tensor
    weights: Tensor
    edges: Tensor
    edge_weights: Tensor

    def dense_weights(self) -> Tensor:
        """Return the weights of all nodes, (S, J)."""
        return self.weights.new_zeros(len(self.weights), len(self.nodes)).scatter_add(1, self.nearest, self.weights)


def build_node_graph(graph: Graph, start: int, num_nodes: int, num_nearest: int = 4) -> NodeGraph:
    """Return nodes chosen by farthest-point sampling along a surface, and the samples hung on them.

    A sample at distances ``d_1 <= d_2 <= ...`` from the nodes follows the first K with weights in proportion to
    ``(1 - d_k / d_{K+1})^2``.

    ``graph``: of the samples; every sample should be reached from every other one.

    References: Sumner, Schmid and Pauly 2007, section 3.
    """
    check_count(num_nodes, "num_nodes", 1)
    check_count(num_nearest, "num_nearest", 1)
    if not 0 <= start < len(graph):
        raise InputError(f"start must be one of {len(graph)} samples, got {start}")
    nodes, reach = _spread(graph, start, min(num_nodes, len(graph)))
    index, weights = _shares(_distances(graph, nodes, reach, num_nearest), num_nearest)
    edges, edge_weights = _neighbors(index, weights, len(nodes))
    return NodeGraph(nodes, index, weights, edges, edge_weights)


def _spread(graph: Graph, start: int, count: int) -> tuple[Tensor, float]:
    """Return ``count`` samples (J,), each farthest from those before it, and how far any sample is from all of them."""
    nodes, nearest = [start], graph.distances(torch.tensor([start]))[0]
    while len(nodes) < count:
        nodes.append(int(nearest.argmax()))
        # Farther away than this, another node is nearer.
        nearest = torch.minimum(nearest, graph.distances(torch.tensor(nodes[-1:]), limit=float(nearest.max()))[0])
    return torch.tensor(nodes), float(nearest.max())


def _distances(graph: Graph, nodes: Tensor, reach: float, num_nearest: int) -> Tensor:
    """Return distances (S, J) of samples from nodes; infinite for some that are not among the nearest of a sample."""
    near = graph.distances(nodes, limit=_REACHES * reach).mT
    if int(near.isfinite().sum(1).min()) > min(num_nearest, len(nodes) - 1):
        return near
    return graph.distances(nodes).mT


def _shares(distance: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return nodes (S, K) and weights of samples at distances (S, J) from the nodes."""
    count = max(1, min(count, distance.shape[1] - 1))
    order = distance.argsort(dim=1, stable=True)[:, : count + 1]
    near = distance.gather(1, order)
    reach = near[:, -1:].clamp_min(torch.finfo(near.dtype).tiny)
    share = (1 - near[:, :count] / reach).nan_to_num(0.0).clamp_min(_LEAST_SHARE).square()
    return order[:, :count], share / share.sum(1, keepdim=True)


def _neighbors(nearest: Tensor, weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return pairs of nodes (E, 2) that carry the same samples, and by how much."""
    dense = weights.new_zeros(len(weights), count).scatter_add(1, nearest, weights)
    shared = (dense.mT @ dense).triu(1)
    edges = (shared > _LEAST_SHARED).nonzero()
    if len(edges) == 0:
        return edges, shared.new_zeros(0)
    weight = shared[edges[:, 0], edges[:, 1]]
    weight = weight / weight.mean()
    return edges, _firmly_linked(edges, weight, count)


def _firmly_linked(edges: Tensor, weights: Tensor, count: int) -> Tensor:
    """Return weights (E,) of edges by which every part of a graph hangs firmly on the rest.

    Those of a maximum spanning tree are raised: across the gaps around islands of a scan samples share next to nothing.
    """
    held = minimum_spanning_forest(edges, -weights, count).chosen()
    return weights.index_copy(0, held, weights[held].clamp(min=_LEAST_LINK))


def spread_weights(
    points: Tensor, normals: Tensor, samples: Tensor, sample_normals: Tensor, weights: Tensor, normal_scale: float
) -> Tensor:
    """Return weights (N, J) of points from those (S, J) of the three samples nearest in place and normal.

    ``normal_scale``: what opposite normals count as, in the unit of the points: it keeps the front of a thin limb from
    following the back of another.
    """
    points = as_float_tensor(points, "points")
    check_points(points, "points", batch=False)
    scale = 0.5 * normal_scale
    here, there = (torch.cat(pair, dim=1) for pair in ((points, scale * normals), (samples, scale * sample_normals)))
    index, distance = k_nearest(here, there, min(3, len(samples)))
    # A point at a sample follows that one alone.
    share = 1 / (distance + 1e-9 * distance.mean().clamp_min(torch.finfo(distance.dtype).tiny))
    share = (share / share.sum(1, keepdim=True)).to(weights)
    return torch.einsum("nk,nkj->nj", share, weights[index])
