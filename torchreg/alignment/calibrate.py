"""Fitting the size and the proportions of an articulated shape to a few clouds of it in different poses."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_finite, check_positive, check_shape
from torchreg.alignment.align import AlignConfig, align
from torchreg.alignment.annealed_em import FINAL_SIGMA_RANGE, SIGMA_PER_NOISE, SURFACE_SIGMAS, surface_noise
from torchreg.alignment.results import Calibration
from torchreg.errors import InputError, InputTypeError
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import fuse
from torchreg.shapes.skin import sample_skin
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt
from torchreg.solvers.robust import welsch_loss, welsch_weight

# Residuals near each other share what the model gets wrong: they weigh as if their noise were this much larger.
_SHARED_ERROR = 1.5
# No part shrinks or grows beyond this factor of what it was.
_MAX_LOG_SCALE = 0.7


@dataclass(frozen=True)
class CalibrateConfig:
    """How a calibration runs.

    Args:
        align: how every frame is aligned before the joint fits.
        rounds: times that frames are aligned one by one and then fitted together with the shape.
        steps: Levenberg-Marquardt steps at each width of a joint fit.
        size_std: standard deviation of the logarithm of the overall size about the shape's own.
        radius_std: of the logarithm of all radii beyond the overall size.
        part_std: of the logarithms of each part's length and radius beyond those; parts that are not seen keep to the
            overall size.
        max_points: data per frame that the joint fits use; drawn evenly from frames with more.
    """

    align: AlignConfig = field(default_factory=AlignConfig)
    rounds: int = 2
    steps: int = 8
    size_std: float = 0.2
    radius_std: float = 0.05
    part_std: float = 0.045
    max_points: int = 2000

    def __post_init__(self) -> None:
        for name in ("rounds", "steps", "max_points"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int):
                raise InputTypeError(f"{name} must be an integer, got {type(value).__name__}")
            if value < 1:
                raise InputError(f"{name} must be at least 1, got {value}")
        for name in ("size_std", "radius_std", "part_std"):
            check_positive(getattr(self, name), name)


@dataclass(frozen=True)
class CalibrateRecord:
    """One joint fit at one kernel width, as given to ``on_step``.

    Args:
        round: number of the round.
        step: number of the fit in the round.
        num_steps: fits per round.
        sigma: kernel width, metres.
        cost: of the fit.
        poses: (T, num_dofs).
        log_length_scales: (P,).
        log_radius_scales: (P,).
    """

    round: int
    step: int
    num_steps: int
    sigma: float
    cost: float
    poses: Tensor
    log_length_scales: Tensor
    log_radius_scales: Tensor


def calibrate(
    shape: ArticulatedShape,
    frames: Tensor | Sequence[Tensor],
    initial_poses: Tensor | None = None,
    *,
    masks: Tensor | None = None,
    config: CalibrateConfig | None = None,
    on_step: Callable[[CalibrateRecord], None] | None = None,
) -> Calibration:
    """Return a copy of a shape whose lengths and radii, part by part, fit a few clouds of it in different poses.

    Frames are first aligned one by one; then all poses and all scales are fitted together to the surface distances of
    all data, robustly (eqs. 21 and 22 summed over the frames), with a hierarchical prior on the scales: one overall
    size, one ratio of radii to lengths, and small deviations of each part. Both are repeated with the better shape.

    Args:
        shape: where to start, in metres; it is not changed. Its solids are fitted, so it must not have come from a file
            with a mesh.
        frames: T clouds: (T, M, 3), or a sequence of (M_t, 3), metres. One to ten frames whose joints move help most.
        initial_poses: (T, num_dofs) or (num_dofs,) for all; the rest pose by default.
        masks: (T, M) False where data are padding; for frames in one tensor.
        config: see `CalibrateConfig`.
        on_step: called with a `CalibrateRecord` after each joint fit.

    Returns:
        a `Calibration`. Its status is FEW_INLIERS if a frame could not be aligned; such frames do not count.

    Raises:
        InputError: if frames are empty, not finite, or do not fit the poses, or the shape has a surface of its own.
        InputTypeError: if an argument has the wrong type.

    Differentiable: no.

    Cost: per step, a Jacobian of T M distances and a Cholesky factorization of size T num_dofs + 2 P.

    References: Dewaele et al. 2006, section 3.4, for the distances.
    """
    config = config or CalibrateConfig()
    if shape.surface is not None:
        raise InputError(
            "shape has the surface of a file, whose mesh cannot follow the scales; calibrate a shape made of solids"
        )
    with torch.no_grad():
        data, valid = _padded(shape, frames, masks, config.align.nan_policy)
        poses = _start_poses(shape, initial_poses, len(data))
        fitted = copy.deepcopy(shape).requires_grad_(False)
        prior = None
        for number in range(config.rounds):
            skin = sample_skin(fitted, config.align.num_model_points, sharpness=config.align.sharpness)
            size = float((skin.points.amax(0) - skin.points.amin(0)).norm())
            prior = _Prior.of(shape, poses, size, config) if prior is None else prior
            found = align(fitted, data, poses, model_points=skin, mask=valid, config=config.align)
            aligned = torch.tensor([status.usable for status in found.statuses], device=valid.device)
            problem = _JointProblem(fitted, data, valid & aligned.unsqueeze(-1), prior, size, config)
            better = problem.unexplained(found.pose) < problem.unexplained(poses)
            poses = torch.where(better.unsqueeze(-1), found.pose, poses)
            poses, cost, change = _fit(problem, poses, number, on_step)
    status = Status.CONVERGED if change <= config.align.pose_atol else Status.MAX_STEPS
    scales = fitted.log_length_scales.detach().clone(), fitted.log_radius_scales.detach().clone()
    for parameter, original in zip(fitted.parameters(), shape.parameters(), strict=True):
        parameter.requires_grad_(original.requires_grad)
    return Calibration(fitted, poses, *scales, cost, status if bool(aligned.all()) else Status.FEW_INLIERS)


def _fit(
    problem: _JointProblem, poses: Tensor, number: int, on_step: Callable[[CalibrateRecord], None] | None
) -> tuple[Tensor, Tensor, float]:
    """Return poses, cost and last change of a joint fit with a kernel that narrows to the noise."""
    state = problem.state(poses)
    for step in range(len(SURFACE_SIGMAS) + 1):
        if step < len(SURFACE_SIGMAS):
            sigma, noise = SURFACE_SIGMAS[step] * problem.size, FINAL_SIGMA_RANGE[1] * problem.size / SIGMA_PER_NOISE
        else:
            noise = problem.noise(state)
            sigma = SIGMA_PER_NOISE * noise
        solved = levenberg_marquardt(
            partial(problem.linearize, sigma=sigma, noise=_SHARED_ERROR * noise),
            state,
            retract=problem.retract,
            lower=problem.lower,
            upper=problem.upper,
            max_steps=problem.config.steps * (1 if step < len(SURFACE_SIGMAS) else 2),
            atol=problem.config.align.pose_atol * min(1.0, problem.size),
        )
        state = solved.state
        poses, scales = problem.parts(state)
        poses = poses + problem.shift
        if on_step is not None:
            on_step(
                CalibrateRecord(
                    number, step, len(SURFACE_SIGMAS) + 1, sigma, float(solved.cost), poses, *scales.chunk(2)
                )
            )
    problem.set_scales(scales)
    return poses, solved.cost[0], float(problem.change(solved.last_step))


@dataclass(frozen=True)
class _Prior:
    """Gaussians on the joints of all frames and on the scales.

    Args:
        poses: (T, num_dofs) means.
        pose_precision: (num_dofs,), zero for the base.
        scales: (2 P,) means, lengths before radii.
        scale_precision: (2 P, 2 P).
    """

    poses: Tensor
    pose_precision: Tensor
    scales: Tensor
    scale_precision: Tensor

    @classmethod
    def of(cls, shape: ArticulatedShape, poses: Tensor, size: float, config: CalibrateConfig) -> _Prior:
        """Return the prior about a shape of some size and poses."""
        pose_precision = torch.zeros_like(shape.rest)
        if config.align.prior_std is not None:
            slides = shape.is_sliding[6:]
            pose_precision[6:] = torch.where(slides, size, 1.0).mul(config.align.prior_std).square().reciprocal()
        scales = torch.cat([shape.log_length_scales, shape.log_radius_scales]).detach()
        radial = torch.arange(len(scales)) >= shape.num_parts
        covariance = (
            config.size_std**2
            + config.radius_std**2 * torch.outer(radial, radial).double()
            + config.part_std**2 * torch.eye(len(scales), dtype=torch.float64)
        )
        return cls(poses, pose_precision, scales, covariance.inverse().to(scales))

    def add_to(self, problem: Linearization, poses: Tensor, scales: Tensor) -> Linearization:
        """Return the problem of one state with the prior added."""
        joints = (poses - self.poses).flatten()
        precision = self.pose_precision.expand_as(poses).flatten()
        offset = scales - self.scales
        pull = torch.cat([precision * joints, self.scale_precision @ offset])
        cost = 0.5 * pull @ torch.cat([joints, offset])
        curvature = torch.block_diag(precision.diag(), self.scale_precision)
        return Linearization(problem.cost + cost, problem.gradient + pull, problem.hessian + curvature)


class _JointProblem:
    """The poses of all frames and the scales of the shape as one least-squares problem.

    A state is one row: the poses of all frames, then lengths and radii. The shape carries the scales of the last state
    that was evaluated.

    Args:
        shape: changed in place.
        data: (T, M, 3), metres.
        valid: (T, M).
        prior: on poses and scales.
        size: of the shape, metres.
        config: of the calibration.
    """

    def __init__(
        self,
        shape: ArticulatedShape,
        data: Tensor,
        valid: Tensor,
        prior: _Prior,
        size: float,
        config: CalibrateConfig,
    ) -> None:
        self.shape, self.size, self.config = shape, size, config
        shape.log_length_scales.requires_grad_()
        # Strides rather than draws: frames are in no order that matters, and the result is the same every time.
        stride = -(-data.shape[1] // config.max_points)
        data, valid = data[:, ::stride], valid[:, ::stride]
        # Every frame's mean at the origin, where float32 is most precise.
        mean = (data * valid.unsqueeze(-1)).sum(-2) / valid.sum(-1, keepdim=True).clamp_min(1)
        self.data, self.valid = torch.where(valid.unsqueeze(-1), data - mean.unsqueeze(1), 0.0), valid
        self.shift = nn.functional.pad(mean, (0, shape.num_dofs - 3))
        self.prior = replace(prior, poses=prior.poses - self.shift)
        limits = (shape.lower - self.shift, -_MAX_LOG_SCALE), (shape.upper - self.shift, _MAX_LOG_SCALE)
        self.lower, self.upper = (torch.cat([poses.flatten(), prior.scales + reach]) for poses, reach in limits)

    def state(self, poses: Tensor) -> Tensor:
        """Return the state (1, T num_dofs + 2 P) of poses and of the shape as it is."""
        scales = self.shape.log_length_scales, self.shape.log_radius_scales
        return torch.cat([(poses - self.shift).flatten(), *scales]).unsqueeze(0)

    def parts(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return poses (T, num_dofs) about the frames' means, and scales (2 P,)."""
        poses, scales = state[0].tensor_split([self.shift.numel()])
        return poses.reshape(self.shift.shape), scales

    def set_scales(self, scales: Tensor) -> None:
        """Give the shape these lengths and radii (2 P,)."""
        for parameter, value in zip(
            (self.shape.log_length_scales, self.shape.log_radius_scales), scales.chunk(2), strict=True
        ):
            parameter.copy_(value)

    def retract(self, state: Tensor, step: Tensor) -> Tensor:
        """Return the state moved by a step; base rotations are updated by composition."""
        (poses, scales), (move, growth) = self.parts(state), self.parts(step)
        return torch.cat([self.shape.retract(poses, move).flatten(), scales + growth]).unsqueeze(0)

    def change(self, step: Tensor) -> Tensor:
        """Return the largest change in a step, radians, metres as a share of the size, or logarithms of scales."""
        move, growth = self.parts(step)
        return torch.cat([(move[:, :3] / self.size).flatten(), move[:, 3:].flatten(), growth]).abs().max()

    def noise(self, state: Tensor) -> float:
        """Return the robust standard deviation of the data of all frames near the surface, metres."""
        poses, scales = self.parts(state)
        self.set_scales(scales)
        return float(surface_noise(self.shape.distance(self.data, poses).flatten(), self.valid.flatten(), self.size))

    def unexplained(self, poses: Tensor) -> Tensor:
        """Return the number of data (T,), softly counted, that poses leave off the surface of the shape as it is."""
        distance = self.shape.distance(self.data, poses - self.shift)
        return (welsch_loss((distance / (SURFACE_SIGMAS[-1] * self.size)).square()) * self.valid).sum(-1)

    def linearize(self, state: Tensor, sigma: float, noise: float) -> Linearization:
        """Return the Welsch cost of all distances and its Gauss-Newton approximation; the batch is one state."""
        poses, scales = self.parts(state)
        self.set_scales(scales)
        distance, by_pose = self.shape.distance_jacobian(self.data, poses, chart="tangent")
        jacobian = torch.cat([by_pose, scale_jacobian(self.shape, self.data, poses)], dim=-1)
        beta = welsch_weight((distance / sigma).square())
        cost = 0.5 * (sigma / noise) ** 2 * ((1 - beta) * self.valid).sum()
        weighted = jacobian * (beta * self.valid / noise**2).unsqueeze(-1)
        gradient = (weighted.mT @ distance.unsqueeze(-1)).squeeze(-1)
        hessian = weighted.mT @ jacobian
        dofs = poses.shape[-1]
        gradients = torch.cat([gradient[:, :dofs].flatten(), gradient[:, dofs:].sum(0)])
        across = hessian[:, :dofs, dofs:].flatten(0, 1)
        blocks = torch.block_diag(*hessian[:, :dofs, :dofs])
        corner = hessian[:, dofs:, dofs:].sum(0)
        whole = torch.cat([torch.cat([blocks, across], dim=1), torch.cat([across.mT, corner], dim=1)])
        problem = self.prior.add_to(Linearization(cost, gradients, whole), poses, scales)
        return Linearization(problem.cost.view(1), problem.gradient.unsqueeze(0), problem.hessian.unsqueeze(0))


def scale_jacobian(shape: ArticulatedShape, points: Tensor, poses: Tensor) -> Tensor:
    """Return the Jacobian of the fused distance with respect to the logarithms of all lengths and radii.

    Args:
        shape: the articulated shape; its `log_length_scales` must require gradients.
        points: (T, M, 3), metres.
        poses: (T, num_dofs).

    Returns:
        (T, M, 2 P), lengths before radii.

    Differentiable: no; it is a derivative already.
    """
    solids = shape.primitives
    centers, rotations, moves = _solid_motions(shape, poses)
    local = ((points.unsqueeze(-2) - centers.unsqueeze(1)).unsqueeze(-2) @ rotations.unsqueeze(1)).squeeze(-2)
    sizes = solids.scaled_sizes(shape.log_length_scales.detach().exp(), shape.log_radius_scales.detach().exp())
    with torch.enable_grad():
        leaves = [local.requires_grad_()]
        # A row of sizes for every point, so that one backward pass gives every point's own derivative.
        leaves += [size.detach().expand(*points.shape[:-1], *size.shape).clone().requires_grad_() for size in sizes]
        distances = solids(leaves[0], leaves[1:])
        by_local, *by_size = torch.autograd.grad(distances.sum(), leaves)
    shares = fuse(distances.detach(), shape.adjacency, shape.nu)[1]
    force = (by_local * shares.unsqueeze(-1)).flatten(-2)
    own = [
        torch.stack([(grown * long).sum(-1), (grown * ~long).sum(-1)])
        for grown, long in (
            (gradient * size * solids.get_buffer(f"scalable_{kind}"), solids.get_buffer(f"long_{kind}"))
            for kind, gradient, size in zip(solids.kinds, by_size, sizes, strict=True)
        )
    ]
    by_length, by_radius = torch.cat(own, dim=-1)[..., solids.kind_order] * shares
    return torch.cat([by_length - force @ moves.flatten(1, 2), by_radius], dim=-1).detach()


def _solid_motions(shape: ArticulatedShape, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return centers (T, P, 3) and rotations (T, P, 3, 3) of the solids, and how the logarithms of lengths move them.

    The last is (T, P, 3, P), in each solid's own frame.
    """
    lengths = shape.log_length_scales
    with torch.enable_grad():
        transforms = shape.part_transforms(poses)
        turned = transforms[..., :3, :3] @ (shape.primitives.centers.detach() * lengths.exp().unsqueeze(-1)).unsqueeze(
            -1
        )
        centers = transforms[..., :3, 3] + turned.squeeze(-1)
        # The product J^T u is linear in u; its derivative by u is J, in as many backward passes as there are lengths.
        probe = torch.zeros_like(centers, requires_grad=True)
        (pulled,) = torch.autograd.grad(centers, lengths, probe, create_graph=True)
        identity = torch.eye(len(lengths)).to(lengths)
        (moves,) = torch.autograd.grad(pulled, probe, identity, is_grads_batched=True)
    rotations = transforms[..., :3, :3].detach() @ shape.primitives.rotations
    return centers.detach(), rotations, rotations.mT @ moves.movedim(0, -1)


def _start_poses(shape: ArticulatedShape, initial_poses: Tensor | None, count: int) -> Tensor:
    poses = shape.rest_pose() if initial_poses is None else shape.check_pose(initial_poses, "initial_poses")
    if poses.ndim > 2 or (poses.ndim == 2 and len(poses) not in (1, count)):
        raise InputError(
            f"initial_poses must have shape ({count}, {shape.num_dofs}), one pose per frame, or ({shape.num_dofs},), "
            f"got {tuple(poses.shape)}"
        )
    check_finite(poses, "initial_poses")
    return shape.clamp(poses.detach().expand(count, shape.num_dofs))


def _padded(
    shape: ArticulatedShape, frames: Tensor | Sequence[Tensor], masks: Tensor | None, nan_policy: str
) -> tuple[Tensor, Tensor]:
    """Return the frames as one tensor (T, M, 3) and which of its rows (T, M) count."""
    if isinstance(frames, Tensor):
        data = as_float_tensor(frames, "frames", like=shape.rest)
        check_shape(data, "frames", ("T", "M", 3))
        valid = torch.ones_like(data[..., 0], dtype=torch.bool) if masks is None else masks
    elif masks is not None:
        raise InputError("masks go with frames in one tensor (T, M, 3); leave padding out of a sequence of clouds")
    else:
        clouds = [as_float_tensor(cloud, f"frames[{i}]", like=shape.rest) for i, cloud in enumerate(frames)]
        for number, cloud in enumerate(clouds):
            check_shape(cloud, f"frames[{number}]", ("M", 3))
        data = nn.utils.rnn.pad_sequence(clouds, batch_first=True) if clouds else shape.rest.new_zeros(0, 0, 3)
        counts = torch.tensor([len(cloud) for cloud in clouds], device=data.device)
        valid = torch.arange(data.shape[1], device=data.device) < counts.unsqueeze(-1)
    if data.shape[0] == 0 or data.shape[1] == 0:
        raise InputError(f"frames must hold at least one cloud with points, got shape {tuple(data.shape)}")
    if not isinstance(valid, Tensor) or valid.dtype != torch.bool or valid.shape != data.shape[:-1]:
        raise InputError(f"masks must be bool of shape {tuple(data.shape[:-1])}, False where frames are padding")
    finite = torch.isfinite(data).all(-1)
    valid = valid.to(data.device)
    if nan_policy == "raise" and bool((valid & ~finite).any()):
        raise InputError(
            f"frames hold {int((valid & ~finite).sum())} points that are not finite; drop them or set "
            f"align=AlignConfig(nan_policy='omit')"
        )
    valid = valid & finite
    return torch.where(valid.unsqueeze(-1), data, 0.0), valid
