"""From many rough candidates to a few good poses: fitted coarsely, pruned with limbs placed anew, and refined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchreg.alignment.fit.problem import PRIOR_SHARE, AlignProblem
from torchreg.alignment.fit.surface_fit import surface_steps
from torchreg.alignment.search.limb_search import Effort, LimbSearch, distinct_first, take_rows
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import FusedSurface
from torchreg.solvers.robust import welsch_loss


@dataclass(frozen=True)
class _Stage:
    """Settings of a stage: placing limbs, fitting to the surface, scoring. Widths are shares of the model's size."""

    effort: Effort
    fit_widths: tuple[float, ...]
    fit_steps: int
    score_width: float


@dataclass(frozen=True)
class _Budget:
    """Numbers of all stages; lengths are shares of the model's size."""

    coarse_widths: tuple[float, ...] = (0.12, 0.08, 0.05, 0.03, 0.018)  # of the kernel in the coarse fits
    num_data: int = 800  # of the refinement: more tell candidates apart no better
    num_coarse_data: int = 250  # of the coarse fits and the pruning of many candidates
    num_model_points: int = 120  # that cover the shape
    num_compared: int = 60  # model points by which candidates are compared
    same: float = 0.005  # candidates whose points differ by less are duplicates
    noise: float = 0.01  # standard deviation of the data for the weight of the prior
    min_gain: float = 0.5  # in data explained: a round that gains less is the last


_PRUNE = _Stage(
    effort=Effort(
        num_data=150, width=0.05, beam=82, configurations=41, refine_widths=(), score_width=0.05, combinations=2,
        exchanged=0,
    ),
    fit_widths=(0.04, 0.03, 0.025),
    fit_steps=1,
    score_width=0.022,
)  # fmt: skip
_REFINE = _Stage(
    effort=Effort(
        num_data=250, width=0.05, beam=123, configurations=40, refine_widths=(0.04, 0.03, 0.025), score_width=0.02,
        combinations=8, exchanged=3,
    ),
    fit_widths=(0.03, 0.022, 0.018),
    fit_steps=2,
    score_width=0.018,
)  # fmt: skip
SEARCH_BUDGET = _Budget()


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
        fitted = fit_candidates(self.problem, poses.unsqueeze(1), _REFINE.fit_widths, _REFINE.fit_steps)
        return score_candidates(self.problem, fitted, _REFINE.score_width)[:, 0]

    def fit_coarsely(self, pool: Tensor, steps: int) -> Tensor:
        """Return candidates (B, N, num_dofs) after surface fits of narrowing kernels, best and different ones first."""
        fitted = fit_candidates(self.coarse_problem, pool, SEARCH_BUDGET.coarse_widths, steps)
        return self._best_first(fitted, score_candidates(self.coarse_problem, fitted, _PRUNE.score_width))

    def prune(self, pool: Tensor, count: int) -> Tensor:
        """Return the best, different ``count`` of candidates (B, N, num_dofs), limbs placed anew or as given."""
        return self._best_first(*self._best_options(self.coarse_problem, pool, _PRUNE, 0))[:, :count]

    def refine(self, candidates: Tensor, rounds: int) -> tuple[Tensor, Tensor]:
        """Return candidates (B, H, num_dofs) after a thorough search, best first, and their scores (B, H)."""
        poses, scores = self._best_options(self.problem, candidates, _REFINE, 1)
        order = scores.argsort(1)
        poses, scores = take_rows(poses, order), scores.gather(1, order)
        active = torch.arange(len(poses), device=poses.device)
        for number in range(2, rounds + 1):
            part = self.problem.rows(active)
            best, score = self._best_options(part, poses[active, :1], _REFINE, number)
            gain = scores[active, 0] - score[:, 0]
            better = (gain > 0).unsqueeze(-1)
            poses[active, 0] = torch.where(better, best[:, 0], poses[active, 0])
            scores[active, 0] = torch.minimum(score[:, 0], scores[active, 0])
            active = active[gain > SEARCH_BUDGET.min_gain]
            if len(active) == 0:
                break
        return poses, scores

    def _best_first(self, poses: Tensor, scores: Tensor) -> Tensor:
        poses = take_rows(poses, scores.argsort(1))
        same = mean_distances(self.problem, poses) < SEARCH_BUDGET.same * self.problem.size
        return take_rows(poses, distinct_first(same))

    def _best_options(
        self, problem: AlignProblem, candidates: Tensor, stage: _Stage, number: int
    ) -> tuple[Tensor, Tensor]:
        """Return candidates (B, N, num_dofs) fitted with their limbs placed anew or as given, and scores (B, N)."""
        generator = torch.Generator().manual_seed(self.seed + number)
        wide = problem.repeated(candidates.shape[1])
        placed = self.limbs(wide, candidates.flatten(0, 1), stage.effort, generator).unflatten(0, candidates.shape[:2])
        options = torch.cat([placed, candidates.unsqueeze(2)], dim=2)
        fitted = fit_candidates(problem, options.flatten(1, 2), stage.fit_widths, stage.fit_steps)
        scores = score_candidates(problem, fitted, stage.score_width).unflatten(1, options.shape[1:3])
        best, choice = scores.min(-1)
        first = torch.arange(choice.shape[1], device=choice.device) * options.shape[2]
        return take_rows(fitted, first + choice), best


def _coarse_skin(skin: LinearBlendSkin) -> LinearBlendSkin:
    """Return a skin of few points that cover the given one's."""
    index = farthest_points(skin.points, min(SEARCH_BUDGET.num_model_points, len(skin)))
    return LinearBlendSkin(skin.shape, skin.points[index], skin.weights[index], skin.reference_pose)


def mean_distances(problem: AlignProblem, poses: Tensor) -> Tensor:
    """Return the distances (B, K, K) of model points, as root mean squares, between poses (B, K, num_dofs)."""
    points = problem.skin(poses)[..., :: max(1, len(problem.skin) // SEARCH_BUDGET.num_compared), :]
    return torch.cdist(points.flatten(2), points.flatten(2)) / math.sqrt(points.shape[-2])


def fit_candidates(problem: AlignProblem, poses: Tensor, widths: Sequence[float], steps: int) -> Tensor:
    """Return poses (B, K, num_dofs) after damped steps on the surface, ``steps`` at each width (shares of the size)."""
    wide, pose = problem.repeated(poses.shape[1]), poses.flatten(0, 1)
    noise = torch.full_like(pose[:, 0], SEARCH_BUDGET.noise * problem.size)
    for width in widths:
        pose = surface_steps(wide, pose, torch.full_like(noise, width * problem.size), noise, steps).state
    return pose.reshape(poses.shape)


def score_candidates(problem: AlignProblem, poses: Tensor, width: float) -> Tensor:
    """Return the score (B, K) of poses (B, K, num_dofs), as `alignment_cost`; lower is better."""
    distance = problem.surface.distance(problem.data.unsqueeze(1), poses)
    outliers = welsch_loss((distance / (width * problem.size)).square())
    scores = (outliers * problem.valid.unsqueeze(1)).sum(-1) + PRIOR_SHARE * problem.prior.cost(poses)
    return scores + problem.factor_score(poses, width)
