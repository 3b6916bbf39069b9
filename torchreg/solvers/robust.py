"""Robust kernels: losses and weights of residuals that may be outliers'.

Each kernel is two functions of the squared ratio ``z = (r / s)^2`` of residual and scale, as in Ceres: a loss
``rho(z)`` with ``rho(0) = 0`` and ``rho'(0) = 1``, and the weight ``rho'(z)``, which falls from 1 to 0. The cost
``s^2 rho(z) / 2`` is near ``r^2 / 2`` for small residuals, has the derivative ``rho'(z) r`` in r, and never rises in
iteratively reweighted least squares with these weights, since rho is concave.

All functions take squared ratios (...) >= 0, without unit, in float32 or float64, and return (...) in the same type.

Differentiable: in z, at zero too, and so in the residual.

References: Triggs et al. 2000, section 4.3; Barron 2019, whose general loss has them as special cases: Welsch with
shape -infinity and ``c = s / sqrt(2)``, Geman-McClure with shape -2 and ``c = s / 2``, Cauchy with shape 0 and
``c = s / sqrt(2)``.
"""

from __future__ import annotations

from torch import Tensor

from torchreg.solvers.levenberg_marquardt import Linearization


def welsch_weight(squared_ratio: Tensor) -> Tensor:
    """Return ``exp(-z)``: 0.37 at the scale, 1e-4 at three scales (Dennis and Welsch 1978)."""
    # In place on what neg() allocates: backward needs the result alone.
    return squared_ratio.neg().exp_()


def welsch_loss(squared_ratio: Tensor) -> Tensor:
    """Return ``1 - exp(-z)``, below 1; its sum over data is a soft count of the outliers (Dennis and Welsch 1978)."""
    return 1 - welsch_weight(squared_ratio)


def geman_mcclure_weight(squared_ratio: Tensor) -> Tensor:
    """Return ``1 / (1 + z)^2``: 1/4 at the scale, 1/100 at three scales (Geman and McClure 1987)."""
    return (1 + squared_ratio).pow_(-2)


def geman_mcclure_loss(squared_ratio: Tensor) -> Tensor:
    """Return ``z / (1 + z)``, below 1 (Geman and McClure 1987)."""
    return squared_ratio / (1 + squared_ratio)


def cauchy_weight(squared_ratio: Tensor) -> Tensor:
    """Return ``1 / (1 + z)``: 1/2 at the scale, 1/10 at three scales (Holland and Welsch 1977)."""
    return (1 + squared_ratio).reciprocal_()


def cauchy_loss(squared_ratio: Tensor) -> Tensor:
    """Return ``log(1 + z)``, without bound (Holland and Welsch 1977)."""
    return squared_ratio.log1p()


def welsch_cost(residual: Tensor, weights: Tensor, sigma: Tensor, noise: Tensor) -> Tensor:
    """Return ``sum_j w_j s^2 rho(r_j^2 / s^2) / 2 n^2`` of residuals (..., M), kernel widths s and noises n (...)."""
    loss = weights * welsch_loss((residual / sigma.unsqueeze(-1)).square())
    return 0.5 * (sigma / noise).square() * loss.sum(-1)


def welsch_system(residual: Tensor, jacobian: Tensor, weights: Tensor, sigma: Tensor, noise: Tensor) -> Linearization:
    """Return the `welsch_cost` of residuals (..., M) with a Jacobian (..., M, D), and its Gauss-Newton system."""
    beta = welsch_weight((residual / sigma.unsqueeze(-1)).square())
    weighted = jacobian * (weights * beta / noise.square().unsqueeze(-1)).unsqueeze(-1)
    cost = 0.5 * (sigma / noise).square() * (weights * (1 - beta)).sum(-1)
    return Linearization(cost, (weighted.mT @ residual.unsqueeze(-1)).squeeze(-1), weighted.mT @ jacobian)
