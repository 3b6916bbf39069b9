"""Follows an articulated shape through a sequence of clouds: predicts, fits, notices a loss and recovers from it."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape, warn_about_rounding
from torchreg._threads import one_thread
from torchreg.alignment.align import align
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.fit.landmarks import MeasuredKeypoints
from torchreg.alignment.inputs import check_skin, floating_origin, warn_about_degenerate, warn_about_units
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.search.pose_proposer import HoldsProposer, PoseProposer
from torchreg.alignment.search.start_source import StartSource
from torchreg.alignment.shape.clothing import CLOTH
from torchreg.capture.depth_frame import DepthFrame
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.far_origin import to_local, to_world
from torchreg.geometry.loaded import as_points
from torchreg.result import Status, normal_copy
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.config import TrackConfig
from torchreg.tracking.evidence import is_continuous, is_doubtful, is_supported, is_unreliable, update_means
from torchreg.tracking.frame import MIN_DATA, Frame, FrameFit, FrameView, frame_generator, subsample
from torchreg.tracking.frame_fit import FrameFitter
from torchreg.tracking.frame_result import fitted_result, next_model_points, predicted_result, track_result
from torchreg.tracking.motion_model import advance_clock, decayed_velocity, initial_state, restart_motion, update_motion
from torchreg.tracking.person_filter import KnownPerson, PersonFilter
from torchreg.tracking.recovery import Recovery, after_search
from torchreg.tracking.results import FrameResult, TrackResult, TrackState

OnFrame = Callable[[Tensor, FrameResult], None]


@dataclass(frozen=True)
class TrackerSettings:
    """Numbers of the tracker."""

    long_gap: float = 2.0  # intervals without a frame after which a limb may be anywhere
    keyframe_interval: int = 10  # frames
    num_keyframes: int = 3  # from which a lost shape is searched: a second and a half of them
    forgotten: int = 10  # frames without a fit, half a second, after which a shape may be anywhere, or have left


_SETTINGS = TrackerSettings()


class Tracker:
    """Follows an articulated shape from cloud to cloud.

    Every frame is predicted from those before, registered by annealed EM with the model points seen last and fitted to
    the surface. When the evidence is worse than in the frames before, other poses are tried: around the last ones, then
    farther off, then everywhere. A shape that is lost keeps its predicted pose for ten frames, and is searched again
    every few frames; then, and before it was first found, it is reported as not found, and has no pose.

    Args:
        shape: the articulated shape, in metres.
        initial_pose: (num_dofs,) near the first frame; without one, `find_pose` looks for it.
        config: see `TrackConfig`.
        model_points: a skin of the shape, whose points represent its surface; sampled by default (see `sample_skin`).
        locked: degrees of freedom that are held at the initial pose, or at rest without one; see `align`.
        initializer: a network that proposes poses where the shape is lost, see `find_pose`.
        fit_shape: True to fit the shape's coefficients too, "bones" the lengths and radii of any rig's parts, see
            `align`. The first frame that shows the shape tells the person, as `align` does; that rig is followed then,
            and every frame that is not doubtful narrows what is known of its coefficients. The initial pose is one of
            the mean person.
        clothed: of a body whose shape is fitted, whether clothes lie between its skin and the data, see `align`: the
            first frame that shows the person tells. The rig followed has the surface of the clothes then.

    Attributes:
        shape: that is followed; with ``fit_shape`` that of the person, once a frame showed any.

    Raises:
        InputError: if the pose does not fit the shape or is not finite, a locked name is unknown, the skin is of
            another shape, or what is given does not go with ``fit_shape``.

    References: Dewaele et al. 2006, sections 3 and 5.
    """

    def __init__(
        self,
        shape: ArticulatedShape,
        initial_pose: Tensor | None = None,
        *,
        config: TrackConfig | None = None,
        model_points: LinearBlendSkin | None = None,
        locked: Sequence[str] | Tensor = (),
        initializer: PoseProposer | HoldsProposer | None = None,
        fit_shape: bool | str = False,
        clothed: bool | str = "auto",
    ) -> None:
        self.shape, self.config = shape, config or TrackConfig()
        if fit_shape is not False and not (model_points is None and initializer is None and len(locked) == 0):
            raise InputError("fit_shape goes without model_points, locked and initializer; leave them out")
        self._person = None if fit_shape is False else PersonFilter(
            shape, fit_shape, self.config.seed, self.config.upright, clothed
        )  # fmt: skip
        if fit_shape is False and clothed is True:
            raise InputError("clothed=True needs fit_shape=True")
        self._followed: Tensor | None = None
        if model_points is not None:
            model_points = check_skin(shape, model_points)
        with torch.no_grad():
            self._fitter = FrameFitter(shape, self.config, model_points)
            self._mean_clusters = self._fitter.clusters
            self._recover = Recovery(
                self._fitter, StartSource.of(shape, initializer=initializer, upright=self.config.upright)
            )  # fmt: skip
            pose = self._checked_pose(initial_pose)
            # In full precision, for clouds far from the origin.
            self._start = pose if initial_pose is None else torch.as_tensor(initial_pose, dtype=torch.float64)
            self._state = initial_state(self._fitter.skin, pose, self.config.seed)
        self._locked = locked
        KnownDofs.of(shape, locked, None)

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
        count = 0 if self._person is None else self._person.body_count
        counts = (count, count + CLOTH.num_modes) if count else (0,)
        if state.person is not None and len(state.person) not in counts:
            raise InputError(
                f"state must be that of a tracker with {count} coefficients, got {tuple(state.person.shape)} of them; "
                f"fit_shape must be the same"
            )
        self._state = state
        if self._person is not None and state.person is not None:
            self._person.of(len(state.person))
        self._follow(state.person)

    def step(
        self,
        points: Tensor | DepthFrame,
        time: float | None = None,
        *,
        prior: tuple[Any, Any] | None = None,
        keypoints: Tensor | None = None,
        keypoint_std: Tensor | float | None = None,
    ) -> FrameResult:
        """Return the pose of the shape in the next frame, and what is known of it.

        Args:
            points: (M, 3), metres; M may be zero. Or a `DepthFrame`, whose free space counts too.
            time: of the frame, in any unit, seconds say; by default one interval after the frame before. Where frames
                were dropped, it tells how far the shape may have moved.
            prior: what is known of the pose in this frame, as encoders tell: mean and standard deviation, see `align`.
            keypoints: where a detector saw the shape's keypoints, see `align`: (K, 3), metres, or with a `DepthFrame`
                (K, 2), pixels; NaN for those not seen, which may be all.
            keypoint_std: see `align`.

        Returns:
            The frame's result. Its pose rests on data unless its status is NO_DATA, LOST, DEGENERATE or
            OTHER_UNITS. Where the status is NOT_FOUND there is none: the shape did not come yet, or has left.

        Raises:
            InputError: if the points are not (M, 3), or not finite under ``nan_policy="raise"``, or the time is not
                later than that of the frame before.

        Warns:
            UnitsWarning: if the data are more than thirty times larger or smaller than the shape.

        Differentiable: no.
        """
        picture = points if isinstance(points, DepthFrame) else None
        given = as_points(points)
        self._check_time(time)
        measured = self._checked_keypoints(keypoints, keypoint_std, picture)
        self._place_origin(given)
        cloud = self._checked_points(given)
        picture, measured = to_local(picture, self._state.origin), to_local(measured, self._state.origin)
        known = self._known(prior)
        state, elapsed = advance_clock(self._state, time)
        finite = torch.isfinite(cloud).all(-1)
        frame = Frame(cloud=cloud, finite=finite, elapsed=elapsed, picture=picture, known=known, keypoints=measured)
        rejection = self._rejection(frame.data)
        if self._person is not None and state.person is None and rejection is None:
            state = self._met(self._person, state, frame)
        # A tenth faster than without gradients alone, as most of the time goes to small operations.
        with torch.inference_mode(), one_thread(), self.shape.held_sizes():
            if rejection is not None:
                result, state = self._hold(state, frame, rejection)
            else:
                result, state = self._tracked(state, frame)
            self._state = normal_copy(state)
            found = normal_copy(self._with_coefficients(result))
        self._follow_closer()
        return to_world(found, state.origin)

    def _tracked(self, state: TrackState, frame: Frame) -> tuple[FrameResult, TrackState]:
        """Return the result of a frame with data, and the state after it."""
        state = self._forgotten(state) if self._has_left(state) else state
        pose = self._fitter.predict(state, frame.elapsed)
        view = self._fitter.look(state, frame, pose)
        fit = self._fit(state, frame, view)
        if self._was_mistaken(state, fit):
            state, view, fit = self._forgotten(state), None, None
        if self._is_trusted(state, frame, fit):
            state = after_search(state, successful=True)
        else:
            fit, state = self._recover(state, frame, view, fit)
        fit, state = self._recover.cross_check(state, frame, fit)
        return self._accept(state, frame, fit)

    def run(
        self,
        frames: Iterable[Tensor | DepthFrame],
        on_frame: OnFrame | None = None,
        *,
        times: Sequence[float] | None = None,
        priors: Sequence[tuple[Any, Any] | None] | None = None,
        keypoints: Sequence[Tensor] | Tensor | None = None,
        keypoint_std: Tensor | float | None = None,
    ) -> TrackResult:
        """Return the poses of all given frames, which follow those that the tracker has seen before.

        An interruption by the keyboard after the first frame ends the sequence: the result then holds the frames done.

        Args:
            frames: T clouds (M_t, 3), metres, such as `load_frames` gives, or T depth frames; each is read just before
                its step.
            on_frame: called with each cloud, or the points of each depth frame, and the result of its `step`.
            times: (T,) of the frames; see `step`.
            priors: of each frame; see `step`.
            keypoints: of each frame, T times (K, 3) or (K, 2); see `step`.
            keypoint_std: see `step`.

        Raises:
            InputError: if there is no frame, times, priors or keypoints are missing, or a frame cannot be used; see
                `step`.
        """
        results: list[FrameResult] = []
        seconds: list[float] = []
        try:
            for number, points in enumerate(frames):
                for name, values in (("times", times), ("priors", priors), ("keypoints", keypoints)):
                    if values is not None and number >= len(values):
                        raise InputError(f"{name} must hold one entry per frame, got {len(values)} and more frames")
                time = None if times is None else float(times[number])
                prior = None if priors is None else priors[number]
                measured = None if keypoints is None else keypoints[number]
                started = clock.perf_counter()
                result = self.step(points, time, prior=prior, keypoints=measured, keypoint_std=keypoint_std)
                seconds.append(clock.perf_counter() - started)
                results.append(result)
                if on_frame is not None:
                    on_frame(as_points(points), result)
        except KeyboardInterrupt:
            if not results:
                raise
        if not results:
            raise InputError("frames must hold at least one cloud, got none")
        return track_result(results, seconds)

    def _met(self, person: PersonFilter, state: TrackState, frame: Frame) -> TrackState:
        """Return the state with the person whom a frame shows, who is followed from now on; itself without one."""
        start = state.pose if state.found else None
        met = person.initialize(frame.data if frame.picture is None else frame.picture, start)
        if met is None:
            return state
        pose, known = met
        self._follow(known.coefficients)
        return replace(_with_person(state, known), pose=pose, person=known.coefficients)

    def _with_coefficients(self, result: FrameResult) -> FrameResult:
        """Return a frame's result with what is known of the body's coefficients."""
        known = self._state.known_coefficients
        if self._person is None or known is None:
            return result
        count, covariance = self._person.body_count, known.total
        return replace(
            result, coefficients=known.coefficients[:count], coefficient_covariance=covariance[:count, :count]
        )

    def _follow(self, coefficients: Tensor | None) -> None:
        """Go on with the rig of a person with coefficients (K,), where there is one and it is another."""
        if self._person is None or coefficients is None:
            return
        if self._followed is not None and torch.equal(self._followed, coefficients):
            return
        self.shape, self._followed = self._person.rig.with_coefficients(coefficients), coefficients
        with torch.no_grad():
            self._fitter = FrameFitter(self.shape, self.config, None, self._person, self._mean_clusters)
            self._recover = Recovery(self._fitter, StartSource.of(self.shape, upright=self.config.upright))

    def _follow_closer(self) -> None:
        """Go on with the rig of the coefficients known by now, where that of the one followed is off."""
        state = self._state
        if self._person is None or state.person is None or state.coefficients is None:
            return
        if self._person.differs(state.person, state.coefficients):
            self._follow(state.coefficients)
            skin = self._fitter.skin
            self._state = replace(
                state, person=state.coefficients, points=skin.points, weights=skin.weights,
                reference_pose=skin.reference_pose,
            )  # fmt: skip

    def _checked_pose(self, pose: Tensor | None) -> Tensor:
        """Return the initial pose (num_dofs,) within the limits, NaN if it is to be found."""
        if pose is None:
            return torch.full_like(self.shape.rest, torch.nan)
        pose = self.shape.check_pose(pose, "initial_pose").detach()
        check_shape(pose, "initial_pose", (self.shape.num_dofs,))
        check_finite(pose, "initial_pose")
        return self.shape.clamp(pose)

    def _place_origin(self, points: Tensor) -> None:
        """Track about an origin near the first cloud where that lies far from the origin of coordinates."""
        if self._state.frame > 0 or self._state.origin is not None:
            return
        origin = floating_origin(self.shape, points)
        if origin is not None:
            start = to_local(self._start, origin).to(self.shape.rest)
            self._state = replace(self._state, origin=origin, pose=start)

    def _checked_points(self, points: Tensor) -> Tensor:
        if self._state.origin is not None:
            points = as_float_tensor(points, "points").double() - self._state.origin
        cloud = as_float_tensor(points, "points", like=self.shape.rest)
        check_shape(cloud, "points", ("M", 3))
        if self.config.nan_policy == "raise":
            check_finite(cloud, "points", "drop them or set nan_policy='omit'")
        return cloud

    def _known(self, prior: tuple[Any, Any] | None) -> KnownDofs | None:
        """Return the locked and prior degrees of freedom, in the coordinates of the state; None if that is nothing."""
        known = KnownDofs.of(self.shape, self._locked, prior)
        if known is None:
            return None
        held = torch.where(self._start.isfinite(), self._start, self.shape.rest.to(self._start))
        return to_local(known, self._state.origin).holding(to_local(held, self._state.origin))

    def _checked_keypoints(self, keypoints: Any, std: Any, picture: DepthFrame | None) -> MeasuredKeypoints | None:
        """Return measured keypoints; None where none was seen."""
        if keypoints is None or not bool(torch.as_tensor(keypoints).isfinite().all(-1).any()):
            return None
        camera = None if picture is None else picture.camera
        return MeasuredKeypoints.of(self.shape, keypoints, std, camera, self._fitter.size)

    def _check_time(self, time: float | None) -> None:
        if time is None:
            return
        latest = self._state.time
        if not math.isfinite(time) or (self._state.frame > 0 and time <= latest):
            raise InputError(f"time must be finite and later than the frame before at {latest:g}, got {time}")

    def _rejection(self, data: Tensor) -> Status | None:
        """Return the status of data (M, 3) that no pose can be fitted to; None for others."""
        if len(data) < MIN_DATA:
            return Status.NO_DATA
        valid = torch.ones_like(data[:, 0], dtype=torch.bool)
        warn_about_rounding(data, "points", self._fitter.size, stacklevel=3)
        if bool(warn_about_degenerate(data, valid, self._fitter.size, stacklevel=3)):
            return Status.DEGENERATE
        if warn_about_units(data - data.mean(0), valid, self._fitter.size, stacklevel=3):
            return Status.OTHER_UNITS
        return None

    def _fit(self, state: TrackState, frame: Frame, view: FrameView | None) -> FrameFit | None:
        """Return the fit by descent from the prediction or, before the first fit, from the initial pose."""
        if view is not None:
            return self._fitter.descend(view, state, frame.elapsed)
        if state.tracked or not state.found:
            return None
        if state.person is not None and self._state.person is None:
            # In this frame the person was found, together with its pose.
            return self._fitter.fit_at(state, frame, state.pose, "tracked")
        data = subsample(frame.data, self.config.max_points, frame_generator(state))
        config = AlignConfig(sharpness=self.config.sharpness)
        pose = align(
            self.shape, data, state.pose, model_points=self._fitter.skin, config=config, **frame.prior_arguments,
            **frame.keypoints_in_space,
        ).pose  # fmt: skip
        return self._fitter.fit_at(state, frame, pose, "tracked")

    def _is_trusted(self, state: TrackState, frame: Frame, fit: FrameFit | None) -> bool:
        """Return whether a fit needs no comparison with others."""
        continuous = not state.tracked or frame.elapsed < _SETTINGS.long_gap
        return continuous and is_supported(fit, state) and not is_doubtful(fit, state)

    def _was_mistaken(self, state: TrackState, fit: FrameFit | None) -> bool:
        """Return whether the shape is lost that was doubtful in all frames: then it was something else."""
        return self.config.recovery == "full" and state.tracked and not state.sure and not is_supported(fit, state)

    def _has_left(self, state: TrackState) -> bool:
        """Return whether a shape was lost for so long that it is searched as one never found."""
        return self.config.recovery == "full" and state.tracked and state.lost >= _SETTINGS.forgotten

    def _forgotten(self, state: TrackState) -> TrackState:
        """Return a state as before the first fit, at the same frame."""
        names = ["frame", "time", "interval", "origin", "person", "lost"]
        kept = {name: getattr(state, name) for name in names}
        first = initial_state(self._fitter.skin, torch.full_like(state.pose, torch.nan), self.config.seed)
        return _with_person(replace(first, **kept), state.known_coefficients)

    def _accept(self, state: TrackState, frame: Frame, fit: FrameFit | None) -> tuple[FrameResult, TrackState]:
        """Return the result of a frame with the best fit that was found, and the state after it."""
        if fit is None:
            return self._hold(state, frame, Status.LOST)
        covariance, observed = self._fitter.covariance(fit)
        result = fitted_result(self._fitter, state, frame, fit, covariance)
        after, usable = self._state_after(state, frame, fit, observed), result.statuses[0].usable
        if fit.person is not None:
            after = _with_person(after, fit.person.known if usable else state.known_coefficients)
        return result, replace(after, sure=after.sure or usable)

    def _state_after(self, state: TrackState, frame: Frame, fit: FrameFit, observed: Tensor) -> TrackState:
        """Return the state after a fit, of whose degrees of freedom data tell the observed share (num_dofs,)."""
        found, pose = fit.acquired == "found", fit.world_pose
        after = update_means(state, fit, len(frame.data))
        if is_continuous(fit, state):
            after = update_motion(after, frame, fit, observed)
        else:
            after = restart_motion(after, self._fitter.size)
        unexplained = state.unexplained
        if found or not is_unreliable(state):
            unexplained = self._fitter.clusters.remember(state, fit.unexplained, fit.transforms[0])
        keyframes = state.keyframes
        if state.frame % _SETTINGS.keyframe_interval == 0:
            keyframes = torch.cat([keyframes, pose[None]])[-_SETTINGS.num_keyframes :]
        points, weights, reference_pose = next_model_points(self._fitter, state, fit)
        return replace(
            after, pose=pose, points=points, weights=weights, reference_pose=reference_pose, keyframes=keyframes,
            unexplained=unexplained, lost=0,
            failed_searches=min(state.failed_searches, 1) if state.lost else state.failed_searches,
        )  # fmt: skip

    def _hold(self, state: TrackState, frame: Frame, status: Status) -> tuple[FrameResult, TrackState]:
        """Return the result of a frame without a fit, at the predicted pose, and the state after it."""
        if status is Status.LOST and not state.found:
            status = Status.NOT_FOUND
        pose = self._fitter.predict(state, frame.elapsed)
        after = replace(state, pose=pose, velocity=decayed_velocity(state, frame.elapsed), lost=state.lost + 1)
        after = _with_person(after, state.known_coefficients)
        return predicted_result(self._fitter, state, frame, pose, status), after


def _with_person(state: TrackState, known: KnownPerson | None) -> TrackState:
    """Return the state with what is known of a person, if there is one."""
    if known is None:
        return state
    return replace(
        state, coefficients=known.coefficients, person_covariance=known.covariance, person_sensitivity=known.sensitivity
    )
