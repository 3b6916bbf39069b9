"""Which tip of each frame is which: K by the most frequent count, then frame after frame from the middle of a run."""

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
from torchreg.spines.tip_matching import TipReference, match_tips

# Shares of the frame next in time and of the reference, which may be far.
_NEAR_SHARE, _REFERENCE_SHARE = 1.0, 0.3
# Next in time a creature has hardly turned; against the reference any turn will do.
_NEAR_TURN, _REFERENCE_TURN = 0.3, 0.0
# Runs of at least so many frames have a reference of their own.
_LONG_RUN = 9
# Limbs go on at this share of their speed.
_PERSISTENCE = 0.5
# Points by which limbs are compared: from the tip to this share of the way to the junction.
_POINTS, _REACH = 8, 0.85
# A limb turns about its root, and the same turn moves its points in proportion to their distance from there: errors
# count as angles, softened near the root.
_LEVER = 1 - torch.linspace(0, _REACH, _POINTS, dtype=torch.float64) + 0.15
_ANGLES = _LEVER**-2 / (_LEVER**-2).mean()


@dataclass(frozen=True, eq=False)
class TipNames:
    """Tips with their identity over T frames.

    Args:
        index: (T, K) which of a frame's tips each is, -1 where it was not found.
        reference: the frame from which names were passed on.
        references: all frames with which others were compared.
        costs: (T,) of the mapping, see `match_tips`; zero for the reference.
    """

    index: Tensor
    reference: int
    references: tuple[int, ...]
    costs: Tensor


def most_frequent_count(counts: Sequence[int]) -> int:
    """Return the most frequent number of tips; of several, the largest: limbs hide more often than they grow."""
    frequency = Counter(counts)
    return max(frequency, key=lambda count: (frequency[count], count))


def name_tips(skeletons: Sequence[Skeleton], num_tips: int | None = None) -> TipNames:
    """Return the identity of the tips in all frames.

    The reference is the middle of the longest run of frames that have K tips, the most frequent topology of these and,
    if there are such frames, no loops, in which limbs hold each other. From there names are passed on in both
    directions of time: each frame is compared with the one before and with the nearest reference; see `match_tips`.

    Args:
        skeletons: one per frame.
        num_tips: K; the most frequent number by default.

    References: Brostow, Essa, Steedly and Kwatra 2004, section 4.2.
    """
    counts = [len(skeleton.tips) for skeleton in skeletons]
    count = most_frequent_count(counts) if num_tips is None else num_tips
    runs = _runs(_usual(skeletons, count))
    longest = max(runs, key=lambda run: (run[1] - run[0], -run[0]))
    reference = (longest[0] + longest[1] - 1) // 2
    references = sorted({reference, *((a + b - 1) // 2 for a, b in runs if b - a >= _LONG_RUN)})
    named = _Named(skeletons, count, references)
    named.start(reference)
    for frames in (range(reference + 1, len(skeletons)), range(reference - 1, -1, -1)):
        for frame in frames:
            named.name(frame)
    return TipNames(named.index, reference, tuple(references), named.costs)


def _usual(skeletons: Sequence[Skeleton], count: int) -> list[bool]:
    """Return which frames may serve as references: those with most of what is wanted."""
    right = [skeleton.topology for skeleton in skeletons if len(skeleton.tips) == count]
    if not right:  # a K that no frame has: the frame that comes nearest
        counts = [len(skeleton.tips) for skeleton in skeletons]
        nearest = min(range(len(counts)), key=lambda frame: (abs(counts[frame] - count), frame))
        return [frame == nearest for frame in range(len(counts))]
    frequent = Counter(right).most_common(1)[0][0]
    usual = [skeleton.topology == frequent for skeleton in skeletons]
    whole = [flag and not has_loops(skeleton) for flag, skeleton in zip(usual, skeletons, strict=True)]
    return whole if any(whole) else usual


def has_loops(skeleton: Skeleton) -> bool:
    """Return whether limbs of the surface touched and were parted."""
    return any("loop" in note for note in skeleton.notes)


class _Named:
    """Names given so far. A limb that was not found has the place that it had before, moved with the others."""

    def __init__(self, skeletons: Sequence[Skeleton], count: int, references: Sequence[int]) -> None:
        self.count, self.references = count, references
        self.index = torch.full((len(skeletons), count), -1)
        self.costs = torch.zeros(len(skeletons), dtype=torch.float64)
        self.topologies = [skeleton.topology for skeleton in skeletons]
        self.topology = ""
        self.limbs = [_tip_limbs(skeleton) for skeleton in skeletons]
        self.lengths = [path_lengths(skeleton, skeleton.tips)[:, skeleton.tips.cpu()] for skeleton in skeletons]
        self.places: dict[int, Tensor] = {}
        self.ways: dict[int, Tensor] = {}
        self.reach = torch.zeros(count)

    def start(self, frame: int) -> None:
        self.topology = self.topologies[frame]
        given = torch.arange(min(self.count, len(self.limbs[frame])))
        self.index[frame, : len(given)] = given
        # Where the reference has too few tips, the others stand in for those until a frame shows them.
        row = self.index[frame].clamp_min(0)
        self.reach = torch.stack([curve_lengths(self.limbs[frame][k]) for k in row.tolist()])
        self.places[frame] = self.cut(frame)[row, torch.arange(self.count)]
        self.ways[frame] = self.lengths[frame][row][:, row]

    def name(self, frame: int) -> None:
        near = min(self.places, key=lambda other: abs(other - frame))
        done = [other for other in self.references if other in self.places]
        far = min(done, key=lambda other: abs(other - frame), default=near)
        known = [TipReference(self._expected(frame, near), self.ways[near], _NEAR_SHARE, _NEAR_TURN)]
        if far != near:
            known.append(TipReference(self.places[far], self.ways[far], _REFERENCE_SHARE, _REFERENCE_TURN))
        curves = self.cut(frame)
        weights = _ANGLES if self._is_usual(frame) else None
        match = match_tips(known, curves, self.lengths[frame], weights=weights)
        self.index[frame], self.costs[frame] = match.index, match.cost
        self._remember(frame, near, curves)

    def _is_usual(self, frame: int) -> bool:
        """Return whether a frame has the junctions of the reference; else the roots of limbs tell nothing."""
        return self.topologies[frame] == self.topology

    def cut(self, frame: int) -> Tensor:
        """Return the limbs of a frame's tips, each as long as each of the known ones, (M, K, S, 3).

        They are measured from the root, as a limb that touches another may end late or early; from the tip where the
        roots are others.
        """
        share = torch.linspace(0, _REACH, _POINTS, dtype=torch.float64)
        wanted = self.reach.unsqueeze(-1) * share
        if not self._is_usual(frame):
            return torch.stack([points_along(limb, wanted) for limb in self.limbs[frame]])
        rest = self.reach.unsqueeze(-1) * (1 - share)
        return torch.stack([points_along(limb.flip(0), rest) for limb in self.limbs[frame]])

    def _expected(self, frame: int, near: int) -> Tensor:
        """Return where the limbs should be if they go on as they did."""
        before = 2 * near - frame
        if before not in self.places:
            return self.places[near]
        return self.places[near] + _PERSISTENCE * (self.places[near] - self.places[before])

    def _remember(self, frame: int, near: int, curves: Tensor) -> None:
        row = self.index[frame]
        found, index = row >= 0, row.clamp_min(0)
        places, ways = self.places[near], self.ways[near]
        if bool(found.any()):
            there = torch.where(found[:, None, None], curves[index, torch.arange(self.count)], 0.0)
            weights = found.to(places).unsqueeze(-1).expand(places.shape[:2]).flatten()
            motion = fit_rigid(places.flatten(0, 1), there.flatten(0, 1), weights)
            moved = transform_points(motion, places.flatten(0, 1)).reshape(places.shape)
            places = torch.where(found[:, None, None], there, moved)
            ways = torch.where(found[:, None] & found, self.lengths[frame][index][:, index], ways)
        self.places[frame], self.ways[frame] = places, ways


def _tip_limbs(skeleton: Skeleton) -> list[Tensor]:
    """Return the limb (n, 3) of each tip, float64, from the tip to the first junction, or to the other tip."""
    nodes = skeleton.nodes.detach().cpu().double()
    by_end = {int(limb[-1]): limb.flip(0) for limb in skeleton.limbs}
    by_end.update({int(limb[0]): limb for limb in skeleton.limbs})
    return [nodes[by_end[tip].cpu()] if tip in by_end else nodes[[tip]] for tip in skeleton.tips.tolist()]


def _runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Return first frames and ends of the runs of True."""
    runs, first = [], None
    for frame, flag in enumerate([*flags, False]):
        if flag and first is None:
            first = frame
        if not flag and first is not None:
            runs.append((first, frame))
            first = None
    return runs
