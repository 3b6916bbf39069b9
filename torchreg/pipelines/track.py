"""Following an articulated shape through a sequence of clouds: predict, align, notice a loss, find it again."""

from __future__ import annotations

import math
import time as clock
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

import torchreg.pipelines.storage  # noqa: F401  (results of a tracker can be saved)
from torchreg._checks import as_float_tensor, check_choice, check_count, check_finite, check_positive, check_shape
from torchreg.correspondence.em import expectation
from torchreg.correspondence.sigma import SigmaSchedule
from torchreg.errors import InputError, InputTypeError, UnitsWarning
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.models.articulated import ArticulatedShape
from torchreg.models.limbs import find_limbs
from torchreg.models.skin import LinearBlendSkin, bending_weights, sample_skin
from torchreg.pipelines.align import AlignConfig, align
from torchreg.pipelines.align_objectives import PosePrior
from torchreg.pipelines.align_problem import INLIER_SHARE, AlignProblem, alignment_cost, centered_problem, shifted
from torchreg.pipelines.align_stages import SIGMA_PER_NOISE, fit_surface, register, surface_noise
from torchreg.pipelines.find_pose import FindPoseConfig, find_pose
from torchreg.pipelines.pose_search import PoseSearch, fit_candidates, score_candidates
from torchreg.results import FrameResult, Status, TrackResult, TrackState

MODEL_POINTS = ("seen", "data", "shape")
OnFrame = Callable[[Tensor, FrameResult], None]

# Kernel widths of a frame's EM as shares of the size: the last, and the range of the first, which is this many times
# the running error of the prediction; two that differ by more than the ratio have one between them.
_STOP_SIGMA, _START_RANGE, _START_PER_ERROR, _SIGMA_RATIO = 0.02, (0.03, 0.08), 2.0, 2.2
_SURFACE_SIGMAS = (0.022,)
# Standard deviation of the joints about their prediction: this many times its running error, within a range, radians;
# and about the last pose where that was lost.
_PRIOR_PER_ERROR, _PRIOR_RANGE, _WIDE_PRIOR, _SURE_SHARE = 2.0, (0.08, 0.3), 0.3, 0.5
# Errors of the prediction at first: joints in radians, points as a share of the size.
_NEW_JOINT_ERROR, _NEW_ERROR = 0.15, 0.04
# Kept from frame to frame of running means, and of the largest errors of the prediction.
_MEMORY, _ERROR_MEMORY = 0.9, 0.9
# Share of a surprise that the velocity takes over, and what is left of a velocity that data did not confirm.
_VELOCITY_GAIN, _FAST_GAIN, _VELOCITY_DECAY, _HELD_DECAY = 0.5, 0.8, 0.7, 0.95
# Frames ahead that a velocity is trusted, and that uncertainty grows.
_MAX_AHEAD, _MAX_SPREAD = 3.0, 4.0
# Where predictions are off by more than this share of the size, other paces are tried as well.
_FAST, _PACES, _FAST_WIDTHS, _FAST_STEPS = 0.04, (0.0, 2.0), (0.06, 0.04, 0.03), 2
# Data count that lie this near the bounds of the predicted model, as a share of its size.
_REACH = 0.12
# Data this near the surface, as a share of the size, are harvested (5 mm on a hand); they show model points this near.
_HARVEST_SHARE, _SHOWN_SHARE = 0.022, 0.03
# A part that is shown at fewer points keeps the shape's own; a part gives at most this many times its even share.
_FEW_SHOWN, _PART_CAP = 4, 2.0
# A model point whose share of the data is less has none.
_COVERED = 0.05
# A loss: fewer inliers than this, or than these shares of the running count and ratio; or model points without data;
# or residuals so many times the usual ones, and not below a share of the size.
_MIN_INLIERS, _LOST_COUNT, _LOST_RATIO, _LOST_COVERED = 10, 0.12, 0.5, 0.3
_LOST_RESIDUAL, _FINE_RESIDUAL = 1.8, 0.006
# A doubt, beyond what is usual: novel dense data off the surface, so many or this share of the inliers; residuals, this
# many times; model points without data or joints at limits, by these shares; points off the prediction, by this share
# of the size.
_DOUBT_NOVEL, _DOUBT_NOVEL_SHARE, _DOUBT_RESIDUAL = 5, 0.012, 1.5
_DOUBT_COVERED, _DOUBT_HELD, _DOUBT_JUMP = 0.25, 0.3, 0.15
# What did not help is tried again at once so many times, then after longer and longer rests, frames; strays that
# stay after so many attempts are background.
_FREE_FAILS, _STARTS_FAILS, _SEARCH_FAILS, _FIND_FAILS, _LONGEST_REST, _LEARNED_AFTER = 1, 1, 3, 5, 32, 6
# A pose found everywhere is checked in as many frames at most, until it holds.
_CHECKS = 3
# Data that another pose must explain beyond those that the prediction led to.
_MIN_GAIN = 4.0
# Frames after a loss before searching around the last pose, and everywhere.
_SEARCH_AFTER, _FIND_AFTER = 2, 3
_SURFACE_STARTS, _SURFACE_START_STEPS = (0.06, 0.04, 0.03), 2
_NUM_PREVIOUS, _PREVIOUS_EVERY, _NUM_SEARCHED, _MAX_FOUND_DATA = 3, 10, 2, 3000
# Found poses compete by how near they are if they leave at most this share of the data more unexplained than the best.
_AS_GOOD = 0.03
# Less data are none; data and model that differ more than this in size are in different units.
_MIN_DATA, _UNITS_RATIO = 10, 30.0
# Most model points; a joint this near to a limit is at it, radians; a frame with as many data less hides the shape.
_MOST, _AT_LIMIT, _HIDDEN_SHARE = 0.9, 1e-3, 0.6
# Data farther from the surface are off it, standard deviations; with this many others within so many distances between
# neighbors, and within this share of the size, they are strays, the same as before within another share.
_FAR_NOISES, _CLUSTER_NEIGHBORS, _CLUSTER_RADIUS, _MAX_CLUSTER, _SAME_STRAY = 3.0, 5, 4.0, 0.1, 0.05
_NUM_SPACINGS, _MAX_STRAYS = 100, 300


@dataclass(frozen=True)
class TrackConfig:
    """How a tracker runs. Lengths default to shares of the model's size, so one configuration fits all shapes.

    Args:
        model_points: what the E-step registers: "seen", the shape's own sampled points that data showed in the frame
            before; "data", data near the surface in the frame before, as in the paper; "shape", all sampled points.
        num_model_points: of them, about.
        prediction: "velocity", every degree of freedom goes on as it went, or "none".
        em_steps: EM iterations per sigma.
        surface_steps: Levenberg-Marquardt steps at each width of the surface fit.
        prior_std: standard deviation of the joints about their prediction, radians; by default twice the running error
            of the prediction, from 0.08 to 0.3.
        inlier_distance: data nearer to the fitted surface are inliers, metres; 2 % of the model's size by default.
        recovery: what a doubtful or lost frame may cost: "full", "starts" (tens of milliseconds, around poses known),
            or "none".
        max_points: data near the shape that a frame is aligned with; drawn from more.
        sharpness: of the bending skin.
        debias: see `AlignConfig`.
        nan_policy: "omit" leaves out data that are not finite; "raise" refuses them.
        seed: of all that is drawn.
    """

    model_points: str = "seen"
    num_model_points: int = 500
    prediction: str = "velocity"
    em_steps: int = 1
    surface_steps: int = 1
    prior_std: float | None = None
    inlier_distance: float | None = None
    recovery: str = "full"
    max_points: int = 1500
    sharpness: float = 2.0
    debias: float = 0.8
    nan_policy: str = "omit"
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice(self.model_points, "model_points", MODEL_POINTS)
        check_choice(self.prediction, "prediction", ("velocity", "none"))
        check_choice(self.recovery, "recovery", ("full", "starts", "none"))
        check_choice(self.nan_policy, "nan_policy", ("omit", "raise"))
        for name in ("num_model_points", "em_steps", "surface_steps", "max_points"):
            check_count(getattr(self, name), name, 1)
        for name in ("prior_std", "inlier_distance"):
            if getattr(self, name) is not None:
                check_positive(getattr(self, name), name)
        check_positive(self.sharpness, "sharpness")
        check_positive(self.debias, "debias", allow_zero=True)


@dataclass(frozen=True)
class _Frame:
    """What is known of a frame before it is aligned: the cloud (M, 3), which points are finite (M,), and the gap.

    The gap counts intervals since the frame before.
    """

    cloud: Tensor
    finite: Tensor
    gap: float

    @property
    def data(self) -> Tensor:
        """The finite points (F, 3)."""
        return self.cloud[self.finite]


@dataclass(frozen=True)
class _View:
    """A frame seen from a pose: the alignment of the data in reach, in coordinates around the pose's base.

    Args:
        problem: one alignment; its prior's mean is the pose.
        origin: (3,) of its coordinates.
        near: (M,) which points of the cloud are in reach; the problem may hold a part of them.
    """

    problem: AlignProblem
    origin: Tensor
    near: Tensor

    def local(self, poses: Tensor) -> Tensor:
        """Return poses (S, num_dofs) of the world within the limits, as (1, S, num_dofs) in these coordinates."""
        return self.problem.clamp(shifted(poses, -self.origin)).unsqueeze(0)


@dataclass(frozen=True)
class _Fit:
    """A pose fitted to a frame, in the coordinates of its view, and the evidence for it.

    Args:
        view: of the frame.
        pose: (1, num_dofs).
        distance: (1, M) of the data.
        jacobian: (1, M, num_dofs) of the distances.
        posterior: (1, M) that a datum belongs to the model points.
        sigma: (1,) last kernel width, metres.
        noise: (1,) standard deviation of the data near the surface, metres.
        change: of the last step.
        cost: that ranks fits to a frame.
        inliers: how many data lie near the surface.
        strays: (K, 3) data that lie off it as densely as others on it.
        novel: how many of them lie elsewhere on the moving shape than those of the frame before.
        covered: share of the model points that have data.
        held: share of the joints that lie at a limit.
        jump: how far from the prediction most model points are, metres.
        how: what led to it.
    """

    view: _View
    pose: Tensor
    distance: Tensor
    jacobian: Tensor
    posterior: Tensor
    sigma: Tensor
    noise: Tensor
    change: float
    cost: float
    inliers: int
    strays: Tensor
    novel: int
    covered: float
    held: float
    jump: float
    how: str

    @property
    def ratio(self) -> float:
        """Inliers as a share of the data in reach."""
        return self.inliers / max(1, self.distance.shape[-1])

    @property
    def explained(self) -> float:
        """How many data in reach lie on the surface, softly counted, less the prior's cost."""
        return (1 - self.cost / max(1, self.distance.shape[-1])) * int(self.view.near.sum())

    @property
    def world(self) -> Tensor:
        """The pose (num_dofs,) in the coordinates of the cloud."""
        return shifted(self.pose[0], self.view.origin)


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
            # About half of the shape's points are seen at a time.
            count = self.config.num_model_points * (2 if self.config.model_points == "seen" else 1)
            self._skin = model_points or sample_skin(shape, count, sharpness=self.config.sharpness)
            self._parts = self._skin.weights.argmax(-1)
            self._limbs = find_limbs(shape)[0]
            nowhere = torch.zeros_like(shape.rest[None, :3])
            self._template = centered_problem(
                self._skin, nowhere[None], torch.ones_like(nowhere[:, :1], dtype=torch.bool), shape.rest[None], nowhere,
                prior_std=1.0, pose_atol=AlignConfig().pose_atol, debias=self.config.debias,
            )  # fmt: skip
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
        state, gap = _timed(self._state, time)
        with torch.no_grad():
            frame = _Frame(cloud, torch.isfinite(cloud).all(-1), gap)
            unfit = self._unfit(frame.data)
            if unfit is not None:
                return self._hold(state, frame, unfit)
            fit, state = self._follow(state, frame) if state.tracked else self._first(state, frame)
            return self._hold(state, frame, Status.LOST) if fit is None else self._accept(state, frame, fit)

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
        points = self._skin.points
        return TrackState(
            frame=0, time=0.0, interval=0.0, pose=pose, velocity=torch.zeros_like(pose), points=points,
            weights=self._skin.weights, reference_pose=self._skin.reference_pose, previous=pose[None][:0],
            strays=points[:0], error=0.0, joint_error=0.0, total=0.0, inliers=0.0, ratio=0.0, residual=0.0,
            covered=0.0, held=0.0, lost=0, rest=0, fails=0, unsure=0, seed=self.config.seed,
        )  # fmt: skip

    def _checked(self, points: Tensor) -> Tensor:
        cloud = as_float_tensor(points, "points", like=self.shape.rest)
        check_shape(cloud, "points", ("M", 3))
        if self.config.nan_policy == "raise":
            check_finite(cloud, "points", "drop them or set nan_policy='omit'")
        return cloud

    def _unfit(self, data: Tensor) -> Status | None:
        """Return why data cannot be aligned with at all, if so."""
        if len(data) < _MIN_DATA:
            return Status.NO_DATA
        spread = 2 * float((data - data.mean(0)).norm(dim=-1).median()) / self._template.size
        if 1 / _UNITS_RATIO < spread < _UNITS_RATIO:
            return None
        warnings.warn(
            f"the data spread over {spread:.3g} times the model's size of {self._template.size:.3g} m: are they in "
            f"metres? Scale them, by 0.001 if they are in millimeters",
            UnitsWarning,
            stacklevel=3,
        )
        return Status.OTHER_UNITS

    def _first(self, state: TrackState, frame: _Frame) -> tuple[_Fit | None, TrackState]:
        """Return the fit of the first frame that shows the shape, if any, and what the search leaves of the state."""
        fit = None
        if state.found:
            data = _thinned(frame.data, self.config.max_points, _generator(state))
            config = AlignConfig(sharpness=self.config.sharpness)
            pose = align(self.shape, data, state.pose, model_points=self._skin, config=config).pose
            fit = self._fit_at(state, frame, pose, "tracked")
        waits = state.rest > 0 or self.config.recovery != "full"
        if (fit is None or _is_lost(state, fit)) and not waits:
            fit = self._sought(state, frame)
        fit, state = _kept(state, fit)
        return fit, _rested(state, fit is not None) if fit is not None or not waits else _waited(state)

    def _follow(self, state: TrackState, frame: _Frame) -> tuple[_Fit | None, TrackState]:
        """Return the fit of a later frame, if any is worth it, and what the search for it leaves of the state."""
        checks = state.unsure
        fit, state = self._continued(state, frame)
        if checks == 0 or (fit is not None and fit.how == "found"):
            return fit, state
        # A pose that was found everywhere must hold against the same search in another frame.
        rival = self._sought(state, frame)
        if rival is None or (fit is not None and rival.explained < fit.explained + _MIN_GAIN):
            return fit, replace(state, unsure=0)
        return rival, replace(state, unsure=checks - 1)

    def _continued(self, state: TrackState, frame: _Frame) -> tuple[_Fit | None, TrackState]:
        """Return the same, from the frames before and what can be searched around them."""
        view = self._view(state, frame, self._predicted(state, frame.gap), self._seen_skin(state))
        fit = None if view is None else self._descended(view, state, frame.gap)
        if fit is not None and not _is_lost(state, fit) and not _is_doubtful(state, fit):
            return fit, _rested(state, True)
        lost = fit is None or _is_lost(state, fit)
        if self.config.recovery != "none" and (lost or state.rest == 0):
            fit = self._recovered(state, frame, view, fit)
            tried = state.rest == 0 and (not lost or _may_show(state, frame))
            good = fit is not None and not _is_lost(state, fit) and not _is_doubtful(state, fit)
            state = _rested(state, good) if good or tried else _waited(state)
        else:
            state = _waited(state)
        return _kept(state, fit)

    def _predicted(self, state: TrackState, gap: float) -> Tensor:
        """Return the pose (num_dofs,) expected after some intervals."""
        if self.config.prediction == "none":
            return state.pose
        ahead = min(gap, _MAX_AHEAD) * (state.interval or 1.0)
        return self.shape.clamp(self.shape.retract(state.pose, ahead * state.velocity))

    def _seen_skin(self, state: TrackState) -> LinearBlendSkin:
        return LinearBlendSkin(self.shape, state.points, state.weights, state.reference_pose)

    def _view(
        self, state: TrackState, frame: _Frame, pose: Tensor, skin: LinearBlendSkin | None = None
    ) -> _View | None:
        """Return the frame as seen from a pose (num_dofs,), if any data are in reach; the prior holds joints there."""
        origin = pose[:3].clone()
        local = shifted(pose, -origin)
        posed, reach = self._skin(local), _REACH * self._template.size * _spread(state, frame.gap)
        data = frame.cloud - origin
        near = ((data > posed.amin(0) - reach) & (data < posed.amax(0) + reach)).all(-1)
        data = _thinned(data[near], self.config.max_points, _generator(state))
        if len(data) < _MIN_DATA:
            return None
        shift = torch.nn.functional.pad(origin, (0, self.shape.num_dofs - 3))
        problem = replace(
            self._template, skin=skin or self._skin, data=data[None],
            valid=torch.ones_like(data[None, :, 0], dtype=torch.bool),
            lower=self.shape.lower - shift, upper=self.shape.upper - shift,
            prior=PosePrior(local[None], self._precision(_WIDE_PRIOR)),
        )  # fmt: skip
        return _View(problem, origin, near)

    def _fit_at(self, state: TrackState, frame: _Frame, pose: Tensor, how: str) -> _Fit | None:
        view = self._view(state, frame, pose)
        return None if view is None else self._fit(view, state, how, view.problem.prior.mean)

    def _precision(self, std: float) -> Tensor:
        return self._template.prior.precision / std**2

    def _descended(self, view: _View, state: TrackState, gap: float) -> _Fit:
        """Return the fit that plain descent from the prediction leads to."""
        problem, spread, size = view.problem, _spread(state, gap), view.problem.size
        low, high = _PRIOR_RANGE
        std = self.config.prior_std or min(max(_PRIOR_PER_ERROR * state.joint_error * spread, low), high)
        problem = replace(problem, prior=replace(problem.prior, precision=self._precision(std)))
        low, high = _START_RANGE
        start, stop = size * min(max(_START_PER_ERROR * spread * state.error / size, low), high), _STOP_SIGMA * size
        schedule = SigmaSchedule.geometric(start, stop, 2 if start < _SIGMA_RATIO * stop else 3)
        starts = problem.prior.mean
        if state.error > _FAST * size and self.config.prediction == "velocity":
            # Joints that fast turn back or speed up within a frame, each at another time.
            steps = starts.new_tensor(_PACES).unsqueeze(-1) * (min(gap, _MAX_AHEAD) * state.interval * state.velocity)
            others = self.shape.retract(state.pose.expand_as(steps), steps)
            starts = torch.cat([starts, view.local(others)[0]])
        rows = replace(problem, prior=replace(problem.prior, mean=problem.prior.mean[:1]))
        rows = rows.rows(torch.zeros(len(starts), dtype=torch.long, device=starts.device))
        moved = register(rows, starts, schedule, em_steps=self.config.em_steps, m_steps=1).pose
        if len(moved) > 1:
            wide = fit_candidates(problem, starts[None], _FAST_WIDTHS, _FAST_STEPS)[0]
            moved = torch.cat([moved, wide])
        pose = moved if len(moved) == 1 else self._mixed(problem, moved)
        return self._fit(replace(view, problem=problem), state, "tracked", pose)

    def _mixed(self, problem: AlignProblem, poses: Tensor) -> Tensor:
        """Return the best of poses (S, num_dofs), (1, num_dofs), each limb as where it explains most data."""
        best = poses[score_candidates(problem, poses[None], _STOP_SIGMA)[0].argmin()]
        if not self._limbs:
            return best[None]
        hybrids = best.repeat(len(self._limbs), len(poses), 1)
        for number, limb in enumerate(self._limbs):
            hybrids[number][:, limb.dofs] = poses[:, limb.dofs]
        scores = score_candidates(problem, hybrids.flatten(0, 1)[None], _STOP_SIGMA)[0].reshape(hybrids.shape[:2])
        mixed = best.clone()
        for limb, chosen in zip(self._limbs, scores.argmin(1).tolist(), strict=True):
            mixed[limb.dofs] = poses[chosen, limb.dofs]
        # Limbs chosen one by one may share their data.
        options = torch.stack([mixed, hybrids.flatten(0, 1)[scores.argmin()]])
        return options[score_candidates(problem, options[None], _STOP_SIGMA)[0].argmin()][None]

    def _fit(self, view: _View, state: TrackState, how: str, pose: Tensor) -> _Fit:
        """Return the fit of the surface from a pose (1, num_dofs), and the evidence for it."""
        problem = view.problem
        fitted = fit_surface(problem, pose, steps=self.config.surface_steps, sigmas=_SURFACE_SIGMAS)
        pose = fitted.pose
        distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
        posed = problem.skin(pose)
        sigma = torch.full_like(fitted.sigma, _STOP_SIGMA * problem.size)
        observed = expectation(posed, problem.data, sigma)
        wide = replace(problem, prior=replace(problem.prior, precision=self._precision(_WIDE_PRIOR)))
        noise = surface_noise(distance, problem.valid, problem.size)
        strays = _strays(problem.data[0], distance[0].abs() < _FAR_NOISES * noise, problem.size)
        known = self._placed_strays(state, pose)
        novel = _nearest_distance(strays, known) > _SAME_STRAY * problem.size
        moved = (posed - problem.skin(problem.prior.mean)).norm(dim=-1)
        return _Fit(
            view, pose, distance, jacobian, observed.inlier_posterior, sigma,
            noise=noise, change=float(fitted.change),
            cost=float(alignment_cost(wide, pose, distance)), inliers=int((distance.abs() < self._inlier).sum()),
            strays=strays, novel=int(novel.sum()), covered=float((observed.weights > _COVERED).float().mean()),
            held=float(_at_limits(problem, pose).float().mean()), jump=float(moved.quantile(_MOST)), how=how,
        )  # fmt: skip

    def _placed_strays(self, state: TrackState, pose: Tensor) -> Tensor:
        """Return where the strays of the frames before are, (S, 3), if they moved along with the trunk to a pose."""
        trunk = self.shape.part_transforms(pose[0])[0]
        return transform_points(trunk, state.strays)

    def _strays_after(self, state: TrackState, fit: _Fit) -> Tensor:
        """Return the strays to be expected in the next frame, in the trunk's frame.

        Those of a doubtful fit may be what the fit missed, and are expected only after attempts to explain them.
        """
        if _in_doubt(state) and fit.how != "found":
            return state.strays
        trunk = self.shape.part_transforms(fit.pose[0])[0]
        strays = transform_points(invert_rigid(trunk), fit.strays)
        # Where there are some still, those of earlier frames show better how far they reach.
        lasting = state.strays[_nearest_distance(state.strays, strays) < _SAME_STRAY * self._template.size]
        return torch.cat([strays, lasting])[:_MAX_STRAYS]

    @property
    def _new_error(self) -> float:
        return _NEW_ERROR * self._template.size

    @property
    def _inlier(self) -> float:
        return self.config.inlier_distance or INLIER_SHARE * self._template.size

    def _recovered(self, state: TrackState, frame: _Frame, view: _View | None, fit: _Fit | None) -> _Fit | None:
        """Return the best fit of what is tried, from what is cheap to what is not, until none is in doubt."""
        best = fit
        was_lost = fit is None or _is_lost(state, fit)
        for attempt in self._attempts(state, frame, view, fit):
            if attempt is None:
                continue
            # What is hidden may be anywhere; only what explains more data is worth a jump.
            if (
                best is None
                or attempt.explained > best.explained + _MIN_GAIN
                or (_is_lost(state, best) and not _is_lost(state, attempt))
            ):
                best = attempt
            # After a loss, doubts are left to the next frames.
            if not _is_lost(state, best) and (was_lost or not _is_doubtful(state, best)):
                break
        return best

    def _attempts(
        self, state: TrackState, frame: _Frame, view: _View | None, fit: _Fit | None
    ) -> Iterator[_Fit | None]:
        """Yield other fits of a frame, each costing more than the one before."""
        lost = fit is None or _is_lost(state, fit)
        dear = self.config.recovery == "full" and state.rest == 0 and (not lost or _may_show(state, frame))
        if view is not None:
            problem = view.problem
            known = torch.cat([problem.prior.mean[None], view.local(state.pose[None])], dim=1)
            known = known if fit is None else torch.cat([fit.pose[None], known], dim=1)
            wide = fit_candidates(problem, known, _SURFACE_STARTS, _SURFACE_START_STEPS)
            yield self._fit(view, state, "surface", wide[:, score_candidates(problem, wide, _STOP_SIGMA)[0].argmin()])
            if lost or state.fails >= _STARTS_FAILS:
                others = torch.cat([view.local(state.previous), view.local(_flipped(self._skin, state.pose))], dim=1)
                search = PoseSearch(problem, _generator(state))
                narrowed = search.narrow(torch.cat([known, others], dim=1) if lost else known, _NUM_SEARCHED)
                yield self._fit(view, state, "starts", narrowed[:, 0])
                if dear and (state.lost >= _SEARCH_AFTER if lost else state.fails == _SEARCH_FAILS):
                    yield self._fit(view, state, "search", search.settle(narrowed, 1)[0][:, 0])
        overdue = state.lost >= _FIND_AFTER if lost else state.fails == _FIND_FAILS
        if dear and overdue:
            yield self._sought(state, frame)

    def _sought(self, state: TrackState, frame: _Frame) -> _Fit | None:
        """Return the fit that a search everywhere leads to; among poses as good, the one nearest to the last."""
        data = _thinned(frame.data, _MAX_FOUND_DATA, _generator(state))
        starts = find_pose(self.shape, data, config=FindPoseConfig(seed=state.seed))
        poses = starts.poses
        if state.lost:
            poses = poses[starts.costs <= starts.costs.min() + _AS_GOOD * len(data)]
            away = (self.shape.keypoints(poses) - self.shape.keypoints(state.pose)).norm(dim=-1).mean(-1)
            poses = poses[away.argsort()]
        return self._fit_at(state, frame, poses[0], "found")

    def _accept(self, state: TrackState, frame: _Frame, fit: _Fit) -> FrameResult:
        """Return the record of a frame that was fitted, and go on from it."""
        pose = fit.world
        covariance, share = self._covariance(fit)
        anew = fit.how == "found"
        known = state.tracked and state.lost == 0 and not anew and not _is_far(state, fit)
        # Where it goes after a beginning, nothing says yet.
        surprise, velocity, jump = torch.full_like(pose, _NEW_JOINT_ERROR), torch.zeros_like(pose), self._new_error
        if known:
            surprise, jump = _difference(fit.view.problem.prior.mean[0], fit.pose[0]), fit.jump
            gain = _VELOCITY_GAIN if state.error < _FAST * self._template.size else _FAST_GAIN
            went = state.velocity + gain / (frame.gap * (state.interval or 1.0)) * surprise
            velocity = share * went + (1 - share) * _VELOCITY_DECAY * state.velocity
        surprise = surprise[6:][share[6:] > _SURE_SHARE]
        joint_error = float(surprise.norm()) / max(1, len(surprise)) ** 0.5
        kept = state.previous if state.frame % _PREVIOUS_EVERY else torch.cat([state.previous, pose[None]])
        points, weights, reference_pose = self._points_after(state, fit)
        self._state = replace(
            _usual_after(state, fit, len(frame.data)), pose=pose, velocity=velocity, points=points, weights=weights,
            reference_pose=reference_pose, previous=kept[-_NUM_PREVIOUS:], strays=self._strays_after(state, fit),
            error=max(jump, _ERROR_MEMORY * state.error),
            joint_error=max(joint_error, _ERROR_MEMORY * state.joint_error),
            lost=0, fails=min(state.fails, 1) if state.lost else state.fails,
        )  # fmt: skip
        done = fit.change <= fit.view.problem.pose_atol
        return self._record(
            state, frame, pose, fit, covariance, Status.CONVERGED if done else Status.MAX_STEPS, fit.how
        )

    def _covariance(self, fit: _Fit) -> tuple[Tensor, Tensor]:
        """Return the covariance of a fit, and which share (num_dofs,) of what is known then the data say."""
        precision = fit.view.problem.prior.precision.clone()
        base = precision.new_tensor([self._template.size] * 3 + [math.pi] * 3)
        precision[:6] = base.square().reciprocal()
        weights = (-(fit.distance[0] / (SIGMA_PER_NOISE * fit.noise)).square()).exp()
        covariance = pose_covariance(fit.jacobian[0], weights, fit.noise[0], precision)
        return covariance, (1 - covariance.diagonal() * precision).clamp(0, 1)

    def _hold(self, state: TrackState, frame: _Frame, status: Status) -> FrameResult:
        """Return the record of a frame without a fit; the prediction stands in for it and slows down."""
        pose = self._predicted(state, frame.gap)
        velocity = state.velocity * _HELD_DECAY ** min(frame.gap, _MAX_AHEAD)
        self._state = replace(state, pose=pose, velocity=velocity, lost=state.lost + 1)
        unknown = torch.full((self.shape.num_dofs,) * 2, torch.nan).to(pose)
        how = "lost" if status is Status.LOST else "held"
        return self._record(state, frame, pose, None, unknown, status, how)

    def _record(
        self, state: TrackState, frame: _Frame, pose: Tensor, fit: _Fit | None, covariance: Tensor, status: Status,
        how: str,
    ) -> FrameResult:  # fmt: skip
        nothing = pose.new_tensor(torch.nan)
        distances = torch.where(frame.finite, torch.inf, torch.nan).to(pose)
        posterior = torch.zeros_like(distances)
        skin, sigma, cost = self._skin, nothing, nothing
        if fit is not None:
            problem, near = fit.view.problem, fit.view.near
            skin, sigma, cost = problem.skin, fit.sigma[0], nothing.new_tensor(fit.cost)
            distance, share = fit.distance[0], fit.posterior[0]
            if int(near.sum()) > len(distance):
                data = (frame.cloud[near] - fit.view.origin)[None]
                distance = problem.surface.distance(data, fit.pose)[0]
                share = expectation(problem.skin(fit.pose), data, fit.sigma).inlier_posterior[0]
            distances[near], posterior[near] = distance, share
        inliers = distances.abs() < self._inlier
        count = int(frame.finite.sum())
        return FrameResult(
            pose=pose, registered=skin(pose), keypoints=self.shape.keypoints(pose), distances=distances,
            inliers=inliers, posterior=posterior, sigma=sigma, cost=cost, status=status, history=(),
            covariance=covariance, acquired=how, frame=state.frame - 1, time=state.time,
            inlier_ratio=int(inliers.sum()) / max(1, count),
            residual=math.nan if fit is None else float(fit.noise),
        )  # fmt: skip

    def _points_after(self, state: TrackState, fit: _Fit) -> tuple[Tensor, Tensor, Tensor]:
        """Return the model points (N, 3) for the next frame, their weights (N, P), and the pose that they are in."""
        skin, pose, size = self._skin, fit.pose[0], fit.view.problem.size
        data = fit.view.problem.data[0]
        data = data[fit.distance[0].abs() < _HARVEST_SHARE * size]
        if self.config.model_points == "shape" or len(data) < _MIN_DATA:
            return skin.points, skin.weights, skin.reference_pose
        posed = skin(pose)
        near = torch.cdist(posed, data, compute_mode="donot_use_mm_for_euclid_dist")
        if self.config.model_points == "seen":
            shown = near.amin(-1) < _SHOWN_SHARE * size
            shown = shown | (self._count(self._parts[shown]) < _FEW_SHOWN)[self._parts]
            return skin.points[shown], skin.weights[shown], skin.reference_pose
        return self._harvested(state, data, pose, posed, near)

    def _count(self, parts: Tensor) -> Tensor:
        return torch.bincount(parts, minlength=self.shape.num_parts)

    def _harvested(
        self, state: TrackState, data: Tensor, pose: Tensor, posed: Tensor, near: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return data as model points, at most so many per part, and the shape's own where a part shows few."""
        if self.shape.surface is None:
            weights = bending_weights(self.shape, data, pose, self.config.sharpness)
        else:
            weights = self._skin.weights[near.argmin(0)]
        parts = weights.argmax(-1)
        order = (parts + torch.rand(len(parts), generator=_generator(state)).to(data)).argsort()
        ordered = parts[order]
        count = self._count(parts)
        rank = torch.arange(len(parts), device=data.device) - (count.cumsum(0) - count)[ordered]
        cap = _PART_CAP * self.config.num_model_points / max(1, int((count >= _FEW_SHOWN).sum()))
        kept = order[rank < cap]
        own = (count < _FEW_SHOWN)[self._parts]
        return torch.cat([posed[own], data[kept]]), torch.cat([self._skin.weights[own], weights[kept]]), pose


def pose_covariance(jacobian: Tensor, weights: Tensor, noise: Tensor, precision: Tensor) -> Tensor:
    """Return the covariance of a fitted pose, ``(J^T W J / noise^2 + diag(precision))^-1``.

    Args:
        jacobian: (M, D) of the residuals.
        weights: (M,) of the residuals, from 0 to 1.
        noise: () standard deviation of the residuals.
        precision: (D,) of the prior; positive wherever residuals do not tell.

    Returns:
        (D, D), in the coordinates of the Jacobian.

    Differentiable: in all.
    """
    rows = (jacobian * (weights.sqrt() / noise).unsqueeze(-1)).double()
    information = rows.mT @ rows + torch.diag_embed(precision.double())
    scale = information.diagonal().rsqrt()
    scaled = information * scale.unsqueeze(-1) * scale
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(scaled))
    return (inverse * scale.unsqueeze(-1) * scale).to(jacobian)


def _timed(state: TrackState, time: float | None) -> tuple[TrackState, float]:
    """Return the state at the time of the next frame, and how many intervals have passed."""
    first = state.frame == 0
    usual = state.interval or 1.0
    if time is None:
        passed = 0.0 if first else usual
    else:
        if not math.isfinite(time) or (not first and time <= state.time):
            raise InputError(f"time must be finite and later than the frame before at {state.time:g}, got {time}")
        passed = 0.0 if first else time - state.time
    now = state.time + passed if time is None or not first else time
    if first:
        return replace(state, frame=1, time=now), 1.0
    # The shortest time between frames is the interval; slightly shorter ones do not change the gaps.
    interval = passed if state.interval == 0 else min(state.interval, passed)
    return replace(state, frame=state.frame + 1, time=now, interval=interval), passed / interval


def _generator(state: TrackState) -> torch.Generator:
    """Return the randomness of a frame, the same whenever it is asked for."""
    return torch.Generator().manual_seed(state.seed + state.frame)


def _thinned(data: Tensor, count: int, generator: torch.Generator) -> Tensor:
    return data if len(data) <= count else data[torch.randperm(len(data), generator=generator)[:count].to(data.device)]


def _spread(state: TrackState, gap: float) -> float:
    """Return how much wider than usual the prediction may be off."""
    return min(gap + state.lost, _MAX_SPREAD)


def _difference(start: Tensor, end: Tensor) -> Tensor:
    """Return the tangent step (num_dofs,) from one pose to another."""
    turned = compose_rotation_vectors(end[3:6], -start[3:6])
    return torch.cat([end[:3] - start[:3], turned, end[6:] - start[6:]])


def _flipped(skin: LinearBlendSkin, pose: Tensor) -> Tensor:
    """Return the pose turned by half around each principal axis of its points, (3, num_dofs)."""
    points = skin(pose)
    center = points.mean(0)
    axes = torch.linalg.eigh((points - center).mT @ (points - center)).eigenvectors.mT
    turns = 2 * axes.unsqueeze(-1) * axes.unsqueeze(-2) - torch.eye(3).to(axes)
    moved = center + (turns @ (pose[:3] - center).unsqueeze(-1)).squeeze(-1)
    rotations = compose_rotation_vectors(math.pi * axes, pose[3:6].expand(3, 3))
    return torch.cat([moved, rotations, pose[6:].expand(3, -1)], dim=-1)


def _at_limits(problem: AlignProblem, pose: Tensor) -> Tensor:
    joints = pose[..., 6:]
    return (joints <= problem.lower[6:] + _AT_LIMIT) | (joints >= problem.upper[6:] - _AT_LIMIT)


def _is_lost(state: TrackState, fit: _Fit) -> bool:
    """Return whether far fewer data than usual support a fit."""
    few = fit.inliers < max(_MIN_INLIERS, _LOST_COUNT * state.inliers)
    # What moved far must bring most of its data along.
    stray = _is_far(state, fit) and fit.inliers < _LOST_RATIO * state.inliers
    # Data of something else lie beside a surface that was drawn to them.
    loose = _DOUBT_RESIDUAL if state.lost else _LOST_RESIDUAL
    usual = max(loose * state.residual, _FINE_RESIDUAL * fit.view.problem.size)
    vague = state.tracked and float(fit.noise) > usual
    bare = fit.covered < _LOST_COVERED * state.covered
    return few or stray or vague or bare or fit.ratio < _LOST_RATIO * state.ratio


def _is_far(state: TrackState, fit: _Fit) -> bool:
    return fit.jump > _DOUBT_JUMP * fit.view.problem.size * max(1, state.lost)


def _in_doubt(state: TrackState) -> bool:
    """Return whether what a frame shows may not yet be taken for usual."""
    return state.tracked and (state.lost > 0 or 0 < state.fails < _LEARNED_AFTER)


def _usual_after(state: TrackState, fit: _Fit, total: int) -> TrackState:
    """Return the state with running means that a fit has gone into."""
    anew = fit.how == "found" and state.lost == 0
    if _in_doubt(state) and not anew:
        return state
    keep = 0.0 if anew or not state.tracked else _MEMORY
    pairs = (
        (state.total, total), (state.inliers, fit.inliers), (state.ratio, fit.ratio), (state.residual, fit.noise),
        (state.covered, fit.covered), (state.held, fit.held),
    )  # fmt: skip
    total_, inliers, ratio, residual, covered, held = (keep * old + (1 - keep) * float(new) for old, new in pairs)
    return replace(state, total=total_, inliers=inliers, ratio=ratio, residual=residual, covered=covered, held=held)


def _is_doubtful(state: TrackState, fit: _Fit) -> bool:
    """Return whether the evidence for a fit is worse than usual in any way."""
    if not state.tracked:
        return False
    return (
        fit.novel > max(_DOUBT_NOVEL, _DOUBT_NOVEL_SHARE * fit.inliers)
        or float(fit.noise) > _DOUBT_RESIDUAL * state.residual
        or fit.covered < state.covered - _DOUBT_COVERED
        or fit.held > state.held + _DOUBT_HELD
        or _is_far(state, fit)
    )


def _may_show(state: TrackState, frame: _Frame) -> bool:
    """Return whether enough data came for the shape to be among them, or it is time to look in any case."""
    return len(frame.data) > state.total - _HIDDEN_SHARE * state.inliers or _rest_after(state.fails) >= _LONGEST_REST


def _rested(state: TrackState, good: bool) -> TrackState:
    """Return the state after an attempt: what helped may be tried at once, what did not, later and later."""
    if good:
        return replace(state, rest=0, fails=0)
    return replace(state, rest=_rest_after(state.fails + 1), fails=state.fails + 1)


def _kept(state: TrackState, fit: _Fit | None) -> tuple[_Fit | None, TrackState]:
    """Return the fit if it is no loss, and the state, which is unsure of a fit that was found everywhere."""
    if fit is None or _is_lost(state, fit):
        return None, state
    return fit, replace(state, unsure=_CHECKS) if fit.how == "found" else state


def _waited(state: TrackState) -> TrackState:
    return replace(state, rest=max(0, state.rest - 1))


def _rest_after(fails: int) -> int:
    return 0 if fails <= _FREE_FAILS else min(2 ** min(fails - _FREE_FAILS, 16), _LONGEST_REST)


def _strays(data: Tensor, near: Tensor, size: float) -> Tensor:
    """Return the data (K, 3) off the surface that lie as densely as those on it: outliers are thin in space."""
    far, on = data[~near], data[near]
    if not len(on) or not len(far):
        return far[:0]
    some = on[:: max(1, len(on) // _NUM_SPACINGS)]
    spacing = torch.cdist(some, on).topk(2, largest=False).values[:, -1].median() if len(on) > 1 else data.new_zeros(())
    radius = (_CLUSTER_RADIUS * spacing).clamp_max(_MAX_CLUSTER * size)
    return far[(torch.cdist(far, far) < radius).sum(-1) > _CLUSTER_NEIGHBORS]


def _nearest_distance(points: Tensor, others: Tensor) -> Tensor:
    """Return the distance (N,) of each point to the nearest of others (K, 3); infinite where there are none."""
    if not len(others):
        return torch.full_like(points[:, 0], torch.inf)
    return torch.cdist(points, others).amin(-1)


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
