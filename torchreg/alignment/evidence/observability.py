"""Which degrees of freedom the data determine: of a cylinder not the turn about its own axis, whatever facets say."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import SurfaceResiduals, end_motions
from torchreg.alignment.fit.objectives import GaussianPosePrior
from torchreg.alignment.fit.problem import BROAD_PRIOR, AlignProblem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_objective
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.solvers.robust import welsch_weight


@dataclass(frozen=True)
class _Open:
    """When a degree of freedom is not determined."""

    least_span: float = 1e-3  # of the limits of a joint that does not move, radians or metres
    confidence: float = 1 / 3  # share of the variance without data that must be gone
    turn: float = math.radians(25)  # standard deviation from which on a joint that turns is open in any case
    slope: float = 0.2  # of the surface along its own motion, on average: of less it may be one of revolution
    num_data: int = 500  # by which its turns are told apart
    most_named: int = 8  # in a sentence


_OPEN = _Open()


def plausible_variance(shape: Articulation, size: float, span: Tensor | None = None) -> Tensor:
    """Return the variance (..., num_dofs) of a uniform pose in the limits, at most a radian or half the size."""
    span = shape.upper - shape.lower if span is None else span
    uniform = span.square().clamp_min(_OPEN.least_span**2) / 12
    return torch.minimum(uniform, BROAD_PRIOR.precision(shape, size).reciprocal())


def dof_confidence(shape: Articulation, covariance: Tensor, size: float) -> Tensor:
    """Return the share (..., num_dofs) of the variance without data that a covariance no longer has; one if held."""
    moves = shape.upper - shape.lower > _OPEN.least_span
    left = covariance.diagonal(dim1=-2, dim2=-1) / plausible_variance(shape, size)
    return torch.where(moves, 1 - left, 1.0).clamp(0, 1).to(covariance)


def told_open(shape: Articulation, covariance: Tensor, size: float) -> str:
    """Return in a sentence which degrees of freedom a covariance (num_dofs, num_dofs) leaves open; empty for none."""
    std, slides = covariance.diagonal().clamp_min(0).sqrt(), shape.is_sliding
    wide = (std > _OPEN.turn) & ~slides & (torch.arange(len(std), device=std.device) >= BASE_DOFS)
    chosen = ((dof_confidence(shape, covariance, size) < _OPEN.confidence) | wide).nonzero()[:, 0].tolist()
    named = [spread_of(shape.dof_names[dof], float(std[dof]), bool(slides[dof])) for dof in chosen]
    more = f" and {len(named) - _OPEN.most_named} more" if len(named) > _OPEN.most_named else ""
    return f"not determined by the data: {', '.join(named[: _OPEN.most_named])}{more}" if named else ""


def spread_of(name: str, std: float, slides: bool) -> str:
    """Return the name of a degree of freedom with its standard deviation, given in metres or radians, in words."""
    return f"{name} (+- {1e3 * std:.0f} mm)" if slides else f"{name} (+- {math.degrees(std):.0f} deg)"


def far_variance(
    problem: AlignProblem,
    pose: Tensor,
    residuals: SurfaceResiduals,
    *,
    noise: Tensor,
    shared: Tensor,
    precision: Tensor,
) -> Tensor:
    """Return variances (B, num_dofs) from poses in which one joint alone is turned far, zero where those are excluded.

    A pose turned by ``a``, one standard deviation without data, with an objective higher by ``E`` adds ``a^2 exp(-E)``.
    It is computed for joints along whose motion the surface hardly has a slope, as of a cylinder.
    """
    near = welsch_weight((residuals.distance / (SURFACE_FIT.width_per_noise * noise).unsqueeze(-1)).square())
    row, dof = _nearly_of_revolution(problem, pose, residuals.jacobian, near * problem.valid).nonzero().unbind(-1)
    found = torch.zeros_like(pose)
    if len(row) == 0:
        return found
    part = problem.draw(_OPEN.num_data, torch.Generator().manual_seed(0))
    share = problem.valid.sum(-1) / part.valid.sum(-1).clamp_min(1)
    step = precision[row, dof].rsqrt()
    least = torch.full_like(step, torch.inf)
    wide, width = part.rows(row), SURFACE_FIT.width_per_noise * noise[row]
    prior = GaussianPosePrior(wide.prior.mean, torch.zeros_like(pose[row]))
    objective = surface_objective(replace(wide, prior=prior), width, noise[row], prior)
    here, column = objective.cost(pose[row]), dof.unsqueeze(-1)
    for sign in (1.0, -1.0):
        turned = wide.clamp(pose[row].scatter_add(1, column, sign * step.unsqueeze(-1)))
        moved = (turned - pose[row]).gather(1, column)[:, 0].abs()
        rise = (objective.cost(turned) - here).clamp_min(0) * share[row] / shared[row]
        least = torch.where(moved > 0.5 * step, torch.minimum(least, rise), least)
    found[row, dof] = (step.square() * (-least).exp()).to(found)
    return found


def _nearly_of_revolution(problem: AlignProblem, pose: Tensor, jacobian: Tensor, near: Tensor) -> Tensor:
    """Return the joints (B, num_dofs) along whose motion the surface hardly has a slope, where there are data."""
    points = torch.arange(len(problem.skin), device=pose.device)
    motion = end_motions(problem.skin, pose, points).square().sum(-2)
    weight = near.unsqueeze(-1) * (jacobian != 0)
    slope = (weight * jacobian.square()).sum(-2) / weight.sum(-2).clamp_min(1e-12)
    lever = motion.sum(-2) / (motion > 0).sum(-2).clamp_min(1)
    turns = ~problem.skin.shape.is_sliding & (torch.arange(pose.shape[-1], device=pose.device) >= BASE_DOFS)
    return (slope < _OPEN.slope**2 * lever) & (weight.sum(-2) > 0) & turns
