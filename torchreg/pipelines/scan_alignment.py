"""One scan bent onto another, however far its limbs moved: several hypotheses, each refined, the best kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torchreg.geometry.blend import blend_linear
from torchreg.geometry.neighbors import nearest_few
from torchreg.geometry.node_graph import spread_weights
from torchreg.geometry.range_scan import RangeScan
from torchreg.pipelines.scan_align_config import (
    Hypothesis,
    OnStep,
    ScanAlignConfig,
    ScanAlignment,
    ScanAlignRecord,
)
from torchreg.pipelines.scan_align_problem import ScanAlignProblem, describe, first_matches
from torchreg.pipelines.scan_align_stages import (
    Reporter,
    agree,
    fit_first_matches,
    judge,
    pull_one_to_one,
    refine,
    soft_matches,
    used_samples,
)
from torchreg.pipelines.scan_fusion import fuse_motions
from torchreg.pipelines.threads import one_thread

# What opposite normals count as when points take over the motion of the samples around them, length.
_NORMAL_SCALE = 0.03
# Two hypotheses that agree need no fusion.
_LEAST_FUSED = 3


@torch.no_grad()
@one_thread()
def align_scans(
    source: RangeScan,
    target: RangeScan,
    config: ScanAlignConfig | None = None,
    *,
    generator: torch.Generator | None = None,
    on_step: OnStep | None = None,
) -> ScanAlignment:
    """Return the source moved onto the target: a deformation graph of many small nodes, without bones yet.

    Both scans are described by even samples, their curvature at several sizes and spin images. Hypotheses start from
    rest; from matches of spin images that agree on distances along the surface, fitted stiffly, or softly and then
    pulled by one-to-one matches; and from one-to-one matches alone. Each ends by an EM with an outlier class, while
    edges of the graph give where its parts disagree, matches beside what something nearer hides hold across the
    surface alone, and samples where the target's camera saw nothing are taken back into its picture. Then each part
    moves as in the hypothesis that suits it, and the EM ends that as well. The best covers the target, is covered by
    it, is like it, and bends least. Where the first two agree, the others are left
    out.

    Everything is relative to the source's size and in its own frame: units change nothing, turns and shifts of both
    scans nothing beyond rounding.

    Args:
        source: the scan to be moved, N points.
        target: the scan to be reached, M points, in the same frame and unit.
        config: see `ScanAlignConfig`.
        generator: source of randomness; None draws the same numbers at every call.
        on_step: called with a `ScanAlignRecord` after each step.

    Returns:
        a `ScanAlignment`.

    Differentiable: no.

    Cost: about 2 s for scans of 8,000 points on one core.

    References: Chang and Zwicker 2009, section 5, on where to start; Sumner, Schmid and Pauly 2007 for the graph;
    Myronenko and Song 2010 for the EM with outliers.
    """
    config = ScanAlignConfig() if config is None else config
    history: list[ScanAlignRecord] = []

    def report(record: ScanAlignRecord) -> None:
        history.append(record)
        if on_step is not None:
            on_step(record)

    problem = describe(source, target, config, generator)
    found = sorted(_hypotheses(problem, config, report), key=_energy)
    if len(found) >= _LEAST_FUSED:
        found = sorted([*found, _fused(problem, found, config, report)], key=_energy)
    chosen, transforms = found[0]
    weights = spread_weights(
        problem.unit.of_points(source.points),
        source.normals.detach().cpu().double(),
        problem.graph.points,
        problem.graph.normals,
        problem.graph.dense_weights,
        _NORMAL_SCALE,
    )
    moved = blend_linear(problem.unit.of_points(source.points), weights, transforms)
    return ScanAlignment(
        problem.unit.points_back(moved, source.points),
        _confidence(problem, transforms, config, source.points).to(source.points),
        problem.samples,
        problem.nodes,
        weights.to(source.points),
        problem.unit.transforms_back(transforms).to(source.points),
        chosen,
        tuple(hypothesis for hypothesis, _ in found),
        tuple(history),
    )


def _hypotheses(
    problem: ScanAlignProblem, config: ScanAlignConfig, on_step: OnStep
) -> Iterator[tuple[Hypothesis, Tensor]]:
    """Yield hypotheses and their motions, until two that started apart agree."""
    rest = problem.graph.rest()
    far, near = config.refine.sigma[0], config.refine.near_sigma

    def refined(transforms: Tensor, sigma: float, reporter: Reporter) -> tuple[Hypothesis, Tensor]:
        transforms = refine(problem, transforms, config.refine, reporter, sigma)
        return judge(problem, reporter.name, transforms, config.choice), transforms

    def reporter(name: str) -> Reporter:
        return Reporter(name, problem.unit.size, on_step)

    still = refined(rest, near, reporter("rest"))
    yield still
    matches = first_matches(problem, config.match)
    if len(matches.weights) >= config.match.min_matches:
        stiff = reporter("stiff matches")
        other = refined(fit_first_matches(problem, matches, config.match.stiffer, config.match, stiff), near, stiff)
        yield other
        if agree(problem, still[1], other[1], config.choice):
            return
        soft = reporter("matches")
        fitted = fit_first_matches(problem, matches, config.match.stiffness, config.match, soft)
        yield refined(pull_one_to_one(problem, fitted, config.reassign, soft), far, soft)
    alone = reporter("one to one")
    yield refined(pull_one_to_one(problem, rest, config.assign, alone), far, alone)


def _fused(
    problem: ScanAlignProblem, found: Sequence[tuple[Hypothesis, Tensor]], config: ScanAlignConfig, on_step: OnStep
) -> tuple[Hypothesis, Tensor]:
    """Return the hypothesis that takes the best of several, and its motions."""
    reporter = Reporter("fused", problem.unit.size, on_step)
    begin = fuse_motions(problem, torch.stack([motions for _, motions in found]), config.choice)
    transforms = refine(problem, begin, config.refine, reporter, config.refine.fused_sigma)
    return judge(problem, reporter.name, transforms, config.choice), transforms


def _energy(found: tuple[Hypothesis, Tensor]) -> float:
    return found[0].energy


def _confidence(problem: ScanAlignProblem, transforms: Tensor, config: ScanAlignConfig, points: Tensor) -> Tensor:
    """Return the posterior mass (N,) of matches at points, by that of the nearest samples."""
    sigma = config.refine.sigma[1]
    moved = used_samples(problem, transforms, sigma, config.refine)
    own = soft_matches(problem, moved, sigma, config.refine).posterior
    index, _ = nearest_few(problem.unit.of_points(points), problem.graph.points[: len(own)], min(3, len(own)))
    return own[index].mean(1)
