"""Sources of start poses: rough poses for a search, and the proposals of a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._threads import one_thread
from torchreg.alignment.evidence.confidence import explains
from torchreg.alignment.evidence.reliability import without_cut
from torchreg.alignment.fit.problem import AlignProblem, centered_problem
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.search.fit_proposals import best_proposal, best_proposals, with_proposed_prior
from torchreg.alignment.search.pose_proposer import HoldsProposer, PoseProposer, check_proposer, shared_proposer
from torchreg.alignment.search.rough_poses import DEFAULT_SOURCES, PoseSource, UprightRotations
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.free_space import FreeSpace
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin


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

    @torch.no_grad()
    def crop_score(self, skin: LinearBlendSkin, frame: DepthFrame) -> float:
        """Return the confidence in the network's pose of the shape in a frame; 1 without a network."""
        if self.proposer is None:
            return 1.0
        near = frame.near(frame.points.double().mean(0))
        data = near.points[None].to(skin.shape.rest)
        valid, origin = torch.ones_like(data[..., 0], dtype=torch.bool), torch.zeros_like(data[:, 0])
        problem = centered_problem(
            skin, data, valid, skin.shape.rest[None], origin, prior_std=None, pose_atol=0.0,
            free_space=FreeSpace.stacked([near.free_space]),
        )  # fmt: skip
        with one_thread():
            best = best_proposal(problem, self.proposer.propose(data, valid))
            uncropped = without_cut(problem, best.pose, [near])
            return float(explains(uncropped, best.pose, best.lead))

    def _substituted(self, problem: AlignProblem, poses: Tensor) -> Tensor:
        return problem.clamp_candidates(
            poses if self.known is None else self.known.substitute_prior_means(problem, poses)
        )
