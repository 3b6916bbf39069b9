"""The covariance of fitted poses: errors of data and shape, what no data determine, what another step would gain."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import SurfaceResiduals, end_motions, limb_points
from torchreg.alignment.fit.objectives import GaussianPosePrior
from torchreg.alignment.fit.problem import BROAD_PRIOR, AlignProblem, errors_per_patch
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, pose_covariance, surface_noise, surface_objective
from torchreg.geometry.neighbors import NeighborTree
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.scale_jacobian import SCALE_RANGE, scale_jacobian
from torchreg.shapes.surface import FusedSurface
from torchreg.solvers.levenberg_marquardt import held_at_limits
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


@dataclass(frozen=True)
class _Errors:
    """How data err together, and when a fit has ended."""

    num_correlated: int = 1000  # data by which the correlation of residuals is measured
    lattice: int = 12  # neighbors to each side whose correlation counts
    max_correlation: float = 0.95  # of neighboring residuals
    limb_data: float = 12.0  # that nothing but one limb explains: so many, and it is misplaced with probability 1 / e
    patches: float = 4.0  # of a part, within which the shape's surface errs alike
    gain: float = 0.1  # of a further step in log-likelihood: less than half a standard deviation of the pose


_ERRORS = _Errors()


@dataclass(frozen=True, eq=False)
class Curvature:
    """Covariance (B, D, D) in tangent coordinates, gain (B,) of another step in log-likelihood, noise (B,) in metres.

    `shared` (B,) is the number of data that err together.
    """

    covariance: Tensor
    gain: Tensor
    noise: Tensor
    shared: Tensor

    @property
    def converged(self) -> Tensor:
        """Whether a further step would hardly matter, (B,)."""
        return self.gain <= _ERRORS.gain


def curvature(problem: AlignProblem, pose: Tensor, residuals: SurfaceResiduals | None = None) -> Curvature:
    """Return the covariance of fitted poses (B, num_dofs), and what another step would gain.

    Correlated residuals, model errors per patch, wrong proportions, and chance hits of single data are included.
    Unobserved directions get the variance of the joint limits.
    """
    residuals = residuals or SurfaceResiduals.of(problem, pose)
    distance, jacobian = residuals.distance, residuals.jacobian
    noise = surface_noise(distance, problem.valid, problem.size)
    sigma = SURFACE_FIT.width_per_noise * noise
    near = welsch_weight((distance / sigma.unsqueeze(-1)).square()) * problem.valid
    patches = _ERRORS.patches * problem.skin.shape.num_parts
    inexact = (SURFACE_FIT.min_noise(problem.size) / noise).square() * near.sum(-1) / patches
    correlation = neighbor_correlation(problem.data, distance, near)
    shared = correlated_count(correlation) + inexact
    if problem.prior_precision is not None:
        # As the fit weighed the data against what was told.
        shared = torch.maximum(shared, errors_per_patch(problem.data, problem.valid, problem.size))
    precision = plausible_precision(problem, pose)
    fitted = pose_covariance(jacobian, near, noise * shared.sqrt(), precision)
    covariance = _sure_covariance(jacobian, near, noise * shared.sqrt(), precision)
    fitted, covariance = (problem.informed(each, pose) for each in (fitted, covariance))
    gain = _gain(problem, pose, distance, jacobian, noise, fitted) / shared.square()
    if problem.prior_precision is not None:
        # A fit takes noise for no larger than a share of the size, so that it keeps its hold; what is known must not.
        error = surface_noise(distance, problem.valid, problem.size, clamped=False)
        # A depth camera sees all surfaces off by one distance, of the order of the noise: it moves what is not held.
        gradient = jacobian.mT @ (near / (noise.square() * shared).unsqueeze(-1)).unsqueeze(-1)
        moved = covariance @ gradient * error[:, None, None]
        covariance = _of_noisier_data(covariance, precision, (error / noise).square()) + moved @ moved.mT
    inexact_shape = shape_covariance(
        problem, pose, distance=distance, jacobian=jacobian, factor=near.sqrt() / noise.unsqueeze(-1),
        covariance=pose_covariance(jacobian, near, noise, precision), share=correlation,
    )  # fmt: skip
    misplaced = torch.diag_embed(_misplaced_share(problem, residuals.misplaced(_ERRORS.limb_data)) / precision)
    return Curvature((covariance + misplaced + inexact_shape).to(pose), gain, noise, shared)


def _sure_covariance(jacobian: Tensor, weights: Tensor, noise: Tensor, precision: Tensor) -> Tensor:
    """Return the covariance of `pose_covariance` by a lower confidence limit of the data's information.

    The standard deviation of a sum over the data is the root of its sum of squares (Efron 1979), so that one or two
    data by chance determine no direction.
    """
    known = precision.double().rsqrt()
    rows = (jacobian * (weights.sqrt() / noise.unsqueeze(-1)).unsqueeze(-1)).double() * known.unsqueeze(-2)
    told, directions = torch.linalg.eigh(rows.mT @ rows)
    sure = (told - (rows @ directions).pow(4).sum(-2).sqrt()).clamp_min(0)
    scaled = directions * known.unsqueeze(-1)
    return ((scaled / (1 + sure).unsqueeze(-2)) @ scaled.mT).to(jacobian)


def _of_noisier_data(covariance: Tensor, precision: Tensor, excess: Tensor) -> Tensor:
    """Return the sandwich covariance ``F (e A + P) F``, ``F = (A + P)^-1``, of data with e times the variance assumed.

    F is ``covariance`` (B, D, D), P ``precision`` (B, D), e ``excess`` (B,). Huber 1967; White 1982.
    """
    by_data = covariance - (covariance * precision.to(covariance).unsqueeze(-2)) @ covariance
    return covariance + (excess.clamp_min(1) - 1)[:, None, None] * by_data


def _gain(
    problem: AlignProblem, pose: Tensor, distance: Tensor, jacobian: Tensor, noise: Tensor, covariance: Tensor
) -> Tensor:
    """Return the log-likelihood (B,) that another step of the last fit promises, all data counted."""
    objective = surface_objective(problem, SURFACE_FIT.width_per_noise * noise, noise)
    gradient = objective(pose, distance, jacobian).gradient
    slope = gradient * ~held_at_limits(gradient, pose, problem.lower, problem.upper)
    return 0.5 * (slope.unsqueeze(-2) @ covariance @ slope.unsqueeze(-1)).flatten()


def hardly_gains(
    problem: AlignProblem, pose: Tensor, distance: Tensor, jacobian: Tensor, noise: Tensor, covariance: Tensor
) -> Tensor:
    """Return whether another step of the last fit would hardly matter, (B,)."""
    patches = _ERRORS.patches * problem.skin.shape.num_parts
    shared = (problem.valid.sum(-1) / patches).clamp_min(1)
    return _gain(problem, pose, distance, jacobian, noise, covariance) / shared <= _ERRORS.gain


def _misplaced_share(problem: AlignProblem, misplaced: Tensor) -> Tensor:
    """Return the probability (B, num_dofs) that a joint is anywhere: that of its limb (B, L)."""
    share = torch.zeros_like(problem.prior.mean)
    for column, (limb, _) in enumerate(limb_points(problem.skin)):
        share[:, limb.dofs] = misplaced[:, column : column + 1]
    return share


def plausible_precision(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return 1 / variance (B, num_dofs) of poses of which no more is known than the limits of the joints."""
    spans = (problem.upper - problem.lower).expand_as(pose)
    plausible = plausible_variance(problem.skin.shape, problem.size, spans).reciprocal()
    return plausible if problem.prior_precision is None else torch.maximum(plausible, problem.prior_precision)


def correlated_count(correlation: Tensor) -> Tensor:
    """Return how many data (B,) err as one: the sum over a lattice of correlations that fall off as a Gaussian."""
    step = torch.arange(-_ERRORS.lattice, _ERRORS.lattice + 1).to(correlation)
    return (correlation.unsqueeze(-1) ** step.square()).sum(-1).square()


def neighbor_correlation(data: Tensor, residual: Tensor, weight: Tensor) -> Tensor:
    """Return the correlation (B,), at least zero, of the residuals (B, M) of nearest neighbors, by weights (B, M)."""
    stride = -(-data.shape[1] // _ERRORS.num_correlated)
    together = []
    for points, errors, shares in zip(data, residual, weight, strict=True):
        chosen = (shares > 0).nonzero()[:, 0]
        if len(chosen) < 2:
            together.append(errors.new_zeros(()))
            continue
        points, errors, shares = points[chosen], errors[chosen], shares[chosen]
        neighbor = NeighborTree(points).k_nearest(points[::stride], 2)[0][:, 1]
        both = (shares[::stride] * shares[neighbor]).sqrt()
        product = (both * errors[::stride] * errors[neighbor]).sum() / both.sum().clamp_min(1e-12)
        together.append(product / ((shares * errors.square()).sum() / shares.sum()).clamp_min(1e-30))
    return torch.stack(together).clamp(0, _ERRORS.max_correlation)


def shape_covariance(
    problem: AlignProblem,
    pose: Tensor,
    *,
    distance: Tensor,
    jacobian: Tensor,
    factor: Tensor,
    covariance: Tensor,
    share: Tensor,
) -> Tensor | float:
    """Return the "consider" covariance (B, D, D) of a pose by errors of a shape of solids; zero for meshes.

    Scales off by s move the pose by ``-G s``, ``G = C J^T S``, and leave residuals ``(S - J G) s``; C is the covariance
    of the fit, J and S its weighted Jacobians by pose and scales. With a standard deviation tau of the scales the
    covariance is ``tau^2 G G^T``; tau is estimated from the ``share`` (B,) of the residuals' variance that neighbors
    share (Schmidt 1966). The whole surface may also be offset by `SURFACE_FIT.min_noise`, which leaves no residual from
    one side: of the hands of ``benchmarks/confidence.py --calibrate`` the true poses are likeliest at 0.25 to 0.3 mm.
    """
    if not isinstance(problem.surface, FusedSurface):
        return 0.0
    # Derivatives are taken, which inference mode would refuse.
    with torch.inference_mode(False):
        by_scale = scale_jacobian(problem.skin.shape, problem.data.clone(), pose.clone())
    weight = factor.double().unsqueeze(-1)
    rows, scaled = jacobian.double() * weight, by_scale.double() * weight
    moved = covariance.double() @ (rows.mT @ scaled)
    left = (scaled - rows @ moved).square().sum((-2, -1))
    shared = share.double() * (distance.double() * weight.squeeze(-1)).square().sum(-1)
    variance = (shared / left.clamp_min(torch.finfo(left.dtype).tiny)).clamp_max(SCALE_RANGE.max_log**2)
    offset = covariance.double() @ (rows.mT @ weight) * SURFACE_FIT.min_noise(problem.size)
    return variance[:, None, None] * (moved @ moved.mT) + offset @ offset.mT
