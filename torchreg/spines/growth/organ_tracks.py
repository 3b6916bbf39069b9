"""Names of the organs of a thing that grows: tips that appear, last and end, over the whole sequence at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import torch
from torch import Tensor

from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.solvers.tracks import TrackGraph
from torchreg.spines.names.name_model import PRIORS, mixture_scales
from torchreg.spines.names.student_t import t_log_density
from torchreg.spines.names.tip_features import TipObservations


@dataclass(frozen=True)
class OrganLife:
    """What is assumed of organs, and how their tracks are searched; log-odds are those of one frame."""

    birth: float = -1.0  # an organ appears, rather than a bump of the surface
    end: float = -1.5  # an organ ends
    hidden: float = -0.75  # an organ that lasts is not observed
    max_hidden: int = 3  # frames in a row
    max_certainty: float = 1.5  # of a single tip: log-odds that it is no bump
    starts: tuple[float, ...] = (0.04, 0.15)  # scales of displacements with which searches start, in sizes of the body
    num_rounds: int = 6  # of the best tracks and new scales, at most
    dof: float = 8.0  # of displacements: what grows does not jump
    inner: int = 2  # sample of a limb that gives, from its tip, its direction
    num_body: int = 3  # organs that determine the motion of the whole body
    num_salient: int = 4  # surest tips of a frame, of which two give candidates for the first motion of the body


LIFE = OrganLife()


@dataclass(frozen=True, eq=False)
class OrganTracks:
    """The K organs of T frames, in the order in which they appear."""

    labels: Tensor  # (T, K) index of each organ's tip in its frame, -1 where the frame lacks it
    # (T, K) probability that this is what became of its last tip; where the frame lacks it, that of the next one; NaN
    # before its birth and after its end
    confidence: Tensor
    births: Tensor
    ends: Tensor

    @property
    def alive(self) -> Tensor:
        """Return a mask (T, K) of the organs that exist, observed or hidden."""
        numbers = torch.arange(len(self.labels))[:, None]
        return (numbers >= self.births) & (numbers <= self.ends)


def track_organs(frames: Sequence[TipObservations], certainties: Sequence[Tensor]) -> OrganTracks:
    """Return the organs of all frames, from log-odds (M,) of each frame that a tip is no bump of the surface.

    Each organ is a chain of states: unborn, observed, hidden, ended. Links have t-distributed changes of position and
    direction, with or without the motion of the whole body, against uniform ones. The most probable set of tracks
    (Zhang, Li and Nevatia 2008) and the scales of the changes are estimated in turn.
    """
    searches = [_Search(frames, certainties, start) for start in LIFE.starts]
    return max(searches, key=lambda search: search.score).tracks()


class _Search:
    """One search for the tracks of N tips, with a scale of displacements at first."""

    def __init__(self, frames: Sequence[TipObservations], certainties: Sequence[Tensor], displacement: float) -> None:
        # (N, 2, 3): where each limb ends, and a point before that.
        self.places = torch.cat([frame.curves[:, [0, LIFE.inner]] for frame in frames])
        self.sizes = [len(frame) for frame in frames]
        self.frame_of = torch.arange(len(frames)).repeat_interleave(torch.tensor(self.sizes))
        extent = (self.places.amax((0, 1)) - self.places.amin((0, 1))).norm().clamp_min(1e-6)
        reach = _steps(self.places)[:, 1].norm(dim=-1).median().clamp_min(1e-6)
        self.log_volumes = torch.stack((3 * extent.log(), math.log(4 / 3 * math.pi) + 3 * reach.log()))
        self.scales = torch.stack((torch.full_like(reach, displacement), reach / 2))
        blocks = self._possible_links()
        self.block_sizes = [len(block) for block in blocks]
        links = torch.cat((torch.zeros(0, 2, dtype=torch.int64), *blocks))
        self.gaps = (self.frame_of[links[:, 1]] - self.frame_of[links[:, 0]]).double()
        first, last = self.frame_of == 0, self.frame_of == len(frames) - 1
        self.graph = TrackGraph(
            links=links,
            gains=torch.zeros(len(links), dtype=torch.float64),
            real=torch.cat(list(certainties)).clamp_max(LIFE.max_certainty),
            starts=torch.where(first, 0.0, LIFE.birth).double(),
            stops=torch.where(last, 0.0, LIFE.end).double(),
        )
        self.motions = [self._first_motion(*(column.unique() for column in pairs.unbind(1))) for pairs in blocks]
        self.used, self.score = torch.zeros(len(links), dtype=torch.bool), -math.inf
        for _ in range(LIFE.num_rounds):
            squares = self._squares()
            self.graph = replace(self.graph, gains=self._gains(squares))
            before, (self.used, self.real, self.score) = self.used, self.graph.best_tracks()
            if torch.equal(before, self.used):
                break
            self.scales = mixture_scales(squares[:, self.used] / self.gaps[self.used][:, None])

    def _possible_links(self) -> list[Tensor]:
        """Return the pairs of tips (n, 2) of any two frames that are not too far apart."""
        numbers = list(torch.arange(len(self.places)).split(self.sizes))
        pairs = [
            torch.cartesian_prod(numbers[before], numbers[after])
            for before in range(len(numbers))
            for after in range(before + 1, min(before + LIFE.max_hidden + 2, len(numbers)))
        ]
        return [block for block in pairs if len(block)]

    def _squares(self) -> Tensor:
        """Return squared changes (2, E, 2) over links, moved with the body and as they are, of place and direction."""
        source, target = self.places[self.graph.links].unbind(1)
        blocks = zip(*(rows.split(self.block_sizes) for rows in (source, target, self.used)), self.motions, strict=True)
        moved = [
            transform_points(_body_motion(*block), block[0].flatten(0, 1)).unflatten(0, (-1, 2)) for block in blocks
        ]
        ways = torch.cat((source[:0], *moved)), source
        return torch.stack([(_steps(target) - _steps(rows)).square().sum(-1) for rows in ways])

    def _first_motion(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the motion (4, 4) of the body between two frames with tips (n,) and (m,) of unknown names."""
        salient = [tips[self.graph.real[tips].argsort(descending=True, stable=True)[: LIFE.num_salient]]
                   for tips in (before, after)]  # fmt: skip
        guesses = torch.cat((torch.eye(4, dtype=torch.float64)[None], self._guesses(*salient)))
        moved = transform_points(guesses, self.places[before, 0].expand(len(guesses), -1, -1))
        apart = (moved[:, :, None] - self.places[after, 0]).square().sum(-1)
        scores = t_log_density(apart.amin(2), self.scales[:1], 3, LIFE.dof).sum(1)
        turn = (3 - guesses[:, :3, :3].diagonal(dim1=1, dim2=2).sum(-1)) / 2
        return guesses[(scores - 1.5 * turn / PRIORS.turn).argmax()]

    def _guesses(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the motions (G, 4, 4) that take two of some limbs to two others."""
        sources = torch.tensor(list(combinations(before.tolist(), 2)), dtype=torch.int64).reshape(-1, 1, 2)
        targets = torch.tensor(list(permutations(after.tolist(), 2)), dtype=torch.int64).reshape(1, -1, 2)
        shape = (sources.shape[0], targets.shape[1], 2)
        source, target = (self.places[rows.expand(shape)].flatten(0, 1).flatten(1, 2) for rows in (sources, targets))
        return fit_rigid(source, target)

    def _gains(self, squares: Tensor) -> Tensor:
        """Return the log-odds (E,) of links with such changes, which grow with time as those of a random walk."""
        scales = self.scales * self.gaps.sqrt()[:, None]
        moved, still = (t_log_density(rows, scales, 3, LIFE.dof) for rows in squares)
        densities = torch.logaddexp(moved, still) - math.log(2) + self.log_volumes
        return densities.sum(-1) + (self.gaps - 1) * LIFE.hidden

    def tracks(self) -> OrganTracks:
        """Return the tracks that were found."""
        first, second = self.graph.links[self.used].unbind(1)
        heads = self.real.clone()
        heads[second] = False
        organs = torch.full((len(heads),), -1)
        organs[heads] = torch.arange(int(heads.sum()))
        for link in self.frame_of[second].argsort(stable=True).tolist():
            organs[second[link]] = organs[first[link]]
        chances, starting = self.graph.link_probabilities()
        chance = torch.where(heads, starting, 0.0)
        chance[second] = chances[self.used]
        tips = self.real.nonzero()[:, 0]
        where = self.frame_of[tips], organs[tips]
        labels = torch.full((len(self.sizes), int(heads.sum())), -1)
        labels[where] = tips - (torch.tensor(self.sizes).cumsum(0) - torch.tensor(self.sizes))[self.frame_of[tips]]
        confidence = torch.full(labels.shape, torch.nan, dtype=torch.float64)
        confidence[where] = chance[tips]
        return _lived(labels, confidence)


def _body_motion(source: Tensor, target: Tensor, used: Tensor, first: Tensor) -> Tensor:
    """Return the motion (4, 4) of the body between two frames by the used links (n,), or the first guess."""
    return fit_rigid(source[used, 0], target[used, 0]) if int(used.sum()) >= LIFE.num_body else first


def _steps(places: Tensor) -> Tensor:
    """Return the place of a limb's end and its direction (..., 2, 3), of its end and a point before that."""
    return torch.stack((places[..., 0, :], places[..., 0, :] - places[..., 1, :]), dim=-2)


def _lived(labels: Tensor, confidence: Tensor) -> OrganTracks:
    """Return tracks with the frames in which organs begin and end, and confidences where they are hidden."""
    shown, numbers = labels >= 0, torch.arange(len(labels))[:, None]
    births = torch.where(shown, numbers, len(labels)).amin(0)
    tracks = OrganTracks(
        labels=labels, confidence=confidence, births=births, ends=torch.where(shown, numbers, -1).amax(0)
    )
    for number in range(len(labels) - 2, -1, -1):
        hidden = tracks.alive[number] & ~shown[number]
        confidence[number, hidden] = confidence[number + 1, hidden]
    return tracks
