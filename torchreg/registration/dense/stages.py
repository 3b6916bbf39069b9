"""The EM that fits a deformation graph to a target, and the energy by which results are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree, k_nearest
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

# Right matches differ by so much in their features, squared, in the mean; more than samples at random tells no more.
_USUALLY_UNLIKE, _UNLIKE = 0.4, 2.0
# Share of the cap by which samples may be off the target and count as on it: about what its samples are apart.
_ON_TARGET = 0.25
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
                misses=fit.misses,
                gaps=fit.gaps,
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
    steps: slice = slice(None),
    stage: str = "refine",
    follow: Tensor | None = None,
) -> Tensor:
    """Return motions refined by EM: sigma shrinks, the graph softens, matches may slide along the surface ever more.

    Args:
        problem: the scans.
        transforms: (J, 4, 4) to start from.
        config: see `EMConfig`.
        reporter: takes a record of each step.
        first_sigma: instead of that of the configuration.
        steps: which of them to take.
        stage: what records call it.
        follow: (S,) how far samples follow the wide regions they are in instead of what they match along the surface,
            from 0 to 1; zeros by default.
    """
    number = config.num_steps + config.final_steps
    widths = (config.sigma[0] if first_sigma is None else first_sigma, config.sigma[1])
    for step in range(number)[steps]:
        share = step / max(config.num_steps - 1, 1)
        sigma, stiffness, slide = (geometric_at(ends, share) for ends in (widths, config.stiffness, config.slide))
        for _ in range(config.fits_per_step):
            moved = used_samples(problem, transforms, sigma, config)
            found = soft_matches(problem, moved, sigma, config, share)
            along = _along_surface(found, slide, sigma < config.boundary_above, follow)
            others = _out_of_empty_space(problem, moved, sigma, config) + _as_expected(problem, moved, found, config)
            if follow is not None and step < config.num_steps:
                others += (problem.regions.matches(moved.points, follow, config.regions),)
            fit = fit_graph(problem.graph, transforms, joined(along, *others), stiffness, give=config.give)
            transforms = fit.transforms
        reporter.report(stage, step, number, sigma, fit, stiffness, float(found.weights.mean()))
    return transforms


def used_samples(problem: ScanAlignProblem, transforms: Tensor, sigma: float, config: EMConfig) -> OrientedSamples:
    """Return as many moved samples as the sigma asks for."""
    return problem.moved(transforms, num_used(sigma, config.density, config.least_samples))


def num_used(sigma: float, density: float, least: int) -> int:
    """Return how many samples a sigma asks for: so many per squared sigma, and at least some."""
    return max(round(density / sigma**2), least)


def soft_matches(
    problem: ScanAlignProblem, moved: OrientedSamples, sigma: float, config: EMConfig, share: float = 1.0
) -> SoftMatches:
    """Return the matches of an E-step, a share of the way through, of moved samples."""
    first, last = config.feature_weight
    compatible = replace(config.compatible, feature_weight=first + (last - first) * min(share, 1.0))
    return match_softly(
        moved,
        problem.target.first(num_used(sigma, config.density, config.least_samples)),
        sigma,
        compatible,
        both_ways=sigma > config.both_ways_above,
        boundary=sigma >= config.boundary_above,
        prior=problem.prior,
        doubt=geometric_at((config.doubt, 1.0), min(share, 1.0)),
    )


def _along_surface(found: SoftMatches, slide: float, beside_edges: bool, follow: Tensor | None) -> GraphMatches:
    """Return matches of the first samples, that may slide; the more beside what is hidden, and if they follow."""
    # A sample beside an edge, whose own place may be hidden behind, must not be attracted to what is still seen.
    free = slide * (1 - found.cut_off) if beside_edges else torch.full_like(found.weights, slide)
    free = free if follow is None else free * (1 - follow[: len(free)])
    return GraphMatches(slice(0, len(found.weights)), found.targets, found.weights, found.normals, free)


def _out_of_empty_space(
    problem: ScanAlignProblem, moved: OrientedSamples, sigma: float, config: EMConfig
) -> tuple[GraphMatches, ...]:
    """Return what takes samples back that are where the target's camera saw nothing, along the picture alone."""
    idle = config.beyond == 0 or sigma >= config.beyond_below
    if idle or problem.free is None or not problem.free.trust.any():
        return ()
    apart, back, trust = problem.free.beyond(moved.points, config.beyond_margin * problem.free.spacing)
    weights = config.beyond * trust * geman_mcclure_weight((apart / config.beyond_scale).square())
    which = weights.nonzero()[:, 0]
    targets = moved.points[which] + apart[which].unsqueeze(1) * back[which]
    return (GraphMatches(which, targets, weights[which], back[which], 0.0),)


def _as_expected(
    problem: ScanAlignProblem, moved: OrientedSamples, found: SoftMatches, config: EMConfig
) -> tuple[GraphMatches, ...]:
    """Return what holds samples without a match near where they are expected."""
    if problem.expected is None or config.expected == 0:
        return ()
    count = len(moved.points)
    expected = problem.expected[:count]
    apart = (moved.points - expected).square().sum(-1) / config.expected_scale**2
    weights = config.expected * (1 - found.weights / _HARDLY_MATCHED).clamp(min=0) * geman_mcclure_weight(apart)
    return (GraphMatches(slice(0, count), expected, weights),)


def follow_regions(problem: ScanAlignProblem, transforms: Tensor, config: EMConfig, choice: ChoiceConfig) -> Tensor:
    """Return how far samples (S,) had better follow wide regions than their own matches, from 0 to 1.

    Where a surface is unlike all around, it has folded anew, or matches are wrong: features tell nothing there.
    """
    moved = problem.moved(transforms)
    apart, unlike = differences(problem, moved, choice)
    unlike = torch.where(apart < 1, unlike, _UNLIKE)
    around, _ = k_nearest(problem.graph.points, problem.graph.points, min(config.surrounding, len(unlike)))
    low, high = config.unlike
    return ((unlike[around].median(dim=1).values - low) / (high - low)).clamp(0, 1)


def judge(problem: ScanAlignProblem, name: str, transforms: Tensor, config: ChoiceConfig) -> Hypothesis:
    """Return how well the moved source and the target cover each other, how alike they are there, bend and strain."""
    moved = problem.moved(transforms)
    forward, seen, unlike = (float(cost.mean()) for cost in mismatch(problem, moved, config))
    apart = NeighborTree(embedded(moved, config)).nearest(embedded(problem.target, config))[1]
    backward = float((apart / config.cap).clamp(max=1).square().mean())
    bend = config.bend * float(problem.graph.bend(transforms, config.slack))
    strain = config.strain * problem.regions.strain(moved.points)
    leap = float(leaps(problem, moved.points, config).mean())
    overlap = config.overlap * float(overlaps(problem, moved, config).mean())
    costs = (forward, seen, backward, unlike, bend, strain, leap, overlap)
    return Hypothesis(name, sum(costs), *costs)


def leaps(problem: ScanAlignProblem, places: Tensor, config: ChoiceConfig) -> Tensor:
    """Return what it costs samples (S,) to be elsewhere than expected."""
    if problem.expected is None:
        return torch.zeros_like(places[:, 0])
    apart = (places - problem.expected).norm(dim=-1) / config.leap_cap
    return config.leap * apart.clamp(max=1).square()


def overlaps(problem: ScanAlignProblem, moved: OrientedSamples, config: ChoiceConfig) -> Tensor:
    """Return how far the first moved samples (M,) lie where others do that are far from them along the surface.

    From 0, no nearer than the cap, to 1. Two limbs that end on one of the target's match it well, each on its own.
    """
    places = embedded(moved.first(len(problem.far)), replace(config, cap=config.overlap_cap))
    apart = torch.cdist(places, places).masked_fill(~problem.far, torch.inf).amin(1)
    return 1 - (apart / config.overlap_cap).clamp(max=1).square()


def mismatch(problem: ScanAlignProblem, moved: OrientedSamples, config: ChoiceConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Return what moved samples cost (S,): by distance from the target, by that where seen, by unlike features there.

    What the target's camera would have seen, had it been there, but did not see, is not there. What it could not have
    seen may be.
    """
    apart, unlike = differences(problem, moved, config)
    seen = torch.zeros_like(apart)
    if problem.free is not None and config.seen > 0:
        off = (apart.sqrt() - _ON_TARGET).clamp(min=0) / (1 - _ON_TARGET)
        seen = config.seen * off * problem.free.in_view(moved.points, moved.normals, config.behind)
    # Where there is nothing to be like, a sample is as unlike as right matches usually are: leaving must not pay.
    return apart, seen, config.unlike * torch.lerp(unlike, torch.full_like(unlike, _USUALLY_UNLIKE), apart)


def differences(problem: ScanAlignProblem, moved: OrientedSamples, config: ChoiceConfig) -> tuple[Tensor, Tensor]:
    """Return how far moved samples (S,) are from the target, squared and capped at one, and how unlike it there."""
    index, apart = NeighborTree(embedded(problem.target, config)).nearest(embedded(moved, config))
    unlike = (moved.features - problem.target.features[index]).square().sum(-1)
    return (apart / config.cap).clamp(max=1).square(), unlike.clamp(max=_UNLIKE)


def embedded(samples: OrientedSamples, config: ChoiceConfig) -> Tensor:
    """Return (S, 6): places and normals, whose distances count for a choice."""
    return torch.cat((samples.points, config.normal_scale * config.cap * samples.normals), dim=1)


def loses_limb(problem: ScanAlignProblem, transforms: Tensor, config: ChoiceConfig) -> bool:
    """Return whether samples of both scans are left over, or limbs of the source lie in one place."""
    moved = problem.moved(transforms)
    if float(overlaps(problem, moved, config).mean()) > config.lost_share:
        return True
    here, there = embedded(moved, config), embedded(problem.target, config)
    left = [
        float((NeighborTree(other).nearest(one)[1] >= config.cap).double().mean())
        for one, other in ((here, there), (there, here))
    ]
    return min(left) > config.lost_share


def agree(problem: ScanAlignProblem, one: Tensor, other: Tensor, config: ChoiceConfig) -> bool:
    """Return whether two hypotheses take nearly all samples to nearly the same places."""
    apart = (problem.graph(one) - problem.graph(other)).norm(dim=-1)
    return float((apart < config.same).double().mean()) >= config.same_share
