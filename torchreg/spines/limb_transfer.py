"""One graph for all frames: limbs that a frame does not show are transferred from the frames around it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.curves import align_frames, curve_frames, tangents
from torchreg.spines.depth_field import DepthField, move_inside
from torchreg.spines.labeled_tree import LimbGraph, gather_nodes, number_nodes, path_lengths
from torchreg.spines.local_icp import LOCAL_FITS, SurfacePoints, transfer_nodes
from torchreg.spines.observed_limbs import FrameLimbs


@dataclass(frozen=True)
class _Memory:
    """What is kept of long sequences."""

    depths: int = 32  # of frames: each takes ten megabytes at most, and a tenth of a second to make again


_MEMORY = _Memory()


@dataclass(frozen=True, eq=False)
class _Sequence:
    """A sequence whose limbs are completed.

    Args:
        frames: T frames with the limbs that they show.
        graph: of the limbs.
        meshes: the surfaces of the frames.
        missing: the frames that lack a limb.
        depth: gives the depth in a frame, of which few are kept.
    """

    frames: Sequence[FrameLimbs]
    graph: LimbGraph
    meshes: Sequence[TriangleMesh]
    missing: frozenset[int]
    depth: Callable[[int], DepthField]

    @classmethod
    def of_frames(
        cls, frames: Sequence[FrameLimbs], graph: LimbGraph, meshes: Sequence[TriangleMesh], missing: Iterable[int]
    ) -> _Sequence:
        """Return the sequence of frames, some of which lack limbs."""
        return cls(
            frames,
            graph,
            meshes,
            frozenset(missing),
            lru_cache(_MEMORY.depths)(lambda number: DepthField(meshes[number])),
        )


def transfer_missing_limbs(
    frames: Sequence[FrameLimbs], graph: LimbGraph, meshes: Sequence[TriangleMesh]
) -> list[FrameLimbs]:
    """Return the frames with all limbs: those that a frame lacks are transferred from the frames around it.

    A limb is transferred from frame to frame: moved with what is observed, and moved inside the body to its own depth.
    Between two frames that show it, it is transferred from both, and the two are interpolated in time.

    Args:
        frames: T frames; every limb must be observed in one of them.
        graph: their graph.
        meshes: the surfaces of the frames.
    """
    missing = [number for number, frame in enumerate(frames) if not bool(frame.observed.all())]
    sequence = _Sequence.of_frames(frames, graph, meshes, missing)
    forward = _propagate(sequence, range(len(frames)))
    backward = _propagate(sequence, range(len(frames) - 1, -1, -1))
    return [
        _interpolated_limbs(sequence, number, forward, backward) if number in sequence.missing else frame
        for number, frame in enumerate(frames)
    ]


def complete_from_prior(
    frames: Sequence[FrameLimbs], graph: LimbGraph, meshes: Sequence[TriangleMesh], prior: FrameLimbs, reference: int
) -> list[FrameLimbs]:
    """Return the frames; if none shows all limbs, the one that shows most gets the others from a prior skeleton.

    The prior's limbs are moved rigidly with those that are shown, and then inside.

    Args:
        frames: T frames.
        graph: their graph.
        meshes: the surfaces of the frames.
        prior: all limbs, of the size of the frames.
        reference: of several frames that show most, the nearest to it is taken.

    Raises:
        InputError: if no frame shows a limb.
    """
    if any(bool(frame.observed.all()) for frame in frames):
        return list(frames)
    counts = [int(frame.observed.sum()) for frame in frames]
    number = max(range(len(frames)), key=lambda frame: (counts[frame], -abs(frame - reference)))
    if counts[number] == 0:
        raise InputError(f"prior must fit the data: no frame shows any of its {len(graph.edges)} limbs")
    frame = frames[number]
    shown = frame.observed
    motion = fit_rigid(prior.curves[shown].flatten(0, 1), frame.curves[shown].flatten(0, 1))
    curves = torch.where(shown[:, None, None], frame.curves, transform_points(motion, prior.curves))
    radii = torch.where(shown[:, None], frame.radii, prior.radii)
    sequence = _Sequence.of_frames(frames, graph, meshes, [number])
    completed = _joined_limbs(replace(frame, curves=curves, radii=radii), sequence, number)
    return [*frames[:number], replace(completed, observed=torch.ones_like(shown)), *frames[number + 1 :]]


def _propagate(sequence: _Sequence, order: Sequence[int]) -> dict[int, FrameLimbs]:
    """Return the frames that lack limbs with those of the frame before them in an order of time."""
    transferred: dict[int, FrameLimbs] = {}
    for before, number in pairwise(order):
        complete = before not in sequence.missing
        if number in sequence.missing and (complete or before in transferred):
            source = sequence.frames[before] if complete else transferred[before]
            transferred[number] = _transfer(sequence, source, before, number)
    return transferred


def _transfer(sequence: _Sequence, source: FrameLimbs, before: int, number: int) -> FrameLimbs:
    """Return a frame with the limbs that it lacks transferred from another, moved with the surface around them."""
    frame = sequence.frames[number]
    limb_nodes = number_nodes(sequence.graph.edges, source.curves.shape[1])
    nodes, radii = gather_nodes(source.curves[None], limb_nodes)[0], gather_nodes(source.radii[None], limb_nodes)[0]
    steps = torch.stack((limb_nodes[:, :-1], limb_nodes[:, 1:]), -1).reshape(-1, 2)
    moved = transfer_nodes(
        nodes=nodes,
        radii=radii,
        path_lengths=path_lengths(Skeleton(nodes, steps, radii), torch.arange(len(nodes))),
        source=_surface_points(sequence.meshes[before], LOCAL_FITS.num_points),
        target=_surface_points(sequence.meshes[number]),
        known=_known_nodes(frame, sequence.graph, limb_nodes),
    )
    curves = torch.where(frame.observed[:, None, None], frame.curves, moved[limb_nodes])
    radii = torch.where(frame.observed[:, None], frame.radii, source.radii)
    return _joined_limbs(replace(frame, curves=curves, radii=radii), sequence, number)


def _known_nodes(frame: FrameLimbs, graph: LimbGraph, limb_nodes: Tensor) -> Tensor:
    """Return the positions (N, 3) of the samples (L, S) of the limbs that a frame shows, NaN for those of others."""
    positions = frame.curves.new_full((int(limb_nodes.max()) + 1, 3), torch.nan)
    positions[limb_nodes[frame.observed]] = frame.curves[frame.observed]
    reliable = _reliable_nodes(frame, graph).nonzero()[:, 0]
    positions[reliable] = frame.nodes[reliable]
    return positions


def _reliable_nodes(frame: FrameLimbs, graph: LimbGraph) -> Tensor:
    """Return which nodes (N,) have a known position: observed tips, and junctions in which an observed limb ends."""
    reliable = frame.node_observed.clone()
    touched = torch.zeros_like(reliable)
    touched[graph.edges[frame.observed].reshape(-1)] = True
    reliable[graph.num_tips :] &= touched[graph.num_tips :]
    return reliable


def _surface_points(mesh: TriangleMesh, count: int | None = None) -> SurfacePoints:
    """Return the vertices that faces use, or ``count`` of them drawn at random, with outward normals, float64."""
    mesh = TriangleMesh(mesh.vertices.detach().cpu().double(), mesh.faces.cpu())
    used = mesh.faces.reshape(-1).unique()
    volume = torch.linalg.det((mesh.vertices - mesh.vertices[used].mean(0))[mesh.faces]).sum()
    if count is not None:
        used = used[torch.randperm(len(used), generator=torch.Generator().manual_seed(0))[:count]]
    return SurfacePoints(mesh.vertices[used], mesh.vertex_normals()[used] * (-1 if volume < 0 else 1))


def _interpolated_limbs(
    sequence: _Sequence, number: int, forward: dict[int, FrameLimbs], backward: dict[int, FrameLimbs]
) -> FrameLimbs:
    """Return a frame whose limbs are interpolated in time between those transferred forward and backward."""
    before, after = forward.get(number), backward.get(number)
    if before is None or after is None:
        return before or after or sequence.frames[number]
    complete = [k for k in range(len(sequence.frames)) if k not in sequence.missing]
    previous, following = max(k for k in complete if k < number), min(k for k in complete if k > number)
    share = (number - previous) / (following - previous)
    curves = before.curves + share * (after.curves - before.curves)
    radii = before.radii + share * (after.radii - before.radii)
    return _joined_limbs(replace(before, curves=curves, radii=radii), sequence, number)


def _joined_limbs(limbs: FrameLimbs, sequence: _Sequence, number: int) -> FrameLimbs:
    """Return transferred limbs of a frame that meet in their nodes again, and lie inside."""
    frame, field, ends = sequence.frames[number], sequence.depth(number), sequence.graph.edges
    reliable = _reliable_nodes(frame, sequence.graph)
    total, count = torch.zeros_like(limbs.nodes), torch.zeros(len(limbs.nodes), dtype=limbs.nodes.dtype)
    for side in (0, -1):
        total.index_add_(0, ends[:, side], limbs.curves[:, side])
        count.index_add_(0, ends[:, side], torch.ones(len(ends), dtype=total.dtype))
    nodes = torch.where(reliable[:, None], frame.nodes, total / count[:, None])
    radii = torch.zeros(len(nodes), dtype=total.dtype)
    radii[ends[:, 0]], radii[ends[:, 1]] = limbs.radii[:, 0], limbs.radii[:, -1]
    free = ~reliable
    if bool(free.any()):
        nodes[free] = move_inside(field, nodes[free], radii[free], free[free], stiffness=0.0)
    share = torch.linspace(0, 1, limbs.curves.shape[1], dtype=total.dtype)[None, :, None]
    start, end = nodes[ends[:, 0]] - limbs.curves[:, 0], nodes[ends[:, 1]] - limbs.curves[:, -1]
    curves = limbs.curves + (1 - share) * start[:, None] + share * end[:, None]
    free = (~frame.observed)[:, None].expand(curves.shape[:2]).clone()
    free[:, [0, -1]] = False
    return replace(limbs, curves=move_inside(field, curves, limbs.radii, free), nodes=nodes)


def transported_frames(curves: Tensor, reference: int) -> Tensor:
    """Return frames ``R_world_curve`` (T, L, S, 3, 3) along curves (T, L, S, 3), transported through time.

    In the reference frame they do not twist along the limbs; from there each frame's rotate with the whole body, and
    then by the smallest angle into the new direction of the limb.
    """
    frames: dict[int, Tensor] = {reference: curve_frames(curves[reference])}
    for order in (range(reference + 1, len(curves)), range(reference - 1, -1, -1)):
        last = reference
        for number in order:
            rotation = fit_rigid(curves[last].flatten(0, 1), curves[number].flatten(0, 1))[:3, :3]
            frames[number] = align_frames(rotation @ frames[last], tangents(curves[number]))
            last = number
    return torch.stack([frames[number] for number in range(len(curves))])
