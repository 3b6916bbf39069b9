"""The identity of tips over time: K of them, tracked from frame to frame from the middle of the longest clean run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.curves import curve_lengths, points_along
from torchreg.spines.labeled_tree import path_lengths
from torchreg.spines.tip_matching import TipReference, rank_mappings


@dataclass(frozen=True)
class TipTracking:
    """How a frame is compared with the nearest tracked frame and with the nearest reference."""

    rotation_weight: float = 0.3  # of the rotation since the nearest frame; since the reference any will do
    reference_weight: float = 0.3  # of the reference, which may be far in time, against the nearest frame
    min_run: int = 9  # frames of a run that has a reference of its own
    velocity_share: float = 0.5  # of the last displacement, by which limbs are predicted to move on
    num_points: int = 8  # of a limb that are compared
    extent: float = 0.85  # share of the limb that they cover, from the tip
    root_softening: float = 0.15  # added to distances from the root, in limb lengths, where errors count as angles

    @property
    def shares(self) -> Tensor:
        """Distances (S,) of the compared points from the tip, in limb lengths."""
        return torch.linspace(0, self.extent, self.num_points, dtype=torch.float64)

    @property
    def point_weights(self) -> Tensor:
        """Weights (S,) that make errors of the compared points angles; their mean is one."""
        weights = (1 - self.shares + self.root_softening) ** -2
        return weights / weights.mean()


_TRACKING = TipTracking()


def track_tips(skeletons: Sequence[Skeleton], num_tips: int | None = None) -> tuple[Tensor, int]:
    """Return the labels (T, K) of the tips in all frames, see `tip_nodes`, and the frame from which they were tracked.

    The reference is the middle of the longest run of frames that have K tips, the most frequent topology of these and,
    if there are such frames, no loops, in which limbs touch each other. From there tips are tracked in both directions
    of time: each frame is compared with the one before and with the nearest reference; see `rank_mappings`.

    Args:
        skeletons: one per frame.
        num_tips: K; the most frequent number by default.

    References: Brostow, Essa, Steedly and Kwatra 2004, section 4.2.
    """
    if num_tips is None:
        num_tips = most_frequent_count([len(skeleton.tips) for skeleton in skeletons])
    clean = _clean_frames(skeletons, num_tips)
    runs, longest = _runs(clean), longest_run(clean)
    reference = (longest[0] + longest[1] - 1) // 2
    references = sorted({reference, *((a + b - 1) // 2 for a, b in runs if b - a >= _TRACKING.min_run)})
    tracker = _TipTracker(skeletons, num_tips, references, reference)
    for frames in (range(reference + 1, len(skeletons)), range(reference - 1, -1, -1)):
        for frame in frames:
            tracker.track(frame)
    return tracker.labels, reference


def most_frequent_count(counts: Sequence[int]) -> int:
    """Return the most frequent number of tips; of several, the largest: limbs hide more often than they grow."""
    frequency = Counter(counts)
    return max(frequency, key=lambda count: (frequency[count], count))


def longest_run(flags: Sequence[bool]) -> tuple[int, int]:
    """Return the first frame and the end of the longest run of True, the earliest of several."""
    return max(_runs(flags), key=lambda run: (run[1] - run[0], -run[0]))


def has_loops(skeleton: Skeleton) -> bool:
    """Return whether limbs of the surface touched and were separated."""
    return any("loop" in note for note in skeleton.notes)


def _clean_frames(skeletons: Sequence[Skeleton], num_tips: int) -> list[bool]:
    """Return which frames may be references: those with K tips, their most frequent topology and no loops, if any."""
    topologies = [skeleton.topology for skeleton in skeletons if len(skeleton.tips) == num_tips]
    if not topologies:  # a K that no frame has: the frame nearest to it
        counts = [len(skeleton.tips) for skeleton in skeletons]
        nearest = min(range(len(counts)), key=lambda frame: (abs(counts[frame] - num_tips), frame))
        return [frame == nearest for frame in range(len(counts))]
    frequent = Counter(topologies).most_common(1)[0][0]
    typical = [skeleton.topology == frequent for skeleton in skeletons]
    clean = [flag and not has_loops(skeleton) for flag, skeleton in zip(typical, skeletons, strict=True)]
    return clean if any(clean) else typical


class _TipTracker:
    """The tips identified so far; one that was not found stays where it was, moved rigidly with the others."""

    def __init__(self, skeletons: Sequence[Skeleton], num_tips: int, references: Sequence[int], start: int) -> None:
        self.references = references
        self.labels = torch.full((len(skeletons), num_tips), -1)
        self.typical = [skeleton.topology == skeletons[start].topology for skeleton in skeletons]
        self.limbs = [_tip_limbs(skeleton) for skeleton in skeletons]
        self.lengths = [path_lengths(skeleton, skeleton.tips)[:, skeleton.tips.cpu()] for skeleton in skeletons]
        # A reference with too few tips shows some of them twice, until a frame has them all.
        numbers = torch.arange(num_tips)
        self.labels[start] = torch.where(numbers < len(self.limbs[start]), numbers, -1)
        row = self.labels[start].clamp_min(0)
        self.limb_lengths = torch.stack([curve_lengths(self.limbs[start][k]) for k in row.tolist()])
        # Per tracked frame: points (K, S, 3) of the tracked limbs, path lengths (K, K) from tip to tip.
        self.points = {start: self._cut_limbs(start)[row, numbers]}
        self.paths = {start: self.lengths[start][row][:, row]}

    def track(self, frame: int) -> None:
        """Identify the tips of a frame."""
        near = min(self.points, key=lambda tracked: abs(tracked - frame))
        tracked_references = [reference for reference in self.references if reference in self.points]
        far = min(tracked_references, key=lambda reference: abs(reference - frame), default=near)
        predicted = self._predicted(frame, near)
        known = [TipReference(predicted, self.paths[near], rotation_weight=_TRACKING.rotation_weight)]
        if far != near:
            known.append(TipReference(self.points[far], self.paths[far], weight=_TRACKING.reference_weight))
        curves = self._cut_limbs(frame)
        weights = _TRACKING.point_weights if self.typical[frame] else None
        maps, _ = rank_mappings(known, curves, self.lengths[frame], weights=weights)
        self.labels[frame] = maps[0]
        self._update(frame, near, curves)

    def _cut_limbs(self, frame: int) -> Tensor:
        """Return the limbs of a frame's tips, each as long as each of the tracked ones, (M, K, S, 3).

        They are measured from the root, as a limb that touches another may end late or early; from the tip where the
        frame has other junctions than the reference, whose roots tell nothing.
        """
        if not self.typical[frame]:
            lengths = self.limb_lengths.unsqueeze(-1) * _TRACKING.shares
            return torch.stack([points_along(limb, lengths) for limb in self.limbs[frame]])
        lengths = self.limb_lengths.unsqueeze(-1) * (1 - _TRACKING.shares)
        return torch.stack([points_along(limb.flip(0), lengths) for limb in self.limbs[frame]])

    def _predicted(self, frame: int, near: int) -> Tensor:
        """Return the points (K, S, 3) of the limbs in a frame if their motion around the nearest one goes on."""
        before = 2 * near - frame
        if before not in self.points:
            return self.points[near]
        return self.points[near] + _TRACKING.velocity_share * (self.points[near] - self.points[before])

    def _update(self, frame: int, near: int, curves: Tensor) -> None:
        """Keep the points and path lengths of a frame; those of tips that were not found come from the nearest one."""
        row = self.labels[frame]
        found, index = row >= 0, row.clamp_min(0)
        points, paths = self.points[near], self.paths[near]
        if bool(found.any()):
            observed = torch.where(found[:, None, None], curves[index, torch.arange(len(row))], 0.0)
            weights = found.to(points).unsqueeze(-1).expand(points.shape[:2]).flatten()
            motion = fit_rigid(points.flatten(0, 1), observed.flatten(0, 1), weights)
            moved = transform_points(motion, points.flatten(0, 1)).reshape(points.shape)
            points = torch.where(found[:, None, None], observed, moved)
            paths = torch.where(found[:, None] & found, self.lengths[frame][index][:, index], paths)
        self.points[frame], self.paths[frame] = points, paths


def _tip_limbs(skeleton: Skeleton) -> list[Tensor]:
    """Return the limb (n, 3) of each tip, float64, from the tip to the first junction, or to the other tip."""
    nodes = skeleton.nodes.detach().cpu().double()
    by_end = {int(limb[-1]): limb.flip(0) for limb in skeleton.limbs}
    by_end.update({int(limb[0]): limb for limb in skeleton.limbs})
    return [nodes[by_end[tip].cpu()] if tip in by_end else nodes[[tip]] for tip in skeleton.tips.tolist()]


def _runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Return the first frames and the ends of the runs of True."""
    starts = [frame for frame, flag in enumerate(flags) if flag and not (frame and flags[frame - 1])]
    return [(start, next((k for k in range(start, len(flags)) if not flags[k]), len(flags))) for start in starts]
