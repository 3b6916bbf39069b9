"""What a tracker expects: times and intervals, poses ahead, how far predictions may be off, velocities after fits."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.tracking.motion_model import prediction_std

VELOCITY = torch.tensor([0.01, 0.0, -0.02, 0.1, -0.2, 0.3, -0.15], dtype=torch.float64)
EMPTY = torch.zeros(0, 3)


def test_time_is_counted_in_shortest_intervals_and_what_is_not_seen_slows_down(arm, tracking):
    tracker = tr.Tracker(arm, tracking.pose, model_points=tracking.skin)
    tracker.state = replace(tracker.state, velocity=VELOCITY)
    clocks, paces = [], []
    for time in (5.0, 5.2, 5.3, 5.5, None, 99.0):
        before = tracker.state.velocity
        tracker.step(EMPTY, time)
        clocks.append((tracker.state.time, tracker.state.interval))
        paces.append(float((tracker.state.velocity / before).nanmean()))
    assert clocks == [
        pytest.approx(pair) for pair in ((5.0, 0), (5.2, 0.2), (5.3, 0.1), (5.5, 0.1), (5.6, 0.1), (99, 0.1))
    ]
    # By 5 % an interval, of which no more than three count.
    assert paces == pytest.approx([0.95**count for count in (1, 1, 1, 2, 1, 3)])


def test_predictions_go_on_evenly_in_position_rotation_and_joints(arm, tracking):
    state = tracking.state(velocity=VELOCITY, interval=0.5)
    ahead = tracking.step(state, EMPTY, 1.0)[0].pose
    torch.testing.assert_close(ahead[:3], state.pose[:3] + VELOCITY[:3])
    torch.testing.assert_close(ahead[3:6], compose_rotation_vectors(VELOCITY[3:6], state.pose[3:6]))
    assert ahead[6] == pytest.approx(0.7 - 0.15)
    # After long gaps nobody knows how it went on.
    assert torch.equal(tracking.step(state, EMPTY, 1.5)[0].pose, tracking.step(state, EMPTY, 25.0)[0].pose)
    assert torch.equal(tracking.step(state, EMPTY, 1.0, prediction="none")[0].pose, state.pose)
    assert tracking.step(replace(state, velocity=100 * VELOCITY), EMPTY, 1.0)[0].pose[6] == arm.lower[6]


@pytest.mark.parametrize(
    ("changes", "elapsed", "joint_std", "expected"),
    [
        ({}, 1.0, None, [0.04, 0.2, 0.2]), ({}, 2.0, None, [0.08, 0.4, 0.3]), ({}, 1.0, 0.5, [0.04, 0.2, 0.5]),
        ({"lost": 9}, 1.0, None, [0.16, 0.8, 0.3]),
        ({"innovation": torch.zeros(3).double()}, 1.0, None, [0.008, 0.08, 0.08]),
    ],
)  # fmt: skip
def test_the_prior_follows_the_innovations_between_bounds(tracking, changes, elapsed, joint_std, expected):
    state = tracking.state(**{"innovation": VELOCITY.new_tensor([0.02, 0.1, 0.1])} | changes)
    torch.testing.assert_close(prediction_std(state, elapsed, 0.4, joint_std), VELOCITY.new_tensor(expected))


STEP = torch.tensor([0.004, 0.003, -0.004, 0.02, -0.02, 0.03, 0.05], dtype=torch.float64)


@pytest.mark.parametrize(("error", "gain"), [(0.01, 0.5), (0.1, 0.8)])
def test_velocities_take_over_what_data_confirm(arm, tracking, error, gain):
    """A half, and more of a shape that is fast."""
    calm = {"innovation": torch.zeros(3).double(), "prediction_error": error}
    state = tracking.state(velocity=VELOCITY, interval=0.5, **calm)
    predicted = arm.retract(state.pose, 0.5 * VELOCITY)
    cloud = tracking.skin(arm.retract(predicted, STEP))
    result, after = tracking.step(state, cloud, 0.5)
    innovation = arm.difference(predicted, result.pose)
    assert float(innovation.abs().max()) > 0.02
    torch.testing.assert_close(after.velocity, VELOCITY + gain / 0.5 * innovation, atol=3e-3, rtol=0.05)
    expected = torch.stack(
        [group.square().mean().sqrt() for group in (innovation[:3], innovation[3:6], innovation[6:])]
    )
    torch.testing.assert_close(after.innovation, expected)
    assert 0.9 * error <= after.prediction_error < 0.9 * error + 0.02


def test_velocities_that_data_do_not_confirm_fade(arm, tracking):
    velocity = torch.tensor([0.0, 0, 0, 0, 0, 0, -0.15]).double()
    body = tracking.cloud[arm.distance(tracking.cloud, tracking.pose, parts=[1]) > 0.03]
    state = tracking.state(velocity=velocity, num_inliers=float(len(body)))
    after = tracking.step(state, body)[1]
    torch.testing.assert_close(after.velocity, 0.7 * velocity, atol=0.015, rtol=0)
    # What data do not tell is no innovation.
    assert float(after.innovation[2]) == pytest.approx(0.9 * float(state.innovation[2]))


def test_motions_begin_at_rest_and_no_more_certain_than_before(tracking):
    size = float((tracking.skin.points.amax(0) - tracking.skin.points.amin(0)).norm())
    for old, innovation in ((0.0, [0.0, 0.0, 0.0]), (0.1, [0.1, 0.0, 0.5])):
        state = tracking.state(
            lost=1, velocity=VELOCITY, prediction_error=old, innovation=VELOCITY.new_tensor(innovation)
        )
        begun = tracking.step(replace(state, pose=tracking.pose - VELOCITY), tracking.cloud)[1]
        assert not begun.velocity.any()
        assert begun.prediction_error == pytest.approx(max(0.032 * size, 0.9 * old))
        least = VELOCITY.new_tensor([0.032 * size, 0.15, 0.15])
        torch.testing.assert_close(begun.innovation, torch.maximum(least, 0.9 * state.innovation))
