"""The mirror symmetry of a body: limbs that are each other's mirror images, which poses do not identify."""

from __future__ import annotations

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
    """A mirror symmetry of a body: the mirror image of each name (K,), and of each feature (n,) with its sign."""

    names: Tensor
    columns: Tensor
    signs: Tensor
    levels: Tensor

    def __call__(self, features: Tensor) -> Tensor:
        """Return the features (..., n) of the mirror images of bodies with features (..., n)."""
        return self.signs * features[..., self.columns]


def find_mirror(
    kinds: TipFeatures, background: GroupedDensity, frames: Sequence[TipObservations], names: Tensor
) -> BodyMirror | None:
    """Return the mirror symmetry of a body; None if none is certain."""
    count, (least, most) = kinds.num_names, SEARCH.num_tips
    # Of frames that show all tips: one without a name has the name that is missing.
    complete = [row for row in range(len(frames)) if len(frames[row]) == count and int((names[row] < 0).sum()) < 2]
    if not least <= count <= most or not complete:
        return None
    shown = [complete[int(row)] for row in torch.linspace(0, len(complete) - 1, min(len(complete), SEARCH.num_frames))]
    exchanges = torch.tensor(list(_exchanges(list(range(count)), 0))[1:])
    columns, signs = _images(kinds, exchanges)
    own, unknown = torch.arange(count)[None], torch.zeros(kinds.pairs.shape[1], dtype=torch.float64)
    features = torch.cat([kinds(frames[row], own, unknown) for row in shown])
    sizes = _sizes(background, columns, signs)
    levels = torch.stack([_levels(background, row - signs * row[columns], sizes) for row in features])
    best, evidence = _most_certain(levels, sizes)
    if evidence < SEARCH.least_evidence:
        return None
    mirror = exchanges[best[1]]
    labels = names[shown[best[0]]]
    labels = torch.where(labels < 0, count * (count - 1) // 2 - labels.clamp_min(0).sum(), labels)
    mirror = labels.argsort()[mirror[labels]]
    columns, signs = _images(kinds, mirror[None])
    return BodyMirror(names=mirror, columns=columns[0], signs=signs[0], levels=best[2])


def _most_certain(levels: Tensor, sizes: Tensor) -> tuple[tuple[int, int, Tensor], float]:
    """Return the frame, its most certain mirror and a median frame's levels (G,), and the margin of log-odds."""
    odds = 0.5 * sizes * (levels - 1 - levels.log())
    evidence = torch.where(levels < 1, odds, -odds).sum(-1)
    highest, mirrors = torch.nn.functional.pad(evidence, (0, 1)).topk(2, dim=1)
    margins = highest[:, 0] - highest[:, 1]
    frame = int(margins.argmax())
    median = levels[torch.arange(len(levels)), mirrors[:, 0].clamp_max(levels.shape[1] - 1)].median(0).values
    return (frame, int(mirrors[frame, 0]), median), float(margins[frame])


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


def _images(kinds: TipFeatures, names: Tensor) -> tuple[Tensor, Tensor]:
    """Return the columns and signs (M, n) of mirrors that exchange names (M, K), as features are ordered."""
    (pairs, _), (triples, parities) = (_mirrored(tuples, names) for tuples in (kinds.pairs.T, kinds.triples))
    numbers = torch.arange(kinds.num_limb_features)
    limbs = (names[..., None] * kinds.num_limb_features + numbers).flatten(1)
    parts = [names, pairs, triples, limbs]
    starts = torch.tensor([0, *(part.shape[1] for part in parts[:-1])]).cumsum(0).tolist()
    columns = torch.cat([part + start for part, start in zip(parts, starts, strict=True)], dim=1)
    signs = torch.ones(columns.shape, dtype=torch.float64)
    signs[:, starts[2] : starts[3]] = -parities
    return columns, signs


def _mirrored(tuples: Tensor, names: Tensor) -> tuple[Tensor, Tensor]:
    """Return where tuples (m, k) are among them after exchanges (M, K), and the parities (M, m) of their orders."""
    count, length = names.shape[1], tuples.shape[1]
    digits = count ** torch.arange(length)
    numbers = torch.zeros(count**length, dtype=torch.int64)
    numbers[tuples @ digits] = torch.arange(len(tuples))
    images = names[:, tuples]
    offsets = torch.stack([images[..., b] - images[..., a] for a in range(length) for b in range(a + 1, length)], -1)
    return numbers[images.sort(-1).values @ digits], offsets.sign().prod(-1).double()


def _sizes(background: GroupedDensity, columns: Tensor, signs: Tensor) -> Tensor:
    """Return in how many dimensions (M, G) of each group of features a body can differ from its mirror image."""
    same = signs * (columns == torch.arange(columns.shape[1]))
    sizes = [(len(group.index) - same[:, group.index].sum(1)) / 2 for group in background.groups]
    # Distances are the sum of terms for both tips, which are a group, and of a rest.
    parts = [sizes[0] * (group.rank < len(group.index)) for group in background.groups]
    return torch.stack(sizes, -1) - torch.stack(parts, -1)


def _levels(background: GroupedDensity, offsets: Tensor, sizes: Tensor) -> Tensor:
    """Return the differences (M, G) of mirror images by offsets (M, n), in variances of random names."""
    squares = torch.stack([rows.square().sum(-1) for rows in background.whitened(offsets)], -1) / 4
    return (squares / sizes.clamp_min(1)).clamp_min(SEARCH.least_difference)
