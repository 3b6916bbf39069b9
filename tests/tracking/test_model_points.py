"""The model points of the next frame: those that the data showed, the data themselves, or all."""

from dataclasses import replace

import pytest
import torch

from torchreg.tracking.model_points import points_after


@pytest.fixture
def tracking(arm_tracking):
    with torch.no_grad():
        yield arm_tracking


def one_side(tracking):
    """Return the half of the cloud that faces a camera on the x axis."""
    return tracking.cloud[tracking.cloud[:, 0] > tracking.cloud[:, 0].median()]


def after(tracking, cloud, state=None, **options):
    fitter, state = tracking.fitter(**options), state or tracking.state(num_inliers=float(len(cloud)))
    fit = fitter.fit_at(state, tracking.frame(cloud), tracking.pose, "tracked")
    return fit, points_after(fitter, state, fit)


def test_seen_points_are_those_near_data(tracking):
    cloud = one_side(tracking)
    fit, (points, weights, reference) = after(tracking, cloud)
    distances = torch.tensor([float((cloud - point).norm(dim=-1).min()) for point in tracking.skin(fit.world)])
    shown = distances < 0.03 * fit.view.problem.size
    assert 20 < shown.sum() < 180
    assert torch.equal(points, tracking.skin.points[shown])
    assert torch.equal(weights, tracking.skin.weights[shown])
    assert torch.equal(reference, tracking.skin.reference_pose)


def test_parts_that_no_data_show_keep_their_points(arm, tracking):
    body = arm.distance(tracking.cloud, tracking.pose, parts=[1]) > 0.03
    _, (_, weights, _) = after(tracking, tracking.cloud[body])
    parts, own = weights.argmax(-1), tracking.skin.weights.argmax(-1)
    assert (parts == 1).sum() == (own == 1).sum()
    assert (parts == 0).sum() < (own == 0).sum()


def test_what_is_hidden_comes_back_as_it_went(tracking):
    side = one_side(tracking)
    points = tracking.skin.points[::2]
    state = tracking.state(points=points, weights=tracking.skin.weights[::2], num_inliers=2.0 * len(side))
    _, (kept, _, _) = after(tracking, side, state)
    _, (shown, _, _) = after(tracking, side)
    expected = {tuple(point) for point in torch.cat([shown, points]).tolist()}
    assert {tuple(point) for point in kept.tolist()} == expected


def test_all_points_stay_where_asked_or_where_hardly_any_data_lie_on_the_shape(tracking):
    for cloud, options in ((one_side(tracking), {"model_points": "shape"}), (tracking.cloud[:10] + 0.03, {})):
        _, (points, _, _) = after(tracking, cloud, **options)
        assert torch.equal(points, tracking.skin.points)


def test_data_are_harvested_in_balance(tracking):
    generator = torch.Generator().manual_seed(5)
    off = tracking.cloud[::10] + 0.05 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    cloud = torch.cat([tracking.cloud, off])
    fit, (points, weights, reference) = after(tracking, cloud, model_points="data", num_model_points=80)
    local = fit.view.problem.data[0]
    source = torch.cdist(points, local, compute_mode="donot_use_mm_for_euclid_dist")
    assert source.amin(-1).max() == 0
    assert (fit.distance[0][source.argmin(-1)].abs() < 0.022 * fit.view.problem.size).all()
    assert len(source.argmin(-1).unique()) == len(points)
    assert torch.equal(reference, fit.pose[0])
    torch.testing.assert_close(weights.sum(-1), torch.ones_like(points[:, 0]))
    assert torch.bincount(weights.argmax(-1)).max() <= 80
    again = after(tracking, cloud, model_points="data", num_model_points=80)[1]
    assert torch.equal(again[0], points)


def test_harvests_take_the_shapes_own_points_where_a_part_shows_none(arm, tracking):
    body = arm.distance(tracking.cloud, tracking.pose, parts=[1]) > 0.03
    fit, (points, weights, _) = after(tracking, tracking.cloud[body], model_points="data")
    own = tracking.skin.weights.argmax(-1) == 1
    hinged = weights.argmax(-1) == 1
    torch.testing.assert_close(points[hinged], tracking.skin(fit.pose[0])[own])
    assert len(points[~hinged]) == body.sum()


def test_later_frames_draw_others(tracking):
    state = tracking.state()
    first, other = (
        after(tracking, tracking.cloud, replace(state, frame=frame), model_points="data", num_model_points=30)[1][0]
        for frame in (1, 2)
    )
    assert not torch.equal(first[: len(other)], other[: len(first)])
