"""The identity of tips over time: named in the middle of the longest clean run, then in all frames at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.curves import curve_lengths, points_along
from torchreg.spines.labeled_tree import path_lengths
from torchreg.spines.names.name_chain import TipNames, name_over_time
from torchreg.spines.names.tip_features import observe_tips
from torchreg.spines.names.tip_matching import TipReference, rank_mappings, tries_all_mappings
from torchreg.spines.skeleton.tip_relations import TipRelations


@dataclass(frozen=True)
class PriorFit:
    """How frames are compared with a prior skeleton."""

    num_points: int = 8  # of a limb that are compared
    extent: float = 0.85  # share of the limb that they cover, from the tip
    num_frames: int = 32  # of a sequence, evenly spaced, that are compared: poses recur

    @property
    def shares(self) -> Tensor:
        """Distances (S,) of the compared points from the tip, in limb lengths."""
        return torch.linspace(0, self.extent, self.num_points, dtype=torch.float64)


_PRIOR_FIT = PriorFit()


def track_tips(
    skeletons: Sequence[Skeleton],
    num_tips: int | None = None,
    prior: Skeleton | None = None,
    relations: Sequence[TipRelations] | None = None,
    workers: int | None = 1,
) -> TipNames:
    """Return the names of the tips in all frames, see `name_over_time` (Brostow et al. 2004, section 4.2)."""
    if prior is not None:
        num_tips = len(prior.tips)
    elif num_tips is None:
        num_tips = most_frequent_count([len(skeleton.tips) for skeleton in skeletons])
    clean = _clean_frames(skeletons, num_tips, None if prior is None else prior.topology)
    if prior is None:
        first, end = longest_run(clean)
        reference, numbers = (first + end - 1) // 2, torch.arange(num_tips)
        names = torch.where(numbers < len(skeletons[reference].tips), numbers, -1)
    else:
        reference, names = _fit_prior(prior, skeletons, _evenly([k for k, flag in enumerate(clean) if flag]))
    relations = [_along_skeleton(skeleton) for skeleton in skeletons] if relations is None else relations
    return name_over_time(observe_tips(skeletons, relations), reference, names, workers)


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


def _clean_frames(skeletons: Sequence[Skeleton], num_tips: int, topology: str | None) -> list[bool]:
    """Return which frames may be references: those of K tips, the topology, or the most frequent one, and no loops."""
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


def _along_skeleton(skeleton: Skeleton) -> TipRelations:
    """Return the relations of tips along a skeleton, which has no volumes."""
    lengths = path_lengths(skeleton, skeleton.tips)[:, skeleton.tips.cpu()]
    return TipRelations(lengths, lengths.new_zeros(len(lengths), len(lengths), len(lengths)))


def _fit_prior(prior: Skeleton, skeletons: Sequence[Skeleton], candidates: Sequence[int]) -> tuple[int, Tensor]:
    """Return that candidate, and its tip (K,) of each name, which a prior skeleton, turned in any way, fits best."""
    limbs = _tip_limbs(prior)
    lengths = torch.stack([curve_lengths(limb) for limb in limbs]).unsqueeze(-1) * _PRIOR_FIT.shares
    points = torch.stack([points_along(*row) for row in zip(limbs, lengths, strict=True)])
    known = TipReference(points, path_lengths(prior, prior.tips)[:, prior.tips])
    fits = [_fit(known, lengths, skeletons[frame]) for frame in candidates]
    best = min(range(len(fits)), key=lambda row: fits[row][1])
    return candidates[best], fits[best][0]


def _fit(known: TipReference, lengths: Tensor, skeleton: Skeleton) -> tuple[Tensor, float]:
    """Return the best mapping (K,) of known limbs, cut at lengths (K, S), to those of a frame, and its cost."""
    curves = torch.stack([points_along(limb, lengths) for limb in _tip_limbs(skeleton)])
    paths = path_lengths(skeleton, skeleton.tips)[:, skeleton.tips.cpu()]
    turns = torch.eye(3, dtype=curves.dtype)[None]
    if not tries_all_mappings(len(known.tips), len(curves)):
        # Assignments start from few rotations, from principal axes the same however the known limbs are turned.
        turns = _axis_alignments(known.tips.flatten(0, 1), curves.flatten(0, 2))
    fits = [rank_mappings([replace(known, tips=known.tips @ turn.mT)], curves, paths) for turn in turns]
    maps, costs = min(fits, key=lambda fit: float(fit[1][0]))
    return maps[0], float(costs[0])


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
    count = min(len(frames), _PRIOR_FIT.num_frames)
    return [frames[int(row)] for row in torch.linspace(0, len(frames) - 1, count).round()]


def _runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Return the first frames and the ends of the runs of True."""
    starts = [frame for frame, flag in enumerate(flags) if flag and not (frame and flags[frame - 1])]
    return [(start, next((k for k in range(start, len(flags)) if not flags[k]), len(flags))) for start in starts]
