"""What a tracker expects: times and intervals, poses ahead, how far predictions may be off, velocities after fits."""

from dataclasses import replace

import pytest
import torch

from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.tracking import motion_model

VELOCITY = torch.tensor([0.01, 0.0, -0.02, 0.1, -0.2, 0.3, -0.15], dtype=torch.float64)


def test_time_is_counted_in_shortest_intervals(tracking):
    state, elapsed = motion_model.advance_clock(tracking.state(frame=0, interval=0.0), 5.0)
    assert (state.frame, state.time, elapsed) == (1, 5.0, 1.0)
    counts = []
    for time in (5.2, 5.3, 5.5, None):
        state, elapsed = motion_model.advance_clock(state, time)
        counts.append(elapsed)
    assert counts == pytest.approx([1.0, 1.0, 2.0, 1.0])
    assert state.time == pytest.approx(5.6)
    assert state.interval == pytest.approx(0.1)
    state, _ = motion_model.advance_clock(tracking.state(frame=0, interval=0.0), None)
    assert state.time == 0
    state, elapsed = motion_model.advance_clock(state, None)
    assert (state.time, state.interval, elapsed) == (1.0, 1.0, 1.0)


def test_predictions_go_on_evenly_in_position_rotation_and_joints(arm, tracking):
    state = tracking.state(velocity=VELOCITY, interval=0.5)
    ahead = motion_model.predict_pose(arm, state, 2.0)
    torch.testing.assert_close(ahead[:3], state.pose[:3] + VELOCITY[:3])
    torch.testing.assert_close(ahead[3:6], compose_rotation_vectors(VELOCITY[3:6], state.pose[3:6]))
    assert ahead[6] == pytest.approx(0.7 - 0.15)
    # After long gaps nobody knows how it went on.
    assert torch.equal(motion_model.predict_pose(arm, state, 3.0), motion_model.predict_pose(arm, state, 50.0))
    assert torch.equal(tracking.fitter().predict(state, 2.0), ahead)
    assert torch.equal(tracking.fitter(prediction="none").predict(state, 2.0), state.pose)


def test_paces_scale_the_step_and_stay_within_limits(arm, tracking):
    state = tracking.state(velocity=VELOCITY)
    poses = motion_model.predict_pose(arm, state, 1.0, torch.tensor([0.0, 1.0, 2.0, 100.0]))
    torch.testing.assert_close(poses[0], state.pose)
    torch.testing.assert_close(poses[1], motion_model.predict_pose(arm, state, 1.0))
    torch.testing.assert_close(poses[2], motion_model.predict_pose(arm, replace(state, velocity=2 * VELOCITY), 1.0))
    assert poses[3, 6] == arm.lower[6]


def test_the_prior_follows_the_innovations_between_bounds(tracking):
    state = tracking.state(innovation=VELOCITY.new_tensor([0.02, 0.1, 0.1]))
    torch.testing.assert_close(
        motion_model.prediction_std(state, 1.0, 0.4, None), VELOCITY.new_tensor([0.04, 0.2, 0.2])
    )
    torch.testing.assert_close(
        motion_model.prediction_std(state, 2.0, 0.4, None), VELOCITY.new_tensor([0.08, 0.4, 0.3])
    )
    assert motion_model.prediction_std(state, 1.0, 0.4, 0.5)[2] == 0.5
    torch.testing.assert_close(
        motion_model.prediction_std(replace(state, lost=9), 1.0, 0.4, None), VELOCITY.new_tensor([0.16, 0.8, 0.3])
    )
    calm = replace(state, innovation=0 * state.innovation)
    torch.testing.assert_close(
        motion_model.prediction_std(calm, 1.0, 0.4, None), VELOCITY.new_tensor([0.008, 0.08, 0.08])
    )


def fit_after(tracking, state, step):
    """Return a fit that lies a tangent step from its prediction."""
    fitter, frame = tracking.fitter(), tracking.frame()
    fit = fitter.fit_at(state, frame, state.pose, "tracked")
    prior = replace(fit.view.problem.prior, mean=fit.pose)
    pose = fitter.shape.retract(fit.pose, step[None])
    view = replace(fit.view, problem=replace(fit.view.problem, prior=prior))
    return frame, replace(fit, view=view, pose=pose, deviation=0.03)


def test_velocities_take_over_what_data_confirm(tracking):
    state = tracking.state(velocity=VELOCITY, interval=0.5, prediction_error=0.01)
    step = 0.1 * torch.arange(1.0, 8.0).double()
    frame, fit = fit_after(tracking, state, step)
    slow = motion_model.update_motion(state, frame, fit, torch.ones_like(step))
    torch.testing.assert_close(slow.velocity, VELOCITY + 0.5 / 0.5 * step)
    expected = torch.stack([group.square().mean().sqrt() for group in (step[:3], step[3:6], step[6:])])
    torch.testing.assert_close(slow.innovation, expected)
    assert slow.prediction_error == 0.03
    fast = motion_model.update_motion(replace(state, prediction_error=0.05), frame, fit, torch.ones_like(step))
    torch.testing.assert_close(fast.velocity, VELOCITY + 0.8 / 0.5 * step)
    assert fast.prediction_error == pytest.approx(0.045)


def test_velocities_that_data_do_not_confirm_fade(tracking):
    state = tracking.state(velocity=VELOCITY)
    frame, fit = fit_after(tracking, state, torch.full_like(VELOCITY, 0.1))
    after = motion_model.update_motion(state, frame, fit, torch.zeros_like(VELOCITY))
    torch.testing.assert_close(after.velocity[:6], 0.95 * VELOCITY[:6])
    torch.testing.assert_close(after.velocity[6:], 0.7 * VELOCITY[6:])
    # What data do not tell is no innovation.
    torch.testing.assert_close(after.innovation, 0.9 * state.innovation)


def test_motions_begin_at_rest_and_no_more_certain_than_before(tracking):
    unknown = tracking.state(velocity=VELOCITY, prediction_error=0.0, innovation=VELOCITY.new_zeros(3))
    begun = motion_model.restart_motion(unknown, 0.5)
    assert not begun.velocity.any()
    assert begun.prediction_error == pytest.approx(0.016)
    torch.testing.assert_close(begun.innovation, VELOCITY.new_tensor([0.016, 0.15, 0.15]))
    state = replace(unknown, prediction_error=0.1, innovation=VELOCITY.new_tensor([0.1, 0.0, 0.5]))
    begun = motion_model.restart_motion(state, 0.5)
    assert begun.prediction_error == pytest.approx(0.09)
    torch.testing.assert_close(begun.innovation, VELOCITY.new_tensor([0.09, 0.15, 0.45]))


def test_what_is_not_seen_slows_down(tracking):
    state = tracking.state(velocity=VELOCITY)
    torch.testing.assert_close(motion_model.decayed_velocity(state, 1.0), 0.95 * VELOCITY)
    torch.testing.assert_close(motion_model.decayed_velocity(state, 2.0), 0.95**2 * VELOCITY)
    assert torch.equal(motion_model.decayed_velocity(state, 3.0), motion_model.decayed_velocity(state, 90.0))
