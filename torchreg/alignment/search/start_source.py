"""Sources of start poses: rough poses for a search, and proposals of a network, fitted to the data in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.fit.annealed_em import ANNEALING
from torchreg.alignment.fit.objectives import GaussianPosePrior, registration_objective
from torchreg.alignment.fit.problem import AlignProblem, joint_precision
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates, Plan, take_rows
from torchreg.alignment.search.pose_proposer import (
    HoldsProposer,
    PoseProposer,
    Proposals,
    check_proposer,
    shared_proposer,
)
from torchreg.alignment.search.pose_search import PoseSearch
from torchreg.alignment.search.rough_poses import DEFAULT_SOURCES, PoseSource, UprightRotations
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.solvers.e_step import EStep


@dataclass(frozen=True)
class _Fit:
    """Numbers of the fit; widths are shares of the model's size."""

    kept: int = 2  # most probable proposals where there is no time for all, beside that fitted to matches
    surface_std: float = 0.015  # of where the network says that a datum lies on the shape
    reach: tuple[float, ...] = (0.15, 0.08)  # by which a datum may be off in the rounds after the first
    joint_std: float = 0.35  # of the network's joints, radians: its pose is the prior, of fingers that no datum shows
    matched_steps: int = 2  # in each round


PROPOSAL_FIT = _Fit()
# From what a proposal errs by to a searched pose's width.
_PLAN = Plan(start=0.05, stop=0.02, steps=2)


@torch.no_grad()
def fitted_proposals(problem: AlignProblem, proposals: Proposals, most: int | None = None) -> Candidates:
    """Return the ``most`` probable poses of a network, and that of its matches, after a coarse fit, best first.

    The problem is one `with_proposed_prior`.
    """
    coarse = PoseSearch(problem, torch.Generator().manual_seed(0)).coarse_problem
    poses = problem.clamp_candidates(proposals.poses[:, :most])
    pool = torch.cat([matched_pose(problem, proposals).unsqueeze(1), poses], dim=1)
    fitted = Candidates.descended(coarse, pool, _PLAN)
    # Each of the few data stands for several.
    share = problem.valid.sum(-1, keepdim=True) / coarse.valid.sum(-1, keepdim=True).clamp_min(1)
    return replace(fitted, costs=fitted.costs * share)


def with_proposed_prior(problem: AlignProblem, proposals: Proposals) -> AlignProblem:
    """Return a problem whose prior's mean is the most probable proposal, except in joints with a prior."""
    mean = problem.clamp_candidates(proposals.poses[:, :1])[:, 0]
    precision = joint_precision(problem.skin.shape, problem.size, PROPOSAL_FIT.joint_std)
    if problem.prior_precision is None:
        return replace(problem, prior=GaussianPosePrior(mean, precision))
    told, prior = problem.prior_precision > 0, problem.prior
    mean, precision = torch.where(told, prior.mean, mean), torch.where(told, prior.precision, precision)
    return replace(problem, prior=replace(prior, mean=mean, precision=precision))


def matched_pose(problem: AlignProblem, proposals: Proposals) -> Tensor:
    """Return poses (B, num_dofs) after an EM that matches data to model points near their places at rest.

    Pairs of a datum and a model point that rounding cannot tell from none are left out: few are near each other.
    """
    skin, sigma, pose = problem.skin, ANNEALING.stop * problem.size, problem.prior.mean
    near = torch.cdist(proposals.surface, skin.points).square()
    share = (near / (-2 * (PROPOSAL_FIT.surface_std * problem.size) ** 2)).softmax(-1)
    share, index = share.topk(int((share > torch.finfo(share.dtype).eps).sum(-1).max()), sorted=False)
    told, index, points = share * proposals.inlier.unsqueeze(-1), index.flatten(1), proposals.points.unsqueeze(2)
    for width in (None, *PROPOSAL_FIT.reach):
        weight = told
        if width is not None:
            far = (points - take_rows(skin(pose), index).unflatten(1, told.shape[1:])).square().sum(-1)
            weight = told * (far * (-0.5 / (width * problem.size) ** 2)).exp()
        each = (weight.unsqueeze(-1) * pad(points, (0, 1), value=1.0)).flatten(1, 2)
        sums = each.new_zeros(len(pose), len(skin), 4).scatter_add(1, index.unsqueeze(-1).expand_as(each), each)
        total = sums[..., 3]
        targets = sums[..., :3] / total.clamp_min(1e-9).unsqueeze(-1)
        matches = EStep(total, targets, weight.sum(2), torch.zeros_like(total[:, 0]))
        objective = registration_objective(skin, matches, torch.full_like(pose[:, 0], sigma), problem.prior)
        for _ in range(PROPOSAL_FIT.matched_steps):
            pose = problem.step(objective(pose), pose).state
    return pose


@dataclass(frozen=True)
class StartSource:
    """Sources of rough poses to search from, a network whose poses need a fit alone, and known degrees of freedom."""

    sources: Sequence[PoseSource] = DEFAULT_SOURCES
    proposer: PoseProposer | None = None
    known: KnownDofs | None = None

    @classmethod
    def of(
        cls,
        shape: ArticulatedShape,
        sources: Sequence[PoseSource] | None = None,
        initializer: PoseProposer | HoldsProposer | None = None,
        upright: Direction | None = None,
    ) -> StartSource:
        """Return the given sources, or else the default for a shape: upright poses alone where ``upright`` is given."""
        if sources is None and upright is not None:
            sources = (UprightRotations(upright),)
        if sources is not None and not sources:
            raise InputError("sources must hold at least one source of rough poses, got none")
        proposer = shared_proposer(shape) if sources is None and initializer is None else None
        if initializer is not None:
            proposer = check_proposer(shape, initializer)
        return cls(DEFAULT_SOURCES if sources is None else sources, proposer)

    def with_known(self, known: KnownDofs | None) -> StartSource:
        """Return the source with known degrees of freedom substituted in its poses."""
        return replace(self, known=known)

    def rough(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return rough poses (B, K, num_dofs) of all sources."""
        return self._substituted(problem, torch.cat([source(problem, generator) for source in self.sources], dim=1))

    def proposed(self, problem: AlignProblem, count: int) -> tuple[AlignProblem, Tensor]:
        """Return the problem with the network's pose as the prior, and its fitted poses (B, count, num_dofs)."""
        if self.proposer is None:
            return problem, problem.prior.mean.new_zeros(len(problem.data), 0, problem.prior.mean.shape[-1])
        proposals = self.proposer.propose(problem.data, problem.valid)
        problem = with_proposed_prior(problem, proposals)
        found = fitted_proposals(problem, proposals).distinct(SEARCH_BUDGET.same, count).poses
        return problem, self._substituted(problem, found)

    def _substituted(self, problem: AlignProblem, poses: Tensor) -> Tensor:
        return problem.clamp_candidates(
            poses if self.known is None else self.known.substitute_prior_means(problem, poses)
        )
