"""Sources of start poses: rough poses for a search, and proposals of a network, fitted to the data in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.fit.objectives import GaussianPosePrior
from torchreg.alignment.fit.problem import AlignProblem, joint_precision
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.search.matched_poses import PROPOSAL_FIT, can_be_matched, matched_pose, matched_poses
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates, Plan, candidate_cost
from torchreg.alignment.search.pose_proposer import (
    HoldsProposer,
    PoseProposer,
    Proposals,
    check_proposer,
    shared_proposer,
)
from torchreg.alignment.search.pose_search import PoseSearch
from torchreg.alignment.search.rough_poses import DEFAULT_SOURCES, PoseSource, UprightRotations
from torchreg.alignment.search.windows import DataWindows
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction
from torchreg.shapes.articulated import ArticulatedShape

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


@dataclass(frozen=True, eq=False)
class Proposed:
    """Proposed poses (B, K, num_dofs), K zero for none, a problem with them as its prior, and one of the data there."""

    problem: AlignProblem
    window: AlignProblem
    poses: Tensor

    def rows(self, index: Tensor) -> Proposed:
        """Return some rows of the batch."""
        return Proposed(self.problem.rows(index), self.window.rows(index), self.poses[index])


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

    def proposed(self, problem: AlignProblem, count: int) -> Proposed:
        """Return what a network for the shape proposes, or the matcher of scans where a file has its surface."""
        if self.proposer is None and (self.sources is not DEFAULT_SOURCES or not can_be_matched(problem)):
            return Proposed(
                problem, problem, problem.prior.mean.new_zeros(len(problem.data), 0, len(problem.skin.shape.rest))
            )
        windows = DataWindows.of(problem)
        if self.proposer is None:
            poses, best = matched_poses(windows, problem, count)
        else:
            proposals = self.proposer.propose(windows.problem.data, windows.problem.valid)
            wide = with_proposed_prior(windows.problem, proposals)
            found = fitted_proposals(wide, proposals).distinct(SEARCH_BUDGET.same, count)
            inside = wide.valid.sum(-1)
            best = windows.best(candidate_cost(wide, found.poses[:, 0]) - inside)
            poses, problem = found.poses[best], replace(problem, prior=wide.rows(best).prior)
        return Proposed(problem, windows.problem.rows(best), self._substituted(problem, poses))

    def _substituted(self, problem: AlignProblem, poses: Tensor) -> Tensor:
        return problem.clamp_candidates(
            poses if self.known is None else self.known.substitute_prior_means(problem, poses)
        )
