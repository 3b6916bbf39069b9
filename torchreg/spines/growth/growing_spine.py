"""The spine of a thing that grows: organs with births and ends, one tree of all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.skeleton import Skeleton
from torchreg.geometry.upright import guess_up
from torchreg.spines.frames.frame_skeletons import FrameSkeleton
from torchreg.spines.frames.frame_surfaces import FrameSurfaces
from torchreg.spines.frames.frame_warnings import irregularities, statuses_and_warnings
from torchreg.spines.growth.growing_limbs import GrowingLimbs, growing_limbs
from torchreg.spines.growth.organ_graph import common_graph, restricted, shown_tree
from torchreg.spines.growth.organ_tracks import OrganTracks, track_organs
from torchreg.spines.labeled_tree import LimbGraph
from torchreg.spines.limbs.limb_transfer import transported_frames
from torchreg.spines.limbs.observed_limbs import smooth_rough_limbs
from torchreg.spines.names.tip_features import observe_tips
from torchreg.spines.results import SpineSequence
from torchreg.spines.spine import Spine

_NO_TIP = -50.0  # log-odds that no place on tracks makes up for


@torch.no_grad()
def growing_spine(
    surfaces: FrameSurfaces, found: Sequence[FrameSkeleton], times: Tensor | None, num_samples: int,
) -> SpineSequence:  # fmt: skip
    """Return the spine of growing surfaces with given skeletons, of two organs or more."""
    skeletons = [smooth_rough_limbs(skeleton) for skeleton, _ in found]
    # Log-odds of tips are half of what their confidences say; a ball has none.
    sure = [skeleton.confidence.cpu().double() for skeleton, _ in found]
    certainties = [torch.where(c > 0, torch.logit(c, eps=1e-3) / 2, _NO_TIP) for c in sure]
    tracks = track_organs(observe_tips(skeletons, [relations for _, relations in found]), certainties)
    num_organs = tracks.labels.shape[1]
    if num_organs < 2:
        raise InputError(f"meshes must show two organs or more, got {num_organs}; is min_protrusion too large?")
    graph = common_graph([shown_tree(*row) for row in zip(skeletons, tracks.labels.tolist(), strict=True)], num_organs)
    limbs = growing_limbs(skeletons, tracks, graph, num_samples)
    reference = int((tracks.labels >= 0).sum(1).argmax())
    like = surfaces.samples[0]
    frames = transported_frames(limbs.curves, reference).to(like)
    curves, radii = limbs.curves.to(like), limbs.radii.to(like)
    model = Spine(curves, graph.edges, radii=radii, frames=frames, times=times)
    absent = ~limbs.present[..., None, None].to(like.device)
    return SpineSequence(
        model=model,
        graph=model.graph,
        curves=model(model.times).detach().masked_fill(absent, torch.nan),
        radii=radii.masked_fill(absent[..., 0], torch.nan),
        frames=frames.masked_fill(absent[..., None], torch.nan),
        times=model.times.clone(),
        found=tracks.labels >= 0,
        confidence=tracks.confidence.to(curves),
        own=limbs.observed,
        reference=reference,
        topologies=tuple(_topology(graph, row) for row in tracks.alive),
        own_topologies=tuple(skeleton.topology for skeleton in skeletons),
        up=guess_up(surfaces.samples),
        births=tracks.births,
        ends=tracks.ends,
        **statuses_and_warnings(_notes(skeletons, surfaces.notes, tracks, limbs)),
    )


def _notes(
    skeletons: Sequence[Skeleton], notes: Sequence[tuple[str, ...]], tracks: OrganTracks, limbs: GrowingLimbs
) -> list[list[str]]:
    """Return the irregularities of the frames; what is not there is not missed."""
    shown = tracks.labels >= 0
    missing, transferred = tracks.alive & ~shown, limbs.present & ~limbs.observed
    return [
        irregularities(*row) for row in zip(skeletons, notes, shown.sum(1).tolist(), missing, transferred, strict=True)
    ]


def _topology(graph: LimbGraph, alive: Tensor) -> str:
    """Return the topology of the tree of the organs that are there (K,)."""
    organs = frozenset(alive.nonzero()[:, 0].tolist())
    if len(organs) < 2:
        return "()"
    order = sorted(organs)
    splits = restricted(graph.splits, organs)
    return LimbGraph(len(order), frozenset(frozenset(map(order.index, split)) for split in splits)).topology
