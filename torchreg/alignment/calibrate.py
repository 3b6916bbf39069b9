"""Fitting the size and the proportions of an articulated shape to a few clouds of it in different poses."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchreg._checks import as_float_tensor, check_count, check_finite, check_positive, check_shape
from torchreg.alignment.align import align
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.fit.problem import model_size
from torchreg.alignment.fit.surface_fit import SURFACE_FIT
from torchreg.alignment.inputs import Task, check_clouds
from torchreg.alignment.results import AlignResult, Calibration
from torchreg.alignment.search.start_source import StartSource
from torchreg.alignment.shape.person_rows import fit_scans
from torchreg.alignment.shape.scale_fit import SCALE_FIT, ScalePrior, ScaleProblem
from torchreg.alignment.shape.shape_problem import shared_covariance
from torchreg.errors import FramesWarning, InputError
from torchreg.result import Status, normal_copy
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin, sample_skin


@dataclass(frozen=True)
class _Trust:
    """Numbers of the trust in frames."""

    surest: int = 3  # frames that give a first size where none can be trusted: a shape of another size is near them


_TRUST = _Trust()


@dataclass(frozen=True, eq=False)
class FramePoses:
    """Poses (T, num_dofs), statuses, confidence (T,), and which are ``known`` (T,), starts for the next alignment."""

    poses: Tensor
    statuses: tuple[Status, ...]
    confidence: Tensor
    known: Tensor
    searched: bool

    @classmethod
    def of(cls, starts: Tensor, searched: bool) -> FramePoses:
        """Return the poses (T, num_dofs) before any alignment."""
        known = torch.full_like(starts[:, 0], not searched, dtype=torch.bool)
        return cls(starts, (), torch.zeros_like(starts[:, 0]), known, searched)

    def aligned(
        self, shape: ArticulatedShape, data: Tensor, valid: Tensor, config: AlignConfig, skin: LinearBlendSkin | None
    ) -> FramePoses:
        """Return the poses after an alignment of each frame (T, M, 3), in a batch; those not known are searched."""
        poses, confidence, statuses = self.poses.clone(), self.confidence.clone(), [Status.NO_DATA] * len(data)
        for rows, start in ((self.known, True), (~self.known, False)):
            index = rows.nonzero()[:, 0]
            if len(index) == 0:
                continue
            starts = self.poses[index] if start else None
            found = align(shape, data[index], starts, model_points=skin, mask=valid[index], config=config)
            poses[index] = found.pose
            confidence[index] = torch.zeros_like(confidence[index]) if found.confidence is None else found.confidence
            for row, status in zip(index.tolist(), found.statuses, strict=True):
                statuses[row] = status
        usable = torch.tensor([status.usable for status in statuses], device=data.device)
        known = usable if self.searched else self.known
        return replace(self, poses=poses, statuses=tuple(statuses), confidence=confidence, known=known)

    def of_person(self, shape: ArticulatedShape, data: Tensor, valid: Tensor, config: AlignConfig) -> FramePoses:
        """Return the poses of a rig in frames (T, M, 3); the first sure one gives its coefficients.

        Later ones in which a pose is doubtful are fitted with coefficients of their own, by more evidence.
        """
        surest, first = None, 0
        for number, (points, kept) in enumerate(zip(data, valid, strict=True)):
            found = align(shape, points[kept], fit_shape=True, config=config)
            if surest is None or _confidence(found) > _confidence(surest):
                surest, first = found, number
            if found.statuses[0].usable:
                break
        if surest is None or surest.coefficients is None:
            return self
        person, known = shape.with_coefficients(surest.coefficients), torch.zeros_like(self.known)
        poses = self.poses.index_put((torch.tensor(first),), surest.pose)
        known[first] = True
        frames = replace(self, poses=poses, known=known).aligned(person, data, valid, config, None)
        for number in filter(lambda left: left > first, frames.left_out):
            found = align(shape, data[number, valid[number]], fit_shape=True, config=config)
            if found.statuses[0].usable:
                frames = frames._with(number, found)
        return frames

    def _with(self, number: int, found: AlignResult) -> FramePoses:
        """Return the poses with that of another alignment in one frame."""
        index = torch.tensor([number], device=self.poses.device)
        statuses = (*self.statuses[:number], found.statuses[0], *self.statuses[number + 1 :])
        return replace(
            self, poses=self.poses.index_copy(0, index, found.pose.reshape(1, -1)), statuses=statuses,
            confidence=self.confidence.index_fill(0, index, _confidence(found)),
            known=self.known.index_fill(0, index, True),
        )  # fmt: skip

    @property
    def failed(self) -> set[Status]:
        """Statuses of frames that do not count; a doubtful one from a start does, as the shape is not fitted yet."""
        return {status for status in self.statuses if not (status.usable or status is Status.DOUBTFUL)}

    @property
    def counting(self) -> Tensor:
        """Which frames (T,) count in a fit: those that can be trusted or, where none can, the surest."""
        if not self.searched:
            return torch.tensor([status not in self.failed for status in self.statuses], device=self.known.device)
        if bool(self.known.any()):
            return self.known
        surest = self.confidence.topk(min(_TRUST.surest, len(self.known))).indices
        return self.known.index_fill(0, surest, True)

    @property
    def left_out(self) -> tuple[int, ...]:
        """Numbers of the frames that were searched and cannot be trusted."""
        return tuple((~self.known).nonzero()[:, 0].tolist())

    def status(self, fitted: Status) -> Status:
        """Return the status of a calibration whose fit ended with one."""
        if not self.searched:
            failed = self.failed
            few = Status.FEW_INLIERS if failed else fitted
            return Status.DEGENERATE if Status.DEGENERATE in failed else few
        if 2 * len(self.left_out) > len(self.known):
            return self.statuses[0] if len(set(self.statuses)) == 1 else Status.DOUBTFUL
        return Status.WITH_WARNINGS if self.left_out else fitted

    def warn(self) -> None:
        """Say which frames were left out."""
        if self.left_out:
            names = ", ".join(map(str, self.left_out))
            warnings.warn(
                f"the shape is not surely found in frames {names} of {len(self.known)}, counted from 0; they are left "
                f"out: give initial_poses near them, or remove them",
                FramesWarning, stacklevel=3,
            )  # fmt: skip


def _confidence(found: AlignResult) -> float:
    return 0.0 if found.confidence is None else float(found.confidence)


@dataclass(frozen=True)
class CalibrateConfig:
    """Settings of a calibration.

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
            check_count(getattr(self, name), name, 1)
        for name in ("size_std", "radius_std", "part_std"):
            check_positive(getattr(self, name), name)


@dataclass(frozen=True)
class CalibrateRecord:
    """One joint fit at one kernel width, as given to ``on_step``: poses (T, num_dofs), scales (P,), sigma in metres."""

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

    Without initial poses the shape is searched in every frame, all in one batch. Frames in which it is not surely found
    are left out, and searched again with the size that the others tell; where none is sure, the surest ones tell it.

    Of a shape with coefficients, the frames are scans of one person: its coefficients and all poses are fitted
    together, as ``align(..., fit_shape=True)`` fits those of one scan.

    Args:
        shape: where to start, in metres; it is not changed. It has coefficients, or its solids are fitted: then it must
            not have come from a file with a mesh.
        frames: T clouds: (T, M, 3), or a sequence of (M_t, 3), metres. One to ten frames whose joints move help most.
        initial_poses: (T, num_dofs) or (num_dofs,) for all, as ``shape.rest_pose()``; without any, the shape is
            searched for.
        masks: (T, M) False where data are padding; for frames in one tensor.
        config: see `CalibrateConfig`.
        on_step: called with a `CalibrateRecord` after each joint fit.

    Returns:
        a `Calibration`. With initial poses its status is FEW_INLIERS, or DEGENERATE, if a frame could not be aligned;
            such frames do not count. Without, the frames left out are its ``outliers``; its status is WITH_WARNINGS
            then, and DOUBTFUL if they are more than half of all.

    Raises:
        InputError: if frames are empty, not finite, or do not fit the poses, or the shape has a surface of its own.
        InputTypeError: if an argument has the wrong type.

    Warns:
        FramesWarning: if frames are left out.

    Differentiable: no.

    Cost: without initial poses that of `find_pose` for each frame, up to twice. Per step, a Jacobian of T M distances
    and a Cholesky factorization of size T num_dofs + 2 P.

    References: Dewaele et al. 2006, section 3.4, for the distances.
    """
    config = config or CalibrateConfig()
    if shape.space is not None:
        return _calibrate_person(shape, frames, initial_poses, masks, config)
    if shape.surface is not None:
        raise InputError(
            "shape has the surface of a file, whose mesh cannot follow the scales; calibrate a shape made of solids, "
            "or shape.with_bone_coefficients()"
        )
    with torch.no_grad():
        data, valid = _check_frames(shape, frames, masks, config.align.nan_policy)
        frame_poses = FramePoses.of(_check_poses(shape, initial_poses, len(data)), initial_poses is None)
        poses = frame_poses.poses
        fitted = copy.deepcopy(shape).requires_grad_(False)
        prior = None
        for number in range(config.rounds):
            skin = sample_skin(fitted, config.align.num_model_points, sharpness=config.align.sharpness)
            size = model_size(skin)
            known = frame_poses.known
            frame_poses = replace(frame_poses, poses=poses).aligned(fitted, data, valid, config.align, skin)
            poses = torch.where(known.unsqueeze(-1), poses, frame_poses.poses)
            prior = prior or _scale_prior(shape, poses, size, config)
            # Of a frame that was searched the prior is about what was found.
            prior = replace(prior, poses=torch.where(known.unsqueeze(-1), prior.poses, poses))
            counts = valid & frame_poses.counting.unsqueeze(-1)
            problem = ScaleProblem(fitted, data, counts, prior, size, config.max_points)
            better = problem.unexplained(frame_poses.poses) < problem.unexplained(poses)
            poses = torch.where(better.unsqueeze(-1), frame_poses.poses, poses)
            poses, cost, change = _fit_jointly(problem, poses, config, number, on_step)
    frame_poses.warn()
    status = Status.CONVERGED if change <= config.align.pose_atol else Status.MAX_STEPS
    return Calibration(
        shape=_learning_like(shape, fitted),
        poses=poses,
        log_length_scales=fitted.log_length_scales.detach().clone(),
        log_radius_scales=fitted.log_radius_scales.detach().clone(),
        cost=cost,
        status=frame_poses.status(status),
        outliers=frame_poses.left_out,
    )


def _scale_prior(shape: ArticulatedShape, poses: Tensor, size: float, config: CalibrateConfig) -> ScalePrior:
    """Return the prior on the scales and the poses (T, num_dofs)."""
    return ScalePrior.from_shape(
        shape, poses, size, joint_std=config.align.prior_std, size_std=config.size_std, radius_std=config.radius_std,
        part_std=config.part_std,
    )  # fmt: skip


def _learning_like(shape: ArticulatedShape, fitted: ArticulatedShape) -> ArticulatedShape:
    """Return a fitted copy of a shape whose parameters take gradients where those of the shape do."""
    for parameter, original in zip(fitted.parameters(), shape.parameters(), strict=True):
        parameter.requires_grad_(original.requires_grad)
    return fitted


def _calibrate_person(
    shape: ArticulatedShape,
    frames: Tensor | Sequence[Tensor],
    initial_poses: Tensor | None,
    masks: Tensor | None,
    config: CalibrateConfig,
) -> Calibration:
    """Return the calibration of one set of coefficients and a pose for each frame."""
    with torch.inference_mode():
        data, valid = _check_frames(shape, frames, masks, config.align.nan_policy)
        frame_poses = FramePoses.of(_check_poses(shape, initial_poses, len(data)), initial_poses is None)
    if frame_poses.searched:
        frame_poses = frame_poses.of_person(shape, data, valid, config.align)
    counts = frame_poses.known | ~frame_poses.known.any()
    task = Task(
        shape=shape, source=StartSource.of(shape), config=config.align, start=frame_poses.poses[counts]
    )  # fmt: skip
    fitted = fit_scans(task, data[counts], valid[counts])
    poses = frame_poses.poses.index_put((counts,), fitted.poses)
    frame_poses.warn()
    person = shape.with_coefficients(fitted.coefficients)
    shared = shared_covariance(fitted.covariance, shape.num_dofs)
    status = Status.CONVERGED if bool(fitted.error.converged.all()) else Status.MAX_STEPS
    return normal_copy(Calibration(
        shape=person,
        poses=poses,
        log_length_scales=person.log_length_scales.detach().clone(),
        log_radius_scales=person.log_radius_scales.detach().clone(),
        cost=fitted.cost,
        status=frame_poses.status(status),
        outliers=frame_poses.left_out,
        coefficients=fitted.coefficients,
        coefficient_covariance=shared.to(poses),
    ))  # fmt: skip


def _fit_jointly(
    problem: ScaleProblem,
    poses: Tensor,
    config: CalibrateConfig,
    number: int,
    on_step: Callable[[CalibrateRecord], None] | None,
) -> tuple[Tensor, Tensor, float]:
    """Return poses, cost and last change of a joint fit with a kernel that narrows to the noise."""
    state, widths = problem.state(poses), SURFACE_FIT.widths
    for step in range(len(widths) + 1):
        is_last = step == len(widths)
        noise = problem.noise(state) if is_last else SURFACE_FIT.max_noise(problem.size)
        sigma = SURFACE_FIT.width_per_noise * noise if is_last else widths[step] * problem.size
        max_steps = config.steps * (SURFACE_FIT.last_steps if is_last else 1)
        atol = config.align.pose_atol * min(1.0, problem.size)
        solved = problem.solve(state, sigma, SCALE_FIT.shared_error * noise, max_steps, atol)
        state, cost = solved.state, solved.cost[0]
        poses = problem.carried(state) + problem.shift
        if on_step is not None:
            lengths, radii = state[0, poses.shape[-1] :].chunk(2)
            on_step(CalibrateRecord(
                round=number, step=step, num_steps=len(widths) + 1, sigma=sigma, cost=float(cost), poses=poses,
                log_length_scales=lengths, log_radius_scales=radii,
            ))  # fmt: skip
    return poses, cost, problem.change(solved.last_step)


def _check_poses(shape: ArticulatedShape, initial_poses: Tensor | None, count: int) -> Tensor:
    """Return the poses (T, num_dofs) to start from."""
    poses = shape.rest_pose() if initial_poses is None else shape.check_pose(initial_poses, "initial_poses")
    if poses.ndim > 2 or (poses.ndim == 2 and len(poses) not in (1, count)):
        raise InputError(
            f"initial_poses must have shape ({count}, {shape.num_dofs}), one pose per frame, or ({shape.num_dofs},), "
            f"got {tuple(poses.shape)}"
        )
    check_finite(poses, "initial_poses")
    return shape.clamp(poses.detach().expand(count, shape.num_dofs))


def _check_frames(
    shape: ArticulatedShape, frames: Tensor | Sequence[Tensor], masks: Tensor | None, nan_policy: str
) -> tuple[Tensor, Tensor]:
    """Return the frames as one tensor (T, M, 3) and its valid points (T, M)."""
    if isinstance(frames, Tensor):
        data = frames
    elif masks is not None:
        raise InputError("masks go with frames in one tensor (T, M, 3); leave padding out of a sequence of clouds")
    else:
        clouds = [as_float_tensor(cloud, f"frames[{i}]", like=shape.rest) for i, cloud in enumerate(frames)]
        for number, cloud in enumerate(clouds):
            check_shape(cloud, f"frames[{number}]", ("M", 3))
        data = pad_sequence(clouds, batch_first=True) if clouds else shape.rest.new_zeros(0, 0, 3)
        counts = torch.tensor([len(cloud) for cloud in clouds], device=data.device)
        masks = torch.arange(data.shape[1], device=data.device) < counts.unsqueeze(-1)
    check_shape(data, "frames", ("T", "M", 3))
    return check_clouds(
        shape, data, masks, nan_policy, name="frames", mask_name="masks",
        omit_option="align=AlignConfig(nan_policy='omit')",
    )  # fmt: skip
