"""One scan bent onto another, however far its limbs moved: by learnt matches and from rest, the best of both kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
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
from torchreg.registration.dense.problem import NORMAL_SCALE, ScanAlignProblem, describe
from torchreg.registration.dense.stages import (
    Reporter,
    agree,
    follow_regions,
    judge,
    loses_limb,
    refine,
    soft_matches,
    used_samples,
)

_One = TypeVar("_One")
_Other = TypeVar("_Other")
# How a graph is taken to where points are expected: that may be wrong in parts, and limbs turn far.
_EXPECTED_STIFFNESS, _EXPECTED_FITS = 0.02, 4
# What the slow end may cost more than the quick one: cloth that follows its folds looks better by its features.
# Between the two it counts so much more that the target is left bare: from far back, what bends strongly can be lost.
_SLOW_COSTS_MORE, _BARE = 0.05, 15.0


@torch.no_grad()
@one_thread()
def align_scans(
    source: RangeScan,
    target: RangeScan,
    config: ScanAlignConfig | None = None,
    *,
    generator: torch.Generator | None = None,
    on_step: OnStep | None = None,
    expected: Tensor | None = None,
) -> ScanAlignment:
    """Return the source moved onto the target: a deformation graph of many small nodes, without bones yet.

    Both scans are described by even samples, their curvature at several sizes, and what a learnt `ScanMatcher` says of
    their matches. Hypotheses start from rest; from where points are expected, if that is known; and from the matcher's
    matches, to which a stiff graph is fitted by an EM in which they are the prior, see `fit_coarsely`. Each goes on by
    an EM with an outlier class in which they still are, while edges of the graph give where its parts disagree, matches
    beside what something nearer hides hold across the surface alone, and samples where the target's camera saw nothing
    are taken back into its picture. Then, unless the two best agree and leave little of both scans over, each part
    moves as in the hypothesis that suits it, and the EM goes on from there as well. The best covers the target, most of
    all where its camera would have seen it, is covered by it, is like it, bends least, leaves the larger part of each
    wide region rigid, is nearest to what is expected, and takes no two limbs to one place; its EM is taken to the end,
    and beside that, unless two agreed, run anew, slowly, with matches that may slide, while what is unlike the target
    all around follows the wide regions it is in: that end is kept unless it is clearly worse or leaves more of the
    target bare.

    Everything is relative to the source's size and in its own frame: units change nothing, turns and shifts of both
    scans nothing beyond rounding.

    Args:
        source: the scan to be moved, N points.
        target: the scan to be reached, M points, in the same frame and unit.
        config: see `ScanAlignConfig`.
        generator: source of randomness; None draws the same numbers at every call.
        on_step: called with a `ScanAlignRecord` for each step, by the calling thread; when a hypothesis that another
            thread follows is done, for all of its steps.
        expected: (N, 3) where the source's points are expected, such as by their velocity.

    Returns:
        a `ScanAlignment`.

    Raises:
        InputError: if ``expected`` is not finite or its shape does not fit.

    Differentiable: no.

    Cost: 0.7 to 1.5 s for scans of 8,000 points on one core; three quarters where torch may use two threads, which
    then follow two hypotheses side by side: the result is the same to the bit.

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
    transforms, hypotheses = align_problem(problem, config, report)
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
        confidence=_confidence(problem, transforms, config, source.points).to(source.points),
        samples=problem.samples,
        nodes=problem.nodes,
        weights=weights.to(source.points),
        transforms=problem.unit.denormalize_motions(transforms).to(source.points),
        chosen=hypotheses[0],
        hypotheses=hypotheses,
        history=tuple(history),
    )


def align_problem(
    problem: ScanAlignProblem, config: ScanAlignConfig, on_step: OnStep
) -> tuple[Tensor, tuple[Hypothesis, ...]]:
    """Return the motions (J, 4, 4) of the nodes, and all hypotheses, the best first; see `align_scans`."""
    found = sorted(_candidates(problem, config, on_step), key=_energy)
    unsure = not _confirmed(problem, found, config)
    if unsure:
        found = sorted([*found, _fused(problem, found, config, on_step)], key=_energy)
    transforms = _finished(problem, found[0], config, unsure, on_step)
    return transforms, tuple(candidate.hypothesis for candidate in found)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Motions (J, 4, 4) on their way.

    Args:
        hypothesis: how they compare.
        transforms: the motions.
        sigma: with which their EM began.
    """

    hypothesis: Hypothesis
    transforms: Tensor
    sigma: float


def _candidates(problem: ScanAlignProblem, config: ScanAlignConfig, on_step: OnStep) -> list[_Candidate]:
    """Return the candidates before any are fused."""
    near, matched = _both_told(on_step, partial(_near, problem, config), partial(_by_matches, problem, config))
    return [*near, matched]


def _near(problem: ScanAlignProblem, config: ScanAlignConfig, on_step: OnStep) -> list[_Candidate]:
    """Return the candidates from rest and, if that is known, from where points are expected."""
    sigma, rest = config.refine.near_sigma, problem.graph.rest()
    found = [_compared(problem, rest, sigma, config, Reporter("rest", problem.unit.scale, on_step))]
    if problem.expected is not None:
        there = GraphMatches.of_places(problem.expected)
        ahead = fit_graph(problem.graph, rest, there, _EXPECTED_STIFFNESS, _EXPECTED_FITS).transforms
        found.append(_compared(problem, ahead, sigma, config, Reporter("expected", problem.unit.scale, on_step)))
    return found


def _by_matches(problem: ScanAlignProblem, config: ScanAlignConfig, on_step: OnStep) -> _Candidate:
    """Return the candidate from the matches of the matcher."""
    reporter = Reporter("matches", problem.unit.scale, on_step)
    begin = fit_coarsely(problem, config.coarse, reporter)
    return _compared(problem, begin, config.refine.near_sigma, config, reporter)


def _both_told(
    on_step: OnStep, one: Callable[[OnStep], _One], other: Callable[[OnStep], _Other]
) -> tuple[_One, _Other]:
    """Return what two calls return, made side by side; the thread that called the library tells of their steps."""
    later: list[ScanAlignRecord] = []
    found = run_both(partial(one, on_step), partial(other, later.append))
    for record in later:
        on_step(record)
    return found


def _checked(expected: Any, source: RangeScan) -> Tensor:
    """Return where points (N, 3) are expected; raise unless it fits the source."""
    expected = as_float_tensor(expected, "expected")
    check_shape(expected, "expected", tuple(source.points.shape))
    check_finite(expected, "expected")
    return expected.detach()


def _fused(
    problem: ScanAlignProblem, found: Sequence[_Candidate], config: ScanAlignConfig, on_step: OnStep
) -> _Candidate:
    """Return the candidate that takes the best of several."""
    begin = fuse_motions(problem, torch.stack([candidate.transforms for candidate in found]), config.choice)
    reporter = Reporter("fused", problem.unit.scale, on_step)
    return _compared(problem, begin, config.refine.fused_sigma, config, reporter)


def _compared(
    problem: ScanAlignProblem, transforms: Tensor, sigma: float, config: ScanAlignConfig, reporter: Reporter
) -> _Candidate:
    """Return the candidate after the first steps of its EM."""
    steps = slice(config.refine.compared_after)
    transforms = refine(problem, transforms, config.refine, reporter, sigma, steps)
    return _Candidate(judge(problem, reporter.name, transforms, config.choice), transforms, sigma)


def _finished(
    problem: ScanAlignProblem, candidate: _Candidate, config: ScanAlignConfig, unsure: bool, on_step: OnStep
) -> Tensor:
    """Return the motions (J, 4, 4) after the last steps; if unsure, those of a slower EM unless they are worse."""
    name, refining = candidate.hypothesis.name, config.refine

    def to_the_end(told: OnStep) -> Tensor:
        steps, reporter = slice(refining.compared_after, None), Reporter(name, problem.unit.scale, told)
        return refine(problem, candidate.transforms, refining, reporter, candidate.sigma, steps)

    def slowly(told: OnStep) -> Tensor:
        slow, reporter = refining.slower(), Reporter(name, problem.unit.scale, told)
        follow = None
        if refining.regions > 0:
            follow = follow_regions(problem, candidate.transforms, refining, config.choice)
        return refine(problem, candidate.transforms, slow, reporter, refining.near_sigma, stage="slide", follow=follow)

    if not unsure or refining.slow_steps == 0:
        return to_the_end(on_step)
    slow, quick = _both_told(on_step, slowly, to_the_end)
    return slow if _slow_is_kept(*(judge(problem, name, end, config.choice) for end in (slow, quick))) else quick


def _slow_is_kept(slow: Hypothesis, quick: Hypothesis) -> bool:
    """Return whether the end of the slower EM is kept."""
    return slow.energy + _BARE * slow.backward < quick.energy + _BARE * quick.backward + _SLOW_COSTS_MORE


def _confirmed(problem: ScanAlignProblem, found: Sequence[_Candidate], config: ScanAlignConfig) -> bool:
    """Return whether the best of several candidates is believed: the next best goes there too, and no limb is lost."""
    best, second = (candidate.transforms for candidate in found[:2])
    return agree(problem, best, second, config.choice) and not loses_limb(problem, best, config.choice)


def _energy(candidate: _Candidate) -> float:
    return candidate.hypothesis.energy


def _confidence(problem: ScanAlignProblem, transforms: Tensor, config: ScanAlignConfig, points: Tensor) -> Tensor:
    """Return the posterior mass (N,) of matches at points, by that of the nearest samples."""
    sigma = config.refine.sigma[1]
    moved = used_samples(problem, transforms, sigma, config.refine)
    own = soft_matches(problem, moved, sigma, config.refine).posterior
    index, _ = k_nearest(problem.unit.normalize(points), problem.graph.points[: len(own)], min(3, len(own)))
    return own[index].mean(1)
