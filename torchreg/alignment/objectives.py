"""The two objectives of an alignment as least-squares problems around a pose: eq. 20 and eqs. 21, 22."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.free_space_term import FreeSpaceTerm
from torchreg.alignment.landmarks import Landmarks
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


class Objective(Protocol):
    """What a fit minimizes over poses (B, num_dofs)."""

    def __call__(self, pose: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian."""

    def cost(self, pose: Tensor) -> Tensor:
        """Return the cost alone (B,)."""


class RegistrationObjective:
    """Eq. 20, ``sum_i lambda_i |T(X_i, pose) - G_i|^2 / 2 sigma^2``, over the model points only.

    The skin is linear in the part transforms, so the curvature over all points collapses into one small matrix.
    """

    def __init__(
        self,
        skin: LinearBlendSkin,
        matches: EStep,
        sigma: Tensor,
        prior: GaussianPosePrior,
        landmarks: Landmarks | None = None,
    ) -> None:
        self.skin, self.prior, self.targets = skin, prior, matches.targets
        self.sigma, self.landmarks = sigma, landmarks
        weights = torch.threshold(matches.weights, 1e-12, 0.0)
        self.weights = (weights / (sigma * sigma).unsqueeze(-1)).unsqueeze(-1)
        self.curvature = skin.basis.mT @ (self.weights * skin.basis)

    def __call__(self, pose: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at poses (B, num_dofs)."""
        return self.linearize(pose, *self.skin.row_jacobian(pose))

    def linearize(self, pose: Tensor, rows: Tensor, derivative: Tensor) -> Linearization:
        """Return the same, given the part transforms and their derivatives at the pose (see `transform_jacobian`)."""
        residual = self.skin.place(rows) - self.targets
        weighted = self.weights * residual
        flat = derivative.flatten(-3, -2)
        # Written with the three coordinates from the left, as in `place`.
        by_transform = (weighted.mT @ self.skin.basis).mT.flatten(-2).unsqueeze(-1)
        gradient = (flat.mT @ by_transform).squeeze(-1)
        curved = (self.curvature @ derivative.flatten(-2)).reshape(flat.shape)
        problem = Linearization(0.5 * (weighted * residual).sum((-2, -1)), gradient, flat.mT @ curved)
        if self.landmarks is not None:
            problem = problem.plus(self.landmarks.linearized(pose, self.sigma))
        return self.prior.add_to(problem, pose)

    def cost(self, pose: Tensor) -> Tensor:
        """Return the cost alone (B,), in a third of the time."""
        residual = self.skin(pose) - self.targets
        cost = 0.5 * (self.weights * residual * residual).sum((-2, -1)) + self.prior.cost(pose)
        return cost if self.landmarks is None else cost + self.landmarks.cost(pose, self.sigma)


class SurfaceObjective:
    """Eqs. 21 and 22: squared surface distances of the data, each weighted by ``beta = exp(-d^2 / sigma_s^2)``.

    Beta at every pose makes it the Welsch function ``sigma_s^2 (1 - beta) / 2``. Sigma and noise (B,) are in metres;
    ``lever`` is the distance of the shape's points from the base's axis of rotation.
    """

    def __init__(
        self,
        surface: ShapeSurface,
        data: Tensor,
        valid: Tensor,
        sigma: Tensor,
        noise: Tensor,
        prior: GaussianPosePrior,
        lever: float = 1.0,
        free_space: tuple[FreeSpaceTerm, LinearBlendSkin] | None = None,
        landmarks: Landmarks | None = None,
    ) -> None:
        self.surface, self.data, self.valid, self.prior = surface, data, valid, prior
        self.sigma, self.noise, self.free_space, self.landmarks = sigma, noise, free_space, landmarks
        self.inverse_square = sigma.square().reciprocal().unsqueeze(-1)
        self.scale = noise.square().reciprocal()
        # Motions of the base that the data leave free, as along a cylinder's axis, are then not taken.
        stiffness = _BASE_DAMPING_DATA * self.inverse_square
        num_dofs = prior.mean.shape[-1]
        turns = pad((stiffness * lever**2).expand(-1, 3), (3, num_dofs - BASE_DOFS))
        self.base_damping = turns + pad(stiffness.expand(-1, 3), (0, num_dofs - 3))

    def __call__(self, pose: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at poses (B, num_dofs)."""
        return self.linearize(pose, *self.surface.distance_jacobian(self.data, pose))

    def linearize(self, pose: Tensor, distance: Tensor, jacobian: Tensor) -> Linearization:
        """Return the same, given the distances and their Jacobian at the pose."""
        beta = self._beta(distance)
        weighted = jacobian * (beta * self.valid * self.scale.unsqueeze(-1)).unsqueeze(-1)
        gradient = (weighted.mT @ distance.unsqueeze(-1)).squeeze(-1)
        hessian = weighted.mT @ jacobian + torch.diag_embed(self.base_damping)
        problem = Linearization(self._data_cost(beta), gradient, hessian)
        if self.free_space is not None:
            term, skin = self.free_space
            against = term.linearized(skin, pose, self.sigma, self.noise)
            problem = problem.plus(against)
        if self.landmarks is not None:
            problem = problem.plus(self.landmarks.linearized(pose, self.sigma))
        return self.prior.add_to(problem, pose)

    def cost(self, pose: Tensor) -> Tensor:
        """Return the cost alone (B,), in half the time."""
        beta = self._beta(self.surface.distance(self.data, pose))
        cost = self._data_cost(beta) + self.prior.cost(pose)
        if self.landmarks is not None:
            cost = cost + self.landmarks.cost(pose, self.sigma)
        if self.free_space is None:
            return cost
        term, skin = self.free_space
        return cost + term.cost(skin(pose), self.sigma, self.noise)

    def _beta(self, distance: Tensor) -> Tensor:
        return welsch_weight(distance.square() * self.inverse_square)

    def _data_cost(self, beta: Tensor) -> Tensor:
        return 0.5 * ((1 - beta) * self.valid).sum(-1) / self.inverse_square.squeeze(-1) * self.scale
