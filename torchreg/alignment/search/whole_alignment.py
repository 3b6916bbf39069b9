"""Candidates as rows of one batch: all their joints aligned, fitted to all data, ranked, the best that differ kept.

The limbs of a skinned rig are not placed one after another: the solids that stand for its parts are too rough for
that, and bones of a spine, rather than a trunk that is found first, lie between them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.config import AlignConfig
from torchreg.alignment.fit.annealed_em import ANNEALING, anneal
from torchreg.alignment.fit.problem import AlignProblem, alignment_cost
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, fit_surface
from torchreg.alignment.search.limb_search import distinct_first, rows_in_memory, take_rows
from torchreg.alignment.search.pose_search import SEARCH_BUDGET, mean_distances


@dataclass(frozen=True)
class _Distinct:
    """When candidates are different ones."""

    max_compared: int = 300  # best candidates, of which different ones are taken
    same: float = 0.045  # share of the model's size: candidates whose points differ by less are duplicates


_DISTINCT = _Distinct()


def align_rows(problem: AlignProblem, poses: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return the best ``count`` of candidates (B, K, num_dofs) after an alignment of all their joints to few data."""
    settings, found, candidates = AlignConfig(), [], poses.shape[1]
    drawn = replace(problem.draw(SEARCH_BUDGET.num_data, generator), debias=settings.debias)
    schedule, shape = ANNEALING.schedule(problem.size), problem.skin.shape
    derivatives = candidates * shape.num_parts * problem.skin.basis.shape[-1] * shape.num_dofs
    for rows in rows_in_memory(len(poses), derivatives, poses.device):
        part, pose = drawn.rows(rows).repeated(candidates), poses[rows].flatten(0, 1)
        pose = anneal(part, pose, schedule, em_steps=settings.em_steps, m_steps=settings.m_steps).pose
        pose = fit_surface(part, pose, steps=settings.surface_steps).pose
        costs = alignment_cost(part, pose).unflatten(0, (-1, candidates))
        found.append(best_distinct(drawn.rows(rows), pose.unflatten(0, (-1, candidates)), costs, count))
    return torch.cat(found)


def fit_rows(problem: AlignProblem, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Return candidates (B, K, num_dofs) fitted to all data, best first, and their costs (B, K)."""
    count = poses.shape[1]
    wide = problem.repeated(count)
    fitted = fit_surface(wide, poses.flatten(0, 1), steps=SURFACE_FIT.search_steps, widths=SURFACE_FIT.widths[-1:]).pose
    return best_first(fitted.reshape(poses.shape), alignment_cost(wide, fitted).reshape(len(poses), count))


def best_first(poses: Tensor, costs: Tensor) -> tuple[Tensor, Tensor]:
    """Return candidates (B, K, num_dofs) and their costs (B, K), sorted by cost."""
    order = costs.argsort(dim=1, stable=True)
    return take_rows(poses, order), costs.gather(1, order)


def best_distinct(problem: AlignProblem, poses: Tensor, costs: Tensor, count: int) -> Tensor:
    """Return the best ``count`` of poses (B, K, num_dofs) whose points differ; then duplicates of them."""
    poses = take_rows(poses, costs.argsort(1)[:, : _DISTINCT.max_compared])
    order = distinct_first(mean_distances(problem, poses) < _DISTINCT.same * problem.size)
    return take_rows(poses, order[:, :count])
