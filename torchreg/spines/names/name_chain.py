"""Names of tips over a whole sequence at once: the most probable chain of assignments, and the posterior of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import torch
from torch import Tensor

from torchreg.solvers.assignment import assign
from torchreg.spines.frames.frame_workers import Job, do_jobs
from torchreg.spines.names.name_model import PRIORS, NameModel, relative_maps
from torchreg.spines.names.tip_features import TipObservations


@dataclass(frozen=True)
class NameSearch:
    """How names are searched."""

    # Scales of displacements, in sizes of the body, and weights of features, with which searches start.
    starts: tuple[tuple[float, float], ...] = ((0.04, 1.0), (0.15, 1.0), (0.04, 0.0))
    num_rounds: int = 6  # of the best chain and a new model, at most
    num_candidates: int = 32  # names of a frame among which the chain chooses, at least
    num_kept: int = 8  # of the names that are one exchange away, from which those two exchanges away are made
    max_distance: float = 20.0  # squared, in scales of displacements, beyond which limbs are equally far
    temperature: float = 8.0  # of confidences: features of one frame are less independent than the model has it


SEARCH = NameSearch()


@dataclass(frozen=True, eq=False)
class TipNames:
    """The tip (T, K) of each name in each frame, -1 for none; its probability (T, K); the frame of certain names."""

    labels: Tensor
    confidence: Tensor
    reference: int


def name_over_time(
    frames: Sequence[TipObservations], reference: int, names: Tensor, workers: int | None = 1
) -> TipNames:
    """Return the names of all frames, given those (K,) of one: the most probable of several searches.

    Names (Viterbi 1967; Rabiner 1989 for the probabilities of single states) and the model of what stays the same under
    them are improved in turn, from small motion, from large motion, and from motion alone.
    """
    unknown: list[Tensor | None] = [None] * len(frames)
    model = NameModel.from_frame(frames, reference, names)
    # Without features a mirror changes nothing: of the last start this is the first round.
    by_motion = _Round(frames, reference, names, model.starting(*SEARCH.starts[-1]), unknown)
    # What names do not determine, as motion where no two frames share a tip, is that of the first start.
    model = model.mirrored(frames, by_motion.labels, reference).starting(*SEARCH.starts[0])
    found = {len(SEARCH.starts) - 1: by_motion}
    jobs = (
        Job(
            number,
            partial(_Round, frames, reference, names, model.starting(*start), unknown),
            partial(found.__setitem__, number),
        )
        for number, start in enumerate(SEARCH.starts[:-1])
    )
    do_jobs(lambda: next(jobs, None), len(frames), workers)
    following: dict[bytes, _Round] = {}

    def after(before: _Round) -> _Round:
        """Return the next round, which depends on nothing but the names of the last one."""
        key = before.labels.numpy().tobytes()
        if key not in following:
            refitted = model.refitted(frames, before.labels)
            following[key] = _Round(frames, reference, names, refitted, before.labels.unbind(0))
        return following[key]

    ends = []
    for _, last in sorted(found.items()):
        for _ in range(SEARCH.num_rounds - 1):
            before, last = last, after(last)
            if torch.equal(before.labels, last.labels):
                break
        ends.append(last)
    best = max(ends, key=lambda end: end.score)
    return TipNames(labels=best.labels, confidence=best.confidence, reference=reference)


class _Round:
    """One search for the names with a fixed model, near ``chosen`` names (K,) of each frame if there are any."""

    def __init__(
        self, frames: Sequence[TipObservations], reference: int, names: Tensor, model: NameModel,
        chosen: Sequence[Tensor | None],
    ) -> None:  # fmt: skip
        self.frames, self.reference, self.known, self.model = frames, reference, names, model
        self.labels = self._most_probable(self._candidates(chosen))

    def _candidates(self, chosen: Sequence[Tensor | None]) -> list[Tensor]:
        """Return names (P, K) of each frame that are worth a look, outwards from the reference."""
        best, rows = {self.reference: self.known}, [self.known[None]] * len(self.frames)
        for step, stop in ((1, len(self.frames)), (-1, -1)):
            for number in range(self.reference + step, stop, step):
                near = best[number - step]
                carried, before = self._carried(number - step, number, near), chosen[number]
                seeds = carried[None] if before is None else torch.stack((carried, before)).unique(dim=0)
                rows[number], first = self._neighborhood(number - step, number, near, seeds)
                best[number] = first if before is None else before
        return rows

    def _carried(self, near: int, number: int, names: Tensor) -> Tensor:
        """Return the names (K,) of a frame if every limb is the nearest one to that of the frame near it."""
        offsets = (self.frames[near].curves[:, None] - self.frames[number].curves).square().sum(-1)
        costs = (offsets / self.model.displacement.square()).mean(-1).clamp_max(SEARCH.max_distance)
        return torch.where(names >= 0, assign(costs)[names.clamp_min(0)], -1)

    def _neighborhood(self, near: int, number: int, known: Tensor, seeds: Tensor) -> tuple[Tensor, Tensor]:
        """Return names (P, K) of a frame within two exchanges of the seeds, and the most probable ones (K,)."""
        maps = seeds
        for kept in (SEARCH.num_kept, SEARCH.num_candidates // 2):
            maps = _exchanged(maps, len(self.frames[number]))
            by_itself = self._by_itself(number, maps)
            after = by_itself + self._motion(near, number, known[None], maps)[0]
            ranks = [scores.argsort(descending=True, stable=True)[:kept] for scores in (after, by_itself)]
            first, maps = maps[ranks[0][0]], maps[torch.cat(ranks).unique()]
        return torch.cat((maps, seeds)).unique(dim=0), first

    def _by_itself(self, number: int, maps: Tensor) -> Tensor:
        """Return the scores (P,) of names (P, K) of a frame without any other."""
        scores = self.model.scores(self.model.of_names(self.frames[number], maps))
        return scores + PRIORS.missing * (maps < 0).sum(-1).double()

    def _motion(self, near: int, number: int, known: Tensor, maps: Tensor) -> Tensor:
        """Return the scores (A, B) of the motion between names (A, K) of a frame and names (B, K) of another."""
        if near > number:
            return self._motion(number, near, maps, known).mT
        before, after = self.frames[near], self.frames[number]
        tips = relative_maps(known, maps, len(before))
        different, which = tips.flatten(0, 1).unique(dim=0, return_inverse=True)
        return self.model.motion_scores(before, after, different)[which].reshape(tips.shape[:2])

    def _most_probable(self, candidates: Sequence[Tensor]) -> Tensor:
        """Return the most probable names (T, K) among candidates; keep their score and confidence."""
        start = self._by_itself(0, candidates[0])
        steps = [
            self._motion(number - 1, number, candidates[number - 1], candidates[number])
            + self._by_itself(number, candidates[number])
            for number in range(1, len(candidates))
        ]
        path, self.score = _best_path(start, steps)
        chances = _state_probabilities(start / SEARCH.temperature, [step / SEARCH.temperature for step in steps])
        labels = torch.stack([rows[state] for rows, state in zip(candidates, path, strict=True)])
        alike = [rows == label for rows, label in zip(candidates, labels, strict=True)]
        self.confidence = torch.stack(
            [(same * chance[:, None]).sum(0) for same, chance in zip(alike, chances, strict=True)]
        )
        return labels


def _exchanged(maps: Tensor, num_tips: int) -> Tensor:
    """Return names (P, K) and all that are one step away: two names exchanged, one moved to a free tip or to none."""
    num_names = maps.shape[1]
    first, second = torch.tensor(list(combinations(range(num_names), 2))).T
    columns = torch.arange(num_names).repeat(len(first), 1)
    columns[torch.arange(len(first)), first], columns[torch.arange(len(first)), second] = second, first
    swapped = maps[:, columns].flatten(0, 1)
    targets = torch.arange(-1, num_tips)
    moved = maps[:, None, None].repeat(1, num_names, len(targets), 1)
    names = torch.arange(num_names)
    moved[:, names, :, names] = targets.expand(num_names, len(maps), -1)
    taken = (maps[:, None] == targets[1:, None]).any(-1)
    free = torch.cat((torch.ones(len(maps), 1, dtype=torch.bool), ~taken), dim=1)
    moved = moved[free[:, None].expand(moved.shape[:3])]
    return torch.cat((maps, swapped, moved)).unique(dim=0)


def _best_path(start: Tensor, steps: Sequence[Tensor]) -> tuple[list[int], float]:
    """Return the states (T,) of the chain of highest score, from scores (A,) and of steps (A, B), and that score."""
    total, back = start, []
    for step in steps:
        total, origin = (total[:, None] + step).max(0)
        back.append(origin)
    path = [int(total.argmax())]
    for origin in reversed(back):
        path.append(int(origin[path[-1]]))
    return path[::-1], float(total.max())


def _state_probabilities(start: Tensor, steps: Sequence[Tensor]) -> list[Tensor]:
    """Return the probabilities of all states of a chain with such log-scores."""
    forward = [start]
    for step in steps:
        forward.append((forward[-1][:, None] + step).logsumexp(0))
    backward = [torch.zeros_like(forward[-1])]
    for step in reversed(steps):
        backward.append((step + backward[-1]).logsumexp(1))
    return [(a + b).softmax(0) for a, b in zip(forward, reversed(backward), strict=True)]
