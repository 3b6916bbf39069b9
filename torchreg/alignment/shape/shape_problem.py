"""Alignments of poses with shape coefficients, which the scans of one person share, and the covariance of a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import one_hot, pad

from torchreg.alignment.evidence.curvature import correlated_count, neighbor_correlation
from torchreg.alignment.fit.problem import BROAD_PRIOR, AlignProblem, alignment_cost
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, pose_covariance, surface_noise
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.shaped import ShapedSkin
from torchreg.shapes.shaped_surface import ShapedSurface
from torchreg.solvers.levenberg_marquardt import SharedRows
from torchreg.solvers.robust import welsch_weight


@dataclass(frozen=True)
class ShapeProblem(AlignProblem):
    """Alignments whose degrees of freedom end with shape coefficients, shared by successive rows, ``scans`` each."""

    skin: ShapedSkin  # type: ignore[assignment]
    surface: ShapedSurface

    def rows(self, index: Tensor) -> Self:
        """Return the problems of some rows of the batch."""
        chosen = super().rows(index)
        return replace(chosen, surface=self.surface.with_normals(chosen.data_normals()))

    def people(self, index: Tensor) -> Tensor:
        """Return the rows (S T,) of some people (S,)."""
        return (index.unsqueeze(-1) * self.scans + torch.arange(self.scans)).flatten()

    def data_normals(self) -> Tensor:
        """Return the normals (B, M, 3) of the data."""
        return torch.zeros_like(self.data) if self.normals is None else self.normals

    def kept(self, index: Tensor) -> Self:
        """Return the problem with the data (B, C) of an index, that stand for all."""
        chosen = super().kept(index)
        return replace(chosen, surface=self.surface.with_normals(chosen.data_normals()))

    def cost_of_people(self, state: Tensor) -> Tensor:
        """Return the cost (S,) by which people are ranked."""
        return alignment_cost(self, state).unflatten(0, (-1, self.scans)).sum(-1)

    def robust_rows(self, state: Tensor) -> RobustRows:
        """Return the data as rows of a least-squares problem in states (B, D + K)."""
        return robust_rows(self.surface, self.data, self.valid, state, self.size)

    @property
    def shared(self) -> SharedRows:
        """The scans of a person share coefficients."""
        return SharedRows(self.skin.shape.retract, self.scans, self.skin.shape.rig.num_dofs)


@dataclass(frozen=True)
class _PartErrors:
    """Errors that the data of a part share."""

    # Of six right fits of made-up people, bare and clothed, 95 % ellipsoids of the surface then cover 87 %, not 66 %.
    shared: float = 2.0  # in deviations of the residuals


_PART_ERRORS = _PartErrors()


@dataclass(frozen=True)
class RobustRows:
    """Distances (B, M) in metres, Jacobian (B, M, D + K) and Welsch weights of data as rows of a least-squares problem.

    `noise` (B,) is the deviation of each datum as if all were independent: larger where neighbors err together.
    `residual` (B,) is that of distances, `shared` (B,) that of the errors which neighbors share, metres.
    """

    distance: Tensor
    jacobian: Tensor
    weights: Tensor
    noise: Tensor
    residual: Tensor
    shared: Tensor

    @property
    def width(self) -> Tensor:
        """The width (B,) of the kernel, metres."""
        return SURFACE_FIT.width_per_noise * self.residual

    def part_gradients(self, surface: ShapedSurface, data: Tensor, state: Tensor) -> Tensor:
        """Return how the gradient (B, D + K) moves by the errors (B, D + K, P) of the surface of parts, one deviation.

        Folds of skin and cloth, and tangent planes in place of a surface, put all data of a part off.
        """
        nearest, shaped = surface.nearest(data, state)[1], surface.shaped
        part = one_hot(shaped.weights.argmax(-1)[nearest], shaped.weights.shape[1]).to(state)
        weighted = self.jacobian * (self.weights / self.noise.square().unsqueeze(-1)).unsqueeze(-1)
        return (_PART_ERRORS.shared * self.residual)[:, None, None] * (weighted.mT @ part)


def robust_rows(surface: ShapedSurface, data: Tensor, valid: Tensor, state: Tensor, size: float) -> RobustRows:
    """Return data (B, M, 3) as rows of a least-squares problem in states (B, D + K) of poses and coefficients."""
    distance, jacobian = surface.distance_jacobian(data, state)
    noise = surface_noise(distance, valid, size)
    near = welsch_weight((distance / (SURFACE_FIT.width_per_noise * noise).unsqueeze(-1)).square()) * valid
    correlation = neighbor_correlation(data, distance, near)
    count = correlated_count(correlation).clamp_min(1)
    return RobustRows(
        distance, jacobian=jacobian, weights=near, noise=noise * count.sqrt(), residual=noise,
        shared=noise * correlation.sqrt(),
    )  # fmt: skip


def noise_covariance(problem: ShapeProblem, rows: RobustRows) -> Tensor:
    """Return the covariance (T, D + K, D + K) of each scan's pose and the coefficients, as if it were alone."""
    precision = plausible_precision(problem.skin.shape.rig, problem.size, problem.prior.precision)
    return pose_covariance(rows.jacobian, rows.weights, rows.noise, precision.expand(len(rows.noise), -1))


def with_errors_of_parts(problem: ShapeProblem, state: Tensor, rows: RobustRows, covariance: Tensor) -> Tensor:
    """Return the "consider" covariance (T, D + K, D + K) of states: the data of a part share an error of its surface.

    It is ``C + G G^T``, ``G = C J^T W S tau`` with S (M, P) the data of each part, tau the deviation of their error and
    C ``covariance`` (Schmidt 1966).
    """
    moved = covariance @ rows.part_gradients(problem.surface, problem.data, state)
    return covariance + moved @ moved.mT


def plausible_precision(rig: Articulation, size: float, precision: Tensor) -> Tensor:
    """Return the precision (D + K,) of a prior, of the pose at least that of any plausible one."""
    broad = BROAD_PRIOR.precision(rig, size)
    return torch.maximum(precision, pad(broad, (0, precision.shape[-1] - rig.num_dofs)))


def shared_covariance(covariance: Tensor, num_dofs: int) -> Tensor:
    """Return the covariance (K, K) of coefficients from scans' (T, D + K, D + K), each with its prior's share."""
    alone = covariance[:, num_dofs:, num_dofs:].double()
    return torch.linalg.inv(torch.linalg.inv(alone).sum(0)).to(covariance)
