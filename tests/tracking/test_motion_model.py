"""What a tracker expects: times and gaps, poses ahead, how far predictions may be off, velocities after fits."""

import math
from dataclasses import replace

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_exp
from torchreg.tracking.motion_model import (
    Motion,
    first_motion,
    merged,
    motion_after,
    moves_fast,
    predicted,
    prior_std,
    slowed,
    spread,
    timed,
)

VELOCITY = torch.tensor([0.01, 0.0, -0.02, 0.1, -0.2, 0.3, -0.15], dtype=torch.float64)


def test_gaps_count_the_shortest_interval(arm_tracking):
    state = arm_tracking.state(frame=0, interval=0.0)
    state, gap = timed(state, 5.0)
    assert (state.frame, state.time, gap) == (1, 5.0, 1.0)
    gaps = []
    for time in (5.2, 5.3, 5.5, None):
        state, gap = timed(state, time)
        gaps.append(gap)
    assert gaps == pytest.approx([1.0, 1.0, 2.0, 1.0])
    assert state.time == pytest.approx(5.6)
    assert state.interval == pytest.approx(0.1)


def test_frames_without_times_are_one_interval_apart(arm_tracking):
    state, _ = timed(arm_tracking.state(frame=0, interval=0.0), None)
    assert state.time == 0
    state, gap = timed(state, None)
    assert (state.time, state.interval, gap) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("time", [3.0, 2.0, math.nan, math.inf])
def test_times_that_do_not_go_on_are_refused(arm_tracking, time):
    with pytest.raises(InputError, match="time must be finite and later than the frame before at 3"):
        timed(arm_tracking.state(time=3.0), time)


def test_predictions_go_on_evenly_in_place_turn_and_joints(arm, arm_tracking):
    state = arm_tracking.state(velocity=VELOCITY, interval=0.5)
    ahead = predicted(arm, state, 2.0)
    torch.testing.assert_close(ahead[:3], state.pose[:3] + VELOCITY[:3])
    torch.testing.assert_close(so3_exp(ahead[3:6]), so3_exp(VELOCITY[3:6]) @ so3_exp(state.pose[3:6]))
    assert ahead[6] == pytest.approx(0.7 - 0.15)
    # After long gaps nobody knows how it went on.
    assert torch.equal(predicted(arm, state, 3.0), predicted(arm, state, 50.0))


def test_paces_scale_the_step_and_stay_within_limits(arm, arm_tracking):
    state = arm_tracking.state(velocity=VELOCITY)
    paces = torch.tensor([0.0, 1.0, 2.0, 100.0])
    poses = predicted(arm, state, 1.0, paces)
    torch.testing.assert_close(poses[0], state.pose)
    torch.testing.assert_close(poses[1], predicted(arm, state, 1.0))
    torch.testing.assert_close(poses[2], predicted(arm, replace(state, velocity=2 * VELOCITY), 1.0))
    assert poses[3, 6] == arm.lower[6]


def test_predictions_spread_with_gaps_and_losses(arm_tracking):
    assert spread(arm_tracking.state(), 1.0) == 1
    assert spread(arm_tracking.state(lost=2), 1.0) == 3
    assert spread(arm_tracking.state(lost=90), 5.0) == 4


def test_prior_follows_the_surprises_between_bounds(arm_tracking):
    state = arm_tracking.state(innovation=torch.tensor([0.02, 0.1, 0.1], dtype=torch.float64))
    torch.testing.assert_close(prior_std(state, 1.0, 0.4, None), state.innovation.new_tensor([0.04, 0.2, 0.2]))
    torch.testing.assert_close(prior_std(state, 2.0, 0.4, None), state.innovation.new_tensor([0.08, 0.4, 0.3]))
    assert prior_std(state, 1.0, 0.4, 0.5)[2] == 0.5
    calm = replace(state, innovation=0 * state.innovation)
    torch.testing.assert_close(prior_std(calm, 1.0, 0.4, None), state.innovation.new_tensor([0.008, 0.08, 0.08]))


def test_motion_is_fast_where_predictions_fail(arm_tracking):
    assert not moves_fast(arm_tracking.state(prediction_error=0.0125), 0.4)
    assert moves_fast(arm_tracking.state(prediction_error=0.0135), 0.4)


def fit_after(arm_tracking, state, step):
    """Return a fit that lies a tangent step from its prediction."""
    fitter, frame = arm_tracking.fitter(), arm_tracking.frame()
    fit = fitter.fit_at(state, frame, state.pose, "tracked")
    prior = replace(fit.view.problem.prior, mean=fit.pose)
    pose = fitter.shape.retract(fit.pose, step[None])
    view = replace(fit.view, problem=replace(fit.view.problem, prior=prior))
    return frame, replace(fit, view=view, pose=pose, jump=0.03)


def test_velocities_take_over_what_data_confirm(arm_tracking):
    state = arm_tracking.state(velocity=VELOCITY, interval=0.5, prediction_error=0.01)
    step = 0.1 * torch.arange(1.0, 8.0).double()
    frame, fit = fit_after(arm_tracking, state, step)
    known = motion_after(state, frame, fit, torch.ones(7, dtype=torch.float64))
    torch.testing.assert_close(known.velocity, VELOCITY + 0.5 / 0.5 * step)
    expected = torch.stack([part.square().mean().sqrt() for part in (step[:3], step[3:6], step[6:])])
    torch.testing.assert_close(known.surprise, expected)
    assert known.error == 0.03
    fast = motion_after(replace(state, prediction_error=0.05), frame, fit, torch.ones(7, dtype=torch.float64))
    torch.testing.assert_close(fast.velocity, VELOCITY + 0.8 / 0.5 * step)
    assert fast.error == pytest.approx(0.045)


def test_velocities_that_data_do_not_confirm_fade(arm_tracking):
    state = arm_tracking.state(velocity=VELOCITY)
    frame, fit = fit_after(arm_tracking, state, torch.full_like(VELOCITY, 0.1))
    unknown = motion_after(state, frame, fit, torch.zeros(7, dtype=torch.float64))
    torch.testing.assert_close(unknown.velocity[:6], 0.95 * VELOCITY[:6])
    torch.testing.assert_close(unknown.velocity[6:], 0.7 * VELOCITY[6:])
    # What data do not tell is no surprise.
    torch.testing.assert_close(unknown.surprise, 0.9 * state.innovation)


def test_motions_begin_at_rest_and_no_surer_than_before(arm_tracking):
    begun = first_motion(arm_tracking.pose, 0.5)
    assert not begun.velocity.any()
    assert begun.error == pytest.approx(0.016)
    torch.testing.assert_close(begun.surprise, arm_tracking.pose.new_tensor([0.016, 0.15, 0.15]))
    state = arm_tracking.state(prediction_error=0.1, innovation=arm_tracking.pose.new_tensor([0.1, 0.0, 0.5]))
    both = merged(state, begun)
    assert both.error == pytest.approx(0.09)
    torch.testing.assert_close(both.surprise, arm_tracking.pose.new_tensor([0.09, 0.15, 0.45]))
    assert isinstance(both, Motion)
    assert replace(state, **both.fields).prediction_error == both.error


def test_what_is_not_seen_slows_down(arm_tracking):
    state = arm_tracking.state(velocity=VELOCITY)
    torch.testing.assert_close(slowed(state, 1.0), 0.95 * VELOCITY)
    torch.testing.assert_close(slowed(state, 2.0), 0.95**2 * VELOCITY)
    assert torch.equal(slowed(state, 3.0), slowed(state, 90.0))
