"""Skeletons: trees of nodes with radii and frames, their tips, junctions, limbs and topology."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, as_tensor, check_count, check_finite, check_points, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import RIGID_TOLERANCE, rotation_error, transform_points

# Neighbors of every node.
_Neighbors = list[list[int]]


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Skeleton:
    """A tree of curves along the medial axis of a body; its leaves are the tips, its branch nodes the junctions.

    Convention: ``frames[n]`` is ``R_world_node``: its columns are the major and minor axis of the ring of surface
    around the node and, right-handed to these, the direction of the limb; signs are consistent along a limb, from its
    start to its end.

    Args:
        nodes: (N, 3) finite coordinates in the unit of the surface, float32 or float64; at least one.
        edges: (N - 1, 2) node indices; together they must join all nodes.
        radii: (N,) distance from a node to the surface around it, in the unit of the surface.
        frames: (N, 3, 3) rotations; identities by default.
        confidence: (K,) from 0 to 1, confidence that each of `tips` is the end of a limb; ones by default.
        notes: repairs of the surface, in words, such as fragments left out or loops cut.

    Raises:
        InputError: if a shape is wrong, a number is not finite, a frame is no rotation, or the graph is no tree.
        InputTypeError: if coordinates are not real numbers or edges not integers.

    Differentiable: `limb_lengths` and `resample`, in nodes and radii.

    References: Brostow, Essa, Steedly and Kwatra 2004, section 4.1.
    """

    nodes: Tensor
    edges: Tensor
    radii: Tensor
    frames: Tensor
    confidence: Tensor
    notes: tuple[str, ...]

    def __init__(
        self, nodes: Any, edges: Any, radii: Any, frames: Any = None, confidence: Any = None, notes: Sequence[str] = ()
    ) -> None:
        nodes = as_float_tensor(nodes, "nodes")
        check_points(nodes, "nodes", batch=False)
        radii = as_float_tensor(radii, "radii", like=nodes)
        check_shape(radii, "radii", (len(nodes),))
        check_finite(radii, "radii")
        edges, frames = _check_tree(edges, nodes), _check_frames(frames, nodes)
        values = {"nodes": nodes, "radii": radii, "edges": edges, "frames": frames, "notes": tuple(notes)}
        for name, value in values.items():
            object.__setattr__(self, name, value)
        confidence = nodes.new_ones(len(self.tips)) if confidence is None else confidence
        confidence = as_float_tensor(confidence, "confidence", like=nodes)
        check_shape(confidence, "confidence", (len(self.tips),))
        object.__setattr__(self, "confidence", confidence)

    def __len__(self) -> int:
        return self.nodes.shape[0]

    def __repr__(self) -> str:
        return (
            f"Skeleton({len(self)} nodes, {len(self.tips)} tips, {len(self.limbs)} limbs, "
            f"junctions of degree {self.degrees[self.junctions].tolist()})"
        )

    @cached_property
    def degrees(self) -> Tensor:
        """Number (N,) of edges at each node."""
        return torch.bincount(self.edges.reshape(-1), minlength=len(self))

    @cached_property
    def tips(self) -> Tensor:
        """Indices (K,) of the nodes with one edge, ascending; the node itself if there is only one."""
        return (self.degrees <= 1).nonzero()[:, 0]

    @cached_property
    def junctions(self) -> Tensor:
        """Indices (J,) of the nodes with three or more edges, ascending; see `degrees`."""
        return (self.degrees >= 3).nonzero()[:, 0]

    @cached_property
    def limbs(self) -> tuple[Tensor, ...]:
        """Node indices (n,) of each limb, with its two ends.

        Limbs that end in tips come first, in the order of `tips`, and start there; a tree without junctions is a single
        limb. Limbs between junctions follow, sorted by the indices of their ends, and start at the smaller one.
        """
        neighbors, stops = self._neighbors, set(self.tips.tolist()) | set(self.junctions.tolist())
        chains: dict[frozenset[int], list[int]] = {}
        for start in (*self.tips.tolist(), *self.junctions.tolist()):
            for first in neighbors[start]:
                chain = [start, first]
                while chain[-1] not in stops:
                    chain.append(next(n for n in neighbors[chain[-1]] if n != chain[-2]))
                # The same limb found from its second end is left out.
                chains.setdefault(frozenset((start, chain[-1])), chain)
        tips = set(self.tips.tolist())
        ordered = sorted(chains.values(), key=lambda chain: (chain[0] not in tips, chain[0], chain[-1]))
        return tuple(torch.tensor(chain, device=self.nodes.device) for chain in ordered)

    @cached_property
    def limb_ends(self) -> Tensor:
        """Node indices (L, 2) of the start and end of each limb."""
        ends = [torch.stack((limb[0], limb[-1])) for limb in self.limbs]
        return torch.stack(ends) if ends else self.edges.new_zeros(0, 2)

    @cached_property
    def limb_lengths(self) -> Tensor:
        """Lengths (L,) of the limbs along their edges, in the unit of the nodes."""
        sides = [(self.nodes[limb[1:]] - self.nodes[limb[:-1]]).norm(dim=-1).sum() for limb in self.limbs]
        return torch.stack(sides) if sides else self.nodes.new_zeros(0)

    @property
    def length(self) -> Tensor:
        """Length () of all limbs together."""
        return self.limb_lengths.sum()

    @cached_property
    def topology(self) -> str:
        """Canonical form of the tree of tips and junctions, equal for two skeletons exactly if these are isomorphic.

        Nodes of degree two, lengths and the numbering do not count. Every node is a pair of brackets around its
        branches, from the center of the tree: ``(()()()()())`` is a junction with five tips.

        References: Aho, Hopcroft and Ullman 1974, example 3.2; Jordan 1869 on the center of a tree.
        """
        graph = _Neighbors()
        number: dict[int, int] = {}
        for node in (*self.tips.tolist(), *self.junctions.tolist()):
            number[node] = len(graph)
            graph.append([])
        for start, end in self.limb_ends.tolist():
            graph[number[start]].append(number[end])
            graph[number[end]].append(number[start])
        return min(_bracketed(graph, center) for center in _tree_centers(graph))

    def limb_of(self, points: Tensor) -> Tensor:
        """Return the limb (N,) with the nearest surface to each point (N, 3): a first guess of the parts of a body.

        A limb ends at the sphere around its junction: its nodes within the radius of the junction, which lie inside the
        trunk, do not count, unless all of them do. Distances are to nodes, less their radii.

        Raises:
            InputError: if points have another shape, or the skeleton has no limb.
        """
        points = as_float_tensor(points, "points", like=self.nodes)
        check_points(points, "points", batch=False)
        if not self.limbs:
            raise InputError("the skeleton must have a limb, got a single node")
        distance = torch.cdist(points, self.nodes) - self.radii
        return torch.stack([distance[:, self._outside(limb)].amin(1) for limb in self.limbs]).argmin(0)

    def _outside(self, limb: Tensor) -> Tensor:
        """Return the nodes of a limb outside the spheres around the junctions in which it ends."""
        ends = [end for end in (limb[0], limb[-1]) if self.degrees[end] >= 3]
        inside = [(self.nodes[limb] - self.nodes[end]).norm(dim=-1) < self.radii[end] for end in ends]
        kept = limb[~torch.stack(inside).any(0)] if inside else limb
        return kept if len(kept) else limb

    def path(self, start: int, end: int) -> Tensor:
        """Return the node indices (n,) of the path between two nodes of the tree, with these.

        Raises:
            InputError: if there is no such node.
        """
        for name, node in (("start", start), ("end", end)):
            if not 0 <= node < len(self):
                raise InputError(f"{name} must be a node from 0 to {len(self) - 1}, got {node}")
        towards = _parent_map(self._neighbors, int(end))
        chain = [int(start)]
        while chain[-1] != end:
            chain.append(towards[chain[-1]])
        return torch.tensor(chain, device=self.nodes.device)

    def resample(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return samples of every limb at equal steps of its arc length.

        Args:
            count: samples per limb, with its two ends; at least 2.

        Returns:
            Curves (L, count, 3), radii (L, count) and frames (L, count, 3, 3); see `resample_curve`.

        Raises:
            InputError: if ``count`` is too small, or the skeleton is a single node.
        """
        check_count(count, "count", 2)
        if not self.limbs:
            raise InputError("skeleton must have a limb to resample, got a single node")
        parts = [resample_curve(self.nodes[limb], self.radii[limb], self.frames[limb], count) for limb in self.limbs]
        curves, radii, frames = zip(*parts, strict=True)
        return torch.stack(curves), torch.stack(radii), torch.stack(frames)

    def transformed(self, transform: Tensor) -> Skeleton:
        """Return the skeleton moved by a rigid motion with or without scale, (4, 4)."""
        transform = as_float_tensor(transform, "transform", like=self.nodes)
        check_shape(transform, "transform", (4, 4))
        scale = torch.linalg.det(transform[:3, :3]).abs() ** (1 / 3)
        return replace(
            self,
            nodes=transform_points(transform, self.nodes),
            radii=self.radii * scale,
            frames=transform[:3, :3] / scale @ self.frames,
        )

    @cached_property
    def _neighbors(self) -> _Neighbors:
        neighbors: _Neighbors = [[] for _ in range(len(self))]
        for start, end in self.edges.tolist():
            neighbors[start].append(end)
            neighbors[end].append(start)
        return [sorted(adjacent) for adjacent in neighbors]


def resample_curve(points: Tensor, radii: Tensor, frames: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return points (count, 3), radii and frames of a polyline at equal steps of its arc length, ends included."""
    with torch.no_grad():
        along = torch.cat((points.new_zeros(1), (points[1:] - points[:-1]).norm(dim=-1).cumsum(0)))
        wanted = torch.linspace(0, 1, count, dtype=points.dtype, device=points.device) * along[-1]
        after = torch.searchsorted(along, wanted).clamp(1, len(points) - 1)
        step = along[after] - along[after - 1]
        share = torch.where(step > 0, (wanted - along[after - 1]) / torch.where(step > 0, step, 1.0), 0.0)
        share = share.clamp(0, 1)

    def interpolated(values: Tensor) -> Tensor:
        weight = share.reshape(-1, *(1,) * (values.ndim - 1))
        return values[after - 1] + weight * (values[after] - values[after - 1])

    return interpolated(points), interpolated(radii), nearest_rotation(interpolated(frames.detach()))


def nearest_rotation(matrices: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) nearest to matrices in least squares (Arun et al. 1987; Umeyama 1991)."""
    u, _, vh = torch.linalg.svd(matrices)
    sign = torch.ones_like(matrices[..., 0])
    sign[..., 2] = torch.linalg.det(u @ vh)
    return u * sign.unsqueeze(-2) @ vh


def build_skeleton(
    limbs: Sequence[tuple[Tensor, Tensor, Tensor]], ends: Sequence[tuple[int, int]], notes: Sequence[str] = ()
) -> Skeleton:
    """Return the skeleton of limbs (points (n, 3), radii, frames) whose ends are nodes named by integers."""
    number: dict[int, int] = {}
    values: list[tuple[Tensor, Tensor, Tensor]] = []
    edges: list[tuple[int, int]] = []
    for limb, (first, last) in zip(limbs, ends, strict=True):
        names = [first, *[None] * (len(limb[0]) - 2), last]
        chain = []
        for name, *value in zip(names, *limb, strict=True):
            if name is None or name not in number:
                values.append(tuple(value))
            chain.append(len(values) - 1 if name is None else number.setdefault(name, len(values) - 1))
        edges += pairwise(chain)
    nodes, radii, frames = (torch.stack(column) for column in zip(*values, strict=True))
    return Skeleton(nodes, torch.tensor(edges, device=nodes.device), radii, frames, notes=tuple(notes))


def _check_tree(edges: Any, nodes: Tensor) -> Tensor:
    edges = as_tensor(edges, "edges", "integers")
    if edges.numel() == 0:
        edges = edges.reshape(0, 2).long()
    if edges.is_floating_point() or edges.is_complex() or edges.dtype == torch.bool:
        raise InputTypeError(f"edges must hold integers, got dtype {edges.dtype}; convert with .long()")
    check_shape(edges, "edges", ("E", 2))
    edges = edges.to(device=nodes.device, dtype=torch.int64)
    if edges.numel() and not 0 <= int(edges.min()) <= int(edges.max()) < len(nodes):
        raise InputError(f"edges must index the {len(nodes)} nodes, got {int(edges.min())} to {int(edges.max())}")
    if len(edges) != len(nodes) - 1 or _count_reached(edges, len(nodes)) != len(nodes):
        raise InputError(
            f"edges must join the nodes in one tree: {len(nodes) - 1} edges that leave none out, got {len(edges)}, "
            f"which reach {_count_reached(edges, len(nodes))} of {len(nodes)} nodes"
        )
    return edges


def _count_reached(edges: Tensor, count: int) -> int:
    """Return the number of nodes that edges connect with node 0, itself included."""
    neighbors: _Neighbors = [[] for _ in range(count)]
    for start, end in edges.tolist():
        neighbors[start].append(end)
        neighbors[end].append(start)
    return len(_parent_map(neighbors, 0))


def _check_frames(frames: Any, nodes: Tensor) -> Tensor:
    if frames is None:
        return torch.eye(3, dtype=nodes.dtype, device=nodes.device).repeat(len(nodes), 1, 1)
    frames = as_float_tensor(frames, "frames", like=nodes)
    check_shape(frames, "frames", (len(nodes), 3, 3))
    check_finite(frames, "frames")
    error = rotation_error(frames)
    if error > RIGID_TOLERANCE.rounded or bool((torch.linalg.det(frames) < 0).any()):
        raise InputError(f"frames must be rotations, got matrices {error:.3g} from orthogonal or with determinant -1")
    return frames


def _parent_map(neighbors: _Neighbors, root: int) -> dict[int, int]:
    """Return the parent of every node reached from the root, whose parent is itself, in order of distance."""
    parents = {root: root}
    queue = [root]
    for node in queue:
        for neighbor in neighbors[node]:
            if neighbor not in parents:
                parents[neighbor] = node
                queue.append(neighbor)
    return parents


def _tree_centers(graph: _Neighbors) -> list[int]:
    """Return the one or two centers of a tree, in the middle of a longest path."""
    far = list(_parent_map(graph, 0))[-1]
    parents = _parent_map(graph, far)
    chain = [list(parents)[-1]]
    while chain[-1] != far:
        chain.append(parents[chain[-1]])
    return sorted({chain[(len(chain) - 1) // 2], chain[len(chain) // 2]})


def _bracketed(graph: _Neighbors, root: int) -> str:
    """Return the canonical form of a rooted tree."""
    parents = _parent_map(graph, root)
    branches: dict[int, list[str]] = {node: [] for node in parents}
    for node in reversed(parents):
        form = "(" + "".join(sorted(branches[node])) + ")"
        if node == root:
            return form
        branches[parents[node]].append(form)
    return "()"
