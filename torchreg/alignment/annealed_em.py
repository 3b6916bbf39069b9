"""The stages of an alignment: annealed EM registration, then surface fitting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.closest_point import closest_point
from torchreg.alignment.objectives import PosePrior, RegistrationObjective, SurfaceObjective
from torchreg.alignment.problem import AlignProblem
from torchreg.alignment.results import AlignRecord
from torchreg.alignment.sigma_schedule import SigmaSchedule, estimate_sigma
from torchreg.alignment.softassign import softassign
from torchreg.solvers.e_step import OUTLIER_CONSTANT, EStep, expectation, outlier_constant
from torchreg.solvers.levenberg_marquardt import (
    LMResult,
)

OnStep = Callable[[AlignRecord], None]

# What may stand in the place of the E-step.
CORRESPONDENCES: dict[str, Callable[..., EStep]] = {
    "em": expectation,
    "softassign": softassign,
    "closest": closest_point,
}

# Widths of the surface fit as shares of the model's size; the last width follows from the residuals, within a range.
SURFACE_SIGMAS = (0.045, 0.022)
FINAL_SIGMA_RANGE = (0.003, 0.02)
# A Welsch kernel of 2.5 standard deviations keeps most of the efficiency of least squares on Gaussian noise.
SIGMA_PER_NOISE = 2.5
_MAD_TO_STD = 1.4826
# The last width of the surface fit takes this many times the steps of the others.
_FINAL_STEPS = 3
# Steps and damping where the pose is near and known to a few degrees.
_SETTLING_STEPS, _SETTLING_DAMPING = 3, 1e-5
# Typical distance of the surface from the base's axis of rotation, as a share of the model's size.
_LEVER = 0.25
# Data that count when asking how many model points share a datum.
_HELD_POSTERIOR, _MAX_POSTERIOR = 0.3, 1 - 1e-6
# Below this share of the model's size the kernel's own pull is less than the noise.
_NARROW_SIGMA = 0.035


@dataclass(frozen=True)
class StageResult:
    """Where a stage ended.

    Args:
        pose: (B, num_dofs).
        sigma: (B,) last width, metres.
        change: (B,) of the last step.
    """

    pose: Tensor
    sigma: Tensor
    change: Tensor


def register(
    problem: AlignProblem,
    pose: Tensor,
    schedule: SigmaSchedule,
    *,
    em_steps: int,
    m_steps: int,
    tempered: bool = True,
    on_step: OnStep | None = None,
) -> StageResult:
    """Return the pose after annealed EM: E-step (17, 18), M-step (20), a smaller sigma, and again.

    Args:
        problem: the batch.
        pose: (B, num_dofs) to start from.
        schedule: of sigma.
        em_steps: EM iterations per sigma, at most; fewer when no pose changes any more.
        m_steps: Levenberg-Marquardt steps per M-step; a single one is taken without testing it (generalized EM).
        tempered: weigh the prior as if data that share a wide kernel were one observation.
        on_step: called after each iteration.

    Returns:
        a `StageResult`.

    References: Dewaele et al. 2006, sections 3.2 and 3.3.
    """
    if schedule.kind == "adaptive":
        # The estimate is that of a conventional EM, whose targets are the means of the data.
        problem = replace(problem, debias=0.0)
    sigma = torch.full_like(pose[:, 0], schedule.values[0])
    change = torch.full_like(sigma, torch.inf)
    damping = None
    for step in range(schedule.steps):
        if schedule.kind == "fixed":
            sigma = torch.full_like(sigma, schedule.values[step])
        for _ in range(em_steps):
            rows, derivative = problem.skin.shape.transform_jacobian(pose, chart="tangent")
            posed = problem.skin.place(rows)
            observed = _expect(problem, posed, sigma)
            shared = tempered and problem.correspondence == "em"
            prior = _tempered(problem.prior, observed) if shared else problem.prior
            objective = RegistrationObjective(problem.skin, observed, sigma, prior)
            around = objective.linearize(pose, rows, derivative)
            if m_steps > 1:
                solved = problem.solve(objective, pose, m_steps, around, damping)
            else:
                solved = problem.step(around, pose)
            pose, damping, change = solved.state, solved.damping, problem.change(solved.last_step)
            _report(on_step, "em", step, schedule.steps, sigma, solved, problem)
            if schedule.kind == "adaptive":
                estimated = estimate_sigma(observed, posed, problem.skin(pose))
                sigma = estimated.clamp(schedule.values[-1], schedule.values[0])
            if float(change.max()) <= problem.pose_atol:
                break
    return StageResult(pose, sigma, change)


def _tempered(prior: PosePrior, observed: EStep) -> PosePrior:
    """Return the prior weighed against data that are not independent while the kernel is wide.

    A datum that n model points share counts n times in eq. 20; n follows from the inlier posterior n / (n + c).
    """
    posterior = observed.inlier_posterior.clamp_max(_MAX_POSTERIOR)
    held = posterior > _HELD_POSTERIOR
    shared = OUTLIER_CONSTANT * (posterior / (1 - posterior) * held).sum(-1) / held.sum(-1).clamp_min(1)
    return replace(prior, precision=prior.precision * shared.clamp_min(1).unsqueeze(-1))


def _expect(problem: AlignProblem, posed: Tensor, sigma: Tensor) -> EStep:
    """Return the E-step, without the kernel's own pull while the kernel is wide."""
    outlier = outlier_level(problem, posed, sigma)
    match = CORRESPONDENCES[problem.correspondence]
    observed = match(posed, problem.data, sigma, outlier, mask=problem.valid)
    if problem.debias > 0 and float(sigma.max()) > _NARROW_SIGMA * problem.size:
        itself = match(posed, posed, sigma, outlier)
        return _debiased(observed, posed, itself, problem.debias)
    return observed


def _debiased(observed: EStep, posed: Tensor, itself: EStep, share: float) -> EStep:
    """Return the E-step with targets moved by how far the kernel alone would pull each model point.

    A wide kernel draws every point towards the mean of its surroundings even in the true pose, which shrinks and bends
    the model. The model registered to itself shows that pull, ``S_i - X_i``; part of it is taken from ``G_i - X_i``.
    It is only a part because hidden model points have no counterpart in the data.
    """
    return replace(observed, targets=observed.targets + share * (posed - itself.targets))


def outlier_level(problem: AlignProblem, posed: Tensor, sigma: Tensor) -> Tensor | float:
    """Return c of eq. 18 as the problem's settings have it: (B,) with the working volume, or its limit."""
    if problem.outlier == "limit":
        return OUTLIER_CONSTANT
    # V: the bounding box of data and posed model, grown by 3 sigma.
    data = torch.where(problem.valid.unsqueeze(-1), problem.data, posed.mean(-2, keepdim=True))
    everything = torch.cat([data, posed], dim=-2)
    box = everything.amax(-2) - everything.amin(-2) + 6 * sigma.unsqueeze(-1)
    return outlier_constant(posed.shape[-2], sigma, box.prod(-1))


def fit_surface(
    problem: AlignProblem,
    pose: Tensor,
    *,
    steps: int,
    sigmas: Sequence[float] = SURFACE_SIGMAS,
    on_step: OnStep | None = None,
) -> StageResult:
    """Return the pose after fitting the surface to the data, eqs. 21 and 22, with a kernel that narrows to the noise.

    Args:
        problem: the batch.
        pose: (B, num_dofs) to start from.
        steps: damped steps per width, at least one; the last width takes up to three times as many, tested.
        sigmas: widths before the last, as shares of the model's size.
        on_step: called after each width.

    Returns:
        a `StageResult`.

    References: Dewaele et al. 2006, section 3.4.
    """
    noise = torch.full_like(pose[:, 0], FINAL_SIGMA_RANGE[1] * problem.size / SIGMA_PER_NOISE)
    for number, share in enumerate(sigmas):
        sigma = torch.full_like(noise, share * problem.size)
        solved = surface_steps(problem, pose, sigma, noise, steps)
        pose = solved.state
        _report(on_step, "surface", number, len(sigmas) + 1, sigma, solved, problem)
    distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    noise = surface_noise(distance, problem.valid, problem.size)
    sigma = SIGMA_PER_NOISE * noise
    objective = _surface_objective(problem, sigma, noise)
    solved = problem.solve(objective, pose, _FINAL_STEPS * steps, objective.linearize(pose, distance, jacobian))
    _report(on_step, "surface", len(sigmas), len(sigmas) + 1, sigma, solved, problem)
    return StageResult(solved.state, sigma, problem.change(solved.last_step))


@dataclass(frozen=True)
class SurfaceResult:
    """Where steps on the surface ended.

    Args:
        pose: (B, num_dofs).
        distance: (B, M) of the data there.
        jacobian: (B, M, num_dofs) of the distances.
        change: (B,) of the last step.
    """

    pose: Tensor
    distance: Tensor
    jacobian: Tensor
    change: Tensor


def settle_surface(problem: AlignProblem, pose: Tensor, *, steps: int, sigmas: Sequence[float]) -> SurfaceResult:
    """Return the same as `fit_surface`, from near: its last steps are not tested, which halves the time."""
    noise = torch.full_like(pose[:, 0], FINAL_SIGMA_RANGE[1] * problem.size / SIGMA_PER_NOISE)
    for share in sigmas:
        pose = surface_steps(problem, pose, torch.full_like(noise, share * problem.size), noise, steps).state
    distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    noise = surface_noise(distance, problem.valid, problem.size)
    objective = _surface_objective(problem, SIGMA_PER_NOISE * noise, noise)
    for _ in range(_SETTLING_STEPS * steps):
        solved = problem.step(objective.linearize(pose, distance, jacobian), pose, _SETTLING_DAMPING)
        pose = solved.state
        distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    return SurfaceResult(pose, distance, jacobian, problem.change(solved.last_step))


def surface_steps(problem: AlignProblem, pose: Tensor, sigma: Tensor, noise: Tensor, steps: int) -> LMResult:
    """Return the result of damped steps on the surface objective at one width, which a narrower one will correct."""
    objective = _surface_objective(problem, sigma, noise)
    solved = problem.step(objective(pose), pose)
    for _ in range(steps - 1):
        solved = problem.step(objective(solved.state), solved.state)
    return solved


def _surface_objective(problem: AlignProblem, sigma: Tensor, noise: Tensor) -> SurfaceObjective:
    lever = _LEVER * problem.size
    return SurfaceObjective(problem.surface, problem.data, problem.valid, sigma, noise, problem.prior, lever)


def _report(
    on_step: OnStep | None,
    stage: str,
    step: int,
    num_steps: int,
    sigma: Tensor,
    solved: LMResult,
    problem: AlignProblem,
) -> None:
    if on_step is not None:
        change = problem.change(solved.last_step)
        on_step(AlignRecord(stage, step, num_steps, sigma, solved.cost, solved.state, change))


def residual_noise(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return the robust standard deviation (B,) of the data near the surface, within a range of the model's size."""
    return surface_noise(problem.surface.distance(problem.data, pose), problem.valid, problem.size)


def surface_noise(distance: Tensor, valid: Tensor, size: float) -> Tensor:
    """Return the robust standard deviation (...) of distances (..., M) near the surface of a model of some size.

    Args:
        distance: (..., M), metres.
        valid: (..., M) True where the distance counts.
        size: of the model, metres; the answer lies within a range of it, at its upper end where nothing is near.

    Returns:
        (...), metres.
    """
    distance = distance.abs()
    near = (distance < SURFACE_SIGMAS[-1] * size) & valid
    median = torch.where(near, distance, torch.nan).nanmedian(-1).values
    low, high = (share * size / SIGMA_PER_NOISE for share in FINAL_SIGMA_RANGE)
    return torch.nan_to_num(_MAD_TO_STD * median, nan=high).clamp(low, high)


def pose_covariance(jacobian: Tensor, weights: Tensor, noise: Tensor, precision: Tensor) -> Tensor:
    """Return the covariance of fitted poses, ``(J^T W J / noise^2 + diag(precision))^-1``.

    Args:
        jacobian: (..., M, D) of the residuals.
        weights: (..., M) of the residuals, from 0 to 1.
        noise: (...) standard deviation of the residuals.
        precision: (..., D) or (D,) of the prior; positive wherever residuals do not tell.

    Returns:
        (..., D, D), in the coordinates of the Jacobian.

    Differentiable: in all.
    """
    rows = (jacobian * (weights.sqrt() / noise.unsqueeze(-1)).unsqueeze(-1)).double()
    information = rows.mT @ rows + torch.diag_embed(precision.double())
    scale = information.diagonal(dim1=-2, dim2=-1).rsqrt()
    outer = scale.unsqueeze(-1) * scale.unsqueeze(-2)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(information * outer))
    return (inverse * outer).to(jacobian)
