"""Fitting one frame: what is in reach, where descent leads, what the fit says of itself and leaves for the next."""

from dataclasses import replace

import pytest
import torch

from torchreg.geometry.rigid import transform_points
from torchreg.tracking.frame_fit import generator

HINGE = 6


@pytest.fixture
def tracking(arm_tracking):
    with torch.no_grad():
        yield arm_tracking


def bent(pose, angle):
    pose = pose.clone()
    pose[HINGE] += angle
    return pose


def on_body(arm, tracking, margin=0.004):
    """Return which of the cloud lie on the body rather than on the arm."""
    body, hinged = (arm.distance(tracking.cloud, tracking.pose, parts=[part]).abs() for part in (0, 1))
    return body + margin < hinged


def test_views_hold_the_data_in_reach_of_the_model(tracking):
    far = tracking.cloud.amax(0) + 0.12
    cloud = torch.cat([tracking.cloud, far[None], torch.full_like(far, torch.nan)[None]])
    fitter = tracking.fitter()
    view = fitter.view(tracking.state(), tracking.frame(cloud), tracking.pose)
    assert view.near.tolist() == [True] * 300 + [False] * 2
    assert torch.equal(view.origin, tracking.pose[:3])
    torch.testing.assert_close(view.problem.data[0], tracking.cloud - view.origin)
    torch.testing.assert_close(view.problem.prior.mean[0, 3:], tracking.pose[3:])
    assert not view.problem.prior.mean[0, :3].any()
    # After losses and gaps the shape may be farther away.
    assert fitter.view(tracking.state(lost=3), tracking.frame(cloud), tracking.pose).near[300]


def test_views_of_few_data_are_none(tracking):
    fitter, state = tracking.fitter(), tracking.state()
    assert fitter.view(state, tracking.frame(tracking.cloud[:9]), tracking.pose) is None
    assert fitter.fit_at(state, tracking.frame(tracking.cloud + 5), tracking.pose, "found") is None
    assert fitter.view(state, tracking.frame(tracking.cloud[:10]), tracking.pose) is not None


def test_views_thin_the_data_alike_whenever_asked(tracking):
    fitter, state = tracking.fitter(max_points=40), tracking.state()
    first, again = (fitter.view(state, tracking.frame(), tracking.pose).problem.data for _ in range(2))
    assert first.shape == (1, 40, 3)
    assert torch.equal(first, again)
    assert torch.equal(torch.rand(3, generator=generator(state)), torch.rand(3, generator=generator(state)))
    later = replace(state, frame=state.frame + 1)
    assert not torch.equal(torch.rand(3, generator=generator(state)), torch.rand(3, generator=generator(later)))


def test_predictions_are_the_last_pose_where_velocities_are_off(tracking):
    state = tracking.state(velocity=torch.full_like(tracking.pose, 0.1))
    assert torch.equal(tracking.fitter(prediction="none").predicted(state, 1.0), state.pose)
    assert tracking.fitter().predicted(state, 1.0)[HINGE] == pytest.approx(0.8)


def test_views_ahead_register_the_points_that_were_seen(tracking):
    half = tracking.skin.points[:, 1] > 0
    state = tracking.state(
        points=tracking.skin.points[half], weights=tracking.skin.weights[half], velocity=0.1 * tracking.pose.sign()
    )
    view = tracking.fitter().view_ahead(state, tracking.frame())
    assert len(view.problem.skin) == half.sum()
    torch.testing.assert_close(view.origin, tracking.pose[:3] + 0.1 * tracking.pose[:3].sign())


def test_fits_lie_on_the_surface_and_say_how_well(arm, tracking):
    fit = tracking.fitter().fit_at(tracking.state(), tracking.frame(), bent(tracking.pose, 0.1), "surface")
    assert fit.how == "surface"
    torch.testing.assert_close(fit.world, tracking.pose, atol=5e-3, rtol=0)
    torch.testing.assert_close(fit.distance[0], arm.distance(tracking.cloud, fit.world), atol=1e-9, rtol=0)
    assert fit.inliers == 300
    assert (fit.novel, len(fit.strays), fit.held) == (0, 0, 0.0)
    # The tip of the arm is 0.3 m from its hinge; most points moved less than it, and more than nothing.
    assert 0.005 < fit.jump < 0.03
    assert fit.cost < 1.0


def test_descent_reaches_what_moved_a_little(tracking):
    fitter, state = tracking.fitter(), tracking.state(pose=bent(tracking.pose, -0.12))
    frame = tracking.frame()
    fit = fitter.descend(fitter.view_ahead(state, frame), state, frame.gap)
    assert fit.how == "tracked"
    torch.testing.assert_close(fit.world, tracking.pose, atol=5e-3, rtol=0)
    assert fit.view.problem.prior.holds_base


@pytest.mark.parametrize("pace", [0.0, 1.0, 2.0])
def test_fast_joints_may_stop_go_on_or_double(tracking, pace):
    """Where predictions fail by much, a joint that went 0.6 rad a frame is found at each pace."""
    velocity = torch.zeros_like(tracking.pose)
    velocity[HINGE] = 0.6
    state = tracking.state(pose=bent(tracking.pose, -0.6 * pace), velocity=velocity, prediction_error=0.06)
    fitter, frame = tracking.fitter(), tracking.frame()
    fit = fitter.descend(fitter.view_ahead(state, frame), state, frame.gap)
    torch.testing.assert_close(fit.world, tracking.pose, atol=0.02, rtol=0)


def test_limbs_that_no_data_show_stay_where_they_are_expected(arm, tracking):
    cloud = tracking.cloud[on_body(arm, tracking)]
    # Five outliers beside the arm would pull at it.
    tip = transform_points(arm.part_transforms(tracking.pose)[1], torch.tensor([[0.25, 0.0, 0.045]]).double())
    beside = torch.cat([cloud, tip + 0.001 * torch.arange(5.0).double().unsqueeze(-1)])
    state = tracking.state()
    fit = tracking.fitter().fit_at(state, tracking.frame(beside), tracking.pose, "tracked")
    assert fit.world[HINGE] == tracking.pose[HINGE]
    _, share = tracking.fitter().covariance(fit)
    shown = tracking.fitter().fit_at(state, tracking.frame(), tracking.pose, "tracked")
    covariance, known = tracking.fitter().covariance(shown)
    assert 1 - share[HINGE] > 4 * (1 - known[HINGE])
    assert (torch.linalg.eigvalsh(covariance) > 0).all()
    # 150 data with a lever of some 0.15 m tell the hinge to half a degree.
    assert covariance[HINGE, HINGE].sqrt() < 0.01


def test_joints_at_their_limits_are_counted(arm, tracking):
    pose = bent(tracking.pose, float(arm.upper[HINGE]) - 0.7)
    cloud = tracking.skin(pose)
    fit = tracking.fitter().fit_at(tracking.state(), tracking.frame(cloud), pose, "tracked")
    assert fit.held in (0.0, 1.0)
    at = bool(fit.pose[0, HINGE] >= arm.upper[HINGE] - 1e-3)
    assert fit.held == float(at)


def blob(arm, tracking):
    """A patch as dense as the surface where the arm could be, but is not."""
    generator = torch.Generator().manual_seed(0)
    spread = torch.rand(30, 3, generator=generator, dtype=torch.float64) - 0.5
    tip = torch.tensor([[0.25, 0.0, 0.0]], dtype=torch.float64)
    return transform_points(arm.part_transforms(bent(tracking.pose, -0.4))[1], tip) + 0.03 * spread


def test_dense_data_where_a_limb_could_be_are_novel_once(arm, tracking):
    fitter, state = tracking.fitter(), tracking.state()
    frame = tracking.frame(torch.cat([tracking.cloud, blob(arm, tracking)]))
    fit = fitter.fit_at(state, frame, tracking.pose, "tracked")
    assert len(fit.strays) >= 20
    assert fit.novel >= 20
    learned = fitter.strays_after(state, fit)
    trunk = arm.part_transforms(fit.pose[0])[0]
    torch.testing.assert_close(transform_points(trunk, learned), fit.strays)
    again = fitter.fit_at(replace(state, unexplained=learned), frame, tracking.pose, "tracked")
    assert again.novel == 0
    # What doubts leave open is not learned until attempts to explain it ended.
    assert fitter.strays_after(replace(state, failed_searches=2), fit) is state.unexplained
    assert len(fitter.strays_after(replace(state, failed_searches=2), replace(fit, how="found"))) == len(fit.strays)
