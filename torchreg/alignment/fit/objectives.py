"""The objective of a fit around a pose: soft matches (eq. 20) or surface distances (eqs. 21, 22), factors, a prior."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self

import torch
from torch import Tensor

from torchreg.shapes.pose_algebra import BASE_DOFS, difference
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import ShapeSurface
from torchreg.solvers.e_step import EStep
from torchreg.solvers.levenberg_marquardt import Linearization
from torchreg.solvers.robust import welsch_cost, welsch_system


class Factor(ABC):
    """Evidence about the poses (B, num_dofs) of a batch, such as keypoints or the free space of a picture.

    A new kind of evidence is a subclass and an entry of `AlignProblem.factors`: fits, searches, rankings, covariances
    sum over that list. Costs are negative log-likelihoods of data with the noise of the fit.
    """

    beside_matches: ClassVar[bool] = True  # False: only the surface fit counts it, not the EM

    @abstractmethod
    def rows(self, index: Tensor) -> Self:
        """Return the factor for some problems, which may repeat."""

    @abstractmethod
    def linearized(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian in a fit with kernel widths and noises (B,), metres."""

    @abstractmethod
    def cost(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Tensor:
        """Return that cost alone (B,)."""

    @abstractmethod
    def score(self, pose: Tensor, width: float) -> Tensor:
        """Return the cost (B, ...) of poses (B, ..., num_dofs) in unexplained data, within a width in metres."""

    def thinned(self, factor: Tensor) -> Self:
        """Return the factor beside data of which each stands for (B,) times as many."""
        return self

    def for_skin(self, skin: LinearBlendSkin) -> Self:
        """Return the factor for other model points that cover the shape as evenly."""
        return self

    def informed(self, covariance: Tensor, pose: Tensor) -> Tensor:
        """Return the covariance (B, num_dofs, num_dofs) of poses that others determine, with what this one adds."""
        return covariance

    def seen_parts(self) -> set[int]:
        """Return the parts of the shape that this factor alone locates in any of the problems."""
        return set()


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

    def linearized(self, pose: Tensor, *_kernel: Tensor) -> Linearization:
        """Return cost, gradient and Hessian at poses (B, num_dofs)."""
        offset = self._offset(pose, self.mean)
        gradient = self.precision * offset
        return Linearization(0.5 * (gradient * offset).sum(-1), gradient, torch.diag_embed(self.precision))

    def cost(self, pose: Tensor, *_kernel: Tensor) -> Tensor:
        """Return the prior's cost (...) of poses (..., num_dofs); the mean's batch is the first dimension."""
        mean = self.mean.reshape(self.mean.shape[0], *[1] * (pose.ndim - 2), -1)
        precision = self.precision
        if precision.ndim > 1:
            precision = precision.reshape(len(precision), *[1] * (pose.ndim - 2), -1)
        return 0.5 * (precision * self._offset(pose, mean).square()).sum(-1)

    def _offset(self, pose: Tensor, mean: Tensor) -> Tensor:
        return difference(mean, pose) if self.holds_base else pose - mean


class Term(Protocol):
    """A summand of an objective of poses (B, num_dofs): data, a `Factor`, or the prior."""

    def linearized(self, pose: Tensor, sigma: Tensor, noise: Tensor, *residuals: Any) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian; of data, given what the term computes of a pose first."""

    def cost(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Tensor:
        """Return the cost alone (B,)."""


@dataclass(frozen=True, eq=False)
class Objective:
    """What a fit minimizes over poses (B, num_dofs): the sum of terms, with kernel widths and noises (B,), metres."""

    terms: Sequence[Term]
    sigma: Tensor
    noise: Tensor

    def __call__(self, pose: Tensor, *residuals: Any) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at poses (B, num_dofs), given residuals of the first term."""
        problem = self.terms[0].linearized(pose, self.sigma, self.noise, *residuals)
        for term in self.terms[1:]:
            problem = problem.plus(term.linearized(pose, self.sigma, self.noise))
        return problem

    def cost(self, pose: Tensor) -> Tensor:
        """Return the cost alone (B,), in a half to a third of the time."""
        return torch.stack([term.cost(pose, self.sigma, self.noise) for term in self.terms]).sum(0)


class SoftMatches:
    """Eq. 20, ``sum_i lambda_i |T(X_i, pose) - G_i|^2 / 2 sigma^2``, over the model points only.

    A skin that is linear in the part transforms has the curvature of all points in one small matrix.
    """

    def __init__(self, skin: LinearBlendSkin, matches: EStep, sigma: Tensor) -> None:
        self.skin, self.targets = skin, matches.targets
        weights = torch.threshold(matches.weights, 1e-12, 0.0)
        self.weights = (weights / (sigma * sigma).unsqueeze(-1)).unsqueeze(-1)
        self.curvature = None if skin.basis is None else skin.basis.mT @ (self.weights * skin.basis)

    def linearized(self, pose: Tensor, _sigma: Tensor, _noise: Tensor, *residuals: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian, given the skin's rows and their derivatives at the pose."""
        rows, derivative = residuals or self.skin.row_jacobian(pose)
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

    def cost(self, pose: Tensor, _sigma: Tensor, _noise: Tensor) -> Tensor:
        """Return the cost alone (B,)."""
        residual = self.skin(pose) - self.targets
        return 0.5 * (self.weights * residual * residual).sum((-2, -1))


@dataclass(frozen=True, eq=False)
class SurfaceDistances:
    """Eqs. 21 and 22: squared surface distances of the data, each weighted by ``beta = exp(-d^2 / sigma_s^2)``.

    Beta at every pose makes it the Welsch function ``sigma_s^2 (1 - beta) / 2``. ``lever``, metres, is the distance of
    the shape's points from the base's axis of rotation.
    """

    surface: ShapeSurface
    data: Tensor
    valid: Tensor
    lever: float

    def linearized(self, pose: Tensor, sigma: Tensor, noise: Tensor, *residuals: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian, given the distances and their Jacobian at the pose."""
        distance, jacobian = residuals or self.surface.distance_jacobian(self.data, pose)
        found = welsch_system(distance, jacobian, self.valid, sigma, noise)
        # Motions of the base that the data leave free, as along a cylinder's axis, are then not taken.
        stiffness = (_BASE_DAMPING_DATA / sigma.square()).unsqueeze(-1)
        diagonal = found.hessian.diagonal(dim1=-2, dim2=-1)
        diagonal[..., :3] += stiffness
        diagonal[..., 3:BASE_DOFS] += stiffness * self.lever**2
        return found

    def cost(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Tensor:
        """Return the cost alone (B,)."""
        return welsch_cost(self.surface.distance(self.data, pose), self.valid, sigma, noise)


def registration_objective(
    skin: LinearBlendSkin, matches: EStep, sigma: Tensor, prior: GaussianPosePrior, factors: Sequence[Factor] = ()
) -> Objective:
    """Return the objective of an M-step: eq. 20 with the factors that count beside soft matches."""
    counted = [factor for factor in factors if factor.beside_matches]
    return Objective((SoftMatches(skin, matches, sigma), *counted, prior), sigma, sigma)


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
    return Objective((SurfaceDistances(surface, data, valid, lever), *factors, prior), sigma, noise)
