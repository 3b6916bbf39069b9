"""The first stage of an alignment: annealed EM, whose sigma narrows, registers model points and rejects outliers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.alignment.fit.objectives import GaussianPosePrior, registration_objective
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.softassign import closest_point, softassign
from torchreg.alignment.results import AlignRecord
from torchreg.errors import InputError
from torchreg.solvers.e_step import OUTLIER_CONSTANT, EStep, expectation, outlier_constant, working_volume
from torchreg.solvers.levenberg_marquardt import LMResult
from torchreg.solvers.oriented_e_step import oriented_expectation


@dataclass(frozen=True)
class _Narrowing:
    """How fast the kernel of a fit narrows."""

    ratio: float = 0.62  # of successive widths, at most: a few steps at one reduce the error of a pose as much


_NARROWING = _Narrowing()


def narrowing(start: float, stop: float) -> tuple[float, ...]:
    """Return kernel widths from the error of a start down to the noise, or to what the next stage bridges."""
    count = math.ceil(math.log(stop / start) / math.log(_NARROWING.ratio))
    return tuple(start * (stop / start) ** (number / count) for number in range(count + 1))


@dataclass(frozen=True)
class SigmaSchedule:
    """The sequence of sigmas of an annealed EM.

    Build one with `geometric`, `linear`, `constant` or `adaptive`.

    Args:
        values: sigma of every step, metres, never rising; for "adaptive" the first value and the floor.
        steps: number of steps.
        kind: "fixed" (the values are the schedule) or "adaptive" (sigma is estimated after each step).

    Raises:
        InputError: if a value is not positive, the values rise, or their number does not fit ``steps`` and ``kind``.
        InputTypeError: if ``steps`` is not an integer.

    References: Dewaele et al. 2006, section 3.3.
    """

    values: tuple[float, ...]
    steps: int
    kind: Literal["fixed", "adaptive"] = "fixed"

    def __post_init__(self) -> None:
        check_choice(self.kind, "kind", ("fixed", "adaptive"))
        check_count(self.steps, "steps", 1)
        expected = self.steps if self.kind == "fixed" else 2
        if len(self.values) != expected:
            raise InputError(
                f"values must hold {expected} sigmas for {self.steps} {self.kind} steps, got {self.values}"
            )
        for index, value in enumerate(self.values):
            check_positive(value, f"values[{index}]")
        if any(later > earlier for earlier, later in pairwise(self.values)):
            raise InputError(f"values must not rise from one step to the next, got {self.values}")

    @classmethod
    def geometric(cls, start: float, stop: float, steps: int = 5) -> SigmaSchedule:
        """Return ``sigma_{q+1} = kappa sigma_q`` from ``start`` down to ``stop``, as in the paper.

        Args:
            start: first sigma, metres: the largest motion that is to be found.
            stop: last sigma, metres: the noise of the data.
            steps: number of sigmas; with one, ``start`` is the only sigma.

        Raises:
            InputError: if a sigma is not positive, ``stop`` exceeds ``start``, or ``steps`` is below one.
            InputTypeError: if a sigma is not a number, or ``steps`` not an integer.
        """
        _check_range(start, stop, steps)
        ratio = (stop / start) ** (1 / max(steps - 1, 1))
        return cls(_between(start, stop, [start * ratio**step for step in range(steps)]), steps)

    @classmethod
    def linear(cls, start: float, stop: float, steps: int = 5) -> SigmaSchedule:
        """Return sigmas that fall by the same amount each step, from ``start`` to ``stop``, metres.

        Arguments and errors are those of `geometric`.
        """
        _check_range(start, stop, steps)
        fall = (start - stop) / max(steps - 1, 1)
        return cls(_between(start, stop, [start - fall * step for step in range(steps)]), steps)

    @classmethod
    def constant(cls, sigma: float, steps: int = 5) -> SigmaSchedule:
        """Return the same sigma for every step, metres.

        Raises:
            InputError: if ``sigma`` is not positive, or ``steps`` is below one.
            InputTypeError: if ``sigma`` is not a number, or ``steps`` not an integer.
        """
        _check_range(sigma, sigma, steps)
        return cls((sigma,) * steps, steps)

    @classmethod
    def adaptive(cls, start: float, stop: float, steps: int = 20) -> SigmaSchedule:
        """Return the conventional schedule: sigma is re-estimated from the residuals, never below ``stop``.

        Each M-step ends with the sigma that maximizes eq. 19 (see `estimate_sigma`), between ``start`` and ``stop``.
        The paper observes that it falls too quickly and gets trapped; it serves for comparison. Arguments and errors
        are those of `geometric`.
        """
        _check_range(start, stop, steps)
        return cls((start, stop), steps, "adaptive")


def estimate_sigma(matches: EStep, before: Tensor, after: Tensor) -> Tensor:
    """Return the sigma (...) that the M-step of a conventional EM estimates from the points (..., N, 3) that it moved.

    ``sigma^2 = sum_ij alpha_ij |Y_j - T(X_i)|^2 / (3 sum_ij alpha_ij)``, zero without inliers. Dewaele et al. 2006,
    3.3.
    """
    decrease = (before - matches.targets).square().sum(-1) - (after - matches.targets).square().sum(-1)
    squares = matches.squared_error - (matches.weights * decrease).sum(-1)
    mass = matches.weights.sum(-1).clamp_min(torch.finfo(squares.dtype).tiny)
    return (squares.clamp_min(0) / (3 * mass)).sqrt()


def _check_range(start: float, stop: float, steps: int) -> None:
    check_positive(start, "start")
    check_positive(stop, "stop")
    if stop > start:
        raise InputError(f"stop must not exceed start, got start {start} and stop {stop}")
    check_count(steps, "steps", 1)


def _between(start: float, stop: float, values: list[float]) -> tuple[float, ...]:
    """Return the values with rounding beyond the two ends removed."""
    return tuple(min(max(value, stop), start) for value in values)


OnStep = Callable[[AlignRecord], None]

# The E-step and its rivals, which match model points and data by other rules.
CORRESPONDENCES: dict[str, Callable[..., EStep]] = {
    "em": expectation,
    "softassign": softassign,
    "closest": closest_point,
}


@dataclass(frozen=True)
class Annealing:
    """Numbers of the annealed EM; widths are shares of the model's size."""

    start: float = 0.08  # first sigma: the largest motion of a point that is to be found
    stop: float = 0.02  # last sigma: the surface fit, which needs no correspondences, is better below
    debias_from: float = 0.035  # sigma below which a kernel shrinks the model by less than the noise
    matched: float = 0.3  # inlier posterior above which a datum counts for the number of model points that share it
    max_posterior: float = 1 - 1e-6  # at which inlier posteriors are capped, so that this number stays finite

    def schedule(self, size: float, steps: int = 5) -> SigmaSchedule:
        """Return the paper's geometric schedule for a model of some size in metres."""
        return SigmaSchedule.geometric(self.start * size, self.stop * size, steps)


ANNEALING = Annealing()


@dataclass(frozen=True)
class StageResult:
    """Poses (B, num_dofs) at the end of a stage, the last kernel widths (B,) in metres, and the last changes (B,)."""

    pose: Tensor
    sigma: Tensor
    change: Tensor

    def rows(self, index: Tensor) -> StageResult:
        """Return the results of some rows of the batch."""
        return StageResult(pose=self.pose[index], sigma=self.sigma[index], change=self.change[index])


def anneal(
    problem: AlignProblem,
    pose: Tensor,
    schedule: SigmaSchedule,
    *,
    em_steps: int,
    m_steps: int,
    on_step: OnStep | None = None,
) -> StageResult:
    """Return the pose (B, num_dofs) after annealed EM: E-step (17, 18), M-step (20), a smaller sigma, and again.

    At most `em_steps` per sigma; a single M-step is taken without a test (generalized EM). Dewaele et al. 2006,
    3.2-3.3.
    """
    adaptive = schedule.kind == "adaptive"
    if adaptive:
        # The estimate is that of a conventional EM, whose targets are the means of the data.
        problem = replace(problem, debias=0.0)
    sigma = torch.full_like(pose[:, 0], schedule.values[0])
    change, damping = torch.full_like(sigma, torch.inf), None
    for step in range(schedule.steps):
        if not adaptive:
            sigma = torch.full_like(sigma, schedule.values[step])
        for _ in range(em_steps):
            rows, derivative = problem.skin.row_jacobian(pose)
            posed = problem.skin.place(rows)
            matches = _match(problem, rows, posed, sigma)
            prior = _tempered_prior(problem, matches)
            objective = registration_objective(problem.skin, matches, sigma, prior, problem.factors)
            around = objective(pose, rows, derivative)
            if m_steps > 1:
                solved = problem.solve(objective, pose, m_steps, around, damping)
            else:
                solved = problem.step(around, pose)
            pose, damping, change = solved.state, solved.damping, problem.change(solved.last_step)
            report_step(on_step, problem, solved, stage="em", step=step, num_steps=schedule.steps, sigma=sigma)
            if adaptive:
                estimate = estimate_sigma(matches, posed, problem.skin(pose))
                sigma = estimate.clamp(schedule.values[-1], schedule.values[0])
            if float(change.max()) <= problem.pose_atol:
                break
    return StageResult(pose=pose, sigma=sigma, change=change)


def _match(problem: AlignProblem, rows: Tensor, posed: Tensor, sigma: Tensor) -> EStep:
    """Return the E-step at posed model points (B, N, 3), debiased while the kernel is wide."""
    outlier = outlier_level(problem, posed, sigma)
    rule, model, data = CORRESPONDENCES[problem.correspondence], posed, problem.data
    if problem.normals is not None:
        rule = oriented_expectation
        model, data = torch.cat([posed, problem.skin.turn_normals(rows)], -1), torch.cat([data, problem.normals], -1)
    matches = rule(model, data, sigma, outlier, mask=problem.valid)
    if problem.debias > 0 and float(sigma.max()) > ANNEALING.debias_from * problem.size:
        return _debiased(matches, posed, rule(model, model, sigma, outlier), problem.debias)
    return matches


def _debiased(matches: EStep, posed: Tensor, self_matches: EStep, share: float) -> EStep:
    """Return the E-step whose targets are corrected by a share of the kernel's shrinkage, that of the model on itself.

    It is only a share because hidden model points have no counterpart in the data.
    """
    return replace(matches, targets=matches.targets + share * (posed - self_matches.targets))


def _tempered_prior(problem: AlignProblem, matches: EStep) -> GaussianPosePrior:
    """Return the prior times the model points that share a datum, n of the inlier posterior n / (n + c)."""
    if problem.correspondence != "em":
        return problem.prior
    posterior = matches.inlier_posterior.clamp_max(ANNEALING.max_posterior)
    matched = posterior > ANNEALING.matched
    sharers = OUTLIER_CONSTANT * (posterior / (1 - posterior) * matched).sum(-1) / matched.sum(-1).clamp_min(1)
    return replace(problem.prior, precision=problem.prior.precision * sharers.clamp_min(1).unsqueeze(-1))


def outlier_level(problem: AlignProblem, posed: Tensor, sigma: Tensor) -> Tensor | float:
    """Return c of eq. 18 as the problem's settings have it: (B,) with the working volume, its limit, or a number."""
    if problem.outlier == "limit":
        return OUTLIER_CONSTANT
    if not isinstance(problem.outlier, str):
        return problem.outlier
    return outlier_constant(posed.shape[-2], sigma, working_volume(posed, problem.data, sigma, problem.valid))


def report_step(
    on_step: OnStep | None,
    problem: AlignProblem,
    solved: LMResult,
    *,
    stage: str,
    step: int,
    num_steps: int,
    sigma: Tensor,
) -> None:
    """Call back, if there is a callback, with the record of a step."""
    if on_step is not None:
        change = problem.change(solved.last_step)
        on_step(AlignRecord(
            stage=stage, step=step, num_steps=num_steps, sigma=sigma, cost=solved.cost, pose=solved.state,
            pose_change=change,
        ))  # fmt: skip
