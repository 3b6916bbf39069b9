"""The joint fit of a calibration: the poses of all frames and the scales of a shape as one least-squares problem."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.fit.objectives import Objective, SurfaceDistances
from torchreg.alignment.fit.problem import masked_mean
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.scale_jacobian import SCALE_RANGE, scale_jacobian
from torchreg.solvers.levenberg_marquardt import Linearization, LMResult, SharedRows
from torchreg.solvers.robust import welsch_loss


@dataclass(frozen=True)
class ScaleFit:
    """Numbers of a joint fit."""

    shared_error: float = 1.5  # factor on the noise: neighboring residuals share the error of the shape's surface


SCALE_FIT = ScaleFit()


@dataclass(frozen=True)
class ScalePrior:
    """Gaussians on poses (T, num_dofs), precision (num_dofs,), and scales (2 P,), lengths first, (2 P, 2 P)."""

    poses: Tensor
    pose_precision: Tensor
    scales: Tensor
    scale_precision: Tensor

    @classmethod
    def from_shape(
        cls,
        shape: ArticulatedShape,
        poses: Tensor,
        size: float,
        *,
        joint_std: float | None,
        size_std: float,
        radius_std: float,
        part_std: float,
    ) -> ScalePrior:
        """Return the prior about a shape of some size and poses, with deviations as in `CalibrateConfig`."""
        pose_precision = torch.zeros_like(shape.rest)
        if joint_std is not None:
            units = torch.where(shape.is_sliding[BASE_DOFS:], size, 1.0)
            pose_precision[BASE_DOFS:] = units.mul(joint_std).square().reciprocal()
        scales = torch.cat([shape.log_length_scales, shape.log_radius_scales]).detach()
        radial = torch.arange(len(scales)) >= shape.num_parts
        covariance = (
            size_std**2
            + radius_std**2 * torch.outer(radial, radial).double()
            + part_std**2 * torch.eye(len(scales), dtype=torch.float64)
        )
        precision = covariance.inverse().to(scales)
        return cls(poses=poses, pose_precision=pose_precision, scales=scales, scale_precision=precision)

    def linearized(self, state: Tensor, *_kernel: Tensor) -> Linearization:
        """Return cost, gradient and Hessian at rows (T, num_dofs + 2 P), each with its share of that of the scales."""
        count = self.poses.shape[-1]
        precision = torch.block_diag(self.pose_precision.diag(), self.scale_precision / len(state))
        offset = torch.cat([state[:, :count] - self.poses, state[:, count:] - self.scales], dim=-1)
        gradient = offset @ precision
        return Linearization(0.5 * (gradient * offset).sum(-1), gradient, precision.expand(len(state), -1, -1))

    def cost(self, state: Tensor, *_kernel: Tensor) -> Tensor:
        """Return the cost alone (T,)."""
        return self.linearized(state).cost


class ScaleProblem:
    """The poses of all frames and the scales of the shape as one least-squares problem.

    A state is a row for each frame, (T, num_dofs + 2 P): its pose, then lengths and radii, which all share. The shape
    carries the scales of the last state evaluated. At most ``max_points`` of each frame's data (T, M, 3) count.
    """

    def __init__(
        self, shape: ArticulatedShape, data: Tensor, valid: Tensor, prior: ScalePrior, size: float, max_points: int
    ) -> None:
        self.shape, self.size = shape, size
        # Strides rather than draws: frames are in no order that matters, and the result is the same every time.
        stride = -(-data.shape[1] // max_points)
        data, valid = data[:, ::stride], valid[:, ::stride]
        # Every frame's mean at the origin, where float32 is most precise.
        mean = masked_mean(data, valid)
        self.data, self.valid = torch.where(valid.unsqueeze(-1), data - mean.unsqueeze(1), 0.0), valid
        self.shift = pad(mean, (0, shape.num_dofs - 3))
        self.prior = replace(prior, poses=prior.poses - self.shift)

    def state(self, poses: Tensor) -> Tensor:
        """Return the state of poses (T, num_dofs) and of the shape as it is."""
        return self._rows(poses, torch.cat([self.shape.log_length_scales, self.shape.log_radius_scales]))

    def _rows(self, poses: Tensor, scales: Tensor) -> Tensor:
        return torch.cat([poses - self.shift, scales.expand(len(self.shift), -1)], dim=-1)

    def carried(self, state: Tensor) -> Tensor:
        """Return the poses (T, num_dofs) about the frames' means of a state, whose scales the shape carries then."""
        poses, scales = state.tensor_split([self.shape.num_dofs], dim=-1)
        lengths, radii = scales[0].chunk(2)
        self.shape.log_length_scales.copy_(lengths)
        self.shape.log_radius_scales.copy_(radii)
        return poses

    def distance(self, points: Tensor, state: Tensor) -> Tensor:
        """Return the distances (T, M) of points (T, M, 3), see `ShapeSurface`."""
        return self.shape.distance(points, self.carried(state))

    def distance_jacobian(self, points: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances and their Jacobian (T, M, num_dofs + 2 P), see `ShapeSurface`."""
        poses = self.carried(state)
        distance, by_pose = self.shape.distance_jacobian(points, poses, chart="tangent")
        return distance, torch.cat([by_pose, scale_jacobian(self.shape, points, poses)], dim=-1)

    def solve(self, state: Tensor, sigma: float, noise: float, max_steps: int, atol: float) -> LMResult:
        """Return the state after Levenberg-Marquardt with a kernel width and a noise, metres."""
        sigmas, noises = (torch.full_like(state[:, 0], value) for value in (sigma, noise))
        terms = SurfaceDistances(self, self.data, self.valid, SURFACE_FIT.lever * self.size), self.prior
        lower = self._rows(self.shape.lower, self.prior.scales - SCALE_RANGE.max_log)
        upper = self._rows(self.shape.upper, self.prior.scales + SCALE_RANGE.max_log)
        return SharedRows(self.shape.retract, len(state), self.shape.num_dofs).descend(
            Objective(terms, sigmas, noises), state, lower=lower, upper=upper, max_steps=max_steps, atol=atol
        )

    def change(self, step: Tensor) -> float:
        """Return the largest change in a step, radians, metres as a share of the size, or logarithms of scales."""
        return float(torch.cat([step[:, :3] / self.size, step[:, 3:]], dim=-1).abs().max())

    def noise(self, state: Tensor) -> float:
        """Return the robust standard deviation of the data of all frames near the surface, metres."""
        return float(surface_noise(self.distance(self.data, state).flatten(), self.valid.flatten(), self.size))

    def unexplained(self, poses: Tensor) -> Tensor:
        """Return the number of data (T,), softly counted, off the surface of the shape as it is in some poses."""
        distance = self.shape.distance(self.data, poses - self.shift)
        return (welsch_loss((distance / (SURFACE_FIT.widths[-1] * self.size)).square()) * self.valid).sum(-1)
