"""The model points of the next frame: those that the data showed, the data themselves, or all."""

from dataclasses import replace

import torch

import torchreg as tr


def one_side(tracking):
    """Return the half of the cloud that faces a camera on the x axis."""
    return tracking.cloud[tracking.cloud[:, 0] > tracking.cloud[:, 0].median()]


def after(tracking, cloud, state=None, **options):
    """Return the pose of a frame and the state after it."""
    result, after = tracking.step(state or tracking.state(num_inliers=float(len(cloud))), cloud, **options)
    return result.pose, after


def test_seen_points_are_those_near_data_and_occluded_ones_are_kept(tracking):
    cloud, skin = one_side(tracking), tracking.skin
    pose, state = after(tracking, cloud)
    distances = torch.cdist(skin(pose), cloud).amin(-1)
    size = (skin.points.amax(0) - skin.points.amin(0)).norm()
    seen = distances < 0.03 * size
    assert 20 < seen.sum() < 180
    assert torch.equal(state.points, skin.points[seen])
    assert torch.equal(state.weights, skin.weights[seen])
    assert torch.equal(state.reference_pose, skin.reference_pose)
    # With far fewer data than inliers before, what was seen is probably occluded.
    points = skin.points[::2]
    begin = tracking.state(points=points, weights=skin.weights[::2], num_inliers=2.0 * len(cloud))
    kept = after(tracking, cloud, begin)[1].points
    assert {tuple(point) for point in kept.tolist()} == {
        tuple(point) for point in [*state.points.tolist(), *points.tolist()]
    }


def test_parts_that_no_data_show_keep_their_points_or_take_those_of_the_shape(arm, tracking):
    body = arm.distance(tracking.cloud, tracking.pose, parts=[1]) > 0.03
    _, state = after(tracking, tracking.cloud[body])
    parts, skin_parts = state.weights.argmax(-1), tracking.skin.weights.argmax(-1)
    assert (parts == 1).sum() == (skin_parts == 1).sum()
    assert (parts == 0).sum() < (skin_parts == 0).sum()
    _, state = after(tracking, tracking.cloud[body], model_points="data")
    hinged = state.weights.argmax(-1) == 1
    torch.testing.assert_close(state.points[hinged], tracking.skin(state.reference_pose)[skin_parts == 1])
    assert len(state.points[~hinged]) == body.sum()


def test_all_points_stay_where_asked_or_where_hardly_any_data_lie_on_the_shape(tracking):
    for cloud, options in ((one_side(tracking), {"model_points": "shape"}), (tracking.cloud[::30], {})):
        begin = tracking.state(
            num_inliers=float(len(cloud)), points=tracking.skin.points[:90], weights=tracking.skin.weights[:90]
        )
        _, state = after(tracking, cloud, begin, **options)
        assert torch.equal(state.points, tracking.skin.points) is ("model_points" in options)


def test_data_become_model_points_in_balance_and_each_frame_draws_anew(arm, tracking):
    generator = torch.Generator().manual_seed(5)
    outliers = tracking.cloud[::10] + 0.05 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    cloud, options = torch.cat([tracking.cloud, outliers]), {"model_points": "data", "num_model_points": 80}
    pose, state = after(tracking, cloud, **options)
    local = cloud - tracking.pose[:3]
    source = torch.cdist(state.points, local, compute_mode="donot_use_mm_for_euclid_dist")
    assert source.amin(-1).max() == 0
    chosen = source.argmin(-1)
    size = (tracking.skin.points.amax(0) - tracking.skin.points.amin(0)).norm()
    assert (arm.distance(cloud[chosen], pose).abs() < 0.022 * size).all()
    assert len(chosen.unique()) == len(chosen)
    torch.testing.assert_close(state.reference_pose[3:], pose[3:])
    torch.testing.assert_close(state.weights.sum(-1), torch.ones_like(state.points[:, 0]))
    counts = torch.bincount(state.weights.argmax(-1), minlength=2)
    assert 20 < counts.min() <= counts.max() <= 80
    begin = tracking.state(num_inliers=float(len(cloud)))
    again, later = (after(tracking, cloud, replace(begin, frame=number), **options)[1].points for number in (1, 2))
    assert torch.equal(again, state.points)
    count = min(len(again), len(later))
    assert not torch.equal(again[:count], later[:count])


def test_data_on_a_rigged_surface_take_the_weights_of_its_nearest_points(arm):
    mesh = arm.surface_mesh(arm.rest_pose(), spacing=0.02)
    weights = torch.nn.functional.one_hot((mesh.vertices[:, 0] > 0.06).long(), 2).double()
    joints = torch.tensor([[0.0, 0, 0], [0.06, 0, 0]], dtype=torch.float64)
    rig = tr.ArticulatedShape.from_skinned_mesh(
        mesh.vertices, mesh.faces, weights, joints, [-1, 0], dtype=torch.float64
    ).requires_grad_(False)
    tracker = tr.Tracker(rig, rig.rest_pose(), config=tr.TrackConfig(model_points="data", num_model_points=100))
    assert tracker.run([mesh.vertices]).statuses[0].usable
    state = tracker.state
    assert len(state.points) > 60
    expected = torch.nn.functional.one_hot((state.points[:, 0] > 0.06).long(), 2).double()
    assert ((state.weights - expected).abs().amax(-1) < 0.5).double().mean() > 0.9
