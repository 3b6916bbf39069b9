"""The joint fit of a calibration: the poses of all frames and the scales of a shape as one least-squares problem."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.fit.problem import masked_mean
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.scale_jacobian import SCALE_RANGE, scale_jacobian
from torchreg.solvers.arrow import join_shared
from torchreg.solvers.levenberg_marquardt import Linearization
from torchreg.solvers.robust import welsch_loss, welsch_weight


@dataclass(frozen=True)
class ScaleFit:
    """Numbers of a joint fit."""

    shared_error: float = 1.5  # factor on the noise: neighboring residuals share the error of the shape's surface
    last_steps: int = 2  # at the last width, as a multiple of those at the others


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

    def add_to(self, problem: Linearization, poses: Tensor, scales: Tensor) -> Linearization:
        """Return the problem of one state, as a batch of one, with the prior added."""
        joints = (poses - self.poses).flatten()
        precision = self.pose_precision.expand_as(poses).flatten()
        offset = scales - self.scales
        gradient = torch.cat([precision * joints, self.scale_precision @ offset])
        cost = 0.5 * gradient @ torch.cat([joints, offset])
        curvature = torch.block_diag(precision.diag(), self.scale_precision)
        return Linearization(problem.cost + cost, problem.gradient + gradient, problem.hessian + curvature)


class ScaleProblem:
    """The poses of all frames and the scales of the shape as one least-squares problem.

    A state is one row: the poses of all frames, lengths, radii. The shape carries the scales of the last state
    evaluated. At most ``max_points`` of each frame's data (T, M, 3) count.
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
        self.lower = torch.cat([(shape.lower - self.shift).flatten(), prior.scales - SCALE_RANGE.max_log])
        self.upper = torch.cat([(shape.upper - self.shift).flatten(), prior.scales + SCALE_RANGE.max_log])

    def state(self, poses: Tensor) -> Tensor:
        """Return the state (1, T num_dofs + 2 P) of poses and of the shape as it is."""
        scales = self.shape.log_length_scales, self.shape.log_radius_scales
        return torch.cat([(poses - self.shift).flatten(), *scales]).unsqueeze(0)

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return poses (T, num_dofs) about the frames' means, and scales (2 P,)."""
        poses, scales = state[0].tensor_split([self.shift.numel()])
        return poses.reshape(self.shift.shape), scales

    def set_scales(self, scales: Tensor) -> None:
        """Give the shape these lengths and radii (2 P,)."""
        lengths, radii = scales.chunk(2)
        self.shape.log_length_scales.copy_(lengths)
        self.shape.log_radius_scales.copy_(radii)

    def retract(self, state: Tensor, step: Tensor) -> Tensor:
        """Return the state moved by a step; base rotations are updated by composition."""
        (poses, scales), (move, growth) = self.split(state), self.split(step)
        return torch.cat([self.shape.retract(poses, move).flatten(), scales + growth]).unsqueeze(0)

    def change(self, step: Tensor) -> Tensor:
        """Return the largest change in a step, radians, metres as a share of the size, or logarithms of scales."""
        move, growth = self.split(step)
        return torch.cat([(move[:, :3] / self.size).flatten(), move[:, 3:].flatten(), growth]).abs().max()

    def noise(self, state: Tensor) -> float:
        """Return the robust standard deviation of the data of all frames near the surface, metres."""
        poses, scales = self.split(state)
        self.set_scales(scales)
        return float(surface_noise(self.shape.distance(self.data, poses).flatten(), self.valid.flatten(), self.size))

    def unexplained(self, poses: Tensor) -> Tensor:
        """Return the number of data (T,), softly counted, off the surface of the shape as it is in some poses."""
        distance = self.shape.distance(self.data, poses - self.shift)
        return (welsch_loss((distance / (SURFACE_FIT.widths[-1] * self.size)).square()) * self.valid).sum(-1)

    def linearize(self, state: Tensor, sigma: float, noise: float) -> Linearization:
        """Return the Welsch cost of all distances and its Gauss-Newton approximation; the batch is one state."""
        poses, scales = self.split(state)
        self.set_scales(scales)
        distance, by_pose = self.shape.distance_jacobian(self.data, poses, chart="tangent")
        jacobian = torch.cat([by_pose, scale_jacobian(self.shape, self.data, poses)], dim=-1)
        beta = welsch_weight((distance / sigma).square())
        cost = 0.5 * (sigma / noise) ** 2 * ((1 - beta) * self.valid).sum(-1)
        weighted = jacobian * (beta * self.valid / noise**2).unsqueeze(-1)
        rows = Linearization(cost, (weighted.mT @ distance.unsqueeze(-1)).squeeze(-1), weighted.mT @ jacobian)
        # Poses of different frames meet in the scales only.
        joined = join_shared(Linearization(*(value.unsqueeze(0) for value in rows)), poses.shape[-1])
        return self.prior.add_to(joined, poses, scales)
