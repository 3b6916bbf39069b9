"""What a tracker expects of the next frame: where the shape goes, and how far it may be from there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import difference
from torchreg.tracking.config import Frame, FrameFit
from torchreg.tracking.results import TrackState

# Errors of the prediction before any is known: joints and turns in radians, points as a share of the size.
NEW_TURN_ERROR, NEW_ERROR = 0.15, 0.032
# Share of the largest errors of the prediction kept from frame to frame: a burst is remembered for half a second.
_ERROR_MEMORY = 0.9
# The prior's standard deviations are this many times the errors of the prediction, which covers 95 % of them...
_STD_PER_ERROR = 2.0
# ...from what smooth motion needs to what one frame allows: joints, radians; the base moves at least this share of it.
_JOINT_STD, _LEAST_SHIFT = (0.08, 0.3), 0.02
# Share of a surprise that the velocity takes over: half of it is noise, less of it where prediction fails often.
_VELOCITY_GAIN, _FAST_GAIN = 0.5, 0.8
# Left of a velocity that data did not confirm: joints stop on their own, a body goes on.
_JOINT_DECAY, _BASE_DECAY = 0.7, 0.95
# Data that say more than this share of what is known of a joint measure its surprise.
_SURE_SHARE = 0.5
# Frames ahead that a velocity is trusted, and that uncertainty grows.
_MAX_AHEAD, _MAX_SPREAD = 3.0, 4.0
# Where predictions are off by more than this share of the size, motion is fast.
_FAST = 0.032


def timed(state: TrackState, time: float | None) -> tuple[TrackState, float]:
    """Return the state at the time of the next frame, and how many intervals have passed.

    Raises:
        InputError: if the time is not finite or not later than that of the frame before.
    """
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


def moves_fast(state: TrackState, size: float) -> bool:
    """Return whether predictions are often off by more than a descent makes good."""
    return state.prediction_error > _FAST * size


def spread(state: TrackState, gap: float) -> float:
    """Return how much wider than usual the prediction may be off."""
    return min(gap + state.lost, _MAX_SPREAD)


def predicted(shape: ArticulatedShape, state: TrackState, gap: float, pace: Tensor | float = 1.0) -> Tensor:
    """Return the pose (num_dofs,) expected after some intervals at the last velocity, or (P, num_dofs) at P paces."""
    ahead = min(gap, _MAX_AHEAD) * (state.interval or 1.0)
    steps = torch.as_tensor(pace).to(state.pose).unsqueeze(-1) * (ahead * state.velocity)
    return shape.clamp(shape.retract(state.pose.expand_as(steps), steps))


def prior_std(state: TrackState, gap: float, size: float, joints: float | None) -> Tensor:
    """Return standard deviations (3,) about the prediction: of the base's place, metres, its turn, and the joints.

    Args:
        state: with the surprises of the frames before.
        gap: intervals since the last frame.
        size: of the shape, metres.
        joints: of the joints, where it is given; radians.
    """
    shift, turn, bend = (_STD_PER_ERROR * spread(state, gap) * state.innovation).tolist()
    low, high = _JOINT_STD
    bend = joints or min(max(bend, low), high)
    return state.innovation.new_tensor([max(shift, _LEAST_SHIFT * size), max(turn, low), bend])


@dataclass(frozen=True)
class Motion:
    """How a shape moves, as fields of a `TrackState`.

    Args:
        velocity: (num_dofs,).
        surprise: (3,).
        error: metres.
    """

    velocity: Tensor
    surprise: Tensor
    error: float

    @property
    def fields(self) -> dict[str, Any]:
        """The fields of a `TrackState`."""
        return {"velocity": self.velocity, "innovation": self.surprise, "prediction_error": self.error}


def first_motion(pose: Tensor, size: float) -> Motion:
    """Return the motion after a beginning, of which nothing says where it goes."""
    surprise = pose.new_tensor([NEW_ERROR * size, NEW_TURN_ERROR, NEW_TURN_ERROR])
    return Motion(torch.zeros_like(pose), surprise, NEW_ERROR * size)


def motion_after(state: TrackState, frame: Frame, fit: FrameFit, share: Tensor) -> Motion:
    """Return the motion after a fit that was predicted.

    Args:
        state: before it.
        frame: the frame.
        fit: what its prediction led to.
        share: (num_dofs,) of what is known of each degree of freedom that the data say.
    """
    surprise = difference(fit.view.problem.prior.mean[0], fit.pose[0])
    gain = _FAST_GAIN if moves_fast(state, fit.view.problem.size) else _VELOCITY_GAIN
    went = state.velocity + gain / (frame.gap * (state.interval or 1.0)) * surprise
    decay = torch.full_like(share, _JOINT_DECAY)
    decay[:6] = _BASE_DECAY
    velocity = share * went + (1 - share) * decay * state.velocity
    errors = [_deviation(surprise[part], share[part]) for part in (slice(3), slice(3, 6), slice(6, None))]
    surprises = torch.maximum(torch.stack(errors), _ERROR_MEMORY * state.innovation)
    return Motion(velocity, surprises, max(fit.jump, _ERROR_MEMORY * state.prediction_error))


def merged(state: TrackState, motion: Motion) -> Motion:
    """Return a motion that is no surer than the one before."""
    surprise = torch.maximum(motion.surprise, _ERROR_MEMORY * state.innovation)
    return replace(motion, surprise=surprise, error=max(motion.error, _ERROR_MEMORY * state.prediction_error))


def slowed(state: TrackState, gap: float) -> Tensor:
    """Return the velocity (num_dofs,) of a shape that was not seen for some intervals."""
    return state.velocity * _BASE_DECAY ** min(gap, _MAX_AHEAD)


def _deviation(surprise: Tensor, share: Tensor) -> Tensor:
    sure = share > _SURE_SHARE
    return (surprise * sure).norm() / sure.sum().clamp_min(1).sqrt()
