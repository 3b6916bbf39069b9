"""The rows of a batch of alignments, from their starts to their judgement."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import warn_about_rounding
from torchreg.alignment.evidence.confidence import explained_alone
from torchreg.alignment.evidence.curvature import curvature
from torchreg.alignment.evidence.reliability import CALIBRATION, SurfaceError, judge, without_cut
from torchreg.alignment.find_pose import FindPoseConfig, FoundStarts, search_everywhere
from torchreg.alignment.fit.annealed_em import ANNEALING, StageResult, anneal, outlier_level
from torchreg.alignment.fit.problem import INLIER_SHARE, AlignProblem, alignment_cost, centered_problem, masked_mean
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, fit_surface
from torchreg.alignment.inputs import UNITS, Task, check_clouds, warn_about_degenerate, warn_about_units
from torchreg.alignment.results import AlignRecord, AlignResult
from torchreg.alignment.search.limb_search import trunk_turns
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates, mean_distances, score_candidates
from torchreg.alignment.search.pose_search import explore, needs_search
from torchreg.alignment.search.start_source import StartSource
from torchreg.errors import InputError, UnitsWarning
from torchreg.geometry.budget import BUDGET
from torchreg.result import Status, normal_copy
from torchreg.shapes.limbs import find_limbs
from torchreg.shapes.pose_algebra import BASE_DOFS, difference, shifted
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.e_step import expectation


@dataclass(frozen=True)
class RowNumbers:
    """Numbers of a batch of alignments."""

    min_share: float = 0.02  # inliers, as a share of the data, with fewer of which a pose means nothing
    many_data: int = 10_000  # in a batch, from which all threads of torch are of use
    turned: int = 8  # poses with the trunk turned, the best of its samples, that are fitted
    far_turn: float = 0.8  # of the base from a start, radians: beyond, three in four of sure poses were wrong


ROWS = RowNumbers()


@dataclass(frozen=True, eq=False)
class PoseRows:
    """B alignments in centered coordinates: starts (B, num_dofs), origins (B, 3), poses found, records of all steps.

    `uncropped` is the problem without what a crop cuts off, as a forearm; `lead` (B,) and `rivals` (B, R, num_dofs) are
    those of a search. The rows are those of ``batched`` clouds, or of several starts in one.
    """

    task: Task
    problem: AlignProblem
    uncropped: AlignProblem
    start: Tensor
    origin: Tensor
    found: StageResult
    batched: bool
    history: list[AlignRecord] = field(default_factory=list)
    lead: Tensor | None = None
    rivals: Tensor | None = None

    @classmethod
    def of(cls, task: Task) -> PoseRows:
        """Return the rows of the starts of a task: given, known, or found by a search."""
        shape, config, start, lead, rivals = task.shape, task.config, task.start, None, None
        task = replace(task, seen=task.seen.drawn(shape, config.nan_policy, config.seed))
        if start is None and task.known is not None and task.known.places_base:
            start = task.known.start(shape)
        if start is None:
            search = _search(task)
            start, lead, rivals = search.starts.best, search.lead, search.rivals
        with torch.inference_mode():
            clouds, valid = check_clouds(shape, task.seen.points, task.seen.mask, config.nan_policy)
            pose = task.starts(clouds, start)
            rows = cls.centered(task, task.skin(pose), clouds, valid, pose)  # the skin's points are the X_i of eq. 3
            problem = rows.problem if task.known is None else task.known.with_prior(rows.problem, rows.start)
            warn_about_rounding(clouds, "data", problem.size, stacklevel=5)
            warn_about_units(problem.data, problem.valid, problem.size, stacklevel=5)
            return replace(rows, problem=problem, uncropped=problem, lead=lead, rivals=rivals)

    @classmethod
    def centered(cls, task: Task, skin: LinearBlendSkin, clouds: Tensor, valid: Tensor, pose: Tensor) -> PoseRows:
        """Return rows of clouds ((B,) M, 3) from starts (B, num_dofs), each about the mean of its data."""
        config, data = task.config, clouds.expand(len(pose), *clouds.shape[-2:])
        valid = valid.expand(len(pose), valid.shape[-1])
        origin, free_space = masked_mean(data, valid), task.seen.free_space
        if free_space is not None and len(free_space.picture) < len(pose):
            free_space = free_space.rows(torch.zeros(len(pose), dtype=torch.int64, device=free_space.picture.device))
        problem = centered_problem(
            skin, data, valid, pose, origin, prior_std=config.prior_std, pose_atol=config.pose_atol,
            outlier=config.outlier, debias=config.debias, correspondence=config.correspondence, free_space=free_space,
            keypoints=task.seen.keypoints,
        )  # fmt: skip
        start, none = shifted(pose, -origin), torch.full_like(pose[:, 0], torch.inf)
        found = StageResult(pose=start, sigma=none, change=none)
        return cls(task, problem, problem, start, origin, found, batched=clouds.ndim == 3)

    def record(self, step: AlignRecord) -> None:
        """Keep the record of a step and pass it on, with poses in the coordinates of the data."""
        step = normal_copy(replace(step, pose=shifted(step.pose, self.origin)))
        self.history.append(step)
        if self.task.on_step is not None:
            with torch.inference_mode(False), torch.no_grad():
                self.task.on_step(step)

    def rows(self, index: Tensor) -> PoseRows:
        """Return some rows of the batch."""
        problem = self.problem.rows(index)
        uncropped = problem if self.uncropped is self.problem else self.uncropped.rows(index)
        start, origin, found = self.start[index], self.origin[index], self.found.rows(index)
        return replace(self, problem=problem, uncropped=uncropped, start=start, origin=origin, found=found)

    def annealed(self) -> PoseRows:
        """Return the rows after the annealed EM from the starts."""
        config, schedule = self.task.config, self.task.config.schedule or ANNEALING.schedule(self.problem.size)
        steps = {"em_steps": config.em_steps, "m_steps": config.m_steps}
        return replace(self, found=anneal(self.problem, self.start, schedule, **steps, on_step=self.record))

    def fitted(self) -> PoseRows:
        """Return the rows after a surface fit, of several starts in one cloud the best; sigma stays the posterior's."""
        rows = self
        if self.task.config.surface_steps:
            fit = fit_surface(self.problem, self.found.pose, steps=self.task.config.surface_steps, on_step=self.record)
            rows = replace(self, found=replace(fit, sigma=self.found.sigma))
        if self.batched or len(self.start) == 1:
            return rows
        return rows.rows(alignment_cost(rows.problem, rows.found.pose).argmin().unsqueeze(0))

    def restarted(self) -> PoseRows:
        """Return the rows, from other starts where that is better: one found, or around one not to be trusted."""
        found, config = self, self.task.config
        if self.lead is not None and config.surface_steps:
            # An EM may draw one-sided data inwards.
            found = self._refitted(self.start, on_step=None)
        if config.search == "never":
            return found
        needed = needs_search(self.problem, self.start, found.found.pose, always=config.search == "always")
        index = needed.nonzero()[:, 0]
        if len(index):
            rows, generator = found.rows(index), torch.Generator().manual_seed(config.seed)
            explored = explore(
                rows.problem, rows.start, rows.found.pose, candidates=config.num_candidates,
                rounds=config.search_rounds, generator=generator,
            )  # fmt: skip
            found = found._joined(index, rows._refitted(explored, on_step=rows.record))
        return found if found.lead is None else found._trunk_turned(found.lead)

    def _trunk_turned(self, lead: Tensor) -> PoseRows:
        """Return the rows, found with a lead (B,), with the trunk turned on the limb it hangs on, where that is better.

        A base that is nearly square, or of which little is seen, stays in the minimum that it was registered in: such
        minima are rivals, unless the trunk looks alike in them.
        """
        problem, turns = self.problem, trunk_turns(self.problem, self.found.pose)
        if turns.shape[1] == 0 or self.task.config.surface_steps == 0:
            return self
        ranked = Candidates.ranked(problem, turns, score_candidates(problem, turns, INLIER_SHARE))
        some = torch.cat([self.found.pose.unsqueeze(1), ranked.poses[:, : ROWS.turned]], dim=1)
        found = Candidates.fitted(problem, some)
        trunk = find_limbs(problem.skin.shape)[1]
        own = torch.isin(problem.skin.weights.argmax(-1), torch.tensor(trunk))
        points = problem.skin(found.poses)[:, :, own]
        off = problem.surface.distance(points.flatten(1, 2), found.poses[:, 0]).view_as(points[..., 0])
        differs = off.square().mean(-1).sqrt() > SEARCH_BUDGET.duplicate * problem.size
        rival = torch.where(differs, found.costs, torch.inf).amin(1) - found.costs[:, 0]
        rows = self._refitted(found.poses[:, 0], on_step=None)
        # Few data tell of a trunk: a lead counts by these.
        telling = explained_alone(problem, rows.found.pose, [trunk])[:, 0].clamp_min(1)
        return replace(rows, lead=torch.minimum(lead, rival * (problem.valid.sum(-1) / telling).clamp_min(1)))

    def finished(self) -> PoseRows:
        """Return the rows fitted without what a crop cuts off, and to the end where another step would still gain."""
        rows = replace(self, uncropped=without_cut(self.problem, self.found.pose, self.task.seen.frames))
        if self.task.config.surface_steps == 0:
            return rows
        if bool((rows.uncropped.valid != self.problem.valid).any()):
            rows = rows._refitted(self.found.pose, on_step=self.record, if_better=False)
        index = (rows.found.change > self.task.config.pose_atol).nonzero()[:, 0]
        if self.task.config.search == "never" or len(index) == 0:
            return rows
        index = index[~curvature(rows.uncropped.rows(index), rows.found.pose[index]).converged]
        if len(index) == 0:
            return rows
        left, steps = rows.rows(index), SURFACE_FIT.more_steps
        more = left._refitted(left.found.pose, on_step=left.record, if_better=False, steps=steps, widths=())
        return rows._joined(index, more)

    def searched_in_doubt(self, found: AlignResult) -> AlignResult:
        """Return the result from given starts, or the surer one of a search without a start.

        There is a search where the result is in doubt, and where the start was so far off that another would do.
        """
        task = self.task
        doubts = set(Status) if task.config.search == "always" else {Status.DOUBTFUL, Status.FEW_INLIERS}
        turn = difference(self.start, found.pose.view_as(self.start))[:, 3:BASE_DOFS].norm(dim=-1)
        in_doubt = turn.new_tensor([status in doubts for status in found.statuses], dtype=torch.bool)
        chosen = (in_doubt | (turn > ROWS.far_turn)).nonzero()[:, 0]
        is_meant = task.config.search == "never" or task.known is not None or isinstance(task.model_points, Tensor)
        if len(chosen) == 0 or is_meant or task.start is None or task.in_picture:
            return found
        source = StartSource.of(task.shape, initializer=task.source.proposer, upright=task.config.upright)
        asked = replace(task, start=None, source=source, seen=task.seen.rows(chosen))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # as told of the same data before
            rows = replace(PoseRows.of(asked), history=self.history)
            searched = rows.annealed().fitted().restarted().finished().judged()
        return found.with_surer(chosen, searched)

    def judged(self, person: tuple[SurfaceError, Tensor] | None = None) -> AlignResult:
        """Return the result, with what speaks against it; ``person`` is as in `judge`."""
        problem, pose, config, seen = self.problem, self.found.pose, self.task.config, self.task.seen
        rivals = None if self.rivals is None else _different(self, self.rivals)
        fitted = DataOnShape.of(self, problem.data, problem.valid)
        everything = fitted if seen.everything is None else DataOnShape.of_all(self, *seen.everything)
        cost = alignment_cost(problem, pose, torch.where(problem.valid, fitted.distances, 0.0))
        inliers, world = fitted.inliers, shifted(pose, self.origin)
        # What lies off the surface tells nothing of the pose, unless all does.
        told = torch.where(inliers.any(-1, keepdim=True), inliers, problem.valid)
        degenerate = warn_about_degenerate(problem.data, told, problem.size, stacklevel=4)
        judgement = judge(self.uncropped, pose, self.lead, person, seen.frames, rivals, self.task.in_picture)
        confidence = torch.where(degenerate, 0.0, judgement.confidence)
        converged = self.found.change <= config.pose_atol
        converged = converged | judgement.converged if config.surface_steps or person is not None else converged
        states = (inliers.sum(-1), problem.valid.sum(-1), converged, degenerate, confidence)
        result = AlignResult(
            pose=world,
            registered=problem.skin(pose) + self.origin.unsqueeze(1),
            keypoints=problem.skin.shape.keypoints(world),
            distances=everything.distances,
            inliers=everything.inliers,
            posterior=everything.posterior,
            sigma=self.found.sigma,
            cost=cost,
            status=tuple(_status(*row) for row in zip(*(row.tolist() for row in states), strict=True)),
            history=tuple(self.history),
            covariance=judgement.covariance,
            dof_confidence=judgement.dof_confidence,
            confidence=confidence,
            evidence=judgement.evidence.table(),
            doubt=judgement.doubt,
            rivals=rivals,
        )
        return normal_copy(result if self.batched else _unbatched(result))

    def _refitted(
        self,
        start: Tensor,
        *,
        on_step: Callable[[AlignRecord], Any] | None,
        if_better: bool = True,
        steps: int | None = None,
        widths: Sequence[float] = SURFACE_FIT.widths[-1:],
    ) -> PoseRows:
        """Return the rows fitted to the surface from other poses, where that is better, or in any case."""
        steps = steps or max(self.task.config.surface_steps, SURFACE_FIT.search_steps)
        found = fit_surface(self.uncropped, start, steps=steps, widths=widths, on_step=on_step)
        pose, change = found.pose, found.change
        if if_better:
            better = alignment_cost(self.problem, pose) < alignment_cost(self.problem, self.found.pose)
            pose = torch.where(better.unsqueeze(-1), pose, self.found.pose)
            change = torch.where(better, change, self.found.change)
        return replace(self, found=replace(self.found, pose=pose, change=change))

    def _joined(self, index: Tensor, rows: PoseRows) -> PoseRows:
        """Return the batch with other results of some rows."""
        pose = self.found.pose.index_copy(0, index, rows.found.pose)
        change = self.found.change.index_copy(0, index, rows.found.change)
        return replace(self, found=replace(self.found, pose=pose, change=change))


def _search(task: Task) -> FoundStarts:
    """Return the poses that a search without a start finds, and the lead of the best over others."""
    if isinstance(task.model_points, Tensor):
        raise InputError("model_points given as a tensor need a single initial_pose, that they are in; give both")
    points, policy, seed = task.config.num_model_points, task.config.nan_policy, task.config.seed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnitsWarning)  # the alignment tells it
        config = FindPoseConfig(num_model_points=points, nan_policy=policy, seed=seed)
        return search_everywhere(task, config.num_searched, config)


def _different(rows: PoseRows, rivals: Tensor) -> Tensor:
    """Return rivals (B, R, num_dofs), NaN where they are as right as the poses (B, num_dofs) found."""
    local = torch.cat([rows.found.pose.unsqueeze(1), shifted(rivals, -rows.origin.unsqueeze(1))], dim=1)
    apart = mean_distances(rows.problem, local)[:, 0, 1:] > CALIBRATION.right * rows.problem.size
    return torch.where(apart.unsqueeze(-1), rivals, torch.nan)


def _status(num_inliers: int, num_data: int, converged: bool, degenerate: bool, confidence: float) -> Status:
    if num_data == 0:
        return Status.NO_DATA
    if degenerate:
        return Status.DEGENERATE
    if num_inliers < max(UNITS.min_data, ROWS.min_share * num_data):
        return Status.FEW_INLIERS
    return CALIBRATION.status(converged, confidence)


def _unbatched(result: AlignResult) -> AlignResult:
    """Return the result of the single problem of a batch."""
    first = {
        item.name: getattr(result, item.name)[0]
        for item in fields(result)
        if item.name not in ("history", "origin", "shape") and getattr(result, item.name) is not None
    }
    rivals = first.get("rivals")
    if rivals is not None:
        first["rivals"] = rivals[rivals.isfinite().all(-1)]
    return replace(result, **first)


@dataclass(frozen=True, eq=False)
class DataOnShape:
    """How data lie on a shape, (B, M) each, see `AlignResult`."""

    distances: Tensor
    inliers: Tensor
    posterior: Tensor

    @classmethod
    def of(cls, rows: PoseRows, data: Tensor, valid: Tensor) -> DataOnShape:
        """Return how data (B, M, 3), in the coordinates of the problem, lie on the shape found."""
        problem, found = rows.problem, rows.found
        posed = problem.skin(found.pose)
        outlier = outlier_level(problem, posed, found.sigma)
        distances = torch.where(valid, problem.surface.distance(data, found.pose), torch.nan)
        return cls(
            distances=distances,
            inliers=distances.abs() < (rows.task.config.inlier_distance or INLIER_SHARE * problem.size),
            posterior=expectation(posed, data, found.sigma, outlier, mask=valid).inlier_posterior,
        )

    @classmethod
    def of_all(cls, rows: PoseRows, clouds: Tensor, valid: Tensor) -> DataOnShape:
        """Return the same for whole clouds ((B,) M, 3), in the world, of which the problem's data are a draw."""
        count = len(rows.found.pose)
        clouds, valid = clouds.expand(count, *clouds.shape[-2:]), valid.expand(count, valid.shape[-1])
        size, parts = max(1, BUDGET.field_points // count), []
        for points, chosen in zip(clouds.split(size, 1), valid.split(size, 1), strict=True):
            local = torch.where(chosen.unsqueeze(-1), points - rows.origin.unsqueeze(1), 0.0)
            parts.append(cls.of(rows, local, chosen))
        return cls(*(torch.cat([getattr(part, item.name) for part in parts], 1) for item in fields(cls)))
