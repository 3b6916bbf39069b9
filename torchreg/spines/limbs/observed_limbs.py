"""The limbs of one graph that each frame's own skeleton shows, and which of them cannot be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import torch
from torch import Tensor

from torchreg.geometry.skeleton import Skeleton, build_skeleton, resample_curve
from torchreg.spines.curves import curve_lengths, moving_average
from torchreg.spines.labeled_tree import LimbGraph, place_junctions, tip_nodes


@dataclass(frozen=True)
class LimbLimits:
    """Which curves are limbs that can be trusted."""

    length_range: tuple[float, float] = (0.65, 1.5)  # of a limb, in median lengths over the frames
    length_range_touching: tuple[float, float] = (0.9, 1.1)  # where limbs touched: the cut may lie on either of them
    max_common: float = 0.15  # share of the shorter path that two limbs have in common before they touch
    max_roughness: float = 1.1  # length, in lengths of the moving average, beyond which a limb zigzags
    window: float = 0.25  # of that average, as a share of the limb's length
    num_points: int = 65  # of that average
    min_length: float = 1e-3  # of a limb between junctions, as a share of all limbs' length


_LIMITS = LimbLimits()


@dataclass(frozen=True, eq=False)
class FrameLimbs:
    """The limbs of a graph in one frame."""

    curves: Tensor  # (L, S, 3) in the order and direction of `LimbGraph.edges`
    radii: Tensor
    observed: Tensor  # (L,) True where the frame's own skeleton has the limb; others are unknown or were transferred
    node_observed: Tensor  # (N,) the same of the nodes of the graph
    nodes: Tensor


def smooth_rough_limbs(skeleton: Skeleton) -> Skeleton:
    """Return the skeleton with limbs smoothed that are much longer than their moving average; tips keep their order."""
    rows, rough = [], False
    for limb in skeleton.limbs:
        nodes, radii = skeleton.nodes[limb], skeleton.radii[limb]
        smooth = moving_average(nodes, _LIMITS.window, _LIMITS.num_points)
        if curve_lengths(nodes) > _LIMITS.max_roughness * curve_lengths(smooth):
            rough, nodes, radii = True, smooth, radii.mean().expand(len(smooth))
        rows.append((nodes, radii, torch.eye(3).to(nodes).expand(len(nodes), 3, 3)))
    if not rough:
        return skeleton
    return build_skeleton(rows, [(first, last) for first, last in skeleton.limb_ends.tolist()], skeleton.notes)


def observe_limbs(skeleton: Skeleton, labels: Sequence[int], graph: LimbGraph, num_samples: int) -> FrameLimbs:
    """Return the limbs between nodes that a skeleton shows; a junction needs tips behind three of its limbs."""
    nodes, node_radii = skeleton.nodes.detach().cpu().double(), skeleton.radii.detach().cpu().double()
    index = _graph_nodes(skeleton, labels, graph)
    limbs = graph.edges.tolist()
    curves, radii = torch.zeros(len(limbs), num_samples, 3).double(), torch.zeros(len(limbs), num_samples).double()
    paths: list[list[int]] = [[] for _ in limbs]
    for limb, (start, end) in enumerate(limbs):
        if index[start] < 0 or index[end] < 0 or index[start] == index[end]:
            continue
        path = skeleton.path(index[start], index[end]).cpu()
        eye = torch.eye(3, dtype=nodes.dtype).expand(len(path), 3, 3)
        curves[limb], radii[limb], _ = resample_curve(nodes[path], node_radii[path], eye, num_samples)
        paths[limb] = path.tolist()
    return FrameLimbs(
        curves=curves,
        radii=radii,
        observed=torch.tensor([len(path) > 1 for path in paths]) & ~_overlapping(nodes, paths),
        node_observed=torch.tensor([node >= 0 for node in index]),
        nodes=nodes[torch.tensor(index).clamp_min(0)],
    )


def _graph_nodes(skeleton: Skeleton, labels: Sequence[int], graph: LimbGraph) -> list[int]:
    """Return the node of the skeleton for each of the N nodes of a graph, -1 for those that are not observed."""
    tips = tip_nodes(skeleton, labels)
    present = {label for label, node in enumerate(tips) if node >= 0}
    if not present:
        return [-1] * (len(graph.edges) + 1)
    junctions = place_junctions(skeleton, labels, graph)
    seen = [sum(bool(present & part) for part in parts) >= 3 for parts in graph.branches]
    return tips + [node if flag else -1 for node, flag in zip(junctions, seen, strict=True)]


def _overlapping(nodes: Tensor, paths: list[list[int]]) -> Tensor:
    """Return a mask (L,) of the paths along a tree of nodes (N, 3) that have much in common with another."""
    steps = [{(min(pair), max(pair)) for pair in pairwise(path)} for path in paths]
    overlapping = torch.zeros(len(paths), dtype=torch.bool)

    def length(pairs: set[tuple[int, int]]) -> float:
        return sum(float((nodes[a] - nodes[b]).norm()) for a, b in pairs)

    for first, second in combinations(range(len(paths)), 2):
        common = steps[first] & steps[second]
        if common and length(common) > _LIMITS.max_common * min(length(steps[first]), length(steps[second])):
            overlapping[[first, second]] = True
    return overlapping


def median_lengths(frames: Sequence[FrameLimbs]) -> Tensor:
    """Return the median length (L,) of each limb over the frames that show it; NaN where none does."""
    lengths = torch.stack([curve_lengths(frame.curves) for frame in frames])
    observed = torch.stack([frame.observed for frame in frames])
    return torch.where(observed, lengths, torch.nan).nanmedian(0).values


def reject_odd_lengths(frame: FrameLimbs, median: Tensor, graph: LimbGraph, *, touching: bool) -> FrameLimbs:
    """Return the frame without limbs, and their tips, whose length is far from the median (L,)."""
    ratio = curve_lengths(frame.curves) / median
    least, most = _LIMITS.length_range_touching if touching else _LIMITS.length_range
    odd = frame.observed & ((ratio < least) | (ratio > most))
    node_observed = frame.node_observed.clone()
    node_observed[: graph.num_tips] &= ~odd[: graph.num_tips]
    return replace(frame, observed=frame.observed & ~odd, node_observed=node_observed)


def accept_shared_paths(frames: Sequence[FrameLimbs]) -> list[FrameLimbs]:
    """Return the frames; if none shows all limbs, those that run along others in their frame count as shown, too."""
    if any(bool(frame.observed.all()) for frame in frames):
        return list(frames)
    return [replace(frame, observed=curve_lengths(frame.curves) > 0) for frame in frames]


def curve_topology(graph: LimbGraph, curves: Tensor) -> str:
    """Return the topology of a graph's curves (L, S, 3): limbs between junctions without length are none."""
    lengths = curve_lengths(curves)
    inner = lengths[graph.num_tips :] > _LIMITS.min_length * lengths.sum()
    kept = frozenset(split for split, keep in zip(graph.ordered_splits, inner.tolist(), strict=True) if keep)
    return LimbGraph(graph.num_tips, kept).topology
