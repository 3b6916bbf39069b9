"""The one multi-start: candidates descend with narrowing kernels, are ranked, and the best that differ are kept."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.confidence import doubled_data
from torchreg.alignment.evidence.coverage import missing_data
from torchreg.alignment.fit.annealed_em import ANNEALING, anneal, narrowing
from torchreg.alignment.fit.problem import PRIOR_SHARE, AlignProblem, alignment_cost
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, fit_surface, surface_steps
from torchreg.solvers.robust import welsch_loss


@dataclass(frozen=True)
class SearchBudget:
    """Numbers of all searches; lengths are shares of the model's size."""

    num_data: int = 800  # of the refinement: more tell candidates apart no better
    num_coarse_data: int = 250  # of the coarse fits and the pruning of many candidates
    num_model_points: int = 120  # that cover the shape
    same: float = 0.05  # poses whose points differ by less are one
    duplicate: float = 0.005  # poses whose points differ by less descend to the same one
    max_ranked: int = 400  # best candidates, of which different ones are taken
    noise: float = 0.01  # standard deviation of the data for the weight of the prior
    cpu_entries: int = 1_500_000  # of a table in memory on a CPU: as its caches hold
    device_entries: int = 150_000_000  # of a table in memory on other devices: enough to keep them busy


SEARCH_BUDGET = SearchBudget()


@dataclass(frozen=True)
class Plan:
    """Damped steps at each of narrowing kernel widths, then a score at the last, all shares of the model's size."""

    start: float
    stop: float
    steps: int


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates (B, K, num_dofs) of a batch of problems, best first, and their costs (B, K)."""

    problem: AlignProblem
    poses: Tensor
    costs: Tensor

    @classmethod
    def ranked(cls, problem: AlignProblem, poses: Tensor, costs: Tensor) -> Candidates:
        """Return candidates (B, K, num_dofs) sorted by costs (B, K)."""
        order = costs.argsort(dim=1, stable=True)
        return cls(problem, take_rows(poses, order), costs.gather(1, order))

    @classmethod
    def descended(cls, problem: AlignProblem, poses: Tensor, plan: Plan) -> Candidates:
        """Return candidates (B, K, num_dofs) after a plan."""
        return cls.ranked(problem, *descend(problem, poses, plan))

    @classmethod
    def fitted(cls, problem: AlignProblem, poses: Tensor) -> Candidates:
        """Return candidates (B, K, num_dofs) fitted to all data down to their noise."""

        def fit(part: AlignProblem, pose: Tensor) -> tuple[Tensor, Tensor]:
            steps, widths = SURFACE_FIT.search_steps, SURFACE_FIT.widths[-1:]
            fitted = fit_surface(part, pose, steps=steps, widths=widths).pose
            return fitted, candidate_cost(part, fitted)

        return cls.ranked(problem, *_few_at_a_time(fit, problem, poses))

    def apart(self, same: float) -> Tensor:
        """Return which candidates differ (B, K, K): by more than a share of the size, on average over their points."""
        return mean_distances(self.problem, self.poses) > same * self.problem.size

    def lead(self) -> Tensor:
        """Return the cost (B,) by which the best of different candidates is worse than the first, or infinity."""
        return torch.where(self.apart(SEARCH_BUDGET.same)[:, 0], self.costs, torch.inf).amin(1) - self.costs[:, 0]

    def distinct(self, same: float, count: int | None = None) -> Candidates:
        """Return the best ``count`` that differ; then duplicates of them."""
        few = self.take(slice(SEARCH_BUDGET.max_ranked))
        order = distinct_first(~few.apart(same))[:, :count]
        return Candidates(self.problem, take_rows(few.poses, order), few.costs.gather(1, order))

    def take(self, which: slice) -> Candidates:
        """Return some of the candidates."""
        return Candidates(self.problem, self.poses[:, which], self.costs[:, which])

    def joined(self, others: Candidates) -> Candidates:
        """Return these candidates and others of the same problems."""
        costs = torch.cat([self.costs, others.costs], dim=1)
        return Candidates.ranked(self.problem, torch.cat([self.poses, others.poses], dim=1), costs)


def descend(problem: AlignProblem, poses: Tensor, plan: Plan) -> tuple[Tensor, Tensor]:
    """Return poses (B, K, num_dofs) after the steps of a plan on the surface, and their scores (B, K)."""

    def descent(part: AlignProblem, pose: Tensor) -> tuple[Tensor, Tensor]:
        noise = torch.full_like(pose[:, 0], SEARCH_BUDGET.noise * problem.size)
        for width in narrowing(plan.start, plan.stop):
            pose = surface_steps(part, pose, torch.full_like(noise, width * problem.size), noise, plan.steps).state
        return pose, score_candidates(part, pose.unsqueeze(1), plan.stop)[:, 0]

    return _few_at_a_time(descent, problem, poses)


def _few_at_a_time(
    evaluate: Callable[[AlignProblem, Tensor], tuple[Tensor, Tensor]], problem: AlignProblem, poses: Tensor
) -> tuple[Tensor, Tensor]:
    """Return poses (B, K, num_dofs) and costs (B, K), evaluated for few candidates at a time, duplicates once."""
    close = mean_distances(problem, poses) <= SEARCH_BUDGET.duplicate * problem.size
    original = first_close(close)
    cloud, number = (original == torch.arange(poses.shape[1], device=poses.device)).nonzero(as_tuple=True)
    # The wrenches of all parts on all data are the largest table of a Jacobian.
    wrenches = 6 * problem.data.shape[1] * problem.skin.shape.num_parts
    found, costs = poses.clone(), torch.zeros_like(poses[..., 0])
    for rows in rows_in_memory(len(cloud), wrenches, poses.device):
        index = cloud[rows], number[rows]
        found[index], costs[index] = evaluate(problem.rows(index[0]), poses[index])
    return take_rows(found, original), costs.gather(1, original)


def score_candidates(problem: AlignProblem, poses: Tensor, width: float) -> Tensor:
    """Return the score (B, K) of poses (B, K, num_dofs), as `alignment_cost`; lower is better."""
    distance = problem.surface.distance(problem.data.unsqueeze(1), poses)
    outliers = welsch_loss((distance / (width * problem.size)).square())
    scores = (outliers * problem.valid.unsqueeze(1)).sum(-1) + PRIOR_SHARE * problem.prior.cost(poses)
    return scores + problem.factor_score(poses, width)


def candidate_cost(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return the cost (B,) that ranks fitted candidates: of data left unexplained, missed, or explained twice."""
    return alignment_cost(problem, pose) + missing_data(problem, pose) + doubled_data(problem, pose)


def align_rows(problem: AlignProblem, poses: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return the best ``count`` of candidates (B, K, num_dofs) after an alignment of all their joints to few data.

    The limbs of a skinned rig are not placed one after another: the solids that stand for its parts are too rough for
    that, and bones of a spine, rather than a trunk that is found first, lie between them.
    """
    settings, found, candidates = AlignConfig(), [], poses.shape[1]
    drawn = replace(problem.draw(SEARCH_BUDGET.num_data, generator), debias=settings.debias)
    schedule, shape = ANNEALING.schedule(problem.size), problem.skin.shape
    derivatives = candidates * shape.num_parts * problem.skin.basis.shape[-1] * shape.num_dofs
    for rows in rows_in_memory(len(poses), derivatives, poses.device):
        part, pose = drawn.rows(rows).repeated(candidates), poses[rows].flatten(0, 1)
        pose = anneal(part, pose, schedule, em_steps=settings.em_steps, m_steps=settings.m_steps).pose
        pose = fit_surface(part, pose, steps=settings.surface_steps).pose
        costs = candidate_cost(part, pose).unflatten(0, (-1, candidates))
        ranked = Candidates.ranked(drawn.rows(rows), pose.unflatten(0, (-1, candidates)), costs)
        found.append(ranked.distinct(SEARCH_BUDGET.same, count).poses)
    return torch.cat(found)


def mean_distances(problem: AlignProblem, poses: Tensor) -> Tensor:
    """Return the distances (B, K, K) of model points, as root mean squares, between poses (B, K, num_dofs)."""
    points = problem.skin(poses)[..., :: max(1, len(problem.skin) // SEARCH_BUDGET.num_model_points), :]
    return torch.cdist(points.flatten(2), points.flatten(2)) / math.sqrt(points.shape[-2])


def rows_in_memory(count: int, entries: int, device: torch.device) -> tuple[Tensor, ...]:
    """Return the indices of ``count`` problems in groups whose tables, of so many entries each, fit into memory."""
    most = SEARCH_BUDGET.cpu_entries if device.type == "cpu" else SEARCH_BUDGET.device_entries
    return torch.arange(count, device=device).split(max(1, most // max(1, entries)))


def take_rows(table: Tensor, index: Tensor) -> Tensor:
    """Return rows ``index`` (B, C) of a table (B, K, ...)."""
    return table.gather(1, index.reshape(*index.shape, *[1] * (table.ndim - 2)).expand(*index.shape, *table.shape[2:]))


def first_close(close: Tensor) -> Tensor:
    """Return for each item (B, K) which item it is close (B, K, K) to of those before it that are kept, or itself."""
    kept = torch.ones_like(close[..., 0])
    for rank in range(1, close.shape[-1]):
        kept[:, rank] = ~(close[:, rank, :rank] & kept[:, :rank]).any(-1)
    return (close & kept.unsqueeze(1)).to(torch.uint8).argmax(-1)


def distinct_first(close: Tensor) -> Tensor:
    """Return the order (B, K) that moves items to the end that are close (B, K, K) to an item kept before them."""
    is_later = first_close(close) != torch.arange(close.shape[-1], device=close.device)
    return is_later.to(torch.uint8).argsort(dim=1, stable=True)
