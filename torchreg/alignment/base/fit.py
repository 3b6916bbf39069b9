"""The fit of a robot's base, and of offsets of its joints, to all frames of a calibration together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

from torchreg.alignment.base.frames import BaseFrame, carrier
from torchreg.alignment.fit.patches import independent_share
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.capture.free_space import FreeSpace
from torchreg.geometry.neighbors import sampling_distance
from torchreg.geometry.rigid import invert_rigid, rigid_matrix
from torchreg.geometry.rotation import skew, so3_exp, so3_log
from torchreg.shapes.pose_algebra import BASE_DOFS, retract
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import ShapeSurface
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt
from torchreg.solvers.robust import welsch_weight


@dataclass(frozen=True)
class BaseFitNumbers:
    """Numbers of the fit of a base; lengths are shares of the model's size."""

    widths: tuple[float, ...] = (0.09, 0.05, 0.03)  # of the kernel before the last one, which follows from the noise
    steps: int = 3  # at each of them
    last_steps: int = 20  # of each round at the last one, at most
    rounds: int = 8  # at the last one, at most
    atol: float = 1e-4  # change that ends it, metres and radians
    depth_std: float = 0.02  # by which all measured surfaces may lie off the true ones, along their normals
    offset_std: float = 0.05  # of a joint's offset about zero, radians: three degrees
    slide_std: float = 0.01  # the same of joints that slide
    max_posterior_to_prior_std: float = 0.3  # of an offset that the data determine
    space_share: float = 0.25  # of its area that a surface shows from a direction, on average (Cauchy)


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
        cls,
        frames: Sequence[BaseFrame],
        surface: ShapeSurface,
        skin: LinearBlendSkin,
        size: float,
        camera_part: int | None = None,
    ) -> BaseProblem:
        """Return the problem without offsets; ``camera_part`` is the number of the link that carries the camera."""
        shares = tuple(independent_share(frame.points, size) for frame in frames)
        free = torch.zeros(skin.shape.num_dofs - BASE_DOFS, dtype=torch.bool)
        return cls(tuple(frames), shares, surface, skin, size, free, camera_part)

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
        """Return the pose (T, num_dofs) of each frame, in the shape's dtype."""
        joints = torch.stack([frame.joints for frame in self.frames]) + state[0, _OFFSETS:]
        bases = base_of(state) @ invert_rigid(carrier(self.skin.shape, joints, self.camera_part))
        base = torch.cat([bases[:, :3, 3], so3_log(bases[:, :3, :3])], dim=-1)
        return torch.cat([base, joints], dim=-1).to(self.skin.shape.rest)

    def _chart(self, state: Tensor, poses: Tensor) -> Tensor | None:
        """Return the derivatives (T, 6 + J, 6 + J) of poses by the state without depth; None where they are one."""
        if self.camera_part is None:
            return None
        shape, part, count = self.skin.shape, self.camera_part, poses.shape[-1]
        rows, derivative = (value.cpu().double() for value in shape.transform_jacobian(poses, chart="tangent"))
        link = rows[:, 4 * part : 4 * part + 4].mT
        moved = derivative[:, 4 * part : 4 * part + 4, :, BASE_DOFS:].movedim(-1, 1).mT
        spin = moved[..., :3] @ link[:, None, :, :3].mT
        turn = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], dim=-1)
        # The link stays where it is in the camera: the base moves against it, turned about the link.
        base = poses[:, None, :3].cpu().double()
        shift = -moved[..., 3] - torch.linalg.cross(turn, base - link[:, None, :, 3])
        chart = torch.eye(count, dtype=torch.float64).repeat(len(poses), 1, 1)
        chart[:, :BASE_DOFS, BASE_DOFS:] = torch.cat([shift, -turn], dim=-1).mT
        chart[:, :3, 3:BASE_DOFS] = -skew(base[:, 0] - state[0, :3])
        return chart

    @cached_property
    def data(self) -> tuple[Tensor, Tensor]:
        """The data of all frames (T, M, 3), in the shape's dtype, and which of them are (T, M): the rest pads."""
        rows = [frame.points.to(self.skin.shape.rest) for frame in self.frames]
        valid = [torch.ones(len(row), dtype=torch.bool) for row in rows]
        return pad_sequence(rows, batch_first=True), pad_sequence(valid, batch_first=True)

    @cached_property
    def skin_area(self) -> float:
        """The area that a point of the skin stands for, square metres."""
        return sampling_distance(self.skin.points) ** 2

    def residuals(self, state: Tensor) -> list[Tensor]:
        """Return the distance (M,) of each frame's data from the surface as it was measured, float64."""
        points, valid = self.data
        distance = self.surface.distance(points, self.poses(state)).cpu().double() - state[0, _DEPTH]
        return [row[kept] for row, kept in zip(distance, valid, strict=True)]

    def facing(self, state: Tensor) -> Tensor:
        """Return which data (T, M) lie on surfaces that face the camera, the only ones that it can have measured."""
        points, valid = self.data
        jacobian = self.surface.distance_jacobian(points, self.poses(state))[1]
        return ((jacobian[..., :3] * points).sum(-1) > 0) & valid

    def linearize(self, state: Tensor, seen: Tensor, sigma: float, noise: float) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian of the data ``seen`` (T, M); sigma and noise in metres."""
        prior = self.precision()
        cost, gradient, hessian = 0.5 * (prior * state[0].square()).sum(), prior * state[0], torch.diag(prior)
        for residual, jacobian, weight in self.terms(state, seen):
            beta = welsch_weight((residual / sigma).square())
            weighted = jacobian * (weight * beta / noise**2).unsqueeze(-1)
            cost = cost + 0.5 * (weight * (1 - beta)).sum() * (sigma / noise) ** 2
            gradient, hessian = gradient + weighted.mT @ residual, hessian + weighted.mT @ jacobian
        held = torch.cat([torch.zeros(_OFFSETS, dtype=torch.bool), ~self.free])
        gradient = gradient.masked_fill(held, 0.0)
        return Linearization(cost[None], gradient[None], hessian.masked_fill(held | held.unsqueeze(-1), 0.0)[None])

    def terms(self, state: Tensor, seen: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Yield residuals (N,), their Jacobian (N, 7 + J) and weights (N,): of the data, and of what is not there."""
        poses = self.poses(state)
        distance, jacobian = self.surface.distance_jacobian(self.data[0], poses)
        chart = self._chart(state, poses)
        jacobian = jacobian if chart is None else jacobian.cpu().double() @ chart
        weight = torch.tensor(self.shares, dtype=torch.float64).unsqueeze(-1).expand(seen.shape)
        yield distance[seen].cpu().double() - state[0, _DEPTH], _with_depth(jacobian[seen], -1.0), weight[seen]
        rows, derivatives = self.skin.shape.transform_jacobian(poses, chart="tangent")
        placed = self.skin.place(rows)
        if chart is not None:
            derivatives = (derivatives.cpu().double() @ chart.unsqueeze(1)).to(derivatives)
        for frame, share, points, derivative in zip(self.frames, self.shares, placed, derivatives, strict=True):
            if frame.free_space is not None:
                yield self._beside(frame.free_space, share, points, derivative)

    def _beside(
        self, space: FreeSpace, share: float, points: Tensor, derivative: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return residuals, Jacobian and weights of the skin's points (N, 3) where a frame saw nothing."""
        intrusion, slope = (value[0].to(points) for value in space.intrusion_gradient(points[None].to(space.depth)))
        along = (self.skin.basis.unsqueeze(-1) * slope.unsqueeze(-2)).flatten(-2)
        shown = BASE_FIT.space_share * self.skin_area / float(space.datum_area) / points[:, 2].double().mean().square()
        weight = (share * shown).expand(len(points))
        return intrusion.cpu().double(), _with_depth(along @ derivative.flatten(-3, -2), 0.0), weight


def _with_depth(jacobian: Tensor, by_depth: float) -> Tensor:
    """Return a Jacobian (N, 6 + J) by poses as one (N, 7 + J) by states, float64."""
    base, joints = jacobian.cpu().double().split([BASE_DOFS, jacobian.shape[-1] - BASE_DOFS], dim=-1)
    return torch.cat([base, torch.full_like(base[:, :1], by_depth), joints], dim=-1)


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


def fit_base(problem: BaseProblem, state: Tensor, widths: Sequence[float] = BASE_FIT.widths) -> BaseFit:
    """Return the state after a fit with kernels of some widths, shares of the size, and one that follows the noise."""
    state = approach_base(problem, state, widths)
    residual = torch.cat(problem.residuals(state))
    noise = float(surface_noise(residual, torch.ones_like(residual, dtype=torch.bool), problem.size))
    sigma = SURFACE_FIT.width_per_noise * noise
    for _ in range(BASE_FIT.rounds):
        before, state = state, _solve(problem, state, sigma, noise, BASE_FIT.last_steps)
        converged = float((state - before).abs().max()) <= BASE_FIT.atol
        if converged:
            break
    return BaseFit(problem=problem, state=state, sigma=sigma, noise=noise, converged=converged)


def approach_base(problem: BaseProblem, state: Tensor, widths: Sequence[float] = BASE_FIT.widths) -> Tensor:
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
    return fit_base(replace(problem, free=free), state, widths=BASE_FIT.widths[-1:])
