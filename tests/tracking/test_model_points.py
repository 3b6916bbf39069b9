"""The model points of the next frame: those that the data showed, the data themselves, or all."""

from dataclasses import replace

import torch

import torchreg as tr
from torchreg.tracking import model_points


def one_side(tracking):
    """Return the half of the cloud that faces a camera on the x axis."""
    return tracking.cloud[tracking.cloud[:, 0] > tracking.cloud[:, 0].median()]


def after(tracking, cloud, state=None, **options):
    fitter, state = tracking.fitter(**options), state or tracking.state(num_inliers=float(len(cloud)))
    fit = fitter.fit_at(state, tracking.frame(cloud), tracking.pose, "tracked")
    return fit, model_points.next_model_points(fitter, state, fit)


def test_seen_points_are_those_near_data(tracking):
    cloud = one_side(tracking)
    fit, (points, weights, reference) = after(tracking, cloud)
    distances = torch.tensor([float((cloud - point).norm(dim=-1).min()) for point in tracking.skin(fit.world_pose)])
    seen = distances < 0.03 * fit.view.problem.size
    assert 20 < seen.sum() < 180
    assert torch.equal(points, tracking.skin.points[seen])
    assert torch.equal(weights, tracking.skin.weights[seen])
    assert torch.equal(reference, tracking.skin.reference_pose)


def test_seen_points_face_the_camera(plain_hand_skin, tracked):
    """The camera stands at the origin: most of what is kept of well-seen parts faces it."""
    state = tracked.states[-1]
    index = torch.cdist(state.points, plain_hand_skin.points).argmin(-1)
    parts = plain_hand_skin.weights.argmax(-1)
    on_palm = parts[index] == 0
    towards = -(plain_hand_skin(state.pose) * plain_hand_skin.posed_normals(state.pose)).sum(-1) > 0
    assert towards[index][on_palm].float().mean() > 0.8 > 0.6 > towards[parts == 0].float().mean()


def test_parts_that_no_data_show_keep_their_points(arm, tracking):
    body = arm.distance(tracking.cloud, tracking.pose, parts=[1]) > 0.03
    _, (_, weights, _) = after(tracking, tracking.cloud[body])
    parts, skin_parts = weights.argmax(-1), tracking.skin.weights.argmax(-1)
    assert (parts == 1).sum() == (skin_parts == 1).sum()
    assert (parts == 0).sum() < (skin_parts == 0).sum()


def test_occluded_points_are_kept(tracking):
    side = one_side(tracking)
    points = tracking.skin.points[::2]
    state = tracking.state(points=points, weights=tracking.skin.weights[::2], num_inliers=2.0 * len(side))
    _, (kept, _, _) = after(tracking, side, state)
    _, (seen, _, _) = after(tracking, side)
    expected = {tuple(point) for point in torch.cat([seen, points]).tolist()}
    assert {tuple(point) for point in kept.tolist()} == expected


def test_all_points_stay_where_asked_or_where_hardly_any_data_lie_on_the_shape(tracking):
    for cloud, options in ((one_side(tracking), {"model_points": "shape"}), (tracking.cloud[:10] + 0.03, {})):
        _, (points, _, _) = after(tracking, cloud, **options)
        assert torch.equal(points, tracking.skin.points)


def test_data_become_model_points_in_balance(tracking):
    generator = torch.Generator().manual_seed(5)
    outliers = tracking.cloud[::10] + 0.05 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    cloud = torch.cat([tracking.cloud, outliers])
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


def test_parts_without_data_take_the_points_of_the_shape(arm, tracking):
    body = arm.distance(tracking.cloud, tracking.pose, parts=[1]) > 0.03
    fit, (points, weights, _) = after(tracking, tracking.cloud[body], model_points="data")
    on_arm = tracking.skin.weights.argmax(-1) == 1
    hinged = weights.argmax(-1) == 1
    torch.testing.assert_close(points[hinged], tracking.skin(fit.pose[0])[on_arm])
    assert len(points[~hinged]) == body.sum()


def test_each_frame_draws_anew(tracking):
    state = tracking.state()
    first, later = (
        after(tracking, tracking.cloud, replace(state, frame=number), model_points="data", num_model_points=30)[1][0]
        for number in (1, 2)
    )
    count = min(len(first), len(later))
    assert not torch.equal(first[:count], later[:count])


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


def test_as_many_data_as_a_pose_takes_are_enough(tracking, monkeypatch):
    """With one datum less on the surface all points are kept; so is a datum at the very width."""
    cloud = one_side(tracking)
    fitter, state = tracking.fitter(), tracking.state(num_inliers=float(len(cloud)))
    fit = fitter.fit_at(state, tracking.frame(cloud), tracking.pose, "tracked")
    on_surface = int((fit.distance[0].abs() < model_points.WIDTHS.surface * fitter.size).sum())
    monkeypatch.setattr(model_points, "MIN_DATA", on_surface)
    assert len(model_points.next_model_points(fitter, state, fit)[0]) < len(fitter.skin)
    monkeypatch.setattr(model_points, "MIN_DATA", on_surface + 1)
    assert torch.equal(model_points.next_model_points(fitter, state, fit)[0], fitter.skin.points)
