"""What a learnt matcher says of the samples of two scans: the prior of every match in an EM."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchreg.geometry.neighbors import k_nearest
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.scan_matcher import shared_matcher
from torchreg.registration.dense.scan_tokens import ScanTokens

# Tokens about each sample between which it lies, and how much nearer the nearest one counts: about their spacing.
_ABOUT, _SOFT = 3, 0.25


@dataclass(frozen=True, eq=False)
class MatchPrior:
    """Probabilities of matches of the tokens of two scans, spread over the samples about them.

    Args:
        by_source: (A, B) that a token of the source is each of the target's; what is missing to one: that it is hidden.
        by_target: (A, B) that a token of the target is each of the source's; columns alike.
        source: (S, A) by how much each sample of the source belongs to each token; rows sum to one.
        target: (T, B) the same of the target.
    """

    by_source: Tensor
    by_target: Tensor
    source: Tensor
    target: Tensor

    @classmethod
    def of_logits(cls, logits: Tensor, source: Tensor, target: Tensor) -> MatchPrior:
        """Return the prior of a matcher's logits.

        ``source``: (S, 3) samples, the first A of which are tokens; of fewer samples tokens repeat some.
        """
        by_source, by_target = logits[:-1].softmax(1)[:, :-1], logits[:, :-1].softmax(0)[:-1]
        rows, columns = (min(size, len(points)) for size, points in zip(by_source.shape, (source, target), strict=True))
        by_source, by_target = _folded(by_source, columns)[:rows], _folded(by_target.mT, rows).mT[:, :columns]
        return cls(by_source, by_target, _shares(source, rows), _shares(target, columns))

    @classmethod
    def of_samples(cls, source: OrientedSamples, target: OrientedSamples, count: int) -> MatchPrior:
        """Return what the matcher of torchreg says of samples, the first ``count`` of the source alone."""
        tokens = (ScanTokens.from_even(scan.points, scan.normals, scan.boundary) for scan in (source, target))
        logits = shared_matcher()(*tokens)[0].to(source.points)
        return cls.of_logits(logits, source.points[:count], target.points)

    @cached_property
    def _offers(self) -> tuple[Tensor, Tensor, Tensor]:
        """What samples of the source (S, B) make of the target's tokens, and the few about each of its samples."""
        weight, about = self.target.topk(min(_ABOUT, self.by_source.shape[1]), dim=1)
        return self.source @ self.by_source, weight, about

    @cached_property
    def visible(self) -> Tensor:
        """(S,) probability that the target shows each sample of the source."""
        return self.source @ self.by_source.sum(1)

    @cached_property
    def target_visible(self) -> Tensor:
        """(T,) probability that the source shows each sample of the target."""
        return self.target @ self.by_target.sum(0)

    @cached_property
    def tables(self) -> tuple[Tensor, Tensor]:
        """Probabilities (A, 2 B) of matches of the source's tokens and twice as many samples of the target as it has.

        By source and by target. What a token has is shared among the samples about it, so that rows and columns sum to
        what is visible.
        """
        here, there = self.source[: self.by_source.shape[0]], self.target[: 2 * self.by_source.shape[1]]
        tiny = torch.finfo(here.dtype).tiny
        one = here @ self.by_source @ (there / there.sum(0).clamp_min(tiny)).mT
        other = (here / here.sum(0).clamp_min(tiny)) @ self.by_target @ there.mT
        return one, other

    def logarithm(self, index: Tensor, doubt: float) -> Tensor:
        """Return the logarithm (n, K) of how far matches are supported: zero for a sure one.

        ``index``: (n, K) samples of the target that each of the first samples of the source may match.
        """
        chances, weight, about = self._offers
        rows = torch.arange(len(index), device=index.device)[:, None, None]
        # A sure match of samples between tokens has the share of one token.
        support = _ABOUT * (chances[rows, about[index]] * weight[index]).sum(-1)
        return ((support + doubt) / (1 + doubt)).log()


def _folded(table: Tensor, count: int) -> Tensor:
    """Return a table (A, B) with what it holds of repeated tokens, those after ``count``, added to the first ones."""
    return table.new_zeros(len(table), count).index_add(1, torch.arange(table.shape[1]) % count, table)


def _shares(points: Tensor, count: int) -> Tensor:
    """Return by how much points (N, 3) belong to tokens, the first of them, (N, count); rows sum to one."""
    tokens = points[:count]
    index, distance = k_nearest(points, tokens, min(_ABOUT, len(tokens)))
    weights = 1 / (distance + (_SOFT * distance.mean()).clamp_min(torch.finfo(distance.dtype).tiny))
    weights = (weights / weights.sum(1, keepdim=True)).to(points)
    return points.new_zeros(len(points), count).scatter_(1, index, weights)
