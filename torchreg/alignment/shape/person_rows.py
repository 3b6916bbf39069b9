"""The rows of a fit of pose and shape coefficients: people of different sizes, until the best of them is judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.evidence.confidence import EVIDENCE, leaves_clusters
from torchreg.alignment.evidence.reliability import CALIBRATION
from torchreg.alignment.fit.annealed_em import ANNEALING, SigmaSchedule, StageResult, anneal
from torchreg.alignment.fit.problem import INLIER_SHARE
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, fit_surface
from torchreg.alignment.inputs import Task, check_clouds
from torchreg.alignment.pose_rows import PoseRows
from torchreg.alignment.results import AlignRecord, AlignResult
from torchreg.alignment.search.multi_start import Candidates
from torchreg.alignment.shape.clothing import CLOTH, are_clothes_likelier, clothed_rig
from torchreg.alignment.shape.person_proposer import shipped_people
from torchreg.alignment.shape.person_search import limb_restarts, rotation_restarts
from torchreg.alignment.shape.shape_fit import (
    SHAPE_FIT,
    FittedShape,
    fitted_shape,
    person_with_gradients,
    shape_problem,
)
from torchreg.alignment.shape.shape_problem import ShapeProblem, noise_covariance, shared_covariance
from torchreg.errors import InputError
from torchreg.result import normal_copy


@dataclass(frozen=True, eq=False)
class PersonRows:
    """States (S T, D + K) of S people in T scans that share coefficients, in the end of the best person.

    They solve `coarse`, a sample of the data of `problem`; `sigma` (1,) is the last kernel width of the EM and `lead`
    (1,) the cost by which the best different state is worse in a search; those that a network proposed are so told.
    """

    task: Task
    problem: ShapeProblem
    coarse: ShapeProblem
    state: Tensor
    generator: torch.Generator
    sigma: Tensor
    lead: Tensor | None = None
    is_proposed: bool = False
    history: list[AlignRecord] = field(default_factory=list)

    @classmethod
    def of(cls, task: Task) -> PersonRows:
        """Return the rows of people of different sizes at a start, or found everywhere, in the data of a task."""
        shape, seen, config, points = task.shape, task.seen, task.config, task.seen.points
        by_data = torch.is_grad_enabled() and isinstance(points, Tensor) and points.requires_grad
        if not by_data:
            seen = seen.drawn(shape, config.nan_policy, config.seed)
            seen = replace(seen, points=seen.points.detach() if isinstance(seen.points, Tensor) else seen.points)
        with torch.inference_mode():
            clouds, valid = check_clouds(shape, seen.points, seen.mask, config.nan_policy)
            if clouds.ndim != 2:
                raise InputError("fit_shape takes one cloud; calibrate fits several scans of one person")
        poses = None if task.start is None else task.starts(clouds[None], task.start)
        if task.clothed is True:
            with torch.no_grad():
                task = replace(task, shape=clothed_rig(shape))
        return cls.of_scans(replace(task, seen=seen), clouds[None], valid[None], poses)

    @classmethod
    @torch.inference_mode()
    def of_scans(
        cls, task: Task, data: Tensor, valid: Tensor, poses: Tensor | None, *, proposes: bool = True
    ) -> PersonRows:
        """Return the rows of one person in T scans (T, M, 3), with poses (T, num_dofs) at the mean coefficients."""
        shape, config, generator = task.shape, task.config, torch.Generator().manual_seed(task.config.seed)
        views = [frame.camera.position for frame in task.seen.frames]
        viewpoints = torch.stack(views) if views else None
        proposer = (task.people or shipped_people(shape)) if poses is None and proposes else None
        problem, start = shape_problem(
            shape, data, valid, poses, viewpoints, config=config, generator=generator, proposer=proposer
        )
        coarse = problem.draw(SHAPE_FIT.coarse_data, generator)
        return cls(task, problem, coarse, start, generator, start[:1, 0], is_proposed=proposer is not None)

    def searched_in_doubt(self, found: AlignResult) -> AlignResult:
        """Return the result, or if in doubt of what a network proposed, that of people searched for in the scan too."""
        if not self.is_proposed or found.confidence is None or float(found.confidence) >= CALIBRATION.doubtful:
            return found
        rows = self._joined(PersonRows.of_scans(self.task, *self._scan, None, proposes=False))
        return replace(rows, is_proposed=False).restarted().finished().judged()

    def _proposed_too(self) -> PersonRows:
        """Return the rows fitted from a start, and those that a network proposes for the data on which the best lies.

        A start may be turned half about, and the data of a flipped person are nearly as likely.
        """
        proposer = self.task.people or shipped_people(self.task.shape)
        if proposer is None or self._searched or self.problem.scans > 1 or self.task.config.search == "never":
            return self
        best, task = self._best(), replace(self.task, start=None, people=proposer)
        rows = self._joined(PersonRows.of_scans(task, *self._scan, None))
        distance = rows.coarse.surface.distance(rows.coarse.data, rows.state)
        near = (distance.abs() < INLIER_SHARE * self.problem.size) & rows.coarse.valid
        # Another person in the data is not the one that is meant.
        alike = (near & near[best]).sum(-1) >= SHAPE_FIT.same_data * near[best].sum(-1)
        own = torch.arange(len(alike)) < len(self.state)
        return rows._chosen((alike | own).nonzero()[:, 0])

    @property
    def _scan(self) -> tuple[Tensor, Tensor]:
        """The data (1, M, 3) of the first scan in the world, and which of them are valid."""
        return self.problem.data[:1] + self.problem.origin[:1].unsqueeze(1), self.problem.valid[:1]

    def _joined(self, rows: PersonRows) -> PersonRows:
        """Return the fitted rows of one scan with others, which are fitted first."""
        state = torch.cat([self.state, replace(rows, history=self.history).annealed().fitted().state])
        every = torch.zeros(len(state), dtype=torch.int64)
        return replace(self, problem=self.problem.rows(every), coarse=self.coarse.rows(every), state=state)

    def _chosen(self, index: Tensor) -> PersonRows:
        """Return some rows."""
        return replace(self, problem=self.problem.rows(index), coarse=self.coarse.rows(index), state=self.state[index])

    def record(self, step: AlignRecord) -> None:
        """Keep the record of a step and pass it on, with the poses alone, in the coordinates of the data."""
        dofs, scans = self.task.shape.num_dofs, len(step.pose) // self.problem.scans
        origin = pad(self.problem.origin[: self.problem.scans].repeat(scans, 1), (0, dofs - 3))
        step = normal_copy(replace(step, pose=step.pose[:, :dofs] + origin))
        self.history.append(step)
        if self.task.on_step is not None:
            self.task.on_step(step)

    def annealed(self) -> PersonRows:
        """Return the best rows after an annealed EM, with normals, which registers shapes of different sizes.

        People proposed by a network have about their size: they are fitted alone, and all are kept as rivals.
        """
        if self.is_proposed:
            state = self._fit(self.coarse, self.state, SHAPE_FIT.coarse_steps).pose
            return replace(self, state=state, sigma=torch.full_like(self.sigma, ANNEALING.stop * self.problem.size))
        widths = self.task.config.schedule or ANNEALING.schedule(self.problem.size, SHAPE_FIT.em_steps)
        found = self._anneal(self.coarse, self.state, widths)
        count = SHAPE_FIT.num_found_kept if self._searched else SHAPE_FIT.num_kept
        kept = self.problem.people(self.coarse.cost_of_people(found.pose).argsort()[:count])
        return replace(self, state=found.pose, sigma=found.sigma[:1])._chosen(kept)

    def fitted(self) -> PersonRows:
        """Return the rows fitted to the surface, and again after a narrower annealing, where that explains more."""
        if not self.is_proposed:
            state = self._fit(self.coarse, self.state, SHAPE_FIT.coarse_steps).pose
            return replace(self, state=self._again(self.coarse, state))
        best = self._best()
        again = self._again(self.coarse.rows(best), self.state[best])
        return replace(self, state=self.state.index_copy(0, best, again))

    def _again(self, problem: ShapeProblem, state: Tensor) -> Tensor:
        again = self._descended(problem, state, self._narrow)
        better = problem.cost_of_people(again) < problem.cost_of_people(state)
        return torch.where(better.repeat_interleave(problem.scans).unsqueeze(-1), again, state)

    def _best(self) -> Tensor:
        """Return the index (1,) of the best row of one scan."""
        return self.coarse.cost_of_people(self.state).argmin().unsqueeze(0)

    def restarted(self) -> PersonRows:
        """Return the row of the best person, one of whose limbs may be re-initialized where clusters are left over.

        Beside a start, people that a network proposes for the same data are tried.
        """
        rows = self._proposed_too()
        return replace(rows, state=rows._restarted_limb() if self.problem.scans == 1 else self.state).best()

    def best(self) -> PersonRows:
        """Return the row of the best person."""
        costs = self.coarse.cost_of_people(self.state)
        ranked = Candidates.ranked(self.coarse, self.state[None], costs[None])
        lead = ranked.lead() if self._searched else None
        best = self.problem.people(costs.argmin().unsqueeze(0))
        return replace(self, problem=self.problem.rows(best), state=self.state[best], lead=lead)

    def finished(self) -> FoundPerson:
        """Return the person fitted to more and more data, with the deviations of alike coefficients learned."""
        fine = self.problem.draw(SHAPE_FIT.fine_data, self.generator)
        state = self._fit(fine, self.state, SHAPE_FIT.fine_steps).pose
        problem, alike = self.problem, self.task.shape.coefficient_space().alike
        if alike is not None:
            fine, state = self._learned_spread(fine, state, alike)
            problem = replace(problem, prior=replace(problem.prior, precision=fine.prior.precision))
        before = self._fitted_closely(problem, state)
        last = replace(self._fit(problem, before, 1, SURFACE_FIT.widths[-1:]), sigma=self.sigma)
        fitted = fitted_shape(problem, before, last, self.task.shape)
        found = FoundPerson(self.task, replace(fitted, lead=self.lead), self.history)
        return self._clothed_where_likelier(found) if self.task.clothed == "auto" else found

    @property
    def _searched(self) -> bool:
        return self.task.start is None

    @property
    def _narrow(self) -> SigmaSchedule:
        """The schedule of people whose size and trunk are right."""
        size = self.problem.size
        return SigmaSchedule.geometric(SHAPE_FIT.again * size, ANNEALING.stop * size, SHAPE_FIT.em_steps)

    def _anneal(self, problem: ShapeProblem, state: Tensor, widths: SigmaSchedule) -> StageResult:
        steps = {"em_steps": self.task.config.em_steps, "m_steps": self.task.config.m_steps}
        return anneal(problem, state, widths, **steps, on_step=self.record)

    def _fit(
        self, problem: ShapeProblem, state: Tensor, steps: int, widths: Sequence[float] = SURFACE_FIT.widths
    ) -> StageResult:
        return fit_surface(problem, state, steps=steps, widths=widths, on_step=self.record)

    def _fitted_closely(self, problem: ShapeProblem, state: Tensor) -> Tensor:
        """Return states (B, D + K) fitted from nearly right ones."""
        return self._fit(problem, state, SHAPE_FIT.fine_steps, SURFACE_FIT.widths[-1:]).pose

    def _descended(self, problem: ShapeProblem, state: Tensor, widths: SigmaSchedule) -> Tensor:
        """Return states (B, D + K) after an annealed EM and a coarse fit to the surface."""
        return self._fit(problem, self._anneal(problem, state, widths).pose, SHAPE_FIT.coarse_steps).pose

    def _restarted_limb(self) -> Tensor:
        """Return states (B, D + K) in one scan, the best with one limb re-initialized where clusters are left over."""
        problem, state, size = self.coarse, self.state, self.problem.size
        costs = problem.cost_of_people(state)
        best = costs.argmin().unsqueeze(0)
        one = problem.rows(best)
        if not bool(leaves_clusters(one, state[best])):
            return state
        limbs = limb_restarts(one, state[best[0]], SHAPE_FIT.num_swung, self.generator)
        others = [(limbs, self._narrow)] if len(limbs) else []  # a chain without branches has no limb to swing
        if self._searched and not self.is_proposed:
            others.append((rotation_restarts(one, state[best[0]]), ANNEALING.schedule(size, SHAPE_FIT.em_steps)))
        if not others:
            return state
        rows = [(problem.rows(best.expand(len(start))), start, widths) for start, widths in others]
        found = torch.cat([self._descended(*row) for row in rows])
        again, choice = problem.rows(best.expand(len(found))).cost_of_people(found).min(0)
        # A smaller lead is no evidence.
        better = float(again) < float(costs[best]) - EVIDENCE.lead
        return state.index_copy(0, best, found[choice].unsqueeze(0)) if better else state

    def _clothed_where_likelier(self, bare: FoundPerson) -> FoundPerson:
        """Return a person in clothes where the data of the scan are likelier with them, else the bare one."""
        # Neighbors share no more of the residuals than a model of bare skin errs: nothing is left for clothes.
        if bool((bare.fitted.shared_noise <= SURFACE_FIT.min_noise(self.problem.size)).all()):
            return bare
        with torch.inference_mode(False), torch.no_grad():
            task = replace(self.task, shape=clothed_rig(self.task.shape), clothed=True)
        data, valid = self.problem.data + self.problem.origin.unsqueeze(1), self.problem.valid
        poses = bare.fitted.poses if task.start is None else task.starts(data, task.start)
        rows = replace(PersonRows.of_scans(task, data, valid, poses), history=self.history)
        one = rows.problem.rows(self.problem.people(torch.zeros(1, dtype=torch.int64)))
        worn = rows.state[:1, -CLOTH.num_modes :]
        state = torch.cat([bare.fitted.state, worn], dim=-1)
        if not are_clothes_likelier(one.draw(SHAPE_FIT.fine_data, self.generator), state, self._fitted_closely):
            return bare
        # Limbs were restarted before, and what clothes leave over is no sign of another.
        return rows.annealed().fitted().best().finished()

    def _learned_spread(self, problem: ShapeProblem, state: Tensor, alike: Tensor) -> tuple[ShapeProblem, Tensor]:
        """Return the problem with the deviations of alike coefficients learned, and states (T, D + K) fitted.

        The deviation of greatest evidence is ``s^2 = sum_k (c_k - m_k)^2 / sum_k g_k``, ``g_k = 1 - C_kk / s^2`` with
        the covariance C (MacKay 1992, eq. 4.9); the prior's guess counts as one more coefficient.
        """
        space, dofs = self.task.shape.coefficient_space(), self.task.shape.num_dofs
        member = alike.unsqueeze(-1) == alike.clamp_min(0).unique()
        group = member.to(state)
        for _ in range(SHAPE_FIT.fine_steps):
            precision = problem.prior.precision[dofs:] * problem.scans
            covariance = shared_covariance(noise_covariance(problem, problem.robust_rows(state)), dofs)
            told = (1 - covariance.diagonal() * precision).clamp(0, 1)
            squares = (state[0, dofs:] - space.mean).square() @ group + (space.std.square() @ group) / group.sum(0)
            variance = squares / (told @ group + 1)
            learned = torch.where(member.any(-1), (group @ variance.reciprocal()), precision) / problem.scans
            joined = torch.cat([problem.prior.precision[:dofs], learned])
            problem = replace(problem, prior=replace(problem.prior, precision=joined))
            state = self._fitted_closely(problem, state)
        return problem, state


@dataclass(frozen=True, eq=False)
class FoundPerson:
    """Poses and coefficients that were fitted, and the records of all steps."""

    task: Task
    fitted: FittedShape
    history: list[AlignRecord]

    def judged(self) -> AlignResult:
        """Return the alignment of the person found, with gradients where the data have them."""
        task, fitted, shape, points = self.task, self.fitted, self.task.shape, self.task.seen.points
        dofs, coefficients = shape.num_dofs, fitted.coefficients
        person = replace(task, shape=fitted.person, model_points=None)
        clouds, valid = check_clouds(shape, points, task.seen.mask, task.config.nan_policy)
        rows = PoseRows.centered(person, person.skin(), clouds, valid, fitted.poses)
        found = StageResult(pose=rows.start, sigma=fitted.sigma, change=fitted.change)
        rows = replace(rows, found=found, lead=fitted.lead, history=self.history)
        result = normal_copy(replace(
            rows.judged((fitted.error, fitted.covariance[:, :dofs, :dofs])),
            coefficients=coefficients,
            coefficient_covariance=fitted.covariance[0, dofs:, dofs:],
            clothing_offset=fitted.clothing,
        ))  # fmt: skip
        if not (isinstance(points, Tensor) and points.requires_grad):
            return result
        with torch.inference_mode(False), torch.enable_grad():
            pose, coefficients = person_with_gradients(shape, fitted, points, valid)
        return replace(result, pose=pose, coefficients=coefficients)


@torch.inference_mode()
def fit_scans(task: Task, data: Tensor, valid: Tensor) -> FittedShape:
    """Return the poses of T scans (T, M, 3) of one shape and the coefficients that they share, from starts."""
    rows: PersonRows = PersonRows.of_scans(task, data, valid, task.start)
    return rows.annealed().fitted().restarted().finished().fitted
