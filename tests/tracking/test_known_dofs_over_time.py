"""Degrees of freedom that are held over a sequence, and what encoders read in every frame."""

import pytest
import torch

import torchreg as tr

HINGE = 6
CONFIG = tr.TrackConfig(num_model_points=150)


@pytest.fixture(scope="module")
def sequence(arm, tracking):
    """Three poses of the arm, whose base rests, and clouds of its surface."""
    poses = tracking.pose.repeat(3, 1)
    poses[:, HINGE] += torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64)
    return poses, [tracking.skin(pose).detach() for pose in poses]


def test_what_is_locked_stays_in_every_frame_and_the_rest_follows(arm, tracking, sequence):
    poses, clouds = sequence
    start = poses[0].clone()
    start[HINGE] += 0.05
    found = tr.Tracker(arm, start, config=CONFIG, model_points=tracking.skin, locked="base").run(clouds)
    torch.testing.assert_close(found.poses[:, :HINGE], poses[:, :HINGE], rtol=0, atol=1e-9)
    torch.testing.assert_close(found.poses[:, HINGE], poses[:, HINGE], rtol=0, atol=0.01)
    assert float(found.std[:, :HINGE].max()) < 1e-4


def test_encoders_tell_what_no_data_show(arm, tracking, sequence):
    """The camera sees the body alone: the arm is where it was told to be, and free without that."""
    poses, clouds = sequence
    body = tracking.skin.weights[:, 0] > 0.5
    seen = [cloud[body] for cloud in clouds]
    told = [({"arm": float(pose[HINGE])}, 0.01) for pose in poses]
    tracker = tr.Tracker(arm, poses[0], config=CONFIG, model_points=tracking.skin, locked="base")
    found = tracker.run(seen, priors=told)
    torch.testing.assert_close(found.poses[:, HINGE], poses[:, HINGE], rtol=0, atol=0.015)
    assert float(found.std[:, HINGE].max()) < 0.011


def test_what_is_locked_is_held_where_the_shape_is_searched(arm, tracking, sequence):
    straight = sequence[0][0].clone()
    straight[HINGE] = 0.0
    tracker = tr.Tracker(arm, config=CONFIG, model_points=tracking.skin, locked=["arm"])
    first = tracker.step(tracking.skin(straight), prior=({"base_x": float(straight[0])}, 0.01))
    assert float(first.pose[HINGE]) == pytest.approx(0.0, abs=1e-9)
    assert first.status.usable
    assert float(first.residual) < 0.001
