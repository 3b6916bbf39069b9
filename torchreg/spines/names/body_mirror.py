"""The mirror symmetry of a body: limbs that are each other's mirror images, which poses do not identify."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.spines.names.student_t import GroupedDensity
from torchreg.spines.names.tip_features import TipFeatures, TipObservations


@dataclass(frozen=True)
class SymmetrySearch:
    """Which exchanges of tips are tried and believed."""

    num_tips: tuple[int, int] = (3, 10)  # with two, no mirror is observable; with more there are too many: 9,496 of ten
    num_frames: int = 16  # of a sequence, evenly spaced, that are looked at: poses recur
    least_evidence: float = 5.0  # log-odds of a mirror against none and any other: of stars 4, of animals 6 to 20
    least_difference: float = 1e-3  # squared, in variances of random names, below which none is measured


SEARCH = SymmetrySearch()


@dataclass(frozen=True, eq=False)
class BodyMirror:
    """A mirror symmetry of a body: the image (K,) of each name, and differences (G,) in variances of random names."""

    names: Tensor
    levels: Tensor

    def features(self, kinds: TipFeatures, frame: TipObservations, maps: Tensor, distances: Tensor) -> Tensor:
        """Return the features (P, n) of the mirror image of a frame with names (P, K), given median distances."""
        return kinds(frame.mirrored(), maps[:, self.names], distances)


def find_mirror(
    kinds: TipFeatures, background: GroupedDensity, frames: Sequence[TipObservations], names: Tensor
) -> BodyMirror | None:
    """Return the mirror symmetry of a body with names (T, K); None if none is certain."""
    count, (least, most) = kinds.num_names, SEARCH.num_tips
    # Of frames that show all tips: one without a name has the name that is missing.
    complete = [row for row in range(len(frames)) if len(frames[row]) == count and int((names[row] < 0).sum()) < 2]
    if not least <= count <= most or not complete:
        return None
    shown = [complete[int(row)] for row in torch.linspace(0, len(complete) - 1, min(len(complete), SEARCH.num_frames))]
    exchanges = torch.tensor(list(_exchanges(list(range(count)), 0))[1:])
    sizes, unknown = _sizes(kinds, background, exchanges), torch.zeros(kinds.pairs.shape[1], dtype=torch.float64)
    best, evidence, levels = 0, -math.inf, []
    for row in shown:
        own = torch.where(names[row] < 0, count * (count - 1) // 2 - names[row].clamp_min(0).sum(), names[row])
        offsets = kinds(frames[row], own[None], unknown) - kinds(frames[row].mirrored(), own[exchanges], unknown)
        squares = torch.stack([white.square().sum(-1) for white in background.whitened(offsets)], -1) / 4
        level = (squares / sizes.clamp_min(1)).clamp_min(SEARCH.least_difference)
        odds = 0.5 * sizes * (level - 1 - level.log())
        odds = torch.where(level < 1, odds, -odds).sum(-1)
        (first, second), order = torch.cat((odds, odds.new_zeros(1))).topk(2)
        levels.append(level[order[0].clamp_max(len(exchanges) - 1)])
        if float(first - second) > evidence:
            best, evidence = int(order[0]), float(first - second)
    if evidence < SEARCH.least_evidence or best == len(exchanges):
        return None
    return BodyMirror(names=exchanges[best], levels=torch.stack(levels).median(0).values)


def _exchanges(names: list[int], first: int) -> Iterator[list[int]]:
    """Yield all ways to exchange pairs of names from a first one on: none at first."""
    if first == len(names):
        yield names
        return
    yield from _exchanges(names, first + 1)
    if names[first] == first:
        for second in range(first + 1, len(names)):
            if names[second] == second:
                swapped = list(names)
                swapped[first], swapped[second] = second, first
                yield from _exchanges(swapped, first + 1)


def _sizes(kinds: TipFeatures, background: GroupedDensity, exchanges: Tensor) -> Tensor:
    """Return in how many dimensions (M, G) of each group a body can differ from its mirror image under exchanges."""
    fixed = (exchanges == torch.arange(kinds.num_names)).sum(1)
    swapped = (kinds.num_names - fixed) // 2
    pairs = (kinds.pairs.shape[1] - fixed * (fixed - 1) // 2 - swapped) / 2
    # Volumes of three names that stay change their sign, those of one that stays and two exchanged do not.
    triples = (len(kinds.triples) - swapped * fixed + fixed * (fixed - 1) * (fixed - 2) // 6) / 2
    sizes = [swapped, pairs - swapped, triples, swapped * kinds.num_limb_features]
    return torch.stack([sizes[group.number] for group in background.groups], -1).double()
