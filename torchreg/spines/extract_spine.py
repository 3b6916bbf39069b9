"""One branching graph of curves for a sequence of surfaces that share nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton
from torchreg.result import Status
from torchreg.spines.curves import curve_lengths
from torchreg.spines.frame_skeletons import skeletonize_frames
from torchreg.spines.labeled_tree import LimbGraph, consensus, skeleton_splits
from torchreg.spines.limb_transfer import (
    FrameLimbs,
    complete,
    doubt_lengths,
    own_limbs,
    steadied,
    travelling_frames,
    usual_lengths,
)
from torchreg.spines.results import SpineRecord, SpineSequence
from torchreg.spines.skeletonize import SkeletonizeConfig
from torchreg.spines.spine import Spine
from torchreg.spines.tip_tracking import TipNames, has_loops, name_tips

# A limb between junctions shorter than this share of the whole is none.
_NO_LIMB = 1e-3


@dataclass(frozen=True)
class SpineConfig:
    """How a spine is extracted.

    Args:
        num_tips: number K of tips; None: the most frequent one.
        num_samples: points along each limb, both ends included.
        skeletons: how each frame is skeletonized.
    """

    num_tips: int | None = None
    num_samples: int = 24
    skeletons: SkeletonizeConfig = field(default_factory=SkeletonizeConfig)

    def __post_init__(self) -> None:
        if self.num_tips is not None:
            check_count(self.num_tips, "num_tips", 2)
        check_count(self.num_samples, "num_samples", 3)


def extract_spine(
    meshes: Sequence[TriangleMesh],
    *,
    times: Tensor | None = None,
    config: SpineConfig | None = None,
    workers: int | None = None,
    on_step: Callable[[SpineRecord], None] | None = None,
    progress: str | os.PathLike[str] | None = None,
) -> SpineSequence:
    """Return the spine of a creature that moves: one graph of limbs, their curves in every frame, tips that keep names.

    1. Every frame is skeletonized by itself.
    2. K is the most frequent number of tips. From a reference in the middle of the longest run of frames with K tips,
       names are passed on from frame to frame by rigid fits (eqs. 6-8), which leaves superfluous tips without names.
    3. The graph G is the most frequent tree of named tips.
    4. G is imposed on every frame: its junctions are placed on the frame's own tree, its limbs are the ways between
       them. Limbs that a frame does not have, because they merge or tuck in, are carried over from the frames around
       it: moved with the surface, then drawn into the body.
    5. Limbs are resampled at equal intervals.

    Args:
        meshes: T surfaces, of any numbers of vertices, in one unit.
        times: (T,) of the frames, strictly increasing; 0, 1, 2, ... by default.
        config: see `SpineConfig`.
        workers: processes for the skeletons; by default one per core.
        on_step: told of every frame that is skeletonized.
        progress: folder in which skeletons are kept, so that a call that was interrupted goes on where it ended.

    Returns:
        a `SpineSequence`; `warnings` tell what was not as it should be, frame by frame.

    Raises:
        InputError: if there is no frame, one of them has no surface (names it), or no frame shows ``num_tips`` limbs.
        InputTypeError: if something else than meshes is given.

    Differentiable: no; `SpineSequence.model` is.

    Cost: about 1 s per frame of 15,000 vertices and CPU core; half a second more where limbs are carried over.

    References: Brostow, Essa, Steedly and Kwatra 2004.
    """
    config = config or SpineConfig()
    meshes = _checked(meshes)
    if workers is not None:
        check_count(workers, "workers", 1)
    with torch.no_grad():
        skeletons = skeletonize_frames(meshes, config.skeletons, workers=workers, on_step=on_step, progress=progress)
        skeletons = [steadied(skeleton) for skeleton in skeletons]
        names = name_tips(skeletons, config.num_tips)
        graph = _graph(skeletons, names)
        own = _own(skeletons, names, graph, config.num_samples)
        frames = complete(own, graph, meshes)
    return _sequence(meshes, times, skeletons, names, graph, own, frames)


def _checked(meshes: Sequence[TriangleMesh]) -> list[TriangleMesh]:
    if isinstance(meshes, TriangleMesh):
        raise InputTypeError("meshes must be a sequence of TriangleMesh, got one mesh; put it into a list")
    meshes = list(meshes)
    if not meshes:
        raise InputError("meshes must hold at least one frame, got none")
    for frame, mesh in enumerate(meshes):
        if not isinstance(mesh, TriangleMesh):
            raise InputTypeError(f"meshes[{frame}] must be a TriangleMesh, got {type(mesh).__name__}")
        if not mesh.num_faces:
            raise InputError(f"meshes[{frame}] must have faces, got none; leave out frames without a surface")
    return meshes


def _graph(skeletons: Sequence[Skeleton], names: TipNames) -> LimbGraph:
    """Return the most frequent tree of the frames in which all tips were found."""
    rows = [
        skeleton_splits(skeleton, index.tolist())
        for skeleton, index in zip(skeletons, names.index, strict=True)
        if bool((index >= 0).all())
    ]
    if not rows:
        most = max(len(skeleton.tips) for skeleton in skeletons)
        raise InputError(f"num_tips must be what a frame shows, {most} at most, got {names.index.shape[1]}")
    return LimbGraph(names.index.shape[1], consensus(rows))


def _own(skeletons: Sequence[Skeleton], names: TipNames, graph: LimbGraph, samples: int) -> list[FrameLimbs]:
    """Return the limbs that each frame's own tree has."""
    frames = [
        own_limbs(skeleton, index.tolist(), graph, samples)
        for skeleton, index in zip(skeletons, names.index, strict=True)
    ]
    usual = usual_lengths(frames)
    doubted = [
        doubt_lengths(frame, usual, graph, touching=has_loops(skeleton))
        for frame, skeleton in zip(frames, skeletons, strict=True)
    ]
    # Should every frame have some odd limb, odd lengths are how the creature is.
    return doubted if any(bool(frame.own.all()) for frame in doubted) else frames


def _sequence(
    meshes: Sequence[TriangleMesh],
    times: Tensor | None,
    skeletons: Sequence[Skeleton],
    names: TipNames,
    graph: LimbGraph,
    own: Sequence[FrameLimbs],
    frames: Sequence[FrameLimbs],
) -> SpineSequence:
    like = meshes[0].vertices.detach()
    curves = torch.stack([frame.curves for frame in frames])
    radii = torch.stack([frame.radii for frame in frames]).to(like)
    axes = travelling_frames(curves, names.reference).to(like)
    model = Spine(curves.to(like), graph.edges, radii, axes, times)
    own_flags = torch.stack([frame.own for frame in own])
    found = names.index >= 0
    notes = tuple(_notes(frame, skeleton, found[frame], own_flags[frame]) for frame, skeleton in enumerate(skeletons))
    statuses = tuple(Status.WITH_WARNINGS if rows else Status.CONVERGED for rows in notes)
    return SpineSequence(
        model=model,
        graph=graph.edges.to(like.device),
        curves=model(model.times).detach(),
        radii=radii,
        frames=axes,
        times=model.times.clone(),
        found=found,
        own=own_flags,
        reference=names.reference,
        topologies=tuple(_delivered(graph, frame.curves) for frame in frames),
        own_topologies=tuple(skeleton.topology for skeleton in skeletons),
        statuses=statuses,
        status=Status.CONVERGED if all(status is Status.CONVERGED for status in statuses) else Status.WITH_WARNINGS,
        warnings=tuple(f"frame {frame}: {row}" for frame, rows in enumerate(notes) for row in rows),
    )


def _notes(frame: int, skeleton: Skeleton, found: Tensor, own: Tensor) -> tuple[str, ...]:
    """Return what was not as it should be in a frame."""
    rows = list(skeleton.notes)
    superfluous = len(skeleton.tips) - int(found.sum())
    if superfluous > 0:
        rows.append(f"{superfluous} superfluous tip(s) left out")
    if not bool(found.all()):
        rows.append(f"tips {_listed(~found)} not found")
    if not bool(own.all()):
        rows.append(f"limbs {_listed(~own)} carried over from other frames")
    return tuple(rows)


def _listed(flags: Tensor) -> str:
    return ", ".join(str(number) for number in flags.nonzero()[:, 0].tolist())


def _delivered(graph: LimbGraph, curves: Tensor) -> str:
    """Return the topology of curves (L, S, 3) as they are: limbs without length are none."""
    lengths = curve_lengths(curves)
    inner = lengths[graph.num_tips :] > _NO_LIMB * lengths.sum()
    kept = frozenset(split for split, there in zip(graph.ordered_splits, inner.tolist(), strict=False) if there)
    return LimbGraph(graph.num_tips, kept).topology
