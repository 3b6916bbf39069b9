"""From many rough candidate poses to a few good ones: the funnel that searches around a start and everywhere share.

Every candidate's limbs are placed coarsely and all is fitted to the surface; the best few are searched thoroughly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import torch
from torch import Tensor

from torchreg.alignment.annealed_em import surface_steps
from torchreg.alignment.limb_search import Effort, LimbSearch, distinct_first, take_rows
from torchreg.alignment.problem import PRIOR_SHARE, AlignProblem
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import FusedSurface
from torchreg.solvers.robust import welsch_loss

_COARSE = Effort(
    num_data=150, width=0.05, beam=82, configurations=41, polish=(), score_width=0.05, combinations=2, exchanged=0
)
_FINE = Effort(
    num_data=250, width=0.05, beam=123, configurations=40, polish=(0.04, 0.03, 0.025), score_width=0.02,
    combinations=8, exchanged=3,
)  # fmt: skip
# Kernel widths of the surface fits of rough, coarse and fine candidates, and of the scores, as shares of the size.
_ROUGH_FIT = (0.12, 0.08, 0.05, 0.03, 0.018)
_COARSE_FIT, _COARSE_SCORE, _COARSE_DATA = (0.04, 0.03, 0.025), 0.022, 250
_FINE_FIT, _FINE_SCORE, _FINE_STEPS = (0.03, 0.022, 0.018), 0.018, 2
# More data and model points than these tell candidates apart no better.
_MAX_DATA, _NUM_MODEL = 800, 120
# Candidates whose points differ by less than this share of the size have fallen together; so many points tell.
_SAME, _COMPARED_POINTS = 0.005, 60
# Standard deviation of the data, as a share of the size, for the weight of the prior.
_NOISE = 0.01
# A search that explains no more than this many data more has ended.
_MIN_GAIN = 0.5
_SEEDS = 2**31


class PoseSearch:
    """A search for the pose that explains most data, for a batch of problems of one shape.

    Args:
        problem: the batch; it is searched with few data, few model points and the shape's solids for its surface.
        generator: draws data, the same for every problem: a batch gives what its problems give alone.
    """

    def __init__(self, problem: AlignProblem, generator: torch.Generator) -> None:
        shape = problem.skin.shape
        skin = _coarse_skin(problem.skin)
        self.problem = replace(problem, skin=skin, surface=FusedSurface(shape)).draw(_MAX_DATA, generator)
        self.few = self.problem.draw(_COARSE_DATA, generator)
        self.limbs = LimbSearch(shape)
        self.seed = int(torch.randint(_SEEDS, (), generator=generator))

    def rows(self, index: Tensor) -> PoseSearch:
        """Return the search for some rows of the batch."""
        part = copy(self)
        part.problem, part.few = self.problem.rows(index), self.few.rows(index)
        return part

    def fitted_score(self, poses: Tensor) -> Tensor:
        """Return the scores (B,) of poses (B, num_dofs) after a fit without any search, as `settle` measures them."""
        fitted = fit_candidates(self.problem, poses.unsqueeze(1), _FINE_FIT, _FINE_STEPS)
        return score_candidates(self.problem, fitted, _FINE_SCORE)[:, 0]

    def attract(self, pool: Tensor, steps: int) -> Tensor:
        """Return rough candidates (B, N, num_dofs) after surface fits from a wide kernel to a narrow one, best first.

        Data of one side only would draw an EM into the shape; the surface they do not. Those that fell together with
        a better one come last.
        """
        fitted = fit_candidates(self.few, pool, _ROUGH_FIT, steps)
        return self._best_first(fitted, score_candidates(self.few, fitted, _COARSE_SCORE))

    def narrow(self, pool: Tensor, count: int) -> Tensor:
        """Return the best ``count`` of candidates (B, N, num_dofs), each with its limbs placed anew or as it came.

        Different ones first: where all rivals but one fall together, a symmetric shape would look certain.
        """
        placed = self._placed(self.few, pool, _COARSE, 0)
        options = torch.cat([placed, pool.unsqueeze(2)], dim=2)
        fitted = fit_candidates(self.few, options.flatten(1, 2), _COARSE_FIT, 1)
        scores = score_candidates(self.few, fitted, _COARSE_SCORE).unflatten(1, options.shape[1:3])
        best, which = scores.min(-1)
        first = torch.arange(which.shape[1], device=which.device) * options.shape[2]
        return self._best_first(take_rows(fitted, first + which), best)[:, :count]

    def settle(self, candidates: Tensor, rounds: int) -> tuple[Tensor, Tensor]:
        """Return what a thorough search makes of each candidate, best first, and the scores.

        Args:
            candidates: (B, H, num_dofs).
            rounds: of the search; after the first, only the best candidate is searched on.

        Returns:
            poses (B, H, num_dofs) and scores (B, H): data that are not explained, and the prior.
        """
        poses, scores = self._searched(candidates, 1)
        order = scores.argsort(1)
        poses, scores = take_rows(poses, order), scores.gather(1, order)
        active = torch.arange(len(poses), device=poses.device)
        for number in range(2, rounds + 1):
            best, score = self.rows(active)._searched(poses[active, :1], number)
            gain = scores[active, 0] - score[:, 0]
            better = (gain > 0).unsqueeze(-1)
            poses[active, 0] = torch.where(better, best[:, 0], poses[active, 0])
            scores[active, 0] = torch.minimum(score[:, 0], scores[active, 0])
            active = active[gain > _MIN_GAIN]
            if len(active) == 0:
                break
        return poses, scores

    def _best_first(self, poses: Tensor, scores: Tensor) -> Tensor:
        poses = take_rows(poses, scores.argsort(1))
        return take_rows(poses, distinct_first(mean_distances(self.problem, poses) < _SAME * self.problem.size))

    def _searched(self, candidates: Tensor, number: int) -> tuple[Tensor, Tensor]:
        options = torch.cat([self._placed(self.problem, candidates, _FINE, number), candidates.unsqueeze(2)], dim=2)
        fitted = fit_candidates(self.problem, options.flatten(1, 2), _FINE_FIT, _FINE_STEPS)
        scores = score_candidates(self.problem, fitted, _FINE_SCORE).unflatten(1, options.shape[1:3])
        best, which = scores.min(-1)
        first = torch.arange(which.shape[1], device=which.device) * options.shape[2]
        return take_rows(fitted, first + which), best

    def _placed(self, problem: AlignProblem, candidates: Tensor, effort: Effort, number: int) -> Tensor:
        """Return candidates (B, N, C, num_dofs) with their limbs placed in the C best ways, on data of their own."""
        generator = torch.Generator().manual_seed(self.seed + number)
        wide = repeated(problem, candidates.shape[1])
        return self.limbs(wide, candidates.flatten(0, 1), effort, generator).unflatten(0, candidates.shape[:2])


def _coarse_skin(skin: LinearBlendSkin) -> LinearBlendSkin:
    """Return a skin of few points that cover the given one's."""
    index = farthest_points(skin.points, min(_NUM_MODEL, len(skin)))
    return LinearBlendSkin(skin.shape, skin.points[index], skin.weights[index], skin.reference_pose)


def mean_distances(problem: AlignProblem, poses: Tensor) -> Tensor:
    """Return how far apart model points are, (B, K, K) root mean squares, in poses (B, K, num_dofs)."""
    points = problem.skin(poses)[..., :: max(1, len(problem.skin) // _COMPARED_POINTS), :]
    return torch.cdist(points.flatten(2), points.flatten(2)) / math.sqrt(points.shape[-2])


def repeated(problem: AlignProblem, count: int) -> AlignProblem:
    """Return the batch with every problem ``count`` times in a row."""
    return problem.rows(torch.arange(len(problem.data), device=problem.data.device).repeat_interleave(count))


def fit_candidates(problem: AlignProblem, poses: Tensor, widths: Sequence[float], steps: int) -> Tensor:
    """Return poses (B, K, num_dofs) after damped steps on the surface, ``steps`` at each width (shares of the size)."""
    wide, pose = repeated(problem, poses.shape[1]), poses.flatten(0, 1)
    noise = torch.full_like(pose[:, 0], _NOISE * problem.size)
    for share in widths:
        pose = surface_steps(wide, pose, torch.full_like(noise, share * problem.size), noise, steps).state
    return pose.reshape(poses.shape)


def score_candidates(problem: AlignProblem, poses: Tensor, width: float) -> Tensor:
    """Return the score (B, K) of poses (B, K, num_dofs): outliers, softly counted, and the prior; lower is better."""
    distance = problem.surface.distance(problem.data.unsqueeze(1), poses)
    lost = welsch_loss((distance / (width * problem.size)).square())
    return (lost * problem.valid.unsqueeze(1)).sum(-1) + PRIOR_SHARE * problem.prior.cost(poses)
