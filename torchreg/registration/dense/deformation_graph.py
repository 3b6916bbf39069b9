"""Surfaces that follow many small nodes, each moving rigidly: how a scan moves before it has bones."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_finite, check_points, check_shape
from torchreg.errors import InputError
from torchreg.geometry.rigid import transform_points
from torchreg.registration.blend import blend_linear
from torchreg.registration.dense.blend_sums import BlendSums
from torchreg.registration.dense.node_graph import NodeGraph


class DeformationGraph(nn.Module):
    """A surface that follows nodes: ``D(x_i) = sum_k w_ik (R_k x_i + t_k)`` over the few nodes each sample hangs on.

    Args:
        points: (S, 3) samples of the surface.
        normals: (S, 3) unit vectors.
        graph: nodes among the samples, and weights; see `build_node_graph`.

    Attributes:
        centers: (J, 3) places of the nodes.
        nearest: (S, K) nodes of each sample.
        weights: (S, K) of those, rows sum to one.
        edges: (E, 2) nodes that are neighbors.
        edge_weights: (E,) how much the neighbors hold each other.

    References: Sumner, Schmid and Pauly 2007, section 3.
    """

    points: Tensor
    normals: Tensor
    centers: Tensor
    nearest: Tensor
    weights: Tensor
    dense_weights: Tensor
    edges: Tensor
    edge_weights: Tensor

    def __init__(self, points: Tensor, normals: Tensor, graph: NodeGraph) -> None:
        super().__init__()
        points = as_float_tensor(points, "points").detach()
        check_points(points, "points", batch=False)
        normals = as_float_tensor(normals, "normals", like=points).detach()
        check_shape(normals, "normals", tuple(points.shape))
        check_finite(normals, "normals")
        if len(points) != len(graph.nearest):
            raise InputError(f"points must be the {len(graph.nearest)} samples of the graph, got {len(points)}")
        values = {
            "points": points,
            "normals": normals,
            "centers": points[graph.nodes],
            "nearest": graph.nearest,
            "weights": graph.weights.to(points),
            "dense_weights": graph.dense_weights().to(points),
            "edges": graph.edges,
            "edge_weights": graph.edge_weights.to(points),
        }
        for name, value in values.items():
            self.register_buffer(name, value.to(points.device).clone())

    @property
    def num_nodes(self) -> int:
        """How many nodes there are."""
        return len(self.centers)

    def rest(self) -> Tensor:
        """Return the motions (J, 4, 4) that move nothing."""
        return torch.eye(4).to(self.points).repeat(self.num_nodes, 1, 1)

    @cached_property
    def sums(self) -> BlendSums:
        """The samples, and after them both nodes of each edge as points whose places by one node and the other differ.

        As the graph is when first asked; on the CPU.
        """
        edges = self.edges.repeat_interleave(2, dim=0)
        signs = self.weights.new_tensor([1.0, -1.0]).expand(len(edges), 2)
        width = max(self.nearest.shape[1], 2)
        nearest, weights = (
            torch.cat([nn.functional.pad(part, (0, width - part.shape[1])) for part in parts])
            for parts in ((self.nearest, edges), (self.weights, signs))
        )
        points = torch.cat((self.points, self.centers[self.edges].flatten(0, 1)))
        return BlendSums(points, nearest, weights, self.num_nodes)

    def within(self, num_edges: int) -> Tensor:
        """Return which nodes (J, J) are at most so many edges from each other; every node is from itself."""
        alone = torch.eye(self.num_nodes, dtype=torch.float64, device=self.edges.device)
        near = alone.clone()
        near[self.edges[:, 0], self.edges[:, 1]] = near[self.edges[:, 1], self.edges[:, 0]] = 1.0
        return torch.linalg.matrix_power(near, num_edges) > 0

    def forward(self, transforms: Tensor, which: Tensor | slice = slice(None)) -> Tensor:
        """Return moved samples (..., n, 3)."""
        return blend_linear(self.points[which], self.dense_weights[which], transforms)

    def move_with_normals(self, transforms: Tensor, which: Tensor | slice = slice(None)) -> tuple[Tensor, Tensor]:
        """Return moved samples and their turned unit normals, (..., n, 3) each; see `forward`."""
        rows = (self.dense_weights[which] @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
        ends = torch.stack((self.points[which], self.normals[which]), dim=-1)
        moved, turned = (rows[..., :3] @ ends).unbind(-1)
        return moved + rows[..., 3], nn.functional.normalize(turned, dim=-1)

    def edge_gaps(self, transforms: Tensor) -> Tensor:
        """Return how far neighbors disagree about where each of the two nodes goes, (..., E, 2, 3).

        The regularizer of the graph is the weighted sum of their squares.
        """
        one, other = (transforms[..., ends, :, :] for ends in self.edges.unbind(-1))
        both = self.centers[self.edges]
        return transform_points(one, both) - transform_points(other, both)

    def smoothness(self, transforms: Tensor) -> Tensor:
        """Return the weighted mean over edges of both gaps' lengths, (...), in the unit of the points."""
        if len(self.edges) == 0:
            return transforms.new_zeros(transforms.shape[:-3])
        gap = self.edge_gaps(transforms).norm(dim=-1).sum(-1)
        return (gap * self.edge_weights).sum(-1) / len(self.edges)
