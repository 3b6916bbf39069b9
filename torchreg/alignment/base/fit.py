"""The fit of a robot's base, and of offsets of its joints, to all frames of a calibration together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

from torchreg.alignment.base.frames import BaseFrame, carrier
from torchreg.alignment.fit.free_space_term import FreeSpaceTerm
from torchreg.alignment.fit.problem import independent_share, masked_mean
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.capture.free_space import FreeSpace
from torchreg.geometry.rigid import invert_rigid, rigid_matrix
from torchreg.geometry.rotation import skew, so3_exp, so3_log
from torchreg.shapes.pose_algebra import BASE_DOFS, retract, shifted
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import ShapeSurface
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt
from torchreg.solvers.robust import welsch_system


@dataclass(frozen=True)
class BaseFitNumbers:
    """Numbers of the fit of a base; lengths are shares of the model's size."""

    start: float = 0.09  # first kernel
    stop: float = 0.03  # of the kernel before the last one, which follows from the noise
    steps: int = 3  # at each of them
    last_steps: int = 20  # of each round at the last one, at most
    rounds: int = 8  # at the last one, at most
    atol: float = 1e-4  # change that ends it, metres and radians
    depth_std: float = 0.02  # by which all measured surfaces may lie off the true ones, along their normals
    offset_std: float = 0.05  # of a joint's offset about zero, radians: three degrees
    slide_std: float = 0.01  # the same of joints that slide
    max_posterior_to_prior_std: float = 0.3  # of an offset that the data determine


BASE_FIT = BaseFitNumbers()
# The base, then one number for the depth, then the joints' offsets.
_DEPTH, _OFFSETS = BASE_DOFS, BASE_DOFS + 1


@dataclass(frozen=True, eq=False)
class BaseProblem:
    """All frames of a calibration. A state (1, 7 + J) is the base, a depth offset in metres, and the joints' offsets.

    The base is a translation and a rotation vector; `shares` are the independent parts of each frame's data; `free`
    (J,) is True for joints with an offset. Where a link carries the camera, the "base" of a state is ``T_camera_link``,
    and that of each frame follows from its joints.
    """

    frames: tuple[BaseFrame, ...]
    shares: tuple[float, ...]
    surface: ShapeSurface
    skin: LinearBlendSkin
    size: float
    free: Tensor
    camera_part: int | None = None

    @classmethod
    def of(
        cls, surface: ShapeSurface, skin: LinearBlendSkin, size: float, camera_part: int | None = None
    ) -> BaseProblem:
        """Return the problem without frames and offsets; ``camera_part`` is the link that carries the camera."""
        free = torch.zeros(skin.shape.num_dofs - BASE_DOFS, dtype=torch.bool)
        return cls((), (), surface, skin, size, free, camera_part)

    def of_frames(self, frames: Sequence[BaseFrame]) -> BaseProblem:
        """Return the problem of other frames."""
        shares = tuple(independent_share(frame.points, self.size) for frame in frames)
        return replace(self, frames=tuple(frames), shares=shares)

    def state(self, base: Tensor) -> Tensor:
        """Return the state (1, 7 + J) of a base (4, 4) without offsets."""
        vector = torch.cat([base[:3, 3], so3_log(base[None, :3, :3])[0]])
        return pad(vector, (0, 1 + len(self.free)))[None]

    def precision(self) -> Tensor:
        """Return the precision (7 + J,) of the prior about zero."""
        slides = self.skin.shape.is_sliding[BASE_DOFS:].cpu()
        std = torch.where(slides, BASE_FIT.slide_std * self.size, BASE_FIT.offset_std).double()
        head = torch.tensor([0.0] * BASE_DOFS + [(BASE_FIT.depth_std * self.size) ** -2], dtype=torch.float64)
        return torch.cat([head, std**-2])

    def poses(self, state: Tensor) -> Tensor:
        """Return the pose (T, num_dofs), float64, of each frame in its camera's coordinates."""
        joints = torch.stack([frame.joints for frame in self.frames]) + state[0, _OFFSETS:]
        bases = base_of(state) @ invert_rigid(carrier(self.skin.shape, joints, self.camera_part))
        return torch.cat([bases[:, :3, 3], so3_log(bases[:, :3, :3]), joints], dim=-1)

    def _chart(self, state: Tensor) -> Tensor:
        """Return the derivatives (T, 6 + J, 6 + J) of poses by the state without depth."""
        shape, part, poses = self.skin.shape, self.camera_part, self.poses(state)
        chart = torch.eye(poses.shape[-1], dtype=torch.float64).repeat(len(poses), 1, 1)
        if part is None:
            return chart
        moves = shape.transform_jacobian(poses.to(shape.rest), chart="tangent")
        rows, derivative = (value.cpu().double() for value in moves)
        link = rows[:, 4 * part : 4 * part + 4].mT
        moved = derivative[:, 4 * part : 4 * part + 4, :, BASE_DOFS:].movedim(-1, 1).mT
        spin = moved[..., :3] @ link[:, None, :, :3].mT
        turn = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], dim=-1)
        # The link stays where it is in the camera: the base moves against it, turned about the link.
        base = poses[:, None, :3]
        shift = -moved[..., 3] - torch.linalg.cross(turn, base - link[:, None, :, 3])
        chart[:, :BASE_DOFS, BASE_DOFS:] = torch.cat([shift, -turn], dim=-1).mT
        chart[:, :3, 3:BASE_DOFS] = -skew(base[:, 0] - state[0, :3])
        return chart

    @cached_property
    def data(self) -> tuple[Tensor, Tensor, Tensor]:
        """The data (T, M, 3) of all frames, float64, which of them are no padding (T, M), and their means (T, 3)."""
        points = pad_sequence([frame.points for frame in self.frames], batch_first=True)
        counts = torch.tensor([len(frame.points) for frame in self.frames])
        valid = torch.arange(points.shape[1]) < counts.unsqueeze(-1)
        return points, valid, masked_mean(points, valid)

    @cached_property
    def free_space(self) -> tuple[Tensor, FreeSpaceTerm] | None:
        """The frames (R,) with a mask, and what their skin costs beside it, about the means of their data."""
        index = [number for number, frame in enumerate(self.frames) if frame.free_space is not None]
        spaces = [frame.free_space for frame in self.frames if frame.free_space is not None]
        if not spaces:
            return None
        space = FreeSpace.stacked(spaces).to(self.skin.shape.rest).moved(self.data[2][index])
        term = FreeSpaceTerm.of_skin(space, self.skin, size=0.0)
        return torch.tensor(index), term.thinned(torch.tensor(self.shares)[index].reciprocal().to(term.skin.points))

    def _distances(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distance (T, M) of the data from the surface as it was measured, and the Jacobian (T, M, 8 + J).

        The Jacobian is that by the poses, the depth, and the relative error of all distances from the camera.
        """
        points, _, origin = self.data
        centered = (points - origin.unsqueeze(1)).to(self.skin.shape.rest)
        found = self.surface.distance_jacobian(centered, self._centered(state))
        distance, by_pose = (value.cpu().double() for value in found)
        by_scale = -(by_pose[..., :3] * points).sum(-1, keepdim=True)
        return distance - state[0, _DEPTH], torch.cat([by_pose, -torch.ones_like(by_scale), by_scale], dim=-1)

    def _centered(self, state: Tensor) -> Tensor:
        """Return the poses (T, num_dofs) about the means of the data, where float32 is precise."""
        return shifted(self.poses(state), -self.data[2]).to(self.skin.shape.rest)

    def residuals(self, state: Tensor) -> Tensor:
        """Return the distance (T, M) of the data from the surface as it was measured, float64, NaN where they pad."""
        return torch.where(self.data[1], self._distances(state)[0], torch.nan)

    def facing(self, state: Tensor) -> Tensor:
        """Return which data (T, M) lie on surfaces that face the camera, the only ones that it can have measured."""
        return (self._distances(state)[1][..., -1] < 0) & self.data[1]

    def systems(self, state: Tensor, seen: Tensor, sigma: float, noise: float) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian (T, 8 + J) of each frame's data ``seen`` (T, M) alone.

        The unknowns are those of the state, all joints free, and the relative error of all distances from the camera.
        """
        distance, jacobian = self._distances(state)
        sigmas, noises = (torch.full_like(distance[:, 0], value) for value in (sigma, noise))
        weights = seen * torch.tensor(self.shares, dtype=torch.float64).unsqueeze(-1)
        found = welsch_system(distance, jacobian, weights, sigmas, noises)
        if self.free_space is not None:
            index, term = self.free_space
            poses = self._centered(state)[index]
            beside = term.linearized(poses, sigmas[index].to(poses), noises[index].to(poses))
            padded = beside.cost, pad(beside.gradient, (0, 2)), pad(beside.hessian, (0, 2, 0, 2))
            for total, part in zip(found, padded, strict=True):
                total.index_add_(0, index, part.cpu().double())
        chart = pad(self._chart(state), (0, 2, 0, 2))
        chart[:, -2:, -2:] = torch.eye(2)
        # The depth of a state comes after its base.
        order = [*range(BASE_DOFS), -2, *range(BASE_DOFS, chart.shape[-1] - 2), -1]
        chart = chart[..., order]
        gradient = (chart.mT @ found.gradient.unsqueeze(-1)).squeeze(-1)
        return Linearization(found.cost, gradient, chart.mT @ found.hessian @ chart)

    def linearize(self, state: Tensor, seen: Tensor, sigma: float, noise: float) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian of the data ``seen`` (T, M); sigma and noise in metres."""
        frames, prior = self.systems(state, seen, sigma, noise), self.precision()
        held = torch.cat([torch.zeros(_OFFSETS, dtype=torch.bool), ~self.free])
        cost = frames.cost.sum(0, keepdim=True) + 0.5 * (prior * state.square()).sum(-1)
        gradient = (frames.gradient[:, :-1].sum(0, keepdim=True) + prior * state).masked_fill(held, 0.0)
        hessian = frames.hessian[:, :-1, :-1].sum(0, keepdim=True) + prior.diag()
        return Linearization(cost, gradient, hessian.masked_fill(held | held.unsqueeze(-1), 0.0))


@dataclass(frozen=True, eq=False)
class BaseFit:
    """A state (1, 7 + J) fitted to frames, the last kernel's width and the robust noise of the residuals, metres."""

    problem: BaseProblem
    state: Tensor
    sigma: float
    noise: float
    converged: bool

    @property
    def base(self) -> Tensor:
        """``T_camera_base`` (4, 4)."""
        return base_of(self.state)[0]

    @property
    def offsets(self) -> Tensor:
        """Offsets (J,) of the joints."""
        return self.state[0, _OFFSETS:]

    def linearization(self) -> Linearization:
        """Return the problem about the state."""
        return self.problem.linearize(self.state, self.problem.facing(self.state), self.sigma, self.noise)

    @property
    def depth(self) -> float:
        """Distance by which all data lie outside of the surface, metres."""
        return float(self.state[0, _DEPTH])


def base_of(state: Tensor) -> Tensor:
    """Return the bases (T, 4, 4) of states or poses (T, D)."""
    return rigid_matrix(so3_exp(state[:, 3:BASE_DOFS]), state[:, :3])


def fit_base(problem: BaseProblem, state: Tensor, widths: Sequence[float]) -> BaseFit:
    """Return the state after a fit with kernels of some widths, shares of the size, and one that follows the noise."""
    state = approach_base(problem, state, widths)
    residual = problem.residuals(state).flatten()
    noise = float(surface_noise(residual, residual.isfinite(), problem.size))
    sigma = SURFACE_FIT.width_per_noise * noise
    for _ in range(BASE_FIT.rounds):
        before, state = state, _solve(problem, state, sigma, noise, BASE_FIT.last_steps)
        converged = float((state - before).abs().max()) <= BASE_FIT.atol
        if converged:
            break
    return BaseFit(problem=problem, state=state, sigma=sigma, noise=noise, converged=converged)


def approach_base(problem: BaseProblem, state: Tensor, widths: Sequence[float]) -> Tensor:
    """Return the state after a few steps with a kernel of each of some widths, shares of the size."""
    noise = SURFACE_FIT.max_noise(problem.size)
    for width in widths:
        state = _solve(problem, state, width * problem.size, noise, BASE_FIT.steps)
    return state


def _solve(problem: BaseProblem, state: Tensor, sigma: float, noise: float, steps: int) -> Tensor:
    """Return the state after steps on the data that are seen in the given one."""
    linearize = partial(problem.linearize, seen=problem.facing(state), sigma=sigma, noise=noise)
    found = levenberg_marquardt(linearize, state, retract=retract, max_steps=steps, atol=BASE_FIT.atol)
    return found.state


def _inverse(hessian: Tensor) -> Tensor:
    """Return the inverse (D, D) of a Hessian on the variables that have a curvature, zero for the others."""
    index = (hessian.diagonal() > 0).nonzero()[:, 0]
    scale = hessian.diagonal()[index].rsqrt()
    outer = scale.unsqueeze(-1) * scale
    found = torch.zeros_like(hessian)
    found[index.unsqueeze(-1), index] = outer * torch.linalg.pinv(hessian[index.unsqueeze(-1), index] * outer)
    return found


def fit_offsets(fit: BaseFit) -> BaseFit:
    """Return a fit with offsets of the joints that the data determine; the least determined is locked in turn."""
    problem = replace(fit.problem, free=torch.ones_like(fit.problem.free))
    found = fit_base(problem, fit.state, widths=())
    prior, hessian = problem.precision()[_OFFSETS:].rsqrt(), found.linearization().hessian[0]
    free = problem.free.clone()
    while bool(free.any()):
        kept = torch.cat([torch.ones(_OFFSETS, dtype=torch.bool), free])
        std = _inverse(hessian.masked_fill(~kept | ~kept.unsqueeze(-1), 0.0)).diagonal()[_OFFSETS:].sqrt()
        worst = int(torch.where(free, std / prior, 0.0).argmax())
        if float(std[worst]) <= BASE_FIT.max_posterior_to_prior_std * float(prior[worst]):
            break
        free[worst] = False
    state = fit.state.clone()
    state[0, _OFFSETS:] = torch.where(free, found.state[0, _OFFSETS:], 0.0)
    return fit_base(replace(problem, free=free), state, widths=(BASE_FIT.stop,))


@dataclass(frozen=True)
class _ModelErrors:
    """Standard deviations of what no averaging over data removes."""

    lever: float = 0.5  # of the size, over which a joint turns its links off the data by their noise
    depth_scale: float = 0.005  # relative error of a depth camera's distances, the same in all frames
    least_frames: int = 3  # that are left out in turn; the spread of fewer is unknown


_ERRORS = _ModelErrors()
_FIT = BASE_DOFS + 1  # variables without the joints: the base and the depth offset


def base_covariance(fit: BaseFit) -> tuple[Tensor, Tensor]:
    """Return the covariance (6, 6) of the base and the standard deviations (J,) of the offsets, float64.

    Data of a link share the error of its mesh, its joints and its mask. So joints and depth offset vary in two levels,
    from frame to frame and in all frames alike, by as much as moves a link by the noise; the camera's scale of depth
    varies alike in all. The first are marginalized (a linear mixed model), the scale is considered, and the jackknife
    covariance over frames, which sees errors without a model, is added.

    References: Laird and Ware 1982; Schmidt 1966; Efron and Stein 1981.
    """
    prior, seen = fit.problem.precision(), fit.problem.facing(fit.state)
    _, gradients, hessians = fit.problem.systems(fit.state, seen, fit.sigma, fit.noise)
    slides = fit.problem.skin.shape.is_sliding[BASE_DOFS:].cpu()
    joint_std = torch.where(slides, fit.noise, fit.noise / (_ERRORS.lever * fit.problem.size)).double()
    shared = torch.where(fit.problem.free, prior[_FIT:], joint_std**-2)
    own = pad(torch.cat([torch.tensor([fit.noise]).double(), joint_std]).square(), (BASE_DOFS, 1))
    identity = torch.eye(len(own), dtype=torch.float64)
    information = torch.linalg.solve(identity + hessians * own, hessians).sum(0)
    by_scale, information = information[:-1, -1], information[:-1, :-1] + torch.diag(torch.cat([prior[:_FIT], shared]))
    found = torch.linalg.pinv(0.5 * (information + information.mT), hermitian=True)
    # The fit takes the scale for right, so what it explains wrongly by the base stays whatever the data (Schmidt).
    moved = _ERRORS.depth_scale * (found @ by_scale)
    found = found + moved.unsqueeze(-1) * moved
    base = found[:BASE_DOFS, :BASE_DOFS]
    if len(hessians) >= _ERRORS.least_frames:
        base = base + _jackknife(gradients[:, :_FIT], hessians[:, :_FIT, :_FIT], torch.diag(prior[:_FIT]))
    offset_std = found.diagonal()[_FIT:].clamp_min(0).sqrt()
    return base, torch.where(fit.problem.free, offset_std, 0.0)


def _jackknife(gradients: Tensor, hessians: Tensor, prior: Tensor) -> Tensor:
    """Return the jackknife covariance (6, 6) of one Newton step without each of T frames."""
    count = len(hessians)
    left = hessians.sum(0) + prior - hessians
    moved = (torch.linalg.pinv(left, hermitian=True) @ gradients.unsqueeze(-1))[:, :BASE_DOFS, 0]
    moved = moved - moved.mean(0)
    return (count - 1) / count * moved.mT @ moved
