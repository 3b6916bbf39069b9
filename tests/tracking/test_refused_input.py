"""Input that makes no sense is refused by name; an interruption keeps the frames that are done."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.tracking import demo

EMPTY = torch.zeros(0, 3)


def another_state(of, to):
    to.state = of.state


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda t, *_: t().step(torch.zeros(5, 2)), "InputError", r"points must have shape \(M, 3\), got \(5, 2\)"),
        (lambda t, *_: t(nan_policy="raise").step(torch.full((50, 3), torch.nan)), "InputError", "must be finite"),
        (lambda t, *_: t().step(EMPTY, math.nan), "InputError", "time must be finite and later"),
        (lambda t, *_: t().step(EMPTY, math.inf), "InputError", "time must be finite and later"),
        (lambda t, *_: t().run([]), "InputError", "frames must hold at least one cloud"),
        (lambda t, *_: t().run([EMPTY] * 2, times=[0.0]), "InputError", "one entry per frame, got 1"),
        (lambda t, *_: t(torch.zeros(26)), "InputError", "initial_pose"),
        (lambda t, *_: t(torch.full((27,), torch.nan)), "InputError", "initial_pose must be finite"),
        (lambda t, *_: t().step(EMPTY, keypoints=torch.zeros(5, 3)), "InputError", r"must have shape \(21, 3\)"),
        (lambda t, *_: t().step(EMPTY, keypoints=torch.zeros(21, 2)), "InputError", "in pixels need the camera"),
        (lambda t, *_: t().run([EMPTY] * 2, keypoints=torch.zeros(1, 21, 3)), "InputError", "one entry per frame"),
        (lambda t, arm, _: tr.Tracker(arm, locked=["elbow"]), "InputError", "locked names 'elbow'"),
        (lambda t, *_: t().run([EMPTY] * 2, priors=[None]), "InputError", "priors must hold one entry per frame"),
        (lambda t, arm, _: another_state(t(), tr.Tracker(arm)), "InputError", "7 degrees of freedom and 2 parts"),
        (lambda t, *_: setattr(t(), "state", None), "InputTypeError", "state must be a TrackState, got NoneType"),
        (lambda t, _, p: tr.Tracker(p, fit_shape=True, locked=["base"]), "InputError", "fit_shape goes without"),
        (lambda t, _, p: tr.Tracker(p, fit_shape="all"), "InputError", "must be True, False or 'bones', got 'all'"),
        (lambda t, arm, _: tr.Tracker(arm, fit_shape=True), "InputError", "has no mesh"),
        (
            lambda *_: tr.TrackConfig(model_points="texture"),
            "InputError",
            "model_points must be one of seen, data, shape",
        ),
        (lambda *_: tr.TrackConfig(prediction="kalman"), "InputError", "prediction must be one of velocity, none"),
        (lambda *_: tr.TrackConfig(recovery="some"), "InputError", "recovery must be one of full, starts, none"),
        (lambda *_: tr.TrackConfig(nan_policy="drop"), "InputError", "nan_policy must be one of omit, raise"),
        (lambda *_: tr.TrackConfig(upright=(0, 0, 0)), "InputError", "upright must be a direction, got zeros"),
        (lambda *_: tr.TrackConfig(num_model_points=0), "InputError", "num_model_points must be at least 1"),
        (lambda *_: tr.TrackConfig(em_steps=0), "InputError", "em_steps must be at least 1"),
        (lambda *_: tr.TrackConfig(surface_steps=0), "InputError", "surface_steps must be at least 1"),
        (lambda *_: tr.TrackConfig(max_points=0), "InputError", "max_points must be at least 1"),
        (lambda *_: tr.TrackConfig(prior_std=-1.0), "InputError", "prior_std must be positive"),
        (lambda *_: tr.TrackConfig(inlier_distance=0.0), "InputError", "inlier_distance must be positive"),
        (lambda *_: tr.TrackConfig(sharpness=0.0), "InputError", "sharpness must be positive"),
        (lambda *_: tr.TrackConfig(debias=-0.1), "InputError", "debias must"),
        (lambda t, arm, p: tr.Tracker(arm, model_points=tr.sample_skin(p, 9)), "InputError", "a skin of another shape"),
        (lambda *_: demo.run_demo(0), "InputError", "num_frames must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_used_is_refused(tracker, arm, person, call, error, words):
    with pytest.raises(getattr(tr.errors, error), match=words):
        call(tracker, arm, person)


def test_time_must_go_on(tracker):
    made = tracker()
    made.step(torch.zeros(0, 3), 1.0)
    made.step(torch.zeros(0, 3))
    assert made.state.time == 2.0
    for time in (2.0, 1.5):
        with pytest.raises(tr.errors.InputError, match=f"later than the frame before at 2, got {time}"):
            made.step(torch.zeros(0, 3), time)


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
