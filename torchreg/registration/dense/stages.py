"""The EM that fits a deformation graph to a target, and the energy by which results are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree
from torchreg.registration.annealing import geometric_at
from torchreg.registration.dense.config import (
    ChoiceConfig,
    EMConfig,
    Hypothesis,
    OnStep,
    ScanAlignRecord,
)
from torchreg.registration.dense.e_step import SoftMatches, match_softly
from torchreg.registration.dense.graph_fit import GraphFit, GraphMatches, fit_graph, joined
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.problem import ScanAlignProblem
from torchreg.solvers.robust import geman_mcclure_weight

# Squared feature distance of right matches, in the mean.
_USUAL_FEATURE_DISTANCE = 0.4
# With less posterior mass a sample has no match: it may be hidden.
_HARDLY_MATCHED = 0.05


@dataclass(frozen=True)
class Reporter:
    """Where records of one hypothesis go.

    Args:
        name: of the hypothesis.
        size: by which widths are multiplied.
        on_step: what takes the records.
    """

    name: str
    size: float
    on_step: OnStep

    def report(
        self, stage: str, step: int, num_steps: int, width: float, fit: GraphFit, stiffness: float, matched: float
    ) -> None:
        """Hand on one record."""
        self.on_step(
            ScanAlignRecord(
                hypothesis=self.name,
                stage=stage,
                step=step,
                num_steps=num_steps,
                width=width * self.size,
                residual=fit.residual,
                smoothness=fit.smoothness,
                stiffness=stiffness,
                matched=matched,
            )
        )


def refine(
    problem: ScanAlignProblem,
    transforms: Tensor,
    config: EMConfig,
    reporter: Reporter,
    first_sigma: float | None = None,
) -> Tensor:
    """Return motions refined by EM: sigma shrinks, the graph softens, matches may slide along the surface ever more.

    Args:
        problem: the scans.
        transforms: (J, 4, 4) to start from.
        config: see `EMConfig`.
        reporter: takes a record of each step.
        first_sigma: instead of that of the configuration.
    """
    widths = (config.sigma[0] if first_sigma is None else first_sigma, config.sigma[1])
    for step in range(config.num_steps):
        share = step / max(config.num_steps - 1, 1)
        ends = (widths, config.stiffness, config.tangential_weight)
        sigma, stiffness, tangential = (geometric_at(each, share) for each in ends)
        for _ in range(config.fits_per_step):
            moved = problem.moved(transforms, problem.num_used(sigma))
            found = soft_matches(problem, moved, sigma, config, share)
            matches = GraphMatches(slice(0, len(moved)), found.targets, found.posterior, found.normals, tangential)
            waiting = _as_expected(problem, moved, found, config)
            matches = joined(matches, *waiting)
            fit = fit_graph(problem.graph, transforms, matches, stiffness, edge_scale=config.edge_scale)
            transforms = fit.transforms
        matched = float(found.posterior.mean())
        reporter.report("refine", step, config.num_steps, sigma, fit, stiffness, matched)
    return transforms


def soft_matches(
    problem: ScanAlignProblem, moved: OrientedSamples, sigma: float, config: EMConfig, share: float = 1.0
) -> SoftMatches:
    """Return the matches of an E-step, a share of the way through, of moved samples."""
    first, last = config.feature_weight
    compatible = replace(config.compatible, feature_weight=first + (last - first) * share)
    target, doubt = problem.target.first(problem.num_used(sigma)), geometric_at((config.doubt, 1.0), share)
    return match_softly(moved, target, sigma, compatible, prior=problem.prior, doubt=doubt)


def _as_expected(
    problem: ScanAlignProblem, moved: OrientedSamples, found: SoftMatches, config: EMConfig
) -> tuple[GraphMatches, ...]:
    """Return what holds samples without a match near where they are expected."""
    if problem.expected is None or config.expected == 0:
        return ()
    count = len(moved)
    expected = problem.expected[:count]
    apart = (moved.points - expected).square().sum(-1) / config.expected_scale**2
    weights = config.expected * (1 - found.posterior / _HARDLY_MATCHED).clamp(min=0) * geman_mcclure_weight(apart)
    return (GraphMatches(slice(0, count), expected, weights),)


def judge(problem: ScanAlignProblem, name: str, transforms: Tensor, config: ChoiceConfig) -> Hypothesis:
    """Return how well moved source and target cover each other, how alike they are there, and how smooth it is."""
    moved = problem.moved(transforms)
    forward = float(mismatch(problem, moved, config)[0].mean())
    apart = NeighborTree(embedded(moved, config)).nearest(embedded(problem.target, config))[1]
    backward = float((apart / config.cap).clamp(max=1).square().mean())
    smoothness = config.smoothness * float(problem.graph.smoothness(transforms, config.slack))
    deviation = float(deviations(problem, moved.points, config).mean())
    costs = (forward, backward, smoothness, deviation)
    return Hypothesis(name, sum(costs), *costs)


def deviations(problem: ScanAlignProblem, places: Tensor, config: ChoiceConfig) -> Tensor:
    """Return what it costs samples (S,) to be elsewhere than expected."""
    if problem.expected is None:
        return torch.zeros_like(places[:, 0])
    apart = (places - problem.expected).norm(dim=-1) / config.deviation_cap
    return config.deviation * apart.clamp(max=1).square()


def mismatch(problem: ScanAlignProblem, moved: OrientedSamples, config: ChoiceConfig) -> tuple[Tensor, Tensor]:
    """Return costs (S,) of moved samples by distance and features, capped at outliers, and the nearest targets."""
    index, apart = NeighborTree(embedded(problem.target, config)).nearest(embedded(moved, config))
    feature_distance = (moved.features - problem.target.features[index]).square().sum(-1)
    # An outlier is as unlike as right matches usually are: leaving the target must not pay.
    most = 1 + config.feature_distance * _USUAL_FEATURE_DISTANCE
    return ((apart / config.cap).square() + config.feature_distance * feature_distance).clamp(max=most), index


def embedded(samples: OrientedSamples, config: ChoiceConfig) -> Tensor:
    """Return (S, 6): places and normals, whose distances count for a choice."""
    return torch.cat((samples.points, config.normal_scale * config.cap * samples.normals), dim=1)


def agree(problem: ScanAlignProblem, one: Tensor, other: Tensor, config: ChoiceConfig) -> bool:
    """Return whether two hypotheses take nearly all samples to nearly the same places."""
    apart = (problem.graph(one) - problem.graph(other)).norm(dim=-1)
    return float((apart < config.same).double().mean()) >= config.same_share
