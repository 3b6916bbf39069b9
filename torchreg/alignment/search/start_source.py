"""Sources of start poses: rough poses for a search, and the proposals of a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.search.fit_proposals import best_proposals, with_proposed_prior
from torchreg.alignment.search.pose_proposer import HoldsProposer, PoseProposer, check_proposer, shared_proposer
from torchreg.alignment.search.rough_poses import DEFAULT_SOURCES, PoseSource, UprightRotations
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction
from torchreg.shapes.articulated import ArticulatedShape


@dataclass(frozen=True)
class StartSource:
    """Sources of rough poses to search from, a network whose poses need a fit alone, and known degrees of freedom."""

    sources: Sequence[PoseSource]
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
        return problem, self._substituted(problem, best_proposals(problem, proposals, count))

    def _substituted(self, problem: AlignProblem, poses: Tensor) -> Tensor:
        return problem.clamp_candidates(
            poses if self.known is None else self.known.substitute_prior_means(problem, poses)
        )
