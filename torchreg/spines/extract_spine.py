"""One branching graph of curves for a sequence of surfaces that share nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_count, warn_about_rounding
from torchreg._threads import one_thread
from torchreg.errors import InputError
from torchreg.geometry.far_origin import far_origin, to_world
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton
from torchreg.geometry.upright import guess_up
from torchreg.spines.frames.frame_skeletons import FrameSkeleton, skeletonize_frames
from torchreg.spines.frames.frame_surfaces import FrameSurfaces
from torchreg.spines.frames.frame_warnings import irregularities, statuses_and_warnings
from torchreg.spines.frames.outlier_frames import check_sizes, frames_to_pass_over, with_frames_between
from torchreg.spines.growth.growing_spine import growing_spine
from torchreg.spines.labeled_tree import LimbGraph, most_frequent_splits, skeleton_splits
from torchreg.spines.limbs.limb_transfer import complete_from_prior, transfer_missing_limbs, transported_frames
from torchreg.spines.limbs.observed_limbs import (
    FrameLimbs,
    accept_shared_paths,
    curve_topology,
    median_lengths,
    observe_limbs,
    reject_odd_lengths,
    smooth_rough_limbs,
)
from torchreg.spines.names.name_chain import TipNames
from torchreg.spines.names.tip_tracking import has_loops, track_tips
from torchreg.spines.paper.rigid_tracking import track_tips_rigidly
from torchreg.spines.prior import PriorSkeleton
from torchreg.spines.results import SpineRecord, SpineSequence
from torchreg.spines.skeleton.tip_relations import TipRelations
from torchreg.spines.skeletonize import SkeletonizeConfig
from torchreg.spines.spine import Spine


@dataclass(frozen=True)
class SpineConfig:
    """How a spine is extracted.

    Args:
        num_tips: number K of tips; None: the most frequent one.
        num_samples: points along each limb, both ends included.
        skeletons: how each frame is skeletonized.
        printed: tips are identified as in the paper, by rigid fits of their positions alone to a reference frame, see
            `track_tips_rigidly`; by default over all frames at once, see `track_tips`.
    """

    num_tips: int | None = None
    num_samples: int = 24
    skeletons: SkeletonizeConfig = field(default_factory=SkeletonizeConfig)
    printed: bool = False

    def __post_init__(self) -> None:
        if self.num_tips is not None:
            check_count(self.num_tips, "num_tips", 2)
        check_count(self.num_samples, "num_samples", 3)

    @classmethod
    def paper(cls, **changes: Any) -> SpineConfig:
        """Return spines as printed, of which some fields may be changed.

        Bins of vertices, 100 of them; trees merged from the tips inward; tips identified by eqs. 6-8 alone. The most
        frequent tree is imposed on all frames as by default, and limbs that a frame hides are transferred, of which the
        paper says nothing.

        Args:
            changes: fields by name.

        References: Brostow, Essa, Steedly and Kwatra 2004, sections 4.1 and 4.2.
        """
        return replace(cls(skeletons=SkeletonizeConfig(printed=True), printed=True), **changes)

    @classmethod
    def growing(cls, **changes: Any) -> SpineConfig:
        """Return spines of things that grow: half as large protrusions are limbs, as time tells them from noise.

        Args:
            changes: fields by name.
        """
        return replace(cls(skeletons=SkeletonizeConfig(min_protrusion=0.025)), **changes)


def extract_spine(
    meshes: Sequence[TriangleMesh | Tensor],
    *,
    prior: Skeleton | SpineSequence | None = None,
    growing: bool = False,
    times: Tensor | None = None,
    config: SpineConfig | None = None,
    workers: int | None = None,
    on_step: Callable[[SpineRecord], None] | None = None,
    progress: str | os.PathLike[str] | None = None,
    support: str = "auto",
) -> SpineSequence:
    """Return the spine of a moving creature: one graph of limbs, their curves in every frame, tips that keep names.

    1. Every frame is skeletonized by itself.
    2. K is the most frequent number of tips. Those of the middle of the longest run of frames with K tips give the
       names; all frames are named at once, by what the surface tells of its tips and by motion, see `confidence`.
       Superfluous tips have no names.
    3. The graph G is the most frequent tree of the tracked tips.
    4. G is imposed on every frame: its junctions are placed on the frame's own skeleton, its limbs are the paths
       between them. Limbs that a frame does not show, because they merge or tuck in, are transferred from the frames
       around it: moved with the surface, then moved inside the body.
    5. Limbs are resampled at equal intervals.

    A prior skeleton is forced on the data: its tree is the graph, its tips are the K, and tip k is what its k-th tip
    fits, in the frame that it fits best. It may be of any size, anywhere and in another pose. Tips that it lacks are
    left out; a limb that no frame shows is the prior's, moved with the others and into the body.

    Of things that grow (``growing``), like plants, K is the number of all organs that are ever there. Each has its
    birth and its end; names are those of the tracks that explain the tips of all frames best, see `track_organs`. The
    graph is the tree of all organs, which agrees with most of what frames show. Limbs have no length before and after
    their lives (`Spine`), and `SpineSequence.curves` and `tips` are NaN there.

    Args:
        meshes: T surfaces, of any numbers of vertices, in one unit; or points (N, 3) of them, clouds or scans without
            faces, see `skeletonize`. A sequence that reads meshes on request, one at a time, is never held as a whole;
            the surfaces of clouds are.
        prior: a skeleton with all limbs, or another spine, whose names (numbers of tips) and graph are kept.
        growing: whether tips may appear and end.
        times: (T,) of the frames, strictly increasing; 0, 1, 2, ... by default.
        config: see `SpineConfig`; by default `SpineConfig.growing()` of what grows.
        workers: processes for surfaces of clouds, skeletons and limbs that are transferred; by default one per core.
        on_step: called with every frame that is skeletonized.
        progress: folder in which each of these is kept as soon as it is done, so that a call that was interrupted goes
            on where it ended.
        support: "auto" leaves out a table or a floor that the creature stands on, see `split_support`; "keep" keeps it.

    Returns:
        A `SpineSequence`; `warnings` tell the irregularities frame by frame. Frames without a body, or with another
        one that is half as large or more, are passed over if most are not so: limbs are interpolated in time.

    Raises:
        InputError: if there is no frame, one of them has no surface (names it), no frame shows ``num_tips`` limbs,
            ``times`` do not fit, the prior has fewer tips than most frames and ``num_tips`` does not say so, a prior
            is given to the paper's way, a prior, ``num_tips`` or the paper's way to what grows, or a frame is eight
            times as large or small as most, as of another unit.
        InputTypeError: if something else than meshes is given, or another prior than a skeleton or a spine.
        SolverError: if a worker process is killed twice.

    Warns:
        FileWarning: if a support is left out.

    Differentiable: no; `SpineSequence.model` is.

    Cost: about 1 s per frame of 15,000 vertices and CPU core; half a second more where limbs are transferred, 1 s more
    for a cloud of 12,000 points; 0.1 s for names.

    References: Brostow, Essa, Steedly and Kwatra 2004; a prior skeleton is its section 6's.
    """
    config = config or (SpineConfig.growing() if growing else SpineConfig())
    _check_settings(config, prior, workers, growing=growing)
    surfaces = meshes
    if not isinstance(surfaces, FrameSurfaces):
        surfaces = FrameSurfaces.of_frames(meshes, workers=workers, progress=progress, support=support)
    origin = far_origin(surfaces.samples)
    if origin is not None:
        surfaces = surfaces.shifted(-origin)
    check_sizes(surfaces.samples, growing=growing)
    known = None if prior is None else PriorSkeleton.from_given(prior, config.num_tips)
    first = surfaces.samples[0]
    warn_about_rounding(first, "meshes", float((first.amax(0) - first.amin(0)).norm()), stacklevel=2)
    with torch.no_grad():
        # Section 4.1: the second factor of eq. 3, frame by frame.
        found = skeletonize_frames(surfaces, config.skeletons, workers=workers, on_step=on_step, progress=progress)
    passed = frames_to_pass_over([skeleton for skeleton, _ in found])
    kept = [number for number in range(len(found)) if number not in passed]
    when = torch.arange(len(found)).to(first) if times is None else times
    if passed:
        surfaces, times = surfaces.chosen(kept), when[kept]
    shown = [found[number] for number in kept]
    if growing:
        spine = growing_spine(surfaces, shown, times, config.num_samples)
    else:
        spine = _joined_spine(surfaces, shown, known, times, config, workers=workers, progress=progress)
    if passed:
        spine = with_frames_between(spine, kept, when, {number: found[number][0] for number in passed})
    return to_world(spine, origin)


@torch.no_grad()
@one_thread()
def _joined_spine(
    surfaces: FrameSurfaces, found: Sequence[FrameSkeleton], known: PriorSkeleton | None, times: Tensor | None,
    config: SpineConfig, *, workers: int | None, progress: str | os.PathLike[str] | None,
) -> SpineSequence:  # fmt: skip
    """Return the spine of surfaces whose skeletons were found."""
    skeletons, relations = [smooth_rough_limbs(skeleton) for skeleton, _ in found], [row for _, row in found]
    known = known and known.fitted(skeletons, config.num_tips)
    names = _named_tips(skeletons, relations, config, known, workers)
    # Section 4.3: the first factor of eq. 3, then G imposed.
    graph = _most_frequent_graph(skeletons, names.labels) if known is None else known.graph
    observed = _observed_limbs(skeletons, names.labels, graph, config.num_samples, known)
    usable = observed
    if known is not None:
        usable = complete_from_prior(observed, graph, surfaces, known.limbs(config.num_samples), names.reference)
    limbs = transfer_missing_limbs(usable, graph, surfaces, workers=workers, progress=progress)
    curves, radii = (torch.stack([getattr(frame, name) for frame in limbs]) for name in ("curves", "radii"))
    frames, topologies = transported_frames(curves, names.reference), [curve_topology(graph, rows) for rows in curves]
    curves, radii, frames = (rows.to(surfaces.samples[0]) for rows in (curves, radii, frames))
    model = Spine(curves, graph.edges, radii=radii, frames=frames, times=times)  # eq. 1
    shown, own = names.labels >= 0, torch.stack([frame.observed for frame in observed])
    return SpineSequence(
        model=model,
        graph=model.graph,
        curves=model(model.times).detach(),
        radii=radii,
        frames=frames,
        times=model.times.clone(),
        found=shown,
        confidence=names.confidence.to(curves),
        own=own,
        reference=names.reference,
        topologies=tuple(topologies),
        own_topologies=tuple(skeleton.topology for skeleton in skeletons),
        up=guess_up(surfaces.samples),
        **statuses_and_warnings(
            [
                irregularities(*rows)
                for rows in zip(skeletons, surfaces.notes, shown.sum(1).tolist(), ~shown, ~own, strict=True)
            ]
        ),
    )


def _check_settings(
    config: SpineConfig, prior: Skeleton | SpineSequence | None, workers: int | None, *, growing: bool
) -> None:
    if workers is not None:
        check_count(workers, "workers", 1)
    if prior is not None and config.printed:
        raise InputError(
            "prior cannot be used by SpineConfig.paper(), which knows of none; leave it out, or use SpineConfig()"
        )
    if growing and (prior is not None or config.num_tips is not None or config.printed):
        what = "prior" if prior is not None else "SpineConfig.paper()" if config.printed else "num_tips"
        raise InputError(f"growing=True cannot be used with {what}, which fixes the number of limbs; leave out either")


def _named_tips(
    skeletons: Sequence[Skeleton], relations: Sequence[TipRelations], config: SpineConfig, prior: PriorSkeleton | None,
    workers: int | None,
) -> TipNames:  # fmt: skip
    """Return the names of the tips in all frames."""
    if config.printed:
        labels, reference = track_tips_rigidly(skeletons, config.num_tips)  # section 4.2, eqs. 6-8
        return TipNames(labels=labels, confidence=(labels >= 0).double(), reference=reference)
    return track_tips(skeletons, config.num_tips, None if prior is None else prior.skeleton, relations, workers)


def _most_frequent_graph(skeletons: Sequence[Skeleton], labels: Tensor) -> LimbGraph:
    """Return the most frequent tree of the frames in which all tips were found."""
    splits = [
        skeleton_splits(skeleton, row.tolist())
        for skeleton, row in zip(skeletons, labels, strict=True)
        if bool((row >= 0).all())
    ]
    num_tips = labels.shape[1]
    if not splits:
        most = max(len(skeleton.tips) for skeleton in skeletons)
        raise InputError(f"num_tips must be what a frame shows, {most} at most, got {num_tips}")
    return LimbGraph(num_tips, most_frequent_splits(splits))


def _observed_limbs(
    skeletons: Sequence[Skeleton], labels: Tensor, graph: LimbGraph, num_samples: int, prior: PriorSkeleton | None
) -> list[FrameLimbs]:
    """Return the limbs of the graph that each frame's own skeleton shows, at their usual length."""
    frames = [
        observe_limbs(skeleton, row.tolist(), graph, num_samples)
        for skeleton, row in zip(skeletons, labels, strict=True)
    ]
    median = median_lengths(frames)
    trusted = [
        reject_odd_lengths(frame, median, graph, touching=has_loops(skeleton))
        for frame, skeleton in zip(frames, skeletons, strict=True)
    ]
    # Should every frame have some odd limb, its limbs do change their lengths.
    observed = trusted if any(bool(frame.observed.all()) for frame in trusted) else frames
    # The tree of a prior need not be that of any frame.
    return observed if prior is None else accept_shared_paths(observed)
