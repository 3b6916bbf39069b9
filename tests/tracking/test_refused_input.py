"""Input that makes no sense is refused by name; an interruption keeps the frames that are done."""

import math

import pytest
import torch

from torchreg.errors import InputError
from torchreg.tracking.tracker import TrackConfig, Tracker


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model_points": "texture"}, "model_points must be one of seen, data, shape"),
        ({"prediction": "kalman"}, "prediction must be one of velocity, none"),
        ({"recovery": "some"}, "recovery must be one of full, starts, none"),
        ({"nan_policy": "drop"}, "nan_policy must be one of omit, raise"),
        ({"upright": (0, 0, 0)}, "upright must be a direction, got zeros"),
        ({"num_model_points": 0}, "num_model_points must be at least 1"),
        ({"em_steps": 0}, "em_steps must be at least 1"),
        ({"surface_steps": 0}, "surface_steps must be at least 1"),
        ({"max_points": 0}, "max_points must be at least 1"),
        ({"prior_std": -1.0}, "prior_std must be positive"),
        ({"inlier_distance": 0.0}, "inlier_distance must be positive"),
        ({"sharpness": 0.0}, "sharpness must be positive"),
        ({"debias": -0.1}, "debias must"),
    ],
)
def test_configurations_that_make_no_sense_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        TrackConfig(**options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: t().step(torch.zeros(5, 2)), r"points must have shape \(M, 3\), got \(5, 2\)"),
        (lambda t: t(nan_policy="raise").step(torch.full((50, 3), torch.nan)), "points must be finite"),
        (lambda t: t().step(torch.zeros(0, 3), math.nan), "time must be finite and later"),
        (lambda t: t().step(torch.zeros(0, 3), math.inf), "time must be finite and later"),
        (lambda t: t().run([]), "frames must hold at least one cloud"),
        (lambda t: t().run([torch.zeros(0, 3)] * 2, times=[0.0]), "one entry per frame, got 1"),
        (lambda t: t(torch.zeros(26)), "initial_pose"),
        (lambda t: t(torch.full((27,), torch.nan)), "initial_pose must be finite"),
    ],
)
def test_what_cannot_be_used_is_refused(tracker, call, message):
    with pytest.raises(InputError, match=message):
        call(tracker)


def test_time_must_go_on(tracker):
    made = tracker()
    made.step(torch.zeros(0, 3), 1.0)
    made.step(torch.zeros(0, 3))
    assert made.state.time == 2.0
    for time in (2.0, 1.5):
        with pytest.raises(InputError, match=f"later than the frame before at 2, got {time}"):
            made.step(torch.zeros(0, 3), time)


def test_skins_of_other_shapes_are_refused(arm, plain_hand_skin):
    with pytest.raises(InputError, match="model_points is a skin of another shape"):
        Tracker(arm, model_points=plain_hand_skin)


def test_an_interruption_keeps_what_was_done(tracker, frames):
    def interrupted():
        yield from frames[:2]
        raise KeyboardInterrupt

    assert len(tracker().run(interrupted()).poses) == 2

    def at_once():
        raise KeyboardInterrupt
        yield

    with pytest.raises(KeyboardInterrupt):
        tracker().run(at_once())
