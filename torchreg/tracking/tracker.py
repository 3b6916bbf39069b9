"""Following an articulated shape through a sequence of clouds: predict, align, notice a loss, find it again."""

from __future__ import annotations

import math
import time as clock
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg._threads import one_thread
from torchreg.alignment.align import AlignConfig, align
from torchreg.alignment.annealed_em import outlier_level
from torchreg.errors import InputError, InputTypeError, UnitsWarning
from torchreg.result import Status, normal_copy
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.e_step import expectation
from torchreg.tracking.config import Frame, FrameFit, TrackConfig, thinned
from torchreg.tracking.evidence import is_doubtful, is_far, is_lost, usual_after
from torchreg.tracking.frame_fit import MIN_DATA, STOP_SIGMA, FrameFitter, generator
from torchreg.tracking.model_points import points_after
from torchreg.tracking.motion_model import first_motion, merged, motion_after, slowed, timed
from torchreg.tracking.recovery import MIN_GAIN, Recovery, rested, waited
from torchreg.tracking.results import FrameResult, TrackResult, TrackState

OnFrame = Callable[[Tensor, FrameResult], None]

# Data and model that differ more than this in size are in different units.
_UNITS_RATIO = 30.0
# Frames in which a pose that was found everywhere is checked against another search.
_CHECKS = 1
# After so many intervals without a frame, a limb may be anywhere, and other starts than the prediction are tried too.
_LONG_GAP = 2.0
# Earlier poses that a lost shape is looked for in, a second and a half of them.
_NUM_PREVIOUS, _PREVIOUS_EVERY = 3, 10


class Tracker:
    """Follows an articulated shape from cloud to cloud.

    Every frame is predicted from those before, registered by annealed EM with the points seen last and fitted to the
    surface. When the evidence drops below what it was, poses are tried around the last ones, then further off, then
    everywhere; what could not be found is held, reported as lost, and sought again every few frames.

    Args:
        shape: the articulated shape, in metres.
        initial_pose: (num_dofs,) near the first frame; without one, `find_pose` looks for it.
        config: see `TrackConfig`.
        model_points: a skin of the shape, whose points stand for its surface; sampled by default (see `sample_skin`).

    Raises:
        InputError: if the pose does not fit the shape or is not finite, or the skin is of another shape.

    References: Dewaele et al. 2006, sections 3 and 5.
    """

    def __init__(
        self,
        shape: ArticulatedShape,
        initial_pose: Tensor | None = None,
        *,
        config: TrackConfig | None = None,
        model_points: LinearBlendSkin | None = None,
    ) -> None:
        self.shape, self.config = shape, config or TrackConfig()
        if model_points is not None and model_points.shape is not shape:
            raise InputError("model_points is a skin of another shape; build it from the shape that is tracked")
        with torch.no_grad():
            self._fitter = FrameFitter(shape, self.config, model_points)
            self._recover = Recovery(self._fitter)
            self._state = self._begin(self._initial(initial_pose))

    @property
    def state(self) -> TrackState:
        """All that the next frame depends on; a tracker of the same shape and configuration that is given it goes on.

        Raises:
            InputError: when set, if the state is that of another shape.
            InputTypeError: when set, if it is something else.
        """
        return self._state

    @state.setter
    def state(self, state: TrackState) -> None:
        if not isinstance(state, TrackState):
            raise InputTypeError(f"state must be a TrackState, got {type(state).__name__}")
        dofs, parts = self.shape.num_dofs, self.shape.num_parts
        if state.pose.shape != (dofs,) or state.weights.shape[-1:] != (parts,):
            raise InputError(
                f"state must be that of a shape with {dofs} degrees of freedom and {parts} parts, got poses of shape "
                f"{tuple(state.pose.shape)} and weights of shape {tuple(state.weights.shape)}"
            )
        self._state = state

    def step(self, points: Tensor, time: float | None = None) -> FrameResult:
        """Return where the shape is in the next frame.

        Args:
            points: (M, 3), metres; M may be zero.
            time: of the frame, in any unit, seconds say; by default one interval after the frame before. Where frames
                were dropped, it says how far the shape may have gone.

        Returns:
            a `FrameResult`. Its status tells whether the pose rests on data: NO_DATA, LOST and OTHER_UNITS do not.

        Raises:
            InputError: if the points are not (M, 3), or not finite under ``nan_policy="raise"``, or the time is not
                later than that of the frame before.

        Warns:
            UnitsWarning: if the data are more than thirty times larger or smaller than the shape.

        Differentiable: no.
        """
        cloud = self._checked(points)
        state, gap = timed(self._state, time)
        # A tenth faster than without gradients alone, as most of the time goes to small operations.
        with torch.inference_mode(), one_thread(), self.shape.held_sizes():
            frame = Frame(cloud, torch.isfinite(cloud).all(-1), gap)
            unfit = self._unfit(frame.data)
            if unfit is not None:
                result, state = self._hold(state, frame, unfit)
            else:
                fit, state = self._follow(state, frame) if state.tracked else self._first(state, frame)
                result, state = (
                    self._hold(state, frame, Status.LOST) if fit is None else self._accept(state, frame, fit)
                )
            self._state = normal_copy(state)
            return normal_copy(result)

    def run(
        self, frames: Iterable[Tensor], on_frame: OnFrame | None = None, *, times: Sequence[float] | None = None
    ) -> TrackResult:
        """Return the poses of all frames given; a tracker that ran some before goes on where it was.

        An interruption by the keyboard after the first frame ends the sequence: the result then holds the frames done.

        Args:
            frames: T clouds (M_t, 3), metres, such as `load_frames` gives; each is read when its turn comes.
            on_frame: is told each cloud and what `step` made of it.
            times: (T,) of the frames; see `step`.

        Returns:
            a `TrackResult`.

        Raises:
            InputError: if there is no frame, times are missing, or a frame cannot be used; see `step`.
        """
        results: list[FrameResult] = []
        seconds: list[float] = []
        try:
            for number, points in enumerate(frames):
                if times is not None and number >= len(times):
                    raise InputError(f"times must hold one entry per frame, got {len(times)} and more frames")
                started = clock.perf_counter()
                result = self.step(points, None if times is None else float(times[number]))
                seconds.append(clock.perf_counter() - started)
                results.append(result)
                if on_frame is not None:
                    on_frame(points, result)
        except KeyboardInterrupt:
            if not results:
                raise
        if not results:
            raise InputError("frames must hold at least one cloud, got none")
        return _collected(results, seconds)

    def _initial(self, pose: Tensor | None) -> Tensor:
        if pose is None:
            return torch.full_like(self.shape.rest, torch.nan)
        pose = self.shape.check_pose(pose, "initial_pose").detach()
        check_shape(pose, "initial_pose", (self.shape.num_dofs,))
        check_finite(pose, "initial_pose")
        return self.shape.clamp(pose)

    def _begin(self, pose: Tensor) -> TrackState:
        skin = self._fitter.skin
        points = skin.points
        return TrackState(
            frame=0, time=0.0, interval=0.0, pose=pose, velocity=torch.zeros_like(pose), points=points,
            weights=skin.weights, reference_pose=skin.reference_pose, keyframes=pose[None][:0],
            unexplained=points[:0], prediction_error=0.0, innovation=points.new_zeros(3), num_data=0.0, num_inliers=0.0,
            ratio_in_reach=0.0, residual=0.0, limit_share=0.0, lost=0, cool_down=0, failed_searches=0, pending_checks=0,
            seed=self.config.seed,
        )  # fmt: skip

    def _checked(self, points: Tensor) -> Tensor:
        cloud = as_float_tensor(points, "points", like=self.shape.rest)
        check_shape(cloud, "points", ("M", 3))
        if self.config.nan_policy == "raise":
            check_finite(cloud, "points", "drop them or set nan_policy='omit'")
        return cloud

    def _unfit(self, data: Tensor) -> Status | None:
        """Return why data cannot be aligned with at all, if so."""
        if len(data) < MIN_DATA:
            return Status.NO_DATA
        spread = 2 * float((data - data.mean(0)).norm(dim=-1).median()) / self._fitter.size
        if 1 / _UNITS_RATIO < spread < _UNITS_RATIO:
            return None
        warnings.warn(
            f"the data spread over {spread:.3g} times the model's size of {self._fitter.size:.3g} m: are they in "
            f"metres? Scale them, by 0.001 if they are in millimeters",
            UnitsWarning,
            stacklevel=3,
        )
        return Status.OTHER_UNITS

    def _first(self, state: TrackState, frame: Frame) -> tuple[FrameFit | None, TrackState]:
        """Return the fit of the first frame that shows the shape, if any, and what the search leaves of the state."""
        fit = None
        if state.found:
            data = thinned(frame.data, self.config.max_points, generator(state))
            config = AlignConfig(sharpness=self.config.sharpness)
            pose = align(self.shape, data, state.pose, model_points=self._fitter.skin, config=config).pose
            fit = self._fitter.fit_at(state, frame, pose, "tracked")
        waits = state.cool_down > 0 or self.config.recovery != "full"
        if (fit is None or is_lost(state, fit)) and not waits:
            fit = self._recover.everywhere(state, frame)
        fit, state = _kept(state, fit)
        return fit, rested(state, fit is not None) if fit is not None or not waits else waited(state)

    def _follow(self, state: TrackState, frame: Frame) -> tuple[FrameFit | None, TrackState]:
        """Return the fit of a later frame, if any is worth it, and what the search for it leaves of the state."""
        checks = state.pending_checks
        fit, state = self._continue(state, frame)
        if checks == 0 or (fit is not None and fit.how == "found"):
            return fit, state
        # A pose that was found everywhere must hold against the same search in another frame.
        rival = self._recover.everywhere(state, frame)
        if rival is None or (fit is not None and rival.explained < fit.explained + MIN_GAIN):
            return fit, replace(state, pending_checks=0)
        return rival, replace(state, pending_checks=checks - 1)

    def _continue(self, state: TrackState, frame: Frame) -> tuple[FrameFit | None, TrackState]:
        """Return the same, from the frames before and what can be searched around them."""
        view = self._fitter.view_ahead(state, frame)
        fit = None if view is None else self._fitter.descend(view, state, frame.gap)
        sure = frame.gap < _LONG_GAP
        if fit is not None and sure and not is_lost(state, fit) and not is_doubtful(state, fit):
            return fit, rested(state, True)
        fit, state = self._recover(state, frame, view, fit)
        return _kept(state, fit)

    def _accept(self, state: TrackState, frame: Frame, fit: FrameFit) -> tuple[FrameResult, TrackState]:
        """Return the record of a frame that was fitted, and the state after it."""
        pose = fit.world
        covariance, share = self._fitter.covariance(fit)
        if state.tracked and state.lost == 0 and fit.how != "found" and not is_far(state, fit):
            motion = motion_after(state, frame, fit, share)
        else:
            motion = merged(state, first_motion(pose, self._fitter.size))
        kept = state.keyframes if state.frame % _PREVIOUS_EVERY else torch.cat([state.keyframes, pose[None]])
        points, weights, reference_pose = points_after(self._fitter, state, fit)
        after = replace(
            usual_after(state, fit, len(frame.data)), pose=pose, points=points, weights=weights,
            reference_pose=reference_pose, keyframes=kept[-_NUM_PREVIOUS:],
            unexplained=self._fitter.strays_after(state, fit), lost=0,
            failed_searches=min(state.failed_searches, 1) if state.lost else state.failed_searches, **motion.fields,
        )  # fmt: skip
        done = fit.change <= fit.view.problem.pose_atol
        status = Status.CONVERGED if done else Status.MAX_STEPS
        return self._record(state, frame, pose, fit, covariance, status, fit.how), after

    def _hold(self, state: TrackState, frame: Frame, status: Status) -> tuple[FrameResult, TrackState]:
        """Return the record of a frame without a fit, for which the prediction stands in, and the state after it."""
        pose = self._fitter.predicted(state, frame.gap)
        after = replace(state, pose=pose, velocity=slowed(state, frame.gap), lost=state.lost + 1)
        unknown = torch.full((self.shape.num_dofs,) * 2, torch.nan).to(pose)
        how = "lost" if status is Status.LOST else "held"
        return self._record(state, frame, pose, None, unknown, status, how), after

    def _record(
        self, state: TrackState, frame: Frame, pose: Tensor, fit: FrameFit | None, covariance: Tensor, status: Status,
        how: str,
    ) -> FrameResult:  # fmt: skip
        nothing = pose.new_tensor(torch.nan)
        distances = torch.where(frame.finite, torch.inf, torch.nan).to(pose)
        posterior = torch.zeros_like(distances)
        sigma = cost = nothing
        if fit is None:
            registered, keypoints = self._fitter.skin(pose), self.shape.keypoints(pose)
        else:
            problem, near = fit.view.problem, fit.view.near
            cost, sigma = nothing.new_tensor(fit.cost), nothing.new_tensor(STOP_SIGMA * problem.size)
            data, distance = problem.data, fit.distance[0]
            if int(near.sum()) > len(distance):
                data = (frame.cloud[near] - fit.view.origin)[None]
                distance = problem.surface.distance(data, fit.pose)[0]
            posed = problem.skin.place(fit.rows)
            registered = posed + fit.view.origin
            keypoints = self.shape.placed_keypoints(fit.transforms) + fit.view.origin
            distances[near] = distance
            outlier = outlier_level(problem, posed[None], sigma[None])
            posterior[near] = expectation(posed[None], data, sigma[None], outlier).inlier_posterior[0]
        inliers = distances.abs() < self._fitter.inlier_distance
        count = int(frame.finite.sum())
        return FrameResult(
            pose=pose, registered=registered, keypoints=keypoints, distances=distances,
            inliers=inliers, posterior=posterior, sigma=sigma, cost=cost, status=status, history=(),
            covariance=covariance, acquired=how, frame=state.frame - 1, time=state.time,
            inlier_ratio=int(inliers.sum()) / max(1, count),
            residual=math.nan if fit is None else float(fit.noise),
        )  # fmt: skip


def _kept(state: TrackState, fit: FrameFit | None) -> tuple[FrameFit | None, TrackState]:
    """Return the fit if it is no loss, and the state, which is unsure of a fit that was found everywhere."""
    if fit is None or is_lost(state, fit):
        return None, state
    return fit, replace(state, pending_checks=_CHECKS) if fit.how == "found" else state


def _collected(results: Sequence[FrameResult], seconds: Sequence[float]) -> TrackResult:
    return TrackResult(
        poses=torch.stack([result.pose for result in results]),
        std=torch.stack([result.std for result in results]),
        keypoints=torch.stack([result.keypoints for result in results]),
        inlier_ratios=torch.tensor([result.inlier_ratio for result in results], dtype=torch.float64),
        residuals=torch.tensor([result.residual for result in results], dtype=torch.float64),
        times=torch.tensor([result.time for result in results], dtype=torch.float64),
        seconds=torch.tensor(list(seconds), dtype=torch.float64),
        statuses=tuple(result.statuses[0] for result in results),
        acquired=tuple(result.acquired for result in results),
    )
