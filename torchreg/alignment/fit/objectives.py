"""The objective of a fit around a pose: soft matches (eq. 20) or surface distances (eqs. 21, 22), factors, a prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.fit.factors import Factor
from torchreg.shapes.pose_algebra import BASE_DOFS, difference
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import ShapeSurface
from torchreg.solvers.e_step import EStep
from torchreg.solvers.levenberg_marquardt import Linearization
from torchreg.solvers.robust import welsch_weight

# The base is damped, in the Hessian alone, as if by this share of a datum: more slows down starts near few data.
_BASE_DAMPING_DATA = 0.1


@dataclass(frozen=True)
class GaussianPosePrior:
    """A Gaussian on the pose, ``sum_k precision_k (pose_k - mean_k)^2 / 2``; zero precision leaves a variable free.

    Mean (B, num_dofs), precision ((B,) num_dofs); with `holds_base`, base rotations differ by composition.
    """

    mean: Tensor
    precision: Tensor
    holds_base: bool = False

    def add_to(self, problem: Linearization, pose: Tensor) -> Linearization:
        """Return the problem with the prior added."""
        offset = self._offset(pose, self.mean)
        gradient = self.precision * offset
        return Linearization(
            problem.cost + 0.5 * (gradient * offset).sum(-1),
            problem.gradient + gradient,
            problem.hessian + torch.diag_embed(self.precision),
        )

    def cost(self, pose: Tensor) -> Tensor:
        """Return the prior's cost (...) of poses (..., num_dofs); the mean's batch is the first dimension."""
        mean = self.mean.reshape(self.mean.shape[0], *[1] * (pose.ndim - 2), -1)
        precision = self.precision
        if precision.ndim > 1:
            precision = precision.reshape(len(precision), *[1] * (pose.ndim - 2), -1)
        return 0.5 * (precision * self._offset(pose, mean).square()).sum(-1)

    def _offset(self, pose: Tensor, mean: Tensor) -> Tensor:
        return difference(mean, pose) if self.holds_base else pose - mean


class DataTerm(Protocol):
    """What the data of a fit say of poses (B, num_dofs)."""

    def residuals(self, pose: Tensor) -> tuple[Any, ...]:
        """Return what `linearized` needs besides the pose."""

    def linearized(self, *residuals: Any) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian."""

    def cost(self, pose: Tensor) -> Tensor:
        """Return the cost alone (B,)."""


@dataclass(frozen=True, eq=False)
class Objective:
    """What a fit minimizes over poses (B, num_dofs): data, where there are any, factors, and the prior.

    ``sigma`` and ``noise`` (B,), metres, are the kernel widths and noises that the factors are weighed with.
    """

    data: DataTerm | None
    factors: Sequence[Factor]
    prior: GaussianPosePrior
    sigma: Tensor
    noise: Tensor

    def __call__(self, pose: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at poses (B, num_dofs)."""
        return self.linearize(pose, *(() if self.data is None else self.data.residuals(pose)))

    def linearize(self, pose: Tensor, *residuals: Any) -> Linearization:
        """Return the same, given the `residuals` of the data at the pose."""
        terms = [] if self.data is None else [self.data.linearized(*residuals)]
        terms += [factor.linearized(pose, self.sigma, self.noise) for factor in self.factors]
        problem = terms[0]
        for term in terms[1:]:
            problem = problem.plus(term)
        return self.prior.add_to(problem, pose)

    def cost(self, pose: Tensor) -> Tensor:
        """Return the cost alone (B,), in a half to a third of the time."""
        cost = self.prior.cost(pose)
        for factor in self.factors:
            cost = cost + factor.cost(pose, self.sigma, self.noise)
        return cost if self.data is None else self.data.cost(pose) + cost


class SoftMatches:
    """Eq. 20, ``sum_i lambda_i |T(X_i, pose) - G_i|^2 / 2 sigma^2``, over the model points only.

    A skin that is linear in the part transforms has the curvature of all points in one small matrix.
    """

    def __init__(self, skin: LinearBlendSkin, matches: EStep, sigma: Tensor) -> None:
        self.skin, self.targets = skin, matches.targets
        weights = torch.threshold(matches.weights, 1e-12, 0.0)
        self.weights = (weights / (sigma * sigma).unsqueeze(-1)).unsqueeze(-1)
        self.curvature = None if skin.basis is None else skin.basis.mT @ (self.weights * skin.basis)

    def residuals(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return the part transforms of poses (B, num_dofs) and their derivatives, see `transform_jacobian`."""
        return self.skin.row_jacobian(pose)

    def linearized(self, rows: Tensor, derivative: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at a pose with part transforms and derivatives."""
        residual = self.skin.place(rows) - self.targets
        weighted = self.weights * residual
        flat = derivative.flatten(-3, -2)
        if self.curvature is None:
            by_row, curved = weighted, self.weights.unsqueeze(-1) * derivative
        else:
            # Written with the three coordinates from the left, as in `place`.
            by_row, curved = (weighted.mT @ self.skin.basis).mT, self.curvature @ derivative.flatten(-2)
        gradient = (flat.mT @ by_row.flatten(-2).unsqueeze(-1)).squeeze(-1)
        curved = curved.reshape(flat.shape)
        return Linearization(0.5 * (weighted * residual).sum((-2, -1)), gradient, flat.mT @ curved)

    def cost(self, pose: Tensor) -> Tensor:
        """Return the cost alone (B,)."""
        residual = self.skin(pose) - self.targets
        return 0.5 * (self.weights * residual * residual).sum((-2, -1))


class SurfaceDistances:
    """Eqs. 21 and 22: squared surface distances of the data, each weighted by ``beta = exp(-d^2 / sigma_s^2)``.

    Beta at every pose makes it the Welsch function ``sigma_s^2 (1 - beta) / 2``. Sigma and noise (B,) are in metres;
    ``lever`` is the distance of the shape's points from the base's axis of rotation.
    """

    def __init__(
        self, surface: ShapeSurface, data: Tensor, valid: Tensor, sigma: Tensor, noise: Tensor, lever: float
    ) -> None:
        self.surface, self.data, self.valid = surface, data, valid
        self.inverse_square = sigma.square().reciprocal().unsqueeze(-1)
        self.scale = noise.square().reciprocal()
        # Motions of the base that the data leave free, as along a cylinder's axis, are then not taken.
        stiffness = _BASE_DAMPING_DATA * self.inverse_square
        turns = pad((stiffness * lever**2).expand(-1, 3), (3, 0))
        self.base_damping = turns + pad(stiffness.expand(-1, 3), (0, 3))

    def residuals(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances (B, M) of the data in poses (B, num_dofs) and their Jacobian."""
        return self.surface.distance_jacobian(self.data, pose)

    def linearized(self, distance: Tensor, jacobian: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian, given the distances and their Jacobian at the pose."""
        beta = self._beta(distance)
        weighted = jacobian * (beta * self.valid * self.scale.unsqueeze(-1)).unsqueeze(-1)
        gradient = (weighted.mT @ distance.unsqueeze(-1)).squeeze(-1)
        damping = pad(self.base_damping, (0, jacobian.shape[-1] - BASE_DOFS))
        return Linearization(self._robust_cost(beta), gradient, weighted.mT @ jacobian + torch.diag_embed(damping))

    def cost(self, pose: Tensor) -> Tensor:
        """Return the cost alone (B,)."""
        return self._robust_cost(self._beta(self.surface.distance(self.data, pose)))

    def _beta(self, distance: Tensor) -> Tensor:
        return welsch_weight(distance.square() * self.inverse_square)

    def _robust_cost(self, beta: Tensor) -> Tensor:
        return 0.5 * ((1 - beta) * self.valid).sum(-1) / self.inverse_square.squeeze(-1) * self.scale


def registration_objective(
    skin: LinearBlendSkin, matches: EStep, sigma: Tensor, prior: GaussianPosePrior, factors: Sequence[Factor] = ()
) -> Objective:
    """Return the objective of an M-step: eq. 20 with the factors that count beside soft matches."""
    counted = [factor for factor in factors if factor.beside_matches]
    return Objective(SoftMatches(skin, matches, sigma), counted, prior, sigma, sigma)


def distance_objective(
    surface: ShapeSurface,
    data: Tensor,
    valid: Tensor,
    sigma: Tensor,
    noise: Tensor,
    prior: GaussianPosePrior,
    lever: float = 1.0,
    factors: Sequence[Factor] = (),
) -> Objective:
    """Return the objective of a surface fit, see `SurfaceDistances`."""
    return Objective(SurfaceDistances(surface, data, valid, sigma, noise, lever), factors, prior, sigma, noise)
