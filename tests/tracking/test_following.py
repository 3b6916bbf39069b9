"""A shape is followed from frame to frame, and every frame's result says what it promises."""

from dataclasses import replace

import pytest
import torch

from torchreg.geometry.rotation import compose_rotation_vectors


def test_a_hand_is_followed(tip_errors, clouds, frames, tracked):
    errors = tip_errors(tracked.result.keypoints, clouds)
    assert errors.mean() < 0.0025
    assert errors.max() < 0.008
    assert all(status.usable for status in tracked.result.statuses)
    assert tracked.result.acquired.count("tracked") >= len(frames) - 1
    assert [record.frame for _, record in tracked.records] == list(range(len(frames)))
    assert all(points is frame for (points, _), frame in zip(tracked.records, frames, strict=True))


def test_results_say_what_they_promise(plain_hand, plain_hand_skin, clouds, tracked):
    corners = plain_hand_skin.points.aminmax(dim=0)
    size = (corners.max - corners.min).norm()
    for cloud, (_, record) in zip(clouds, tracked.records, strict=True):
        inside = record.distances.isfinite()
        measured = plain_hand.distance(cloud.points, record.pose)
        torch.testing.assert_close(record.distances[inside], measured[inside], atol=2e-6, rtol=0)
        assert (measured[~inside].abs() > 0.02).all()
        assert torch.equal(record.inliers, record.distances.abs() < 0.02 * size)
        assert record.inlier_ratio == pytest.approx(float(record.inliers.float().mean()))
        # What is called an inlier is one, and outliers are few among them.
        assert (record.inliers == cloud.inliers).float().mean() > 0.9
        assert record.posterior[cloud.inliers].mean() > 4 * record.posterior[~cloud.inliers].mean()
        assert 0.0005 < record.residual < 0.003
        torch.testing.assert_close(record.keypoints, plain_hand.keypoints(record.pose))
    result = tracked.result
    assert torch.equal(result.poses, torch.stack([record.pose for _, record in tracked.records]))
    assert torch.equal(result.std, torch.stack([record.std for _, record in tracked.records]))
    assert (result.seconds > 0).all()
    assert result.times.tolist() == [float(k) for k in range(len(clouds))]


def test_the_order_of_points_does_not_matter(tracker, frames, tracked):
    expected = tracked.records[5][1]
    order = torch.randperm(len(frames[5]), generator=torch.Generator().manual_seed(3))
    record = tracker(state=tracked.states[4]).step(frames[5][order])
    torch.testing.assert_close(record.pose, expected.pose, atol=1e-3, rtol=0)
    assert (record.inliers == expected.inliers[order]).float().mean() > 0.99


def test_a_moved_world_moves_the_base_alone(tracker, frames, tracked):
    """The same data elsewhere, far from the origin, lead to the same joints."""
    turn, shift = torch.tensor([0.3, -1.2, 0.4]), torch.tensor([3.0, -2.0, 1.0])
    matrix = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.4, -1.2], [0.4, 0.0, -0.3], [1.2, 0.3, 0.0]]))
    before, expected = tracked.states[4], tracked.records[5][1].pose
    pose, velocity = before.pose.clone(), before.velocity.clone()
    pose[:3], pose[3:6] = matrix @ pose[:3] + shift, compose_rotation_vectors(turn, pose[3:6])
    velocity[:3], velocity[3:6] = matrix @ velocity[:3], matrix @ velocity[3:6]
    record = tracker(state=replace(before, pose=pose, velocity=velocity)).step(frames[5] @ matrix.mT + shift)
    torch.testing.assert_close(record.pose[6:], expected[6:], atol=2e-2, rtol=0)
    torch.testing.assert_close(record.pose[:3], matrix @ expected[:3] + shift, atol=1e-3, rtol=0)


def test_velocity_predicts_what_goes_on_evenly(plain_hand, truths, tracker, frames, tracked):
    for state, truth in zip(tracked.states[3:6], truths[4:7], strict=True):
        predicted = tracker(state=state).step(torch.zeros(0, 3)).keypoints
        near, far = ((places - plain_hand.keypoints(truth)).norm(dim=-1).mean()
                     for places in (predicted, plain_hand.keypoints(state.pose)))  # fmt: skip
        assert near < 0.7 * far
    assert tracker(prediction="none").run(frames[:2]).statuses[1].usable


def test_dropped_frames_are_bridged_by_their_time(tip_errors, tracker, clouds, frames):
    kept = [0, 1, 2, 3, 6, 7]
    result = tracker().run([frames[k] for k in kept], times=[0.05 * k for k in kept])
    assert all(status.usable for status in result.statuses)
    assert tip_errors(result.keypoints, [clouds[k] for k in kept]).mean() < 0.003
    torch.testing.assert_close(result.times, torch.tensor([0.05 * k for k in kept], dtype=torch.float64))


@pytest.mark.parametrize(
    ("options", "most"),
    [({"max_points": 150}, 0.008), ({"model_points": "data"}, 0.006), ({"model_points": "shape"}, 0.006)],
)
def test_other_model_points_and_fewer_data_follow_and_all_are_measured(
    tip_errors, tracker, clouds, frames, options, most
):
    made = tracker(**options)
    result = [made.step(frame) for frame in frames[:3]]
    assert tip_errors(torch.stack([record.keypoints for record in result]), clouds[:3]).mean() < most
    assert result[2].distances.isfinite().sum() > 300
    assert (result[2].inliers == clouds[2].inliers).float().mean() > 0.9
    assert result[2].posterior[clouds[2].inliers].mean() > 0.2


def test_keypoints_tell_where_a_hidden_finger_is(plain_hand, plain_hand_skin, truths, tracker):
    hidden = [number for number, name in enumerate(plain_hand.part_names) if name.startswith("index")]
    shown = ~torch.isin(plain_hand_skin.weights.argmax(-1), torch.tensor(hidden))
    truth = truths[0].clone()
    truth[[plain_hand.dof_names.index(name) for name in plain_hand.dof_names if name.startswith("index")]] += 0.3
    truth = plain_hand.clamp(truth)
    clouds, seen = [plain_hand_skin(truth)[shown]] * 3, plain_hand.keypoints(truth)
    nothing = torch.full_like(seen, torch.nan)
    kept = (None, [nothing, seen, seen])
    alone, told = (tracker(truths[0]).run(clouds, keypoints=given, keypoint_std=0.003) for given in kept)
    off = [(track.keypoints[:, 8] - seen[8]).norm(dim=-1) for track in (alone, told)]
    assert float(off[0][0] - off[1][0]) == 0
    assert float(off[1][-1]) < 0.006 < 0.015 < float(off[0][-1])
