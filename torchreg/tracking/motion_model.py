"""Prediction of the next frame: a constant-velocity filter with a running estimate of how far it is off."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import difference
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.frame import Frame, FrameFit
from torchreg.tracking.results import TrackState


@dataclass(frozen=True)
class VelocityFilter:
    """Numbers of the prediction. Lengths are shares of the model's size, angles radians."""

    memory: float = 0.9  # share of running means and largest errors kept per frame: they span half a second
    fast_error: float = 0.032  # prediction error from which on descent may fail; also that of an unknown motion
    first_turn: float = 0.15  # innovation of base rotation and joints before any is known
    std_per_error: float = 2.0  # widths of the prior and of the first kernel per error: two cover 95 %
    min_shift_std: float = 0.02  # of the prior of the base's position: what smooth motion needs
    min_turn_std: float = 0.08  # the same of the base's rotation and of joints
    max_joint_std: float = 0.3  # of the prior of a joint: what one interval allows, and all that is known after a loss
    gain: float = 0.5  # share of an innovation that the velocity takes over: about half of it is noise
    fast_gain: float = 0.8  # the same of a fast shape: noise is the smaller part
    joint_decay: float = 0.7  # share of its velocity that a joint keeps over an interval without data: joints stop
    base_decay: float = 0.95  # the same of the base: a body goes on
    min_observed: float = 0.5  # observed share from which on a degree of freedom counts in the innovation
    max_ahead: float = 3.0  # intervals over which a velocity is trusted
    max_growth: float = 4.0  # intervals over which the prediction gets less certain


FILTER = VelocityFilter()


def initial_state(skin: LinearBlendSkin, pose: Tensor, seed: int) -> TrackState:
    """Return the state of a tracker of a skin before the first frame, at a pose (num_dofs,), NaN if it is unknown."""
    return TrackState(
        frame=0, time=0.0, interval=0.0, pose=pose, velocity=torch.zeros_like(pose), points=skin.points,
        weights=skin.weights, reference_pose=skin.reference_pose, keyframes=pose[None][:0],
        unexplained=skin.points[:0], prediction_error=0.0, innovation=skin.points.new_zeros(3), num_data=0.0,
        num_inliers=0.0, ratio_in_reach=0.0, residual=0.0, limit_share=0.0, lost=0, cool_down=0, failed_searches=0,
        pending_checks=0, seed=seed, sure=False,
    )  # fmt: skip


def advance_clock(state: TrackState, time: float | None) -> tuple[TrackState, float]:
    """Return the state at the next frame's time, one interval later if None, and the time elapsed, in intervals."""
    if state.frame == 0:
        return replace(state, frame=1, time=state.time if time is None else time), 1.0
    passed = (state.interval or 1.0) if time is None else time - state.time
    # The shortest time between frames is the interval; a slightly shorter one hardly changes the others' count.
    interval = passed if state.interval == 0 else min(state.interval, passed)
    return replace(state, frame=state.frame + 1, time=state.time + passed, interval=interval), passed / interval


def moves_fast(state: TrackState, size: float) -> bool:
    """Return whether predictions are often too far off for a descent, for a shape of some size in metres."""
    return state.prediction_error > FILTER.fast_error * size


def uncertainty_growth(state: TrackState, elapsed: float) -> float:
    """Return the factor by which the prediction is less certain than after one interval."""
    return min(elapsed + state.lost, FILTER.max_growth)


def predict_pose(shape: ArticulatedShape, state: TrackState, elapsed: float, pace: Tensor | float = 1.0) -> Tensor:
    """Return the pose (num_dofs,) after some intervals at the last velocity, or (P, num_dofs) at P multiples of it."""
    ahead = min(elapsed, FILTER.max_ahead) * (state.interval or 1.0)
    steps = torch.as_tensor(pace).to(state.pose).unsqueeze(-1) * (ahead * state.velocity)
    return shape.clamp(shape.retract(state.pose.expand_as(steps), steps))


def prediction_std(state: TrackState, elapsed: float, size: float, joint_std: float | None) -> Tensor:
    """Return standard deviations (3,) about the prediction: base position, metres, base rotation and joints, radians.

    The size of the shape is in metres; ``joint_std`` replaces the estimate for the joints.
    """
    growth = FILTER.std_per_error * uncertainty_growth(state, elapsed)
    shift, turn, joints = (growth * state.innovation).tolist()
    joints = joint_std or min(max(joints, FILTER.min_turn_std), FILTER.max_joint_std)
    deviations = [max(shift, FILTER.min_shift_std * size), max(turn, FILTER.min_turn_std), joints]
    return state.innovation.new_tensor(deviations)


def restart_motion(state: TrackState, size: float) -> TrackState:
    """Return the state with a shape at rest, of whose motion no more is known than before."""
    shift, turn = FILTER.fast_error * size, FILTER.first_turn
    innovation = torch.maximum(state.innovation.new_tensor([shift, turn, turn]), FILTER.memory * state.innovation)
    error = max(shift, FILTER.memory * state.prediction_error)
    return replace(state, velocity=torch.zeros_like(state.pose), innovation=innovation, prediction_error=error)


def update_motion(state: TrackState, frame: Frame, fit: FrameFit, observed: Tensor) -> TrackState:
    """Return the state with the motion after a fit near its prediction, with observed shares (num_dofs,) of 0 to 1."""
    innovation = difference(fit.view.problem.prior.mean[0], fit.pose[0])
    gain = FILTER.fast_gain if moves_fast(state, fit.view.problem.size) else FILTER.gain
    corrected = state.velocity + gain / (frame.elapsed * (state.interval or 1.0)) * innovation
    decay = torch.full_like(observed, FILTER.joint_decay)
    decay[:6] = FILTER.base_decay
    groups = (slice(3), slice(3, 6), slice(6, None))
    latest = torch.stack([_root_mean_square(innovation[group], observed[group]) for group in groups])
    return replace(
        state,
        velocity=observed * corrected + (1 - observed) * decay * state.velocity,
        innovation=torch.maximum(latest, FILTER.memory * state.innovation),
        prediction_error=max(fit.deviation, FILTER.memory * state.prediction_error),
    )


def decayed_velocity(state: TrackState, elapsed: float) -> Tensor:
    """Return the velocity (num_dofs,) of a shape that was not seen for some intervals."""
    return state.velocity * FILTER.base_decay ** min(elapsed, FILTER.max_ahead)


def _root_mean_square(innovation: Tensor, observed: Tensor) -> Tensor:
    """Return the root mean square () of the innovation over the degrees of freedom that the data tell."""
    counts = observed > FILTER.min_observed
    return (innovation * counts).norm() / counts.sum().clamp_min(1).to(innovation).sqrt()
