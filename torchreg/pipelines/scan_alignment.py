"""One scan bent onto another, however far its limbs moved: several hypotheses, each refined, the best kept."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from torchreg.geometry.blend import blend_linear
from torchreg.geometry.neighbors import nearest_few
from torchreg.geometry.node_graph import spread_weights
from torchreg.geometry.range_scan import RangeScan
from torchreg.pipelines.scan_align_config import (
    AssignConfig,
    Hypothesis,
    OnStep,
    ScanAlignConfig,
    ScanAlignment,
    ScanAlignRecord,
)
from torchreg.pipelines.scan_align_problem import ScanAlignProblem, describe, first_matches
from torchreg.pipelines.scan_align_stages import (
    Reporter,
    fit_first_matches,
    judge,
    pull_one_to_one,
    refine,
    shrunk,
    soft_matches,
)

# What opposite normals count as when points take over the motion of the samples around them, length.
_NORMAL_SCALE = 0.03


@torch.no_grad()
def align_scans(
    source: RangeScan,
    target: RangeScan,
    config: ScanAlignConfig | None = None,
    *,
    generator: torch.Generator | None = None,
    on_step: OnStep | None = None,
) -> ScanAlignment:
    """Return the source moved onto the target: a deformation graph of many small nodes, without bones yet.

    Both scans are described by even samples, their curvature at several sizes and spin images. Hypotheses of the motion
    come from matches of spin images that agree on distances along the surface, with and without a pull by one-to-one
    matches, and from one-to-one matches alone. Each is refined by EM with an outlier class; the best covers the target
    and is covered by it, and bends least. From there one-to-one matches may find what was missed, unless the hypotheses
    agree with each other.

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

    Cost: about 1 s for scans of 8,000 points on one core.

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
    chosen, transforms = found[0]
    weights = spread_weights(
        problem.normalized(source.points),
        source.normals.detach().cpu().double(),
        problem.graph.points,
        problem.graph.normals,
        problem.graph.dense_weights,
        _NORMAL_SCALE,
    )
    everywhere = _in_user_frame(problem, transforms)
    points = source.points.detach().cpu().double()
    # Centered, so that places far from the origin lose no digits.
    shift = blend_linear(points - problem.middle, weights, _about(problem.middle, everywhere))
    return ScanAlignment(
        (problem.middle + shift).to(source.points),
        _confidence(problem, transforms, config, source.points).to(source.points),
        problem.samples,
        problem.nodes,
        weights.to(source.points),
        everywhere.to(source.points),
        chosen,
        tuple(hypothesis for hypothesis, _ in found),
        tuple(history),
    )


def _hypotheses(
    problem: ScanAlignProblem, config: ScanAlignConfig, on_step: OnStep
) -> Iterator[tuple[Hypothesis, Tensor]]:
    """Yield hypotheses and their motions."""
    found: list[tuple[Hypothesis, Tensor]] = []
    rest = problem.graph.rest()
    far, near = config.refine.sigma[0], config.refine.near_sigma

    def reporter(name: str) -> Reporter:
        return Reporter(name, problem.size, on_step)

    def refined(name: str, transforms: Tensor, sigma: float) -> tuple[Hypothesis, Tensor]:
        transforms = refine(problem, transforms, config.refine, reporter(name), sigma)
        found.append((judge(problem, name, transforms, config.choice), transforms))
        return found[-1]

    def pulled(name: str, transforms: Tensor, stage: AssignConfig) -> tuple[Hypothesis, Tensor]:
        return refined(name, pull_one_to_one(problem, transforms, stage, reporter(name)), far)

    yield refined("rest", rest, near)
    matches = first_matches(problem, config.match)
    if len(matches.weights) >= config.match.min_matches:
        for name, stiffness in (("matches", config.match.stiffness), ("stiff matches", config.match.stiffer)):
            fitted = fit_first_matches(problem, matches, stiffness, config.match, reporter(name))
            yield refined(name, fitted, near)
            if name == "matches":
                yield pulled("matches, one to one", fitted, config.reassign)
    yield pulled("one to one", rest, config.assign)
    yield pulled("again", min(found, key=_energy)[1], config.again)
    _, best = min(found, key=_energy)
    for share in config.shrink:
        yield refined(f"{share:g} of it", shrunk(problem, best, share), near)


def _energy(found: tuple[Hypothesis, Tensor]) -> float:
    return found[0].energy


def _in_user_frame(problem: ScanAlignProblem, transforms: Tensor) -> Tensor:
    """Return motions of the problem's frame in that of the scans."""
    moved = transforms.clone()
    moved[:, :3, 3] = problem.size * transforms[:, :3, 3]
    return _about(-problem.middle, moved)


def _about(origin: Tensor, transforms: Tensor) -> Tensor:
    """Return motions as seen from another origin."""
    moved = transforms.clone()
    moved[:, :3, 3] = transforms[:, :3, 3] + transforms[:, :3, :3] @ origin - origin
    return moved


def _confidence(problem: ScanAlignProblem, transforms: Tensor, config: ScanAlignConfig, points: Tensor) -> Tensor:
    """Return the posterior mass (N,) of matches at points, by that of the nearest samples."""
    own = soft_matches(problem, transforms, config.refine.sigma[1], config.refine).posterior
    index, _ = nearest_few(problem.normalized(points), problem.graph.points[: len(own)], min(3, len(own)))
    return own[index].mean(1)
