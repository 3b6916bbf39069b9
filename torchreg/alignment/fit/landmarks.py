"""Landmarks: keypoints of the shape that a detector measured, in space or in a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_positive
from torchreg.alignment.fit.objectives import Factor
from torchreg.errors import InputError
from torchreg.geometry.camera import Camera, lens_jacobian
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.levenberg_marquardt import Linearization


@dataclass(frozen=True)
class LandmarkModel:
    """What is assumed of landmarks."""

    std_pixels: float = 5.0  # of one in a picture, if none is given
    std_share: float = 0.03  # of one in space, as a share of the shape's size
    wrong: float = 3.0  # standard deviations at which a landmark is as likely to be wrong as right

    @property
    def floor(self) -> float:
        """Density of wrong landmarks, as a share of that of right ones at their mean."""
        return math.exp(-0.5 * self.wrong**2)


LANDMARKS = LandmarkModel()


@dataclass(frozen=True, eq=False)
class Landmarks(Factor):
    """Measured keypoints of B problems, each a Gaussian about its true place or, with a small share, anywhere.

    Targets (B, K, 3) in metres from the origins, or (B, K, 2) pixels (column, row) of a camera; zero if unseen.
    """

    skin: LinearBlendSkin
    targets: Tensor
    seen: Tensor
    std: Tensor
    camera: Camera | None
    origin: Tensor

    def rows(self, index: Tensor) -> Landmarks:
        """Return the landmarks of some problems, which may repeat."""
        names = ("targets", "seen", "std", "origin")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def seen_parts(self) -> set[int]:
        """Return the parts that carry keypoints seen in any of the problems."""
        return set(self.skin.weights.argmax(-1)[self.seen.any(0)].tolist())

    def informed(self, covariance: Tensor, pose: Tensor) -> Tensor:
        """Return the covariance (B, num_dofs, num_dofs) of poses, of which others tell the rest."""
        information = torch.linalg.inv(covariance.double()) + self.linearized(pose, 0.0).hessian.double()
        return torch.linalg.inv(information).to(covariance)

    def agree(self, pose: Tensor) -> Tensor:
        """Return the mask (B, K) of landmarks that agree with poses (B, num_dofs): right more likely than wrong."""
        residual = self._measured(self.skin(pose.unsqueeze(1)))[:, 0] - self.targets
        return self.seen & (residual.square().sum(-1) < LANDMARKS.wrong**2 * self.std.square())

    def score(self, pose: Tensor, width: float) -> Tensor:
        """Return the negative log-likelihood (B, ...) at poses (B, ..., num_dofs); ``width`` adds to the std."""
        return self.cost(pose, width)

    def cost(self, pose: Tensor, sigma: Tensor | float, noise: Tensor | None = None) -> Tensor:
        """Return the negative log-likelihood (B, ...) at poses (B, ..., num_dofs); ``sigma`` (B,) adds to the std."""
        several = pose.reshape(len(pose), -1, pose.shape[-1])
        residual = self._measured(self.skin(several)) - self.targets.unsqueeze(1)
        square = residual.square().sum(-1) / self._variance(sigma).unsqueeze(1)
        return (_loss(square) * self.seen.unsqueeze(1)).sum(-1).reshape(pose.shape[:-1])

    def linearized(self, pose: Tensor, sigma: Tensor | float, noise: Tensor | None = None) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at poses (B, num_dofs)."""
        points, motion = self.skin.jacobian(pose, chart="tangent")
        variance = self._variance(sigma)
        residual = self._measured(points.unsqueeze(1))[:, 0] - self.targets
        jacobian = self._slope(points) @ motion
        square = residual.square().sum(-1) / variance
        share = torch.exp(-0.5 * square)
        weight = (share / (share + LANDMARKS.floor) * self.seen / variance)[..., None, None]
        gradient = (jacobian * weight * residual.unsqueeze(-1)).sum((-3, -2))
        flat = jacobian.flatten(1, 2)
        hessian = flat.mT @ (jacobian * weight).flatten(1, 2)
        return Linearization((_loss(square) * self.seen).sum(-1), gradient, hessian)

    def _variance(self, width: Tensor | float) -> Tensor:
        """Return the variances (B, K), in square metres or pixels."""
        wide = torch.as_tensor(width).to(self.std).expand(len(self.std))
        if self.camera is not None:
            depth = transform_points(self.camera.world_to_camera, self.origin.double())[:, 2].to(self.std)
            wide = wide * float(self.camera.intrinsics[:2].mean()) / depth
        return self.std.square() + wide.square().unsqueeze(-1)

    def _world(self, points: Tensor) -> Tensor:
        return points.double() + self.origin.double().reshape(-1, *[1] * (points.ndim - 2), 3)

    def _measured(self, points: Tensor) -> Tensor:
        """Return what keypoints (B, S, K, 3) would be measured as."""
        if self.camera is None:
            return points
        # Behind the camera nothing is seen: as far off as can be.
        return self.camera.project(self._world(points))[0].nan_to_num(1e6).to(points)

    def _slope(self, points: Tensor) -> Tensor:
        """Return the derivative (B, K, C, 3) of the measurement of keypoints (B, K, 3)."""
        if self.camera is None:
            return torch.eye(3).to(points).expand(*points.shape[:-1], 3, 3)
        motion = self.camera.world_to_camera.double()
        local = transform_points(motion, self._world(points))
        depth = local[..., 2].clamp_min(1e-6)
        plane = local[..., :2] / depth.unsqueeze(-1)
        by_local = torch.cat((torch.eye(2).to(plane).expand(*plane.shape, 2), -plane.unsqueeze(-1)), dim=-1)
        lens = lens_jacobian(plane, self.camera.distortion.double()) * self.camera.intrinsics[:2].double().unsqueeze(-1)
        return (lens @ (by_local / depth[..., None, None]) @ motion[:3, :3]).to(points)


def _loss(square: Tensor) -> Tensor:
    """Return the negative log-likelihood of residuals with squares in variances, zero at zero."""
    return math.log1p(LANDMARKS.floor) - torch.log(torch.exp(-0.5 * square) + LANDMARKS.floor)


@dataclass(frozen=True, eq=False)
class MeasuredKeypoints:
    """Targets ((B,) K, 3) in metres in the world, or ((B,) K, 2) in pixels, NaN where unseen, and their std ((K,))."""

    targets: Tensor
    std: Tensor
    camera: Camera | None

    @classmethod
    def of(cls, shape: Articulation, keypoints: Any, std: Any, camera: Camera | None, size: float) -> MeasuredKeypoints:
        """Return the checked landmarks of a shape of some size."""
        targets = as_float_tensor(keypoints, "keypoints", like=shape.rest)
        count = shape.keypoints(shape.rest_pose()).shape[-2]
        if targets.ndim not in (2, 3) or targets.shape[-2] != count or targets.shape[-1] not in (2, 3):
            raise InputError(
                f"keypoints must have shape ({count}, 3), metres, or ({count}, 2), pixels, as many as the shape's, "
                f"with NaN for those not seen; got {tuple(targets.shape)}"
            )
        pixels = targets.shape[-1] == 2
        if pixels and camera is None:
            raise InputError("keypoints in pixels need the camera of a DepthFrame as data, or give them in metres")
        if not bool(targets.isfinite().all(-1).any()):
            raise InputError("keypoints hold none that is seen: all are NaN")
        default = LANDMARKS.std_pixels if pixels else LANDMARKS.std_share * size
        deviations = as_float_tensor(default if std is None else std, "keypoint_std", like=shape.rest)
        check_positive(float(deviations.min()), "keypoint_std")
        return cls(targets, deviations, camera if pixels else None)

    def near(self, origin: Tensor) -> MeasuredKeypoints:
        """Return the same in coordinates that begin at an origin (3,)."""
        if self.camera is None:
            return replace(self, targets=self.targets - origin.to(self.targets))
        shift = torch.eye(4, dtype=torch.float64)
        shift[:3, 3] = -origin.double().cpu()
        return replace(self, camera=self.camera.moved(shift))

    def of_problems(self, skin: LinearBlendSkin, origin: Tensor) -> Landmarks:
        """Return the landmarks of problems whose coordinates begin at origins (B, 3), with a `keypoint_skin`."""
        targets = self.targets.expand(len(origin), *self.targets.shape[-2:])
        if self.camera is None:
            targets = targets - origin.unsqueeze(1)
        seen = targets.isfinite().all(-1)
        return Landmarks(
            skin=skin,
            targets=torch.where(seen.unsqueeze(-1), targets, 0.0),
            seen=seen,
            std=self.std.expand(seen.shape),
            camera=self.camera,
            origin=origin,
        )


def keypoint_extent(shape: Articulation) -> float:
    """Return the diagonal of the bounding box of a shape's keypoints at rest, metres."""
    points = shape.keypoints(shape.rest_pose()).detach()
    return float((points.amax(0) - points.amin(0)).norm())


def keypoint_skin(shape: Articulation) -> LinearBlendSkin:
    """Return the shape's keypoints as points of the parts that carry them: those in whose coordinates they stay."""
    generator = torch.Generator().manual_seed(0)
    lower, upper = shape.lower.clamp_min(-1.0), shape.upper.clamp_max(1.0)
    draws = torch.rand(8, shape.num_dofs, generator=generator, dtype=torch.float64).to(shape.rest)
    poses = torch.cat([shape.rest_pose()[None], lower + (upper - lower) * draws])
    with torch.no_grad():
        points = shape.keypoints(poses)
        local = transform_points(invert_rigid(shape.part_transforms(poses)), points.unsqueeze(-3))
        carrier = local.var(0).sum(-1).argmin(0)
    weights = torch.nn.functional.one_hot(carrier, shape.num_parts).to(shape.rest)
    return LinearBlendSkin(shape, points[0], weights, shape.rest_pose())
