"""Outlier frames of a sequence: of another unit, with an error, or with another body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.skeleton import Skeleton
from torchreg.geometry.surface_graph import ANOTHER_BODY
from torchreg.result import Status
from torchreg.spines.results import SpineSequence
from torchreg.spines.skeletonize import FLAT
from torchreg.spines.spine import Spine


@dataclass(frozen=True)
class SizeLimits:
    """Which frames are of one unit."""

    most: float = (
        8.0  # times as large: a body that bends or a part of it changes less, centimeters and millimeters more
    )


_LIMITS = SizeLimits()


def check_sizes(samples: Sequence[Tensor], *, growing: bool) -> None:
    """Raise InputError if a frame differs far in size from most, or, growing, from the one before it."""
    sizes = torch.stack([_size(points) for points in samples])
    expected = torch.cat((sizes[:1], sizes[:-1])) if growing else sizes.median().expand_as(sizes)
    # Points, whose size is zero, are checked elsewhere.
    ratios = torch.where((sizes > 0) & (expected > 0), (sizes / expected).log().abs().exp(), 1.0)
    frame = int(ratios.argmax())
    if float(ratios[frame]) > _LIMITS.most:
        than = "the frame before it" if growing else "most frames"
        raise InputError(
            f"meshes must be in one unit: meshes[{frame}] is {float(ratios[frame]):.3g} times as "
            f"{'large' if sizes[frame] > expected[frame] else 'small'} as {than}; scale it, or leave it out"
        )


def _size(points: Tensor) -> Tensor:
    """Return the median distance of points from their middle, which no far fragment changes much."""
    points = points.detach().cpu().double()
    return (points - points.median(0).values).norm(dim=-1).median()


def frames_to_pass_over(skeletons: Sequence[Skeleton]) -> list[int]:
    """Return the frames that are flat, or hold another body, of which no one knows which is meant; none if most do."""
    frames = [
        number
        for number, skeleton in enumerate(skeletons)
        if any(note.startswith((ANOTHER_BODY, FLAT)) for note in skeleton.notes)
    ]
    return frames if 2 * len(frames) < len(skeletons) else []


def with_frames_between(
    spine: SpineSequence, kept: Sequence[int], times: Tensor, passed: Mapping[int, Skeleton]
) -> SpineSequence:
    """Return the spine with the outlier frames ``passed``, interpolated in time between the frames ``kept``."""
    count = len(kept) + len(passed)
    within = times.clamp(spine.times[0], spine.times[-1])
    nearest = (times[:, None] - spine.times).abs().argmin(1)
    there = torch.zeros(count, dtype=torch.bool)
    there[list(kept)] = True
    with torch.no_grad():
        curves, radii, frames = (part(within) for part in (spine.model, spine.model.radii, spine.model.frames))
    absent = spine.curves.isnan()[nearest]
    nothing = spine.found.new_zeros(())
    notes = [f"frame {number}: passed over: {'; '.join(row.notes)}" for number, row in passed.items()]
    warnings = [*notes, *(_renumbered(warning, kept) for warning in spine.warnings)]
    statuses = [
        spine.statuses[int(row)] if flag else Status.WITH_WARNINGS for row, flag in zip(nearest, there, strict=True)
    ]
    model = Spine(curves, spine.graph, radii=radii, frames=frames, times=times)
    numbers = torch.tensor(list(kept))
    return replace(
        spine,
        model=model,
        curves=curves.masked_fill(absent, torch.nan),
        radii=radii.masked_fill(absent[..., 0], torch.nan),
        frames=frames.masked_fill(absent[..., None], torch.nan),
        times=times,
        found=torch.where(there[:, None], spine.found[nearest], nothing),
        own=torch.where(there[:, None], spine.own[nearest], nothing),
        confidence=None if spine.confidence is None else torch.where(there[:, None], spine.confidence[nearest], 0.0),
        reference=kept[spine.reference],
        topologies=tuple(spine.topologies[row] for row in nearest.tolist()),
        own_topologies=tuple(
            passed[number].topology if number in passed else spine.own_topologies[int(nearest[number])]
            for number in range(count)
        ),
        statuses=tuple(statuses),
        status=Status.WITH_WARNINGS,
        warnings=tuple(sorted(warnings, key=lambda warning: int(warning.split(":")[0].removeprefix("frame ")))),
        births=None if spine.births is None else numbers[spine.births],
        ends=None if spine.ends is None else numbers[spine.ends],
    )


def _renumbered(warning: str, kept: Sequence[int]) -> str:
    """Return a warning with the frame's number among all frames."""
    frame, _, text = warning.removeprefix("frame ").partition(": ")
    return f"frame {kept[int(frame)]}: {text}"
