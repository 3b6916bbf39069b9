"""The stages of the alignments of a batch: annealed EM, surface fit, a search where needed, steps to the end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchreg.alignment.evidence.curvature import curvature
from torchreg.alignment.fit.annealed_em import ANNEALING, OnStep, StageResult, anneal, outlier_level
from torchreg.alignment.fit.problem import INLIER_SHARE, AlignProblem, alignment_cost
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, fit_surface
from torchreg.alignment.results import AlignRecord
from torchreg.alignment.search.local_search import explore, needs_search
from torchreg.geometry.budget import BUDGET
from torchreg.result import normal_copy
from torchreg.shapes.pose_algebra import shifted
from torchreg.solvers.e_step import expectation

if TYPE_CHECKING:
    from torchreg.alignment.config import AlignConfig


@dataclass(frozen=True)
class AlignBatch:
    """B alignments in centered coordinates: starts (B, num_dofs), origins (B, 3), and the records of all stages."""

    problem: AlignProblem
    start: Tensor
    origin: Tensor
    on_step: OnStep | None
    history: list[AlignRecord]

    def record(self, step: AlignRecord) -> None:
        """Keep the record of a step and pass it on, with poses in the coordinates of the data."""
        step = normal_copy(replace(step, pose=shifted(step.pose, self.origin)))
        self.history.append(step)
        if self.on_step is not None:
            with torch.inference_mode(False), torch.no_grad():
                self.on_step(step)

    def rows(self, index: Tensor) -> AlignBatch:
        """Return some rows of the batch."""
        return replace(self, problem=self.problem.rows(index), start=self.start[index], origin=self.origin[index])


@dataclass(frozen=True, eq=False)
class DataOnShape:
    """How data lie on a shape, (B, M) each, see `AlignResult`."""

    distances: Tensor
    inliers: Tensor
    posterior: Tensor

    @classmethod
    def of(cls, batch: AlignBatch, found: StageResult, config: AlignConfig, data: Tensor, valid: Tensor) -> DataOnShape:
        """Return how data (B, M, 3), in the coordinates of the problem, lie on the shape found."""
        problem, posed = batch.problem, batch.problem.skin(found.pose)
        outlier = outlier_level(problem, posed, found.sigma)
        distances = torch.where(valid, problem.surface.distance(data, found.pose), torch.nan)
        return cls(
            distances=distances,
            inliers=distances.abs() < (config.inlier_distance or INLIER_SHARE * problem.size),
            posterior=expectation(posed, data, found.sigma, outlier, mask=valid).inlier_posterior,
        )

    @classmethod
    def of_all(
        cls, batch: AlignBatch, found: StageResult, config: AlignConfig, clouds: Tensor, valid: Tensor
    ) -> DataOnShape:
        """Return the same for whole clouds ((B,) M, 3), in the world, of which the problem's data are a draw."""
        count = len(found.pose)
        clouds, valid = clouds.expand(count, *clouds.shape[-2:]), valid.expand(count, valid.shape[-1])
        size, parts = max(1, BUDGET.field_points // count), []
        for points, chosen in zip(clouds.split(size, 1), valid.split(size, 1), strict=True):
            local = torch.where(chosen.unsqueeze(-1), points - batch.origin.unsqueeze(1), 0.0)
            parts.append(cls.of(batch, found, config, local, chosen))
        return cls(
            distances=torch.cat([part.distances for part in parts], 1),
            inliers=torch.cat([part.inliers for part in parts], 1),
            posterior=torch.cat([part.posterior for part in parts], 1),
        )


def anneal_batch(batch: AlignBatch, config: AlignConfig) -> StageResult:
    """Return the poses after the annealed EM from the starts."""
    schedule = config.schedule or ANNEALING.schedule(batch.problem.size)
    return anneal(
        batch.problem, batch.start, schedule, em_steps=config.em_steps, m_steps=config.m_steps, on_step=batch.record
    )


def fit_batch_surface(batch: AlignBatch, found: StageResult, config: AlignConfig) -> StageResult:
    """Return the poses after a surface fit; sigma stays that of the registration, of the posterior."""
    if config.surface_steps == 0:
        return found
    fitted = fit_surface(batch.problem, found.pose, steps=config.surface_steps, on_step=batch.record)
    return replace(fitted, sigma=found.sigma)


def prefer_start_fit(batch: AlignBatch, found: StageResult, config: AlignConfig) -> StageResult:
    """Return the result, or the fitted start where that is better: an EM may draw one-sided data inwards."""
    if config.surface_steps == 0:
        return found
    steps, widths = max(config.surface_steps, SURFACE_FIT.search_steps), SURFACE_FIT.widths[-1:]
    kept = fit_surface(batch.problem, batch.start, steps=steps, widths=widths)
    better = alignment_cost(batch.problem, kept.pose) < alignment_cost(batch.problem, found.pose)
    pose = torch.where(better.unsqueeze(-1), kept.pose, found.pose)
    return replace(found, pose=pose, change=torch.where(better, kept.change, found.change))


def best_start(batch: AlignBatch, found: StageResult) -> tuple[AlignBatch, StageResult]:
    """Return the alignment of least cost, where all are of one cloud."""
    best = alignment_cost(batch.problem, found.pose).argmin().unsqueeze(0)
    return batch.rows(best), found.rows(best)


def search_where_needed(batch: AlignBatch, found: StageResult, config: AlignConfig) -> StageResult:
    """Return the result with better poses where a search found any."""
    if config.search == "never":
        return found
    wanted = torch.ones_like(found.change, dtype=torch.bool)
    if config.search == "auto":
        wanted = needs_search(batch.problem, batch.start, found.pose)
    rows = wanted.nonzero()[:, 0]
    if len(rows) == 0:
        return found
    part, before = batch.rows(rows), found.rows(rows)
    generator = torch.Generator().manual_seed(config.seed)
    explored = explore(
        part.problem, part.start, before.pose, candidates=config.num_candidates, rounds=config.search_rounds,
        generator=generator,
    )  # fmt: skip
    steps = max(config.surface_steps, SURFACE_FIT.search_steps)
    widths = SURFACE_FIT.widths[-1:]
    refined = fit_surface(part.problem, explored, steps=steps, widths=widths, on_step=part.record)
    better = alignment_cost(part.problem, refined.pose) < alignment_cost(part.problem, before.pose)
    pose, change = found.pose.clone(), found.change.clone()
    pose[rows] = torch.where(better.unsqueeze(-1), refined.pose, before.pose)
    change[rows] = torch.where(better, refined.change, before.change)
    return replace(found, pose=pose, change=change)


def refit_uncropped(batch: AlignBatch, uncropped: AlignProblem, found: StageResult, config: AlignConfig) -> StageResult:
    """Return the poses fitted without what a crop cuts off, as a forearm, where there is any."""
    if config.surface_steps == 0 or bool((uncropped.valid == batch.problem.valid).all()):
        return found
    steps = max(config.surface_steps, SURFACE_FIT.search_steps)
    refined = fit_surface(uncropped, found.pose, steps=steps, widths=SURFACE_FIT.widths[-1:], on_step=batch.record)
    return replace(refined, sigma=found.sigma)


def continue_unconverged(
    batch: AlignBatch, uncropped: AlignProblem, found: StageResult, config: AlignConfig
) -> StageResult:
    """Return the poses after more steps of the last fit, where another would still gain; not of a plain descent."""
    if config.surface_steps == 0 or config.search == "never":
        return found
    rows = (found.change > config.pose_atol).nonzero()[:, 0]
    rows = rows[~curvature(uncropped.rows(rows), found.pose[rows]).converged] if len(rows) else rows
    if len(rows) == 0:
        return found
    part, start = uncropped.rows(rows), found.pose[rows]
    record = batch.rows(rows).record
    refined = fit_surface(part, start, steps=SURFACE_FIT.more_steps, widths=(), on_step=record)
    pose, change = found.pose.clone(), found.change.clone()
    pose[rows], change[rows] = refined.pose, refined.change
    return replace(found, pose=pose, change=change)
