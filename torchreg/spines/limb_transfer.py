"""One graph for all frames: limbs from each frame's own tree where that has them, elsewhere from the frames around."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import fit_rigid
from torchreg.geometry.skeleton import Skeleton, build_skeleton, resample_curve
from torchreg.spines.curves import curve_frames, curve_lengths, follow, smooth_curve, tangents
from torchreg.spines.depth_field import DepthField, draw_inside
from torchreg.spines.labeled_tree import LimbGraph, gather_nodes, number_nodes, path_lengths, place_junctions
from torchreg.spines.local_icp import carry_nodes

# A limb of a frame is its own if its length is within these shares of its usual one.
_LENGTHS, _LENGTHS_TOUCHING = (0.65, 1.5), (0.9, 1.1)
# Limbs that have more than this share of the shorter one's way in common hold each other.
_COMMON = 0.15
# A limb that is longer by this factor than its mean over this share of its length zigzags.
_ZIGZAG, _WINDOW = 1.1, 0.25
# Surface points that carry limbs from frame to frame, and how far along the skeleton they act, in shares of its extent.
_SURFACE_POINTS, _WIDTHS = 1200, (0.5, 0.25, 0.12, 0.06)


@dataclass(frozen=True, eq=False)
class FrameLimbs:
    """The limbs of a graph in one frame.

    Args:
        curves: (L, S, 3) in the order and direction of `LimbGraph.edges`.
        radii: (L, S).
        own: (L,) True where the frame's own tree gave the limb; the others are not known or come from other frames.
        placed: (N,) True for nodes of the graph that the frame's own tree gave.
        nodes: (N, 3) places of the nodes of the graph.
    """

    curves: Tensor
    radii: Tensor
    own: Tensor
    placed: Tensor
    nodes: Tensor


def steadied(skeleton: Skeleton) -> Skeleton:
    """Return the skeleton with those limbs smoothed that zigzag, as in a surface full of noise; tips keep their order.

    A limb zigzags if it is much longer than the same limb averaged over a share of its length.
    """
    rows, zigzag = [], False
    for limb in skeleton.limbs:
        nodes, radii = skeleton.nodes[limb], skeleton.radii[limb]
        smooth = smooth_curve(nodes, _WINDOW)
        if curve_lengths(nodes) > _ZIGZAG * curve_lengths(smooth):
            zigzag = True
            nodes = smooth
            radii = radii.mean().expand(len(smooth))
        rows.append((nodes, radii, torch.eye(3).to(nodes).expand(len(nodes), 3, 3)))
    if not zigzag:
        return skeleton
    return build_skeleton(rows, [(first, last) for first, last in skeleton.limb_ends.tolist()], skeleton.notes)


def own_limbs(skeleton: Skeleton, named: Sequence[int], graph: LimbGraph, num_samples: int) -> FrameLimbs:
    """Return the limbs of a graph that a frame's tree has.

    A junction has a place if tips behind three of its limbs were found; a limb is the way along the tree between two
    nodes with places, unless it has much of its way in common with another.

    Args:
        skeleton: the tree.
        named: K indices into `Skeleton.tips`, -1 for a tip that was not found.
        graph: with K tips.
        num_samples: S points per limb.
    """
    nodes = skeleton.nodes.detach().cpu().double()
    tips = skeleton.tips.cpu()
    index = [int(tips[k]) if k >= 0 else -1 for k in named]
    found = {name for name, node in enumerate(index) if node >= 0}
    if found:
        for place, parts in zip(place_junctions(skeleton, named, graph), graph.branches, strict=True):
            index.append(place if sum(bool(found & part) for part in parts) >= 3 else -1)
    else:
        index += [-1] * len(graph.branches)
    limbs = graph.edges.tolist()
    curves, radii = torch.zeros(len(limbs), num_samples, 3).double(), torch.zeros(len(limbs), num_samples).double()
    ways: list[list[int]] = [[] for _ in limbs]
    for limb, (start, end) in enumerate(limbs):
        if index[start] < 0 or index[end] < 0 or index[start] == index[end]:
            continue
        way = skeleton.path(index[start], index[end]).cpu()
        eye = torch.eye(3, dtype=nodes.dtype).expand(len(way), 3, 3)
        points, widths, _ = resample_curve(nodes[way], skeleton.radii.detach().cpu().double()[way], eye, num_samples)
        curves[limb], radii[limb], ways[limb] = points, widths, way.tolist()
    own = torch.tensor([len(way) > 1 for way in ways]) & ~_overlapping(skeleton, ways)
    placed = torch.tensor([node >= 0 for node in index])
    return FrameLimbs(curves, radii, own, placed, nodes[torch.tensor(index).clamp_min(0)])


def _overlapping(skeleton: Skeleton, ways: list[list[int]]) -> Tensor:
    """Return which ways (L,) along a tree have much in common with another."""
    nodes = skeleton.nodes.detach().cpu().double()
    steps = [{(min(a, b), max(a, b)) for a, b in pairwise(way)} for way in ways]
    result = torch.zeros(len(ways), dtype=torch.bool)

    def length(some: set[tuple[int, int]]) -> float:
        return sum(float((nodes[a] - nodes[b]).norm()) for a, b in some)

    for first in range(len(ways)):
        for second in range(first):
            common = steps[first] & steps[second]
            if common and length(common) > _COMMON * min(length(steps[first]), length(steps[second])):
                result[[first, second]] = True
    return result


def usual_lengths(frames: Sequence[FrameLimbs]) -> Tensor:
    """Return the median length (L,) of each limb over the frames that have it; NaN where none has."""
    lengths = torch.stack([curve_lengths(frame.curves) for frame in frames])
    own = torch.stack([frame.own for frame in frames])
    return torch.where(own, lengths, torch.nan).nanmedian(0).values


def doubt_lengths(frame: FrameLimbs, usual: Tensor, graph: LimbGraph, *, touching: bool) -> FrameLimbs:
    """Return the frame without the limbs, and the tips of these, whose length is far from the usual one.

    Args:
        frame: what its own tree has.
        usual: (L,) lengths.
        graph: of the limbs.
        touching: whether limbs touched: the place at which they were parted may lie on either of them, and their
            lengths are held to be nearer to the usual ones.
    """
    ratio = curve_lengths(frame.curves) / usual
    least, most = _LENGTHS_TOUCHING if touching else _LENGTHS
    odd = frame.own & ((ratio < least) | (ratio > most))
    placed = frame.placed.clone()
    placed[: graph.num_tips] &= ~odd[: graph.num_tips]
    return replace(frame, own=frame.own & ~odd, placed=placed)


def complete(frames: Sequence[FrameLimbs], graph: LimbGraph, meshes: Sequence[TriangleMesh]) -> list[FrameLimbs]:
    """Return the frames with all limbs: those that a frame lacks are carried over from the frames around it.

    A limb is carried from frame to frame: moved with what is known there, and drawn into the body to its own depth.
    Between two frames that have it, it is carried from both, and the two are mixed by their distance in time.

    Args:
        frames: T frames; every limb must be some frame's own.
        graph: their graph.
        meshes: the surfaces of the frames.
    """
    lacking = [not bool(frame.own.all()) for frame in frames]
    if not any(lacking):
        return list(frames)
    filled = list(frames)
    fields = {number: DepthField(meshes[number]) for number, lacks in enumerate(lacking) if lacks}
    carried: tuple[dict[int, FrameLimbs], dict[int, FrameLimbs]] = ({}, {})
    for done, order in zip(carried, (range(len(frames)), range(len(frames) - 1, -1, -1)), strict=True):
        last: tuple[int, FrameLimbs] | None = None
        for number in order:
            frame = frames[number]
            if lacking[number] and last is not None:
                frame = _carry(last[1], frame, graph, (meshes[last[0]], meshes[number]), fields[number])
                done[number] = frame
            if not lacking[number] or last is not None:
                last = number, frame
    for number in fields:
        filled[number] = _mixed(number, frames[number], carried, lacking, graph, fields[number])
    return filled


def _mixed(
    number: int,
    frame: FrameLimbs,
    carried: tuple[dict[int, FrameLimbs], dict[int, FrameLimbs]],
    lacking: Sequence[bool],
    graph: LimbGraph,
    field: DepthField,
) -> FrameLimbs:
    """Return a frame whose limbs came from before and after, nearer ones with more weight."""
    before, after = (some.get(number) for some in carried)
    if before is None or after is None:
        return next(some for some in (before, after, frame) if some is not None)
    since = next(k for k in range(1, number + 1) if not lacking[number - k])
    until = next(k for k in range(1, len(lacking) - number) if not lacking[number + k])
    share = since / (since + until)
    curves = before.curves + share * (after.curves - before.curves)
    radii = before.radii + share * (after.radii - before.radii)
    return _settled(replace(before, curves=curves, radii=radii), frame, graph, field)


def _carry(
    source: FrameLimbs,
    frame: FrameLimbs,
    graph: LimbGraph,
    surfaces: tuple[TriangleMesh, TriangleMesh],
    field: DepthField,
) -> FrameLimbs:
    """Return a frame with the limbs that it lacks carried there from another one, with the surface around them."""
    numbers = number_nodes(graph.edges, source.curves.shape[1])
    nodes, radii = gather_nodes(source.curves[None], numbers)[0], gather_nodes(source.radii[None], numbers)[0]
    known = torch.zeros(len(nodes), dtype=torch.bool)
    places = gather_nodes(frame.curves[None], numbers)[0]
    known[numbers[frame.own].reshape(-1)] = True
    places[numbers[frame.own]] = frame.curves[frame.own]
    sure = _sure_nodes(frame, graph)
    known[: len(sure)] |= sure
    places[: len(sure)][sure] = frame.nodes[sure]
    steps = torch.stack((numbers[:, :-1], numbers[:, 1:]), -1).reshape(-1, 2)
    apart = path_lengths(Skeleton(nodes, steps, radii), torch.arange(len(nodes)))
    size = float(apart.max())
    (before, before_normals), (after, after_normals) = (_surface_points(mesh) for mesh in surfaces)
    few = torch.randperm(len(before), generator=torch.Generator().manual_seed(0))[:_SURFACE_POINTS]
    moved = carry_nodes(
        nodes, radii, apart, before[few], before_normals[few], after, after_normals, [w * size for w in _WIDTHS],
        known=known, places=places,
    )  # fmt: skip
    curves = torch.where(frame.own[:, None, None], frame.curves, moved[numbers])
    radii = torch.where(frame.own[:, None], frame.radii, source.radii)
    return _settled(replace(frame, curves=curves, radii=radii), frame, graph, field)


def _surface_points(mesh: TriangleMesh) -> tuple[Tensor, Tensor]:
    """Return the vertices (V, 3) that faces use, and their normals, outwards, float64."""
    mesh = TriangleMesh(mesh.vertices.detach().cpu().double(), mesh.faces.cpu())
    used = mesh.faces.reshape(-1).unique()
    volume = torch.linalg.det((mesh.vertices - mesh.vertices[used].mean(0))[mesh.faces]).sum()
    return mesh.vertices[used], mesh.vertex_normals()[used] * (-1 if volume < 0 else 1)


def _sure_nodes(frame: FrameLimbs, graph: LimbGraph) -> Tensor:
    """Return which nodes (N,) have a place: tips that were found, and junctions in which an own limb ends."""
    ends = graph.edges
    sure = frame.placed.clone()
    touched = torch.zeros_like(sure)
    touched[ends[frame.own].reshape(-1)] = True
    sure[graph.num_tips :] &= touched[graph.num_tips :]
    return sure


def _settled(limbs: FrameLimbs, frame: FrameLimbs, graph: LimbGraph, field: DepthField) -> FrameLimbs:
    """Return limbs that meet in their nodes again, and lie inside."""
    ends = graph.edges
    sure = _sure_nodes(frame, graph)
    curves = limbs.curves
    total = torch.zeros_like(limbs.nodes)
    count = torch.zeros(len(total), dtype=total.dtype)
    for side, place in ((0, 0), (1, -1)):
        total.index_add_(0, ends[:, side], curves[:, place])
        count.index_add_(0, ends[:, side], torch.ones(len(ends), dtype=total.dtype))
    nodes = torch.where(sure[:, None], frame.nodes, total / count[:, None])
    width = torch.zeros(len(nodes), dtype=total.dtype)
    width[ends[:, 0]], width[ends[:, 1]] = limbs.radii[:, 0], limbs.radii[:, -1]
    free = ~sure
    if bool(free.any()):
        nodes[free] = draw_inside(field, nodes[free], width[free], free[free], stiffness=0.0)
    share = torch.linspace(0, 1, curves.shape[1], dtype=curves.dtype)[None, :, None]
    start, end = nodes[ends[:, 0]] - curves[:, 0], nodes[ends[:, 1]] - curves[:, -1]
    curves = curves + (1 - share) * start[:, None] + share * end[:, None]
    loose = (~frame.own)[:, None].expand(curves.shape[:2]).clone()
    loose[:, [0, -1]] = False
    curves = draw_inside(field, curves, limbs.radii, loose)
    return replace(limbs, curves=curves, nodes=nodes)


def travelling_frames(curves: Tensor, reference: int) -> Tensor:
    """Return frames ``R_world_curve`` (T, L, S, 3, 3) along curves (T, L, S, 3) that travel with them through time.

    In the reference frame they do not twist along the limbs; from there each frame's turn with the whole body, and then
    by the least angle into the new direction of the limb.
    """
    result: dict[int, Tensor] = {reference: curve_frames(curves[reference])}
    for order in (range(reference + 1, len(curves)), range(reference - 1, -1, -1)):
        last = reference
        for frame in order:
            turn = fit_rigid(curves[last].flatten(0, 1), curves[frame].flatten(0, 1))[:3, :3]
            result[frame] = follow(turn @ result[last], tangents(curves[frame]))
            last = frame
    return torch.stack([result[frame] for frame in range(len(curves))])
