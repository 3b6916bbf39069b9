"""The covariance of fitted poses: which errors data share, what no data determine, and what another step would gain."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import SurfaceResiduals, limb_points
from torchreg.alignment.evidence.observability import plausible_variance
from torchreg.alignment.evidence.shape_errors import shape_covariance
from torchreg.alignment.fit.patches import errors_per_patch
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, pose_covariance, surface_noise, surface_objective
from torchreg.geometry.neighbors import NeighborTree
from torchreg.solvers.levenberg_marquardt import held_at_limits
from torchreg.solvers.robust import welsch_weight


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
