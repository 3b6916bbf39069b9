"""From many rough candidates to a few good poses: fitted coarsely, pruned with limbs placed anew, and refined."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.sigma_schedule import narrowing
from torchreg.alignment.search.limb_search import Effort, LimbSearch
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates, Plan, descend, take_rows
from torchreg.alignment.search.rough_poses import register_rigidly
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import FusedSurface


@dataclass(frozen=True)
class _Stage:
    """Settings of a stage: placing limbs, then fits to the surface and scores."""

    effort: Effort
    plan: Plan


@dataclass(frozen=True)
class _Search:
    """Numbers of the search; lengths are shares of the model's size."""

    min_gain: float = 0.5  # in data explained: a round that gains less is the last


_PRUNE = _Stage(
    effort=Effort(
        num_data=150, width=0.05, beam=82, configurations=41, refine_widths=(), score_width=0.05, combinations=2,
        exchanged=0,
    ),
    plan=Plan(start=0.04, stop=0.022, steps=1),
)  # fmt: skip
_REFINE = _Stage(
    effort=Effort(
        num_data=250, width=0.05, beam=123, configurations=40, refine_widths=narrowing(0.04, 0.022), score_width=0.02,
        combinations=8, exchanged=3,
    ),
    plan=Plan(start=0.03, stop=0.018, steps=2),
)  # fmt: skip
_COARSE = Plan(start=0.12, stop=0.018, steps=3)
_SEARCH = _Search()


class PoseSearch:
    """A search, with few data and model points, for the poses that explain most data of a batch of problems."""

    def __init__(self, problem: AlignProblem, generator: torch.Generator) -> None:
        shape = problem.skin.shape
        reduced = replace(problem.with_skin(_coarse_skin(problem.skin)), surface=FusedSurface(shape))
        self.problem = reduced.draw(SEARCH_BUDGET.num_data, generator)
        self.coarse_problem = self.problem.draw(SEARCH_BUDGET.num_coarse_data, generator)
        self.seed = int(torch.randint(2**31, (), generator=generator))

    @cached_property
    def limbs(self) -> LimbSearch:
        """The search over the limbs, whose samples of the joints are placed when first needed."""
        return LimbSearch(self.problem.skin.shape)

    def rows(self, index: Tensor) -> PoseSearch:
        """Return the search for some rows of the batch."""
        part = copy(self)
        part.problem, part.coarse_problem = self.problem.rows(index), self.coarse_problem.rows(index)
        return part

    def fitted_score(self, poses: Tensor) -> Tensor:
        """Return the scores (B,) of poses (B, num_dofs) after a fit without any search, comparable to `refine`'s."""
        return descend(self.problem, poses.unsqueeze(1), _REFINE.plan)[1][:, 0]

    def registered(self, rough: Tensor, generator: torch.Generator) -> Candidates:
        """Return rough poses (B, K, num_dofs) after a rigid registration, best first."""
        return Candidates.ranked(self.problem, *register_rigidly(self.problem, rough, generator))

    def fit_coarsely(self, pool: Tensor) -> Tensor:
        """Return candidates (B, N, num_dofs) after surface fits of narrowing kernels, best and different ones first."""
        fitted = Candidates.descended(self.coarse_problem, pool, _COARSE)
        return fitted.distinct(SEARCH_BUDGET.duplicate).poses

    def prune(self, pool: Tensor, count: int) -> Tensor:
        """Return the best, different ``count`` of candidates (B, N, num_dofs), limbs placed anew or as given."""
        return self._best_options(self.coarse_problem, pool, _PRUNE, 0).distinct(SEARCH_BUDGET.duplicate, count).poses

    def refine(self, candidates: Tensor, rounds: int) -> tuple[Tensor, Tensor]:
        """Return candidates (B, H, num_dofs) after a thorough search, best first, and their scores (B, H)."""
        first = self._best_options(self.problem, candidates, _REFINE, 1)
        poses, scores = first.poses, first.costs
        active = torch.arange(len(poses), device=poses.device)
        for number in range(2, rounds + 1):
            part = self.problem.rows(active)
            best = self._best_options(part, poses[active, :1], _REFINE, number)
            gain = scores[active, 0] - best.costs[:, 0]
            better = (gain > 0).unsqueeze(-1)
            poses[active, 0] = torch.where(better, best.poses[:, 0], poses[active, 0])
            scores[active, 0] = torch.minimum(best.costs[:, 0], scores[active, 0])
            active = active[gain > _SEARCH.min_gain]
            if len(active) == 0:
                break
        return poses, scores

    def _best_options(self, problem: AlignProblem, candidates: Tensor, stage: _Stage, number: int) -> Candidates:
        """Return candidates (B, N, num_dofs) fitted with their limbs placed anew or as given, whichever is better."""
        generator = torch.Generator().manual_seed(self.seed + number)
        wide = problem.repeated(candidates.shape[1])
        placed = self.limbs(wide, candidates.flatten(0, 1), stage.effort, generator).unflatten(0, candidates.shape[:2])
        options = torch.cat([placed, candidates.unsqueeze(2)], dim=2)
        fitted, scores = descend(problem, options.flatten(1, 2), stage.plan)
        best, choice = scores.unflatten(1, options.shape[1:3]).min(-1)
        first = torch.arange(choice.shape[1], device=choice.device) * options.shape[2]
        return Candidates.ranked(problem, take_rows(fitted, first + choice), best)


def _coarse_skin(skin: LinearBlendSkin) -> LinearBlendSkin:
    """Return a skin of few points that cover the given one's."""
    index = farthest_points(skin.points, min(SEARCH_BUDGET.num_model_points, len(skin)))
    return LinearBlendSkin(skin.shape, skin.points[index], skin.weights[index], skin.reference_pose)
