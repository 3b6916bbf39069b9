"""A prior skeleton that is forced on a sequence: its tree is the graph, its tips give the names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.labeled_tree import LimbGraph, path_lengths, skeleton_splits
from torchreg.spines.limbs.observed_limbs import FrameLimbs, observe_limbs
from torchreg.spines.names.tip_tracking import most_frequent_count
from torchreg.spines.results import SpineSequence


@dataclass(frozen=True, eq=False)
class PriorSkeleton:
    """A skeleton whose limbs and names the frames of a sequence get; its k-th tip gives the name k."""

    skeleton: Skeleton

    @classmethod
    def from_given(cls, prior: Skeleton | SpineSequence, num_tips: int | None) -> PriorSkeleton:
        """Return the prior that a user gave; of a spine, its reference frame."""
        if isinstance(prior, SpineSequence):
            prior = prior.model.skeleton(float(prior.times[prior.reference]))
        if not isinstance(prior, Skeleton):
            raise InputTypeError(f"prior must be a Skeleton or a SpineSequence, got {type(prior).__name__}")
        count = len(prior.tips)
        if count < 2 or not float((prior.nodes - prior.nodes[0]).abs().max()) > 0:
            raise InputError(f"prior must have two tips or more, apart from each other, got {count} tip(s)")
        if num_tips is not None and num_tips != count:
            raise InputError(f"num_tips must be that of the prior, {count}, got {num_tips}; leave it out")
        nodes, radii, frames = (rows.detach().cpu().double() for rows in (prior.nodes, prior.radii, prior.frames))
        return cls(Skeleton(nodes, prior.edges.cpu(), radii, frames))

    @property
    def num_tips(self) -> int:
        """Number K of tips."""
        return len(self.skeleton.tips)

    @property
    def graph(self) -> LimbGraph:
        """The tree of its tips."""
        return LimbGraph(self.num_tips, skeleton_splits(self.skeleton, range(self.num_tips)))

    def limbs(self, num_samples: int) -> FrameLimbs:
        """Return its curves at S points per limb, in the order of its graph."""
        return observe_limbs(self.skeleton, range(self.num_tips), self.graph, num_samples)

    def fitted(self, skeletons: Sequence[Skeleton], num_tips: int | None) -> PriorSkeleton:
        """Return the prior scaled to the frames with the number of tips nearest to its own."""
        counts = [len(skeleton.tips) for skeleton in skeletons]
        common = most_frequent_count(counts)
        if num_tips is None and self.num_tips < common:
            raise InputError(
                f"prior must have the limbs of the data: it has {self.num_tips} tips, most frames show {common}; "
                f"give one with all of them, or num_tips={self.num_tips} to leave the others out"
            )
        least = min(abs(count - self.num_tips) for count in counts)
        sizes = [_mean_distance(row) for row in skeletons if abs(len(row.tips) - self.num_tips) == least]
        scale = float(torch.tensor(sizes).double().median()) / _mean_distance(self.skeleton)
        matrix = torch.diag(torch.tensor([scale, scale, scale, 1.0], dtype=torch.float64))
        return PriorSkeleton(self.skeleton.transformed(matrix))


def _mean_distance(skeleton: Skeleton) -> float:
    """Return the mean length of the paths from tip to tip; zero for a single node."""
    lengths: Tensor = path_lengths(skeleton, skeleton.tips)[:, skeleton.tips.cpu()]
    return float(lengths.sum()) / max(1, lengths.numel() - len(lengths))
