"""Tips identified over time as printed: the mapping of least error of a rigid fit to a reference frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.names.tip_matching import TipReference, rank_mappings
from torchreg.spines.names.tip_tracking import longest_run, most_frequent_count

# More than any rigid fit: a tip stays without a name only if there are too few.
_NEVER_MISSING = 1e6


def track_tips_rigidly(skeletons: Sequence[Skeleton], num_tips: int | None = None) -> tuple[Tensor, int]:
    """Return the labels (T, K) of tips, see `tip_nodes`, and the reference frame (Brostow et al. 2004, eqs. 6-8)."""
    counts = [len(skeleton.tips) for skeleton in skeletons]
    num_tips = most_frequent_count(counts) if num_tips is None else num_tips
    full = [count == num_tips for count in counts]
    if not any(full):
        raise InputError(f"num_tips must be what a frame shows, {max(counts)} at most, got {num_tips}")
    first, end = longest_run(full)
    reference = (first + end - 1) // 2
    tips = [skeleton.nodes[skeleton.tips].detach().cpu().double() for skeleton in skeletons]
    known = TipReference(tips[reference])
    labels = torch.full((len(skeletons), num_tips), -1)
    for frame in (frame for frame, is_full in enumerate(full) if is_full):
        labels[frame] = rank_mappings([known], tips[frame], missing_cost=_NEVER_MISSING)[0][0]
    for frame in (frame for frame, is_full in enumerate(full) if not is_full):
        near = min((other for other, is_full in enumerate(full) if is_full), key=lambda other: abs(other - frame))
        references = [known, TipReference(tips[near][labels[near]])]
        labels[frame] = rank_mappings(references, tips[frame], missing_cost=_NEVER_MISSING)[0][0]
    return labels, reference
