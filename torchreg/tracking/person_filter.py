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
from torchreg.alignment.shape.clothing import CLOTH, clothed_rig, may_be_clothed
from torchreg.alignment.shape.outside_term import OutsideTerm
from torchreg.alignment.shape.shape_fit import fitted_rig, scan_normals, surface_skins
from torchreg.alignment.shape.shape_problem import RobustRows, plausible_precision, robust_rows
from torchreg.capture.depth_frame import DepthFrame
from torchreg.geometry.upright import Direction
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.shaped import ShapedTree
from torchreg.shapes.shaped_surface import ShapedSurface
from torchreg.solvers.levenberg_marquardt import shared_information


@dataclass(frozen=True)
class KnownPerson:
    """A Gaussian on shape coefficients, of mean (K,), and on a pose in tangent coordinates with them.

    `covariance` is that of coefficients (K, K), or of pose and coefficients (D + K, D + K), by the noise of the frames.
    `sensitivity` (K, P) or (D + K, P) is how they move by one deviation of the errors of the model's parts, which all
    frames share.
    """

    coefficients: Tensor
    covariance: Tensor
    sensitivity: Tensor

    @property
    def alone(self) -> KnownPerson:
        """What is known of the coefficients."""
        count = len(self.coefficients)
        return KnownPerson(self.coefficients, self.covariance[-count:, -count:], self.sensitivity[-count:])

    @property
    def total(self) -> Tensor:
        """The covariance by noise and by errors of the model, the "consider" covariance (Schmidt 1966)."""
        return self.covariance + self.sensitivity @ self.sensitivity.mT


@dataclass(frozen=True, eq=False)
class OrientedScan:
    """Data (1, M, 3) of a frame and their normals (1, M, 3), zero where unknown."""

    data: Tensor
    normals: Tensor

    @classmethod
    def of(cls, data: Tensor, viewpoint: Tensor | None) -> OrientedScan:
        """Return data (M, 3) with normals, which face the camera at a viewpoint (3,) where one is known."""
        normals = scan_normals(data, torch.ones_like(data[:, 0], dtype=torch.bool), viewpoint)
        return cls(data[None], normals[None])

    @property
    def valid(self) -> Tensor:
        """True everywhere."""
        return torch.ones_like(self.data[..., 0], dtype=torch.bool)


@dataclass(frozen=True)
class Motion:
    """Where a person is expected: a pose (D,) and its standard deviations (D,) after what the frame before told."""

    pose: Tensor
    std: Tensor


@dataclass(frozen=True)
class PersonFit:
    """A pose (D,) fitted together with coefficients, the errors of the surface, and all that is known then."""

    pose: Tensor
    last_step: Tensor
    known: KnownPerson
    error: SurfaceError


@dataclass(frozen=True)
class PersonUpdate:
    """Numbers of an update."""

    steps: int = 4  # of Gauss-Newton, from a pose and coefficients that are nearly right


_UPDATE = PersonUpdate()


class PersonFilter:
    """Estimates the shape coefficients of a rig recursively, frame by frame; arguments as of `align`.

    Those of clothes, where a person wears any, follow those of the body.
    """

    def __init__(
        self, shape: ArticulatedShape, fit_shape: bool | str, seed: int = 0, upright: Direction | None = None,
        clothed: bool | str = False,
    ) -> None:  # fmt: skip
        self._clothed = may_be_clothed(shape, clothed, fit_shape)
        self._bare = fitted_rig(shape, fit_shape)
        self._config = AlignConfig(nan_policy="omit", upright=upright, seed=seed)
        self.body_count = len(self._bare.coefficient_space())
        self._wear(self._bare)

    def _wear(self, rig: ArticulatedShape) -> None:
        """Go on with a rig, bare or with clothes."""
        self.rig, seed = rig, self._config.seed
        self.space = self.rig.coefficient_space()
        tree, generator = ShapedTree(self.rig, self.space), torch.Generator().manual_seed(seed)
        self._model, self._skin = surface_skins(
            tree, self.rig.file_surface(), self._config.num_model_points, generator
        )  # fmt: skip
        self._size = model_size(self._model)
        joints = joint_precision(self.rig, self._size, self._config.prior_std)
        self._precision = plausible_precision(self.rig, self._size, joints).double()

    def initialize(self, data: Tensor | DepthFrame, start: Tensor | None) -> tuple[Tensor, KnownPerson] | None:
        """Return the pose (num_dofs,) and coefficients of a first frame; None where the shape is not found."""
        found = align(self._bare, data, start, fit_shape=True, clothed=self._clothed, config=self._config)
        mean, covariance = found.coefficients, found.coefficient_covariance
        shows = found.statuses[0] in (Status.CONVERGED, Status.MAX_STEPS, Status.DOUBTFUL)
        if not shows or mean is None or covariance is None:
            return None
        if found.clothing_offset is not None:
            self.of(self.body_count + CLOTH.num_modes)
            modes: Tensor = self.space.get_buffer("modes").double()
            worn = torch.linalg.lstsq(modes, found.clothing_offset.to(modes)[:, None]).solution[:, 0]
            mean = torch.cat([mean, worn.to(mean)])
            covariance = torch.block_diag(covariance, torch.eye(len(worn)).to(covariance))
        return found.pose, KnownPerson(mean, covariance, covariance.new_zeros(len(mean), self.rig.num_parts))

    def of(self, count: int) -> None:
        """Go on with a rig of a number of coefficients, those of clothes included."""
        if count > self.body_count and count != len(self.space):
            # Buffers of clothes must not be inference tensors.
            with torch.inference_mode(False), torch.no_grad():
                self._wear(clothed_rig(self._bare))

    def fit(self, person: KnownPerson, scan: OrientedScan, start: Tensor, motion: Motion | None) -> PersonFit:
        """Return pose and coefficients after another frame, from a start (D,) near its pose.

        The iterated Kalman filter as Gauss-Newton (Bell and Cathey 1993): ``|d(x, c)|^2_W + |(x, c) - (m, c_0)|^2_P``
        is least, with P the information of all frames before, whose poses are marginalized. Joints follow
        ``x = r + a (m - r) + w``, ``a^2 = 1 - q^2 / s^2``, with q the deviation of the motion and s that of poses about
        rest r: what no data show returns to rest, and is never known better or worse than it is told. Without a motion
        poses are independent of those before. Errors of the model's parts are the same in all frames: they are
        considered, not estimated.
        """
        terms = self._terms(scan)
        center, prior, sensitivity = self._prior(person, start, motion)
        tree, dofs, state = self._skin.shape, self.rig.num_dofs, torch.cat([start, center[0, len(start) :]])[None]
        for _ in range(_UPDATE.steps):
            _, hessian, gradient = self._normal_equations(*terms, scan, state)
            gradient = gradient + prior @ tree.difference(center, state)[0].double()
            step = -torch.linalg.solve(hessian + prior, gradient).to(state)
            moved = tree.retract(state, step[None])
            inside = torch.minimum(torch.maximum(moved, tree.lower), tree.upper)
            state = torch.cat([moved[:, :6], inside[:, 6:]], dim=-1)
        rows, hessian, _ = self._normal_equations(*terms, scan, state)
        covariance = torch.linalg.inv(hessian + prior)
        moves = rows.part_gradients(terms[0], scan.data, state)[0].double()
        sensitivity = covariance @ (prior @ sensitivity - moves)
        error = self._error(state, step, covariance)
        known = KnownPerson(state[0, dofs:], covariance.to(state), sensitivity.to(state))
        return PersonFit(state[0, :dofs], step[:dofs], known, error)

    def joined(self, person: KnownPerson, scan: OrientedScan, pose: Tensor) -> PersonFit:
        """Return a person found by `initialize`, together with a pose (D,), in a frame that counts once."""
        state, count = torch.cat([pose, person.coefficients.to(pose)])[None], len(person.coefficients)
        _, hessian, _ = self._normal_equations(*self._terms(scan), scan, state)
        known = torch.linalg.inv(person.covariance.double())
        hessian = hessian + torch.cat([self._precision, known.diagonal()]).diag()
        error = self._error(state, torch.zeros_like(state[0]), torch.linalg.inv(hessian))
        hessian[-count:, -count:] += known - shared_information(hessian, self.rig.num_dofs)
        sensitivity = pad(person.sensitivity, (0, 0, self.rig.num_dofs, 0))
        joint = KnownPerson(person.coefficients, torch.linalg.inv(hessian).to(person.covariance), sensitivity)
        return PersonFit(pose, torch.zeros_like(pose), joint, error)

    def _error(self, state: Tensor, last_step: Tensor, covariance: Tensor) -> SurfaceError:
        """Return the errors of the surface in a state (1, D + K) with a covariance, after a step (D + K,)."""
        _, moves = self._model.row_jacobian(state)
        moved = (moves @ last_step).square().sum(-1).mean(-1).sqrt()
        return SurfaceError.of(self._model, moves, covariance[None].to(state), moved)

    def _prior(self, person: KnownPerson, start: Tensor, motion: Motion | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mean (1, D + K) of pose and coefficients before a frame, its information and its sensitivity."""
        dofs, count = self.rig.num_dofs, len(person.coefficients)
        if motion is None or len(person.covariance) == count:
            alone, center = person.alone, torch.cat([start, person.coefficients.to(start)])[None]
            information = torch.block_diag(self._precision.diag(), torch.linalg.inv(alone.covariance.double()))
            return center, information, pad(alone.sensitivity, (0, 0, dofs, 0)).double()
        moved, kept = pad(motion.std.double().square(), (0, count)), torch.ones(dofs + count, dtype=torch.float64)
        kept[6:dofs] = (1 - moved[6:dofs] * self._precision[6:]).clamp_min(0).sqrt()
        moved[6:dofs] = (1 - kept[6:dofs].square()) / self._precision[6:]
        rest = self.rig.rest[6:]
        joints = rest + kept[6:dofs].to(rest) * (motion.pose[6:] - rest)
        center = torch.cat([motion.pose[:6], joints, person.coefficients.to(start)])[None]
        covariance = kept.unsqueeze(-1) * person.covariance.double() * kept + moved.diag()
        return center, torch.linalg.inv(covariance), kept.unsqueeze(-1) * person.sensitivity.double()

    def _terms(self, scan: OrientedScan) -> tuple[ShapedSurface, OutsideTerm | None]:
        """Return the surface for a scan, and what skin outside of it costs where it is closed."""
        surface = ShapedSurface(self._skin, scan.normals, SURFACE_FIT.max_width * self._size)
        outside = OutsideTerm.of_scans(self._model, scan.data, scan.valid, scan.normals, self._size)
        return surface, outside if bool(outside.weight.any()) else None

    def differs(self, first: Tensor, second: Tensor) -> bool:
        """Return whether two people with coefficients (K,) differ, at rest, by more than a model is exact."""
        vertices = self.space.rest(torch.stack([first, second]).to(self.space.mean))[0]
        moved = (vertices[0] - vertices[1]).square().sum(-1).mean().sqrt()
        return float(moved) > SURFACE_FIT.min_noise(self._size)

    def _normal_equations(
        self, surface: ShapedSurface, outside: OutsideTerm | None, scan: OrientedScan, state: Tensor
    ) -> tuple[RobustRows, Tensor, Tensor]:
        """Return the data's rows, and Gauss-Newton Hessian (D + K, D + K) and gradient (D + K,) of a frame, float64."""
        rows = robust_rows(surface, scan.data, scan.valid, state, self._size)
        factor = (rows.weights.sqrt() / rows.noise.unsqueeze(-1))[0].double()
        jacobian = rows.jacobian[0].double() * factor.unsqueeze(-1)
        hessian, gradient = jacobian.mT @ jacobian, jacobian.mT @ (rows.distance[0].double() * factor)
        if outside is None:
            return rows, hessian, gradient
        found = outside.linearized(state, rows.width, rows.noise)
        return rows, hessian + found.hessian[0].double(), gradient + found.gradient[0].double()
