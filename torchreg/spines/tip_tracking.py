"""The identity of tips over time: K of them, tracked from frame to frame from the middle of the longest clean run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.curves import curve_lengths, points_along
from torchreg.spines.labeled_tree import path_lengths
from torchreg.spines.tip_matching import TipReference, rank_mappings, tries_all_mappings


@dataclass(frozen=True)
class TipTracking:
    """How a frame is compared with the nearest tracked frame and with the nearest reference."""

    rotation_weight: float = 0.3  # of the rotation since the nearest frame; since the reference any will do
    reference_weight: float = 0.3  # of the reference, which may be far in time, against the nearest frame
    min_run: int = 9  # frames of a run that has a reference of its own
    velocity_share: float = 0.5  # of the last displacement, by which limbs are predicted to move on
    num_points: int = 8  # of a limb that are compared
    extent: float = 0.85  # share of the limb that they cover, from the tip
    prior_frames: int = 32  # of a sequence, evenly spaced, that are compared with a prior: poses recur
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


def track_tips(
    skeletons: Sequence[Skeleton], num_tips: int | None = None, prior: Skeleton | None = None
) -> tuple[Tensor, int]:
    """Return the labels (T, K) of the tips in all frames, see `tip_nodes`, and the frame from which they were tracked.

    The reference is the middle of the longest run of frames that have K tips, the most frequent topology of these and,
    if there are such frames, no loops, in which limbs touch each other. From there tips are tracked in both directions
    of time: each frame is compared with the one before and with the nearest reference; see `rank_mappings`.

    With a prior its tips are the K, and the reference is the frame, of some with K tips, that it fits best.

    Args:
        skeletons: one per frame.
        num_tips: K; the most frequent number by default.
        prior: float64 and of the size of the frames; names are the numbers of its tips.

    References: Brostow, Essa, Steedly and Kwatra 2004, section 4.2.
    """
    if prior is not None:
        num_tips = len(prior.tips)
    elif num_tips is None:
        num_tips = most_frequent_count([len(skeleton.tips) for skeleton in skeletons])
    clean = _clean_frames(skeletons, num_tips, None if prior is None else prior.topology)
    runs = _runs(clean)
    longest = max(runs, key=lambda run: (run[1] - run[0], -run[0]))
    middles = [(a + b - 1) // 2 for a, b in runs if b - a >= _TRACKING.min_run]
    tracker = _TipTracker(skeletons, num_tips, middles)
    if prior is None:
        reference = (longest[0] + longest[1] - 1) // 2
        tracker.start(reference)
    else:
        reference = tracker.start_from(prior, _evenly([k for k, flag in enumerate(clean) if flag]))
    for frames in (range(reference + 1, len(skeletons)), range(reference - 1, -1, -1)):
        for frame in frames:
            tracker.track(frame)
    return tracker.labels, reference


def most_frequent_count(counts: Sequence[int]) -> int:
    """Return the most frequent number of tips; of several, the largest: limbs hide more often than they grow."""
    frequency = Counter(counts)
    return max(frequency, key=lambda count: (frequency[count], count))


def has_loops(skeleton: Skeleton) -> bool:
    """Return whether limbs of the surface touched and were separated."""
    return any("loop" in note for note in skeleton.notes)


def _clean_frames(skeletons: Sequence[Skeleton], num_tips: int, topology: str | None) -> list[bool]:
    """Return which frames may be references: those with K tips, a topology and no loops, if any.

    Without a topology, or if none of them has it, it is their most frequent one.
    """
    topologies = [skeleton.topology for skeleton in skeletons if len(skeleton.tips) == num_tips]
    if not topologies:  # a K that no frame has: the frame nearest to it
        counts = [len(skeleton.tips) for skeleton in skeletons]
        nearest = min(range(len(counts)), key=lambda frame: (abs(counts[frame] - num_tips), frame))
        return [frame == nearest for frame in range(len(counts))]
    if topology not in topologies:
        topology = Counter(topologies).most_common(1)[0][0]
    typical = [skeleton.topology == topology for skeleton in skeletons]
    clean = [flag and not has_loops(skeleton) for flag, skeleton in zip(typical, skeletons, strict=True)]
    return clean if any(clean) else typical


class _TipTracker:
    """The tips identified so far; one that was not found stays where it was, moved rigidly with the others."""

    def __init__(self, skeletons: Sequence[Skeleton], num_tips: int, references: Sequence[int]) -> None:
        self.references = list(references)
        self.labels = torch.full((len(skeletons), num_tips), -1)
        self.topologies = [skeleton.topology for skeleton in skeletons]
        self.limbs = [_tip_limbs(skeleton) for skeleton in skeletons]
        self.lengths = [path_lengths(skeleton, skeleton.tips)[:, skeleton.tips.cpu()] for skeleton in skeletons]
        # Per tracked frame: points (K, S, 3) of the tracked limbs, path lengths (K, K) from tip to tip.
        self.points: dict[int, Tensor] = {}
        self.paths: dict[int, Tensor] = {}

    def start(self, frame: int) -> None:
        """Give the tips of the first frame their own numbers as names."""
        self.references = sorted({*self.references, frame})
        self.typical = [topology == self.topologies[frame] for topology in self.topologies]
        # A reference with too few tips shows some of them twice, until a frame has them all.
        numbers = torch.arange(self.labels.shape[1])
        self.labels[frame] = torch.where(numbers < len(self.limbs[frame]), numbers, -1)
        row = self.labels[frame].clamp_min(0)
        self.limb_lengths = torch.stack([curve_lengths(self.limbs[frame][k]) for k in row.tolist()])
        self.points[frame] = self._cut_limbs(frame)[row, numbers]
        self.paths[frame] = self.lengths[frame][row][:, row]

    def start_from(self, prior: Skeleton, candidates: Sequence[int]) -> int:
        """Name the tips of that candidate after those of a prior skeleton that it fits best; return its number."""
        limbs = _tip_limbs(prior)
        self.limb_lengths = torch.stack([curve_lengths(limb) for limb in limbs])
        lengths = self.limb_lengths.unsqueeze(-1) * _TRACKING.shares
        points = torch.stack([points_along(*row) for row in zip(limbs, lengths, strict=True)])
        paths = path_lengths(prior, prior.tips)[:, prior.tips]
        known = TipReference(points, paths)
        fits = [self._fit(known, frame) for frame in candidates]
        best = min(range(len(fits)), key=lambda row: fits[row][1])
        frame, row = candidates[best], fits[best][0]
        self.references = sorted({*self.references, frame})
        self.labels[frame] = row
        self.typical = [topology == self.topologies[frame] for topology in self.topologies]
        own = torch.stack([curve_lengths(self.limbs[frame][k]) for k in row.clamp_min(0).tolist()])
        self.limb_lengths = torch.where(row >= 0, own, self.limb_lengths)
        self.points[frame], self.paths[frame] = points, paths
        self._update(frame, frame, self._cut_limbs(frame))
        return frame

    def _fit(self, known: TipReference, frame: int) -> tuple[Tensor, float]:
        """Return the best mapping (K,) of known limbs, turned in any way, to those of a frame, and its cost."""
        curves = self._cut_from_tips(frame)
        turns = torch.eye(3, dtype=curves.dtype)[None]
        if not tries_all_mappings(len(known.tips), len(curves)):
            # Assignments start from few rotations, from principal axes the same however the known limbs are turned.
            turns = _axis_alignments(known.tips.flatten(0, 1), curves.flatten(0, 2))
        fits = [
            rank_mappings([replace(known, tips=known.tips @ turn.mT)], curves, self.lengths[frame]) for turn in turns
        ]
        maps, costs = min(fits, key=lambda fit: float(fit[1][0]))
        return maps[0], float(costs[0])

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
            return self._cut_from_tips(frame)
        lengths = self.limb_lengths.unsqueeze(-1) * (1 - _TRACKING.shares)
        return torch.stack([points_along(limb.flip(0), lengths) for limb in self.limbs[frame]])

    def _cut_from_tips(self, frame: int) -> Tensor:
        """Return the limbs of a frame's tips as far inwards as each of the tracked ones, (M, K, S, 3)."""
        lengths = self.limb_lengths.unsqueeze(-1) * _TRACKING.shares
        return torch.stack([points_along(limb, lengths) for limb in self.limbs[frame]])

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


def _axis_alignments(source: Tensor, target: Tensor) -> Tensor:
    """Return the four rotations (4, 3, 3) that take the principal axes of points (N, 3) to those of others (M, 3)."""
    axes = [torch.linalg.eigh((row - row.mean(0)).mT @ (row - row.mean(0)))[1] for row in (source, target)]
    signs = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]).to(source)
    turns = axes[1] @ torch.diag_embed(signs) @ axes[0].mT
    return turns * torch.linalg.det(turns)[:, None, None].sign()


def _evenly(frames: Sequence[int]) -> list[int]:
    """Return some of the frames, evenly spaced, that are compared with a prior."""
    count = min(len(frames), _TRACKING.prior_frames)
    return [frames[int(row)] for row in torch.linspace(0, len(frames) - 1, count).round()]


def _runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Return the first frames and the ends of the runs of True."""
    starts = [frame for frame, flag in enumerate(flags) if flag and not (frame and flags[frame - 1])]
    return [(start, next((k for k in range(start, len(flags)) if not flags[k]), len(flags))) for start in starts]
