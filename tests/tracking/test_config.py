"""How a tracker runs: configurations that are refused, frames, views and fits of them."""

from dataclasses import replace

import pytest
import torch

from torchreg.errors import InputError
from torchreg.tracking.config import Frame, TrackConfig, thinned


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model_points": "texture"}, "model_points must be one of seen, data, shape"),
        ({"prediction": "kalman"}, "prediction must be one of velocity, none"),
        ({"recovery": "some"}, "recovery must be one of full, starts, none"),
        ({"nan_policy": "drop"}, "nan_policy must be one of omit, raise"),
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


def test_lengths_may_be_given_and_no_debiasing_asked_for():
    config = TrackConfig(prior_std=0.2, inlier_distance=0.004, debias=0.0)
    assert (config.prior_std, config.inlier_distance, config.debias) == (0.2, 0.004, 0.0)


def test_a_frame_holds_its_finite_points():
    cloud = torch.tensor([[0.0, 1, 2], [torch.nan, 0, 0], [3, 4, 5]])
    frame = Frame(cloud, torch.tensor([True, False, True]), 1.0)
    assert torch.equal(frame.data, cloud[[0, 2]])


def test_thinned_data_are_some_of_them_each_once():
    data = torch.arange(60.0).reshape(20, 3)
    assert thinned(data, 20, torch.Generator()) is data
    few = thinned(data, 7, torch.Generator().manual_seed(1))
    index = (few[:, 0] / 3).long()
    assert torch.equal(few, data[index])
    assert len(index.unique()) == 7
    assert torch.equal(few, thinned(data, 7, torch.Generator().manual_seed(1)))
    assert not torch.equal(few, thinned(data, 7, torch.Generator().manual_seed(2)))


def test_a_view_has_poses_within_limits_around_its_origin(arm, arm_tracking):
    view = arm_tracking.fitter().view(arm_tracking.state(), arm_tracking.frame(), arm_tracking.pose)
    poses = torch.stack([arm_tracking.pose, arm_tracking.pose])
    poses[1, 0] += 0.1
    poses[1, 6] = 9.0
    local = view.local(poses)
    assert local.shape == (1, 2, 7)
    torch.testing.assert_close(local[0, 0, :3], torch.zeros(3, dtype=torch.float64))
    assert torch.equal(local[0, 0, 3:], arm_tracking.pose[3:])
    assert local[0, 1, 0] == pytest.approx(0.1)
    assert local[0, 1, 6] == arm.upper[6]


def test_a_fit_counts_what_it_explains(arm_tracking):
    fitter, state = arm_tracking.fitter(max_points=100), arm_tracking.state()
    fit = fitter.fit_at(state, arm_tracking.frame(), arm_tracking.pose, "tracked")
    near = int(fit.view.near.sum())
    assert near == 300
    assert fit.distance.shape == (1, 100)
    half = replace(fit, inliers=50, cost=25.0)
    assert half.ratio == 0.5
    # What is true of the data that were drawn is true of all in reach.
    assert half.explained == pytest.approx(0.75 * near)
    torch.testing.assert_close(half.world[:3], fit.pose[0, :3] + fit.view.origin)
    assert torch.equal(half.world[3:], fit.pose[0, 3:])
    assert replace(fit, distance=fit.distance[:, :0], inliers=0).ratio == 0
