"""The second stage of an alignment: the surface is fitted to the data, with a kernel that narrows to the noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.fit.annealed_em import OnStep, StageResult, report_step
from torchreg.alignment.fit.objectives import GaussianPosePrior, Objective, distance_objective
from torchreg.alignment.fit.problem import INLIER_SHARE, AlignProblem
from torchreg.solvers.levenberg_marquardt import LMResult

# The median absolute deviation of a Gaussian times this is its standard deviation.
_MAD_TO_STD = 1.4826


@dataclass(frozen=True)
class SurfaceFit:
    """Numbers of the surface fit; widths are shares of the model's size."""

    widths: tuple[float, ...] = (0.045, 0.022)  # of the kernel, before the last one, which follows from the noise
    min_width: float = 0.003  # of the last kernel: the model itself is no more exact
    max_width: float = INLIER_SHARE  # of the last kernel: data beyond are outliers
    width_per_noise: float = 2.5  # at which a Welsch kernel is almost as efficient as least squares on Gaussian noise
    last_steps: int = 3  # at the last width, as a multiple of those at the others
    search_steps: int = 4  # at each width after a search, to whose time they hardly add
    more_steps: int = 5  # of a fit that has not converged, as a multiple of those at its last width
    refine_damping: float = 1e-5  # of untested steps from a pose that is known to a few degrees
    lever: float = 0.25  # typical distance of the surface from the base's axis of rotation

    def max_noise(self, size: float) -> float:
        """Return the largest noise of data on a model of some size, as a standard deviation, metres."""
        return self.max_width * size / self.width_per_noise

    def min_noise(self, size: float) -> float:
        """Return the smallest: what a model of some size is not exact, metres."""
        return self.min_width * size / self.width_per_noise

    def relative_noise(self, noise: Tensor, size: float) -> Tensor:
        """Return where noise (...), metres, lies between the smallest (0) and the largest (1), in logarithms."""
        least = self.min_noise(size)
        return (noise / least).log() / math.log(self.max_noise(size) / least)


SURFACE_FIT = SurfaceFit()


def fit_surface(
    problem: AlignProblem,
    pose: Tensor,
    *,
    steps: int,
    widths: Sequence[float] = SURFACE_FIT.widths,
    on_step: OnStep | None = None,
) -> StageResult:
    """Return the pose (B, num_dofs) fitted to the data, eqs. 21 and 22, with a kernel that narrows to the noise.

    ``steps`` damped steps per width, shares of the model's size; the last takes up to three times as many, tested.
    Dewaele et al. 2006, section 3.4.
    """
    noise = torch.full_like(pose[:, 0], SURFACE_FIT.max_noise(problem.size))
    num_steps = len(widths) + 1
    for number, width in enumerate(widths):
        sigma = torch.full_like(noise, width * problem.size)
        solved = surface_steps(problem, pose, sigma, noise, steps)
        pose = solved.state
        report_step(on_step, problem, solved, stage="surface", step=number, num_steps=num_steps, sigma=sigma)
    distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    noise = surface_noise(distance, problem.valid, problem.size)
    sigma = SURFACE_FIT.width_per_noise * noise
    objective = surface_objective(problem, sigma, noise)
    solved = problem.solve(objective, pose, steps, objective(pose, distance, jacobian))
    for _ in range(SURFACE_FIT.last_steps - 1):
        index = problem.unfinished(solved.last_step)
        if len(index) == 0:
            break
        solved = _solve_rows(problem, solved, index, sigma, noise, steps)
    report_step(on_step, problem, solved, stage="surface", step=len(widths), num_steps=num_steps, sigma=sigma)
    return StageResult(pose=solved.state, sigma=sigma, change=problem.change(solved.last_step))


def _solve_rows(
    problem: AlignProblem, solved: LMResult, index: Tensor, sigma: Tensor, noise: Tensor, steps: int
) -> LMResult:
    """Return the result with more tested steps of some rows."""
    part, pose = problem.rows(index), solved.state[index]
    objective = surface_objective(part, sigma[index], noise[index])
    more = part.solve(objective, pose, steps, objective(pose), solved.damping[index])
    accepted = (more.last_step != 0).any(-1, keepdim=True)
    last_step = torch.where(accepted, more.last_step, solved.last_step[index])
    return LMResult(
        solved.state.index_copy(0, index, more.state),
        solved.cost.index_copy(0, index, more.cost),
        solved.damping.index_copy(0, index, more.damping),
        solved.last_step.index_copy(0, index, last_step),
        solved.num_steps + more.num_steps,
    )


@dataclass(frozen=True)
class SurfaceResult:
    """Poses (B, num_dofs) after steps on the surface, distances (B, M), their Jacobian, and the last step."""

    pose: Tensor
    distance: Tensor
    jacobian: Tensor
    last_step: Tensor


def refine_surface(problem: AlignProblem, pose: Tensor, *, steps: int, widths: Sequence[float]) -> SurfaceResult:
    """Return the pose that `fit_surface` reaches from nearby, in half the time: its last steps are not tested."""
    noise = torch.full_like(pose[:, 0], SURFACE_FIT.max_noise(problem.size))
    for width in widths:
        pose = surface_steps(problem, pose, torch.full_like(noise, width * problem.size), noise, steps).state
    distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    noise = surface_noise(distance, problem.valid, problem.size)
    objective = surface_objective(problem, SURFACE_FIT.width_per_noise * noise, noise)
    for _ in range(SURFACE_FIT.last_steps * steps):
        around = objective(pose, distance, jacobian)
        solved = problem.step(around, pose, SURFACE_FIT.refine_damping)
        pose = solved.state
        distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    return SurfaceResult(pose=pose, distance=distance, jacobian=jacobian, last_step=solved.last_step)


def surface_steps(problem: AlignProblem, pose: Tensor, sigma: Tensor, noise: Tensor, steps: int) -> LMResult:
    """Return the result of damped steps on the surface objective at one width, which a narrower one will correct."""
    objective = surface_objective(problem, sigma, noise)
    solved = problem.step(objective(pose), pose)
    for _ in range(steps - 1):
        solved = problem.step(objective(solved.state), solved.state)
    return solved


def surface_objective(
    problem: AlignProblem, sigma: Tensor, noise: Tensor, prior: GaussianPosePrior | None = None
) -> Objective:
    """Return the objective of a surface fit at kernel widths (B,) and noise levels (B,), with the problem's prior."""
    return distance_objective(
        surface=problem.surface,
        data=problem.data,
        valid=problem.valid,
        sigma=sigma,
        noise=noise,
        prior=prior or problem.prior,
        lever=SURFACE_FIT.lever * problem.size,
        factors=problem.factors,
    )


def surface_noise(distance: Tensor, valid: Tensor, size: float, *, clamped: bool = True) -> Tensor:
    """Return the robust standard deviation (...) of distances (..., M) near the surface, ``clamped`` by the size."""
    distance = distance.abs()
    near = (distance < SURFACE_FIT.widths[-1 if clamped else 0] * size) & valid
    median = torch.where(near, distance, torch.nan).nanmedian(-1).values
    lowest, highest = SURFACE_FIT.min_noise(size), SURFACE_FIT.max_noise(size)
    if not clamped:
        return torch.nan_to_num(_MAD_TO_STD * median, nan=highest).clamp_min(lowest)
    return torch.nan_to_num(_MAD_TO_STD * median, nan=highest).clamp(lowest, highest)


def pose_covariance(jacobian: Tensor, weights: Tensor, noise: Tensor, precision: Tensor) -> Tensor:
    """Return the covariance (..., D, D) of fitted poses, ``(J^T W J / noise^2 + diag(precision))^-1``."""
    rows = (jacobian * (weights.sqrt() / noise.unsqueeze(-1)).unsqueeze(-1)).double()
    information = rows.mT @ rows + torch.diag_embed(precision.double())
    scale = information.diagonal(dim1=-2, dim2=-1).rsqrt()
    outer = scale.unsqueeze(-1) * scale.unsqueeze(-2)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(information * outer))
    return (inverse * outer).to(jacobian)
