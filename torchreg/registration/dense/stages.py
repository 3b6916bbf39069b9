"""The EM that fits a deformation graph to a target, and how far results are from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree
from torchreg.registration.annealing import geometric_at
from torchreg.registration.dense.config import OnStep, ScanAlignRecord
from torchreg.registration.dense.e_step import SoftMatches, match_softly
from torchreg.registration.dense.graph_fit import GraphFit, GraphMatches, fit_graph
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.problem import ScanAlignProblem


@dataclass(frozen=True)
class _Trust:
    """How far expectations and tokens are to be trusted.

    Args:
        far_off: stds beyond which an expectation no longer tells where a sample is: of a Gaussian three in a hundred
            samples lie there.
        alike: tokens that are wrong together, those of a limb or two: they count as one.
    """

    far_off: float = 3.0
    alike: int = 64


_TRUST = _Trust()


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


def refine(problem: ScanAlignProblem, transforms: Tensor, reporter: Reporter) -> Tensor:
    """Return motions refined by EM: sigma shrinks, and the graph softens.

    Samples on a surface tell little of where they lie along it: there the matches of the tokens count too, by the sigma
    at which the coarse EM ends.
    """
    config, plan, coarse = problem.config, problem.config.refine, problem.config.coarse.sigma[1]
    for step in range(plan.num_steps):
        share = step / max(plan.num_steps - 1, 1)
        sigma, stiffness = geometric_at(plan.sigma, share), geometric_at(plan.stiffness, share)
        moved = problem.moved(transforms)
        found = soft_matches(problem, moved, sigma)
        matches = GraphMatches(
            slice(0, len(moved)), found.targets, found.posterior, found.normals, config.tangential_weight
        )
        tokens = match_tokens(problem, transforms, coarse, 1.0)
        # Each is chosen from both sides.
        weight = (sigma / coarse) ** 2 / _TRUST.alike
        tokens = replace(tokens, weights=0.5 * tokens.weights, tangential_weight=weight)
        fit = fit_graph(problem.graph, transforms, [matches, tokens], stiffness, edge_scale=config.edge_scale)
        transforms = fit.transforms
        matched = float(found.posterior.mean())
        reporter.report("refine", step, plan.num_steps, sigma, fit, stiffness, matched)
    return transforms


def match_tokens(problem: ScanAlignProblem, transforms: Tensor, sigma: float, share: float) -> GraphMatches:
    """Return the E-step of the samples that are tokens, a share of the way through; see `fit_coarsely`."""
    # As fine as the matcher; the target twice as much, for places between its tokens.
    count, seen = problem.prior.by_source.shape
    target = problem.target.first(2 * seen)
    moved, normals = problem.graph.move_with_normals(transforms, slice(0, count))
    near = torch.cdist(moved, target.points).square().mul_(-1 / (2 * sigma**2))
    near = near.add_(normals @ target.normals.mT - 1, alpha=problem.config.normal_weight * share).exp_()
    prior, doubt = problem.prior, problem.config.doubt
    visible, shown = prior.visible[:count, None], prior.target_visible[: len(target)]
    by_source, by_target = prior.tables
    # A density per area, as that of the Gaussian along the surface, the squared size being one.
    outlier = 2 * math.pi * sigma**2
    hidden, unshown = ((1 - share).clamp_min(torch.finfo(share.dtype).eps) for share in (visible, shown))
    chosen = near * torch.lerp(by_source, visible / len(target), doubt)
    choice = chosen / (chosen.sum(1, keepdim=True) + outlier * hidden)
    chosen = near * torch.lerp(by_target, shown / count, doubt)
    choice += (count / len(target)) * chosen / (chosen.sum(0) + outlier * unshown)
    weights = choice.sum(1)
    targets = choice @ target.points / weights.clamp_min(torch.finfo(weights.dtype).tiny).unsqueeze(1)
    return GraphMatches(slice(0, count), torch.where(weights.unsqueeze(1) > 0, targets, moved), weights)


def soft_matches(problem: ScanAlignProblem, moved: OrientedSamples, sigma: float) -> SoftMatches:
    """Return the matches of an E-step of moved samples, in which the matcher's are the prior."""
    config = problem.config
    return match_softly(
        moved, problem.target, sigma, normal_weight=config.normal_weight, outliers=config.outliers,
        visible=problem.prior.visible[: len(moved)],
        prior=problem.prior, doubt=config.doubt,
    )  # fmt: skip


def deviations(problem: ScanAlignProblem, places: Tensor) -> Tensor:
    """Return squared distances of samples (S,) from where they are expected, in `far_off`, at most one."""
    if problem.expected is None:
        return torch.zeros_like(places[:, 0])
    apart = (places - problem.expected.places).norm(dim=-1) / (_TRUST.far_off * problem.expected.std)
    return apart.clamp(max=1).square()


def mismatch(problem: ScanAlignProblem, moved: OrientedSamples) -> tuple[Tensor, Tensor]:
    """Return what moved samples (S,) are expected to cost, and the target samples nearest to them.

    The squared distance from the target, in caps, at most one, times the probability that the target shows the sample.
    """
    index, apart = NeighborTree(problem.target.points).nearest(moved.points)
    return problem.prior.visible[: len(apart)] * (apart / problem.config.cap).clamp(max=1).square(), index


def uncovered(problem: ScanAlignProblem, moved: OrientedSamples) -> Tensor:
    """Return what the target's samples (T,) are expected to cost, by their distance from the moved source alike."""
    apart = NeighborTree(moved.points).nearest(problem.target.points)[1]
    return problem.prior.target_visible * (apart / problem.config.cap).clamp(max=1).square()


def agree(problem: ScanAlignProblem, one: Tensor, other: Tensor) -> bool:
    """Return whether two hypotheses take samples to the same places, up to the last sigma, root mean square."""
    apart = (problem.graph(one) - problem.graph(other)).square().sum(-1)
    return float(apart.mean()) < problem.config.refine.sigma[1] ** 2
