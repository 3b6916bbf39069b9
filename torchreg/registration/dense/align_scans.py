"""One scan bent onto another, however far its limbs moved: by learnt matches and from rest, the best of both kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_positive, check_shape
from torchreg._threads import one_thread, run_both
from torchreg.geometry.neighbors import k_nearest
from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.blend import blend_linear
from torchreg.registration.dense.coarse_fit import fit_coarsely
from torchreg.registration.dense.config import (
    Hypothesis,
    OnStep,
    ScanAlignConfig,
    ScanAlignment,
    ScanAlignRecord,
)
from torchreg.registration.dense.fusion import fuse_motions
from torchreg.registration.dense.graph_fit import GraphMatches, fit_graph
from torchreg.registration.dense.node_graph import spread_weights
from torchreg.registration.dense.problem import NORMAL_SCALE, ExpectedPlaces, ScanAlignProblem, describe
from torchreg.registration.dense.reliability import confidence_of, judge
from torchreg.registration.dense.stages import Reporter, agree, refine, soft_matches

_One = TypeVar("_One")
_Other = TypeVar("_Other")
# How a graph is taken to where points are expected: that may be wrong in parts, and limbs turn far.
_EXPECTED_STIFFNESS, _EXPECTED_FITS = 0.02, 4


@torch.no_grad()
@one_thread()
def align_scans(
    source: RangeScan,
    target: RangeScan,
    config: ScanAlignConfig | None = None,
    *,
    generator: torch.Generator | None = None,
    on_step: OnStep | None = None,
    expected: ExpectedPlaces | None = None,
) -> ScanAlignment:
    """Return the source moved onto the target: a deformation graph of many small nodes, without bones yet.

    Both scans are described by even samples and what a learnt `ScanMatcher` says of their matches. Hypotheses start
    from rest; from where points are expected, if that is known, and there samples that the matcher calls hidden are
    held; and from the matcher's matches, to which a stiff graph is fitted by an EM in which they are the prior, see
    `fit_coarsely`. Each goes on by an EM with an outlier class, hidden samples by the matcher's probability, in which
    its matches still are the prior, while edges of the graph count robustly. Unless the two best agree,
    each part then moves as in the hypothesis that suits it, and the EM goes on from there as well.
    The best is the one that is right with the largest probability, by a learnt model: it covers the target, is covered
    by it, as far as each shows the other, deforms smoothly, has the matcher's support, and is near to what is expected.

    Everything is relative to the source's size and in its own frame: units change nothing, turns and shifts of both
    scans nothing beyond rounding.

    ``target``: the scan to be reached, M points, in the same frame and unit. ``generator``: source of randomness; None
    draws the same numbers at every call. ``on_step``: called with a `ScanAlignRecord` for each step, by the calling
    thread; when a hypothesis that another thread follows is done, for all of its steps. ``expected``: where the
    source's points (N, 3) are expected, such as by their velocity, and how surely.

    References: Chang and Zwicker 2009, section 5, on where to start; Sumner, Schmid and Pauly 2007 for the graph;
    Myronenko and Song 2010 for the EM with outliers.
    """
    config = ScanAlignConfig() if config is None else config
    history: list[ScanAlignRecord] = []

    def report(record: ScanAlignRecord) -> None:
        history.append(record)
        if on_step is not None:
            on_step(record)

    problem = describe(source, target, config, generator, None if expected is None else _checked(expected, source))
    found = align_problem(problem, report)
    transforms, hypotheses = found[0].transforms, tuple(candidate.hypothesis for candidate in found)
    weights = spread_weights(
        problem.unit.normalize(source.points),
        source.normals.detach().cpu().double(),
        problem.graph.points,
        problem.graph.normals,
        problem.graph.dense_weights,
        NORMAL_SCALE,
    )
    moved = blend_linear(problem.unit.normalize(source.points), weights, transforms)
    return ScanAlignment(
        points=problem.unit.denormalize(moved, source.points),
        confidence=confidence_of(hypotheses[0].evidence),
        point_confidence=_point_confidence(problem, transforms, source.points).to(source.points),
        samples=problem.samples,
        nodes=problem.nodes,
        weights=weights.to(source.points),
        transforms=problem.unit.denormalize_motions(transforms).to(source.points),
        chosen=hypotheses[0],
        hypotheses=hypotheses,
        history=tuple(history),
    )


@dataclass(frozen=True, eq=False)
class Candidate:
    """Motions (J, 4, 4) of the nodes, and how they compare with others."""

    hypothesis: Hypothesis
    transforms: Tensor


def align_problem(problem: ScanAlignProblem, on_step: OnStep) -> list[Candidate]:
    """Return all candidates, two at least, the best first; see `align_scans`."""
    found = sorted(_candidates(problem, on_step), key=_energy)
    if not agree(problem, found[0].transforms, found[1].transforms):
        found = sorted([*found, _fused(problem, found, on_step)], key=_energy)
    return found


def _candidates(problem: ScanAlignProblem, on_step: OnStep) -> list[Candidate]:
    """Return the candidates before any are fused."""
    near, matched = _run_both_reporting(on_step, partial(_near, problem), partial(_by_matches, problem))
    return [*near, matched]


def _near(problem: ScanAlignProblem, on_step: OnStep) -> list[Candidate]:
    """Return the candidates from rest and, if that is known, from where points are expected."""
    rest = problem.graph.rest()
    found = [_compared(problem, rest, Reporter("rest", problem.unit.scale, on_step))]
    if problem.expected is not None:
        expected = GraphMatches.of_places(problem.expected.places)
        ahead = fit_graph(problem.graph, rest, expected, _EXPECTED_STIFFNESS, _EXPECTED_FITS).transforms
        found.append(_compared(problem, ahead, Reporter("expected", problem.unit.scale, on_step)))
    return found


def _by_matches(problem: ScanAlignProblem, on_step: OnStep) -> Candidate:
    """Return the candidate from the matches of the matcher."""
    reporter = Reporter("matches", problem.unit.scale, on_step)
    return _compared(problem, fit_coarsely(problem, reporter), reporter)


def _run_both_reporting(
    on_step: OnStep, one: Callable[[OnStep], _One], other: Callable[[OnStep], _Other]
) -> tuple[_One, _Other]:
    """Return what two calls return, made side by side; the thread that called the library tells of their steps."""
    later: list[ScanAlignRecord] = []
    found = run_both(partial(one, on_step), partial(other, later.append))
    for record in later:
        on_step(record)
    return found


def _checked(expected: ExpectedPlaces, source: RangeScan) -> ExpectedPlaces:
    """Return where points are expected; raise unless that fits the source."""
    places = as_float_tensor(expected.places, "expected.places")
    check_shape(places, "expected.places", tuple(source.points.shape))
    check_finite(places, "expected.places")
    check_positive(expected.std, "expected.std", allow_zero=True)
    return ExpectedPlaces(places.detach(), expected.std)


def _fused(problem: ScanAlignProblem, found: Sequence[Candidate], on_step: OnStep) -> Candidate:
    """Return the candidate that takes the best of several."""
    begin = fuse_motions(problem, torch.stack([candidate.transforms for candidate in found]))
    return _compared(problem, begin, Reporter("fused", problem.unit.scale, on_step))


def _compared(problem: ScanAlignProblem, transforms: Tensor, reporter: Reporter) -> Candidate:
    """Return the candidate after its EM, see `refine`."""
    transforms = refine(problem, transforms, reporter)
    return Candidate(judge(problem, reporter.name, transforms), transforms)


def _energy(candidate: Candidate) -> float:
    return candidate.hypothesis.energy


def _point_confidence(problem: ScanAlignProblem, transforms: Tensor, points: Tensor) -> Tensor:
    """Return the posterior mass (N,) of matches at points, by that of the nearest samples."""
    own = soft_matches(problem, problem.moved(transforms), problem.config.refine.sigma[1]).posterior
    index, _ = k_nearest(problem.unit.normalize(points), problem.graph.points[: len(own)], min(3, len(own)))
    return own[index].mean(1)
