"""Recursive estimate of shape coefficients, frame by frame (iterated Kalman)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.align import align
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.reliability import SurfaceError
from torchreg.alignment.fit.problem import joint_precision, model_size
from torchreg.alignment.fit.surface_fit import SURFACE_FIT
from torchreg.alignment.shape.person_covariance import plausible_precision, robust_rows
from torchreg.alignment.shape.shape_fit import fitted_rig, scan_normals, surface_skins
from torchreg.capture.depth_frame import DepthFrame
from torchreg.geometry.upright import Direction
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.shaped import ShapedTree
from torchreg.shapes.shaped_surface import ShapedSurface
from torchreg.solvers.arrow import shared_information


@dataclass(frozen=True)
class KnownPerson:
    """A Gaussian on shape coefficients: mean (K,) and covariance (K, K)."""

    coefficients: Tensor
    covariance: Tensor


@dataclass(frozen=True)
class PersonUpdate:
    """Numbers of an update."""

    steps: int = 3  # of Gauss-Newton, from a pose and coefficients that are nearly right


_UPDATE = PersonUpdate()


class PersonFilter:
    """Estimates the shape coefficients of a rig recursively, frame by frame; ``fit_shape`` as of `align`."""

    def __init__(
        self, shape: ArticulatedShape, fit_shape: bool | str, seed: int = 0, upright: Direction | None = None
    ) -> None:
        self.rig = fitted_rig(shape, fit_shape)
        self.space = self.rig.coefficient_space()
        self._config = AlignConfig(nan_policy="omit", upright=upright, seed=seed)
        tree, generator = ShapedTree(self.rig, self.space), torch.Generator().manual_seed(seed)
        model, self._skin = surface_skins(
            tree, self.rig.file_surface(), self._config.num_model_points, generator
        )  # fmt: skip
        self._size = model_size(model)
        joints = joint_precision(self.rig, self._size, self._config.prior_std)
        self._precision = plausible_precision(self.rig, self._size, joints).double()

    def initialize(self, data: Tensor | DepthFrame, start: Tensor | None) -> tuple[Tensor, KnownPerson] | None:
        """Return the pose (num_dofs,) and coefficients of a first frame; None where the shape is not found."""
        found = align(self.rig, data, start, fit_shape=True, clothed=False, config=self._config)
        mean, covariance = found.coefficients, found.coefficient_covariance
        shows = found.statuses[0] in (Status.CONVERGED, Status.MAX_STEPS, Status.DOUBTFUL)
        if not shows or mean is None or covariance is None:
            return None
        return found.pose, KnownPerson(mean, covariance)

    def update(self, person: KnownPerson, data: Tensor, pose: Tensor, viewpoint: Tensor | None = None) -> KnownPerson:
        """Return the coefficients after another, independent frame (M, 3) with a fitted pose.

        The mean minimizes ``|d(x, c)|^2_W + |x - x_0|^2_P + |c - m|^2_L``; the information L grows by the Schur
        complement ``H_cc - H_cx (H_xx + P)^-1 H_xc``. Bell and Cathey 1993, the iterated Kalman filter as Gauss-Newton.
        """
        dofs, tree = self.rig.num_dofs, self._skin.shape
        valid = torch.ones_like(data[:, 0], dtype=torch.bool)
        normals = scan_normals(data, valid, viewpoint)
        surface = ShapedSurface(self._skin, normals[None], SURFACE_FIT.max_width * self._size)
        information = torch.linalg.inv(person.covariance.double())
        prior = torch.block_diag(self._precision.diag(), information)
        start = torch.cat([pose, person.coefficients.to(pose)])[None]
        state = start
        for _ in range(_UPDATE.steps):
            hessian, gradient = self._normal_equations(surface, data, valid, state)
            gradient = gradient + prior @ tree.difference(start, state)[0].double()
            step = -torch.linalg.solve(hessian + prior, gradient)
            moved = tree.retract(state, step[None].to(state))
            coefficients = moved[:, dofs:].clamp(self.space.lower, self.space.upper)
            state = torch.cat([moved[:, :dofs], coefficients], dim=-1)
        hessian, _ = self._normal_equations(surface, data, valid, state)
        alone = hessian + pad(self._precision, (0, len(information))).diag()
        covariance = torch.linalg.inv(information + shared_information(alone, dofs))
        return KnownPerson(state[0, dofs:], covariance.to(person.covariance))

    def surface_error(
        self, person: KnownPerson, data: Tensor, pose: Tensor, last_step: Tensor, viewpoint: Tensor | None = None
    ) -> SurfaceError:
        """Return the standard errors of the surface in a frame (M, 3), with the last step of its fit.

        They are those of pose and coefficients together, of which the frames before know the latter.
        """
        dofs, valid = self.rig.num_dofs, torch.ones_like(data[:, 0], dtype=torch.bool)
        surface = ShapedSurface(
            self._skin, scan_normals(data, valid, viewpoint)[None], SURFACE_FIT.max_width * self._size
        )
        state = torch.cat([pose, person.coefficients.to(pose)])[None]
        hessian, _ = self._normal_equations(surface, data, valid, state)
        known = torch.block_diag(self._precision.diag(), torch.linalg.inv(person.covariance.double()))
        covariance = torch.linalg.inv(hessian + known)[None].to(pose)
        _, moves = self._skin.row_jacobian(state)
        moved = (moves[..., :dofs] @ last_step).square().sum(-1).mean(-1).sqrt()
        return SurfaceError.of(self._skin, moves, covariance, moved)

    def differs(self, first: Tensor, second: Tensor) -> bool:
        """Return whether two people with coefficients (K,) differ, at rest, by more than a model is exact."""
        vertices = self.space.rest(torch.stack([first, second]).to(self.space.mean))[0]
        moved = (vertices[0] - vertices[1]).square().sum(-1).mean().sqrt()
        return float(moved) > SURFACE_FIT.min_noise(self._size)

    def _normal_equations(
        self, surface: ShapedSurface, data: Tensor, valid: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the Gauss-Newton Hessian (D + K, D + K) and the gradient (D + K,) of the data alone, float64."""
        rows = robust_rows(surface, data[None], valid[None], state, self._size)
        factor = (rows.weights.sqrt() / rows.noise.unsqueeze(-1))[0].double()
        jacobian = rows.jacobian[0].double() * factor.unsqueeze(-1)
        return jacobian.mT @ jacobian, jacobian.mT @ (rows.distance[0].double() * factor)
