"""Frames that show no shape are named; a shape that is doubtful, lost or unknown is searched, ever more rarely."""

from itertools import pairwise

import pytest
import torch

import torchreg as tr
from torchreg.tracking.recovery import flipped_poses


def test_bad_frames_are_named_and_do_not_stop_the_tracker(plain_hand, tip_errors, noise_frame, tracker, clouds, frames):
    made = tracker()
    made.run(frames[:3])
    before = made.state.pose
    noise = made.step(noise_frame())
    assert (noise.status, noise.acquired) == (tr.Status.LOST, "lost")
    assert not noise.status.usable
    empty = made.step(torch.zeros(0, 3))
    assert (empty.status, empty.acquired) == (tr.Status.NO_DATA, "held")
    assert empty.inlier_ratio == 0
    assert empty.std.isnan().all()
    assert (plain_hand.keypoints(empty.pose) - plain_hand.keypoints(before)).norm(dim=-1).max() < 0.02
    assert made.step(torch.full((600, 3), torch.nan)).status is tr.Status.NO_DATA
    with pytest.warns(tr.errors.UnitsWarning, match="in millimeters"):
        scaled = made.step(1000 * frames[3])
    assert (scaled.status, scaled.acquired) == (tr.Status.OTHER_UNITS, "held")
    assert made.state.lost == 4
    good = made.step(torch.cat([frames[3], torch.full((5, 3), torch.nan)]))
    assert good.status.usable
    assert good.distances[-5:].isnan().all()
    assert not good.inliers[-5:].any()
    assert made.state.lost == 0
    assert tip_errors(good.keypoints[None], clouds[3:4]).mean() < 0.004


def test_a_hand_that_leaps_out_of_reach_is_proposed_by_the_network_at_once(tip_errors, tracker, clouds, frames):
    made, turn, shift = tracker(), torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), torch.tensor([0.4, -0.3, 0.2])
    made.run(frames[:2])
    result = made.step(frames[2] @ turn.mT + shift)
    assert (result.acquired, result.status.usable) == ("found", True)
    assert tip_errors(((result.keypoints - shift) @ turn)[None], clouds[2:3]).mean() < 0.006


def moved(pose, x):
    return torch.cat([pose[:1] + x, pose[1:]])


def test_a_wrong_pose_that_was_found_is_corrected_in_the_next_frame(plain_hand, tracker, frames, find, truths):
    """The first search misplaces two fingers; that in the next frame does not."""
    wrong = truths[:1].clone()
    wrong[:, [name in ("middle_mcp_flexion", "ring_mcp_flexion") for name in plain_hand.dof_names]] += 1.0
    find(lambda number: wrong if number == 1 else truths[1:2], [10.0])
    made = tracker(None)
    for frame, truth, correct in zip(frames, truths[:2], (False, True), strict=False):
        record = made.step(frame)
        assert record.acquired == "found"
        assert ((record.keypoints - plain_hand.keypoints(truth)).norm(dim=-1).mean() < 0.005) == correct
    assert made.step(frames[2]).acquired == "tracked"


def test_a_pose_that_the_data_contradict_is_not_taken(plain_hand_skin, tracker, frames, find, truths):
    """A hand turned over lies on a part of the data, which show nothing of its rest."""
    for flipped in flipped_poses(plain_hand_skin, truths[0]):
        find(flipped[None], [10.0])
        assert tracker(None).step(frames[0]).status is tr.Status.NOT_FOUND


def test_what_is_nowhere_stays_unknown_and_is_searched_ever_more_rarely(noise_frame, tracker, find, truths):
    made = tracker(None)
    searched = []
    find(lambda number: searched.append(made.state.frame) or truths[:1] + 2.0, [300.0])
    result = made.run([noise_frame(seed=k) for k in range(30)])
    assert set(result.statuses) == {tr.Status.NOT_FOUND}
    assert result.poses.isnan().all()
    assert result.keypoints.isnan().all()
    assert not made.state.found
    # After the second failure in a row, each cool-down is twice as long.
    assert [later - earlier for earlier, later in pairwise(sorted(set(searched)))] == [1, 3, 5, 9]
    before = len(searched)
    assert tracker(None, recovery="none").step(noise_frame()).status is tr.Status.NOT_FOUND
    assert len(searched) == before


def wall(seed, behind):
    """Return 600 points of a wall behind the hand, other ones each time."""
    generator = torch.Generator().manual_seed(seed)
    across = 0.5 * (torch.rand(600, 2, generator=generator) - 0.5)
    return torch.cat([across, behind + 0.002 * torch.randn(600, 1, generator=generator)], dim=-1)


def test_what_comes_into_a_room_is_searched_at_once_and_the_room_alone_ever_more_rarely(
    plain_hand, tracker, frames, find, truths
):
    made = tracker(None)
    away = float(frames[0][:, 2].mean()) + 0.4
    searched = []

    def found(number):
        searched.append(made.state.frame)
        return truths[6:7] if made.state.frame == 6 else truths[:1] + 2.0

    find(found, [10.0])
    result = made.run([*(wall(k, away) for k in range(6)), torch.cat([wall(6, away), frames[6]])])
    assert sorted(set(searched)) == [0, 1, 4, 6]
    assert result.acquired == ("lost",) * 6 + ("found",)
    assert (plain_hand.keypoints(result.poses[6]) - plain_hand.keypoints(truths[6])).norm(dim=-1).mean() < 0.005


def test_what_was_doubtful_in_all_frames_is_forgotten_when_it_is_gone(plain_hand, tracker, frames, find, truths):
    """The first frames show a wall on which the hand is said to lie; a search does not take the wall for it."""
    away = float(frames[0][:, 2].mean()) + 0.4
    lying = truths[0].clone()
    lying[:3] += torch.tensor([0.0, 0.0, away]) - plain_hand.keypoints(truths[0]).mean(0)
    for start, first in ((lying, tr.Status.DOUBTFUL), (None, tr.Status.NOT_FOUND)):
        made = tracker(start)
        find(lambda number, made=made: truths[2:3] if made.state.frame == 2 else lying[None], [10.0])
        records = [made.step(points) for points in (wall(0, away), wall(1, away), frames[2], frames[3])]
        assert [record.status for record in records[:2]] == [first, tr.Status.NOT_FOUND]
        assert [record.acquired for record in records[2:]] == ["found", "tracked"]
        assert (plain_hand.keypoints(records[2].pose) - plain_hand.keypoints(truths[2])).norm(dim=-1).mean() < 0.005


def test_a_flipped_base_is_among_the_starts(plain_hand_skin, truths):
    flipped = flipped_poses(plain_hand_skin, truths[0])
    points = plain_hand_skin(truths[0])
    for pose in flipped:
        turned = plain_hand_skin(pose)
        torch.testing.assert_close(turned.mean(0), points.mean(0), atol=1e-5, rtol=0)
        assert (turned - points).norm(dim=-1).max() > 0.02
    # Half turns: done twice, nothing happened.
    again = torch.stack([plain_hand_skin(pose) for pose in flipped_poses(plain_hand_skin, flipped[2])])
    assert (again - points).norm(dim=-1).amax(-1).min() < 1e-4


def test_a_limb_that_was_missed_is_placed_anew(tracking):
    state = tracking.state(pose=tracking.bent(-1.2), failed_searches=1)
    plain, _ = tracking.step(state, recovery="none")
    assert (plain.pose - tracking.pose)[-1].abs() > 0.2
    result, after = tracking.step(state)
    assert result.acquired in ("surface", "starts")
    torch.testing.assert_close(result.pose, tracking.pose, atol=0.01, rtol=0)
    # Nothing that data show goes so far in a frame: the doubt remains.
    assert (after.cool_down, after.failed_searches) == (2, 2)


def test_nothing_is_tried_where_it_may_not_or_was_tried_lately(tracking, find):
    calls = find(tracking.pose[None], [10.0])
    for level, changes, cool_down in (("none", {}, 0), ("full", {"cool_down": 2}, 1)):
        result, after = tracking.step(tracking.state(pose=tracking.bent(-0.3), **changes), recovery=level)
        assert result.acquired == "tracked"
        assert after.cool_down == cool_down
    assert calls == []


def test_what_is_long_lost_is_searched_everywhere_and_taken_where_it_is_nearest(tracking, find):
    calls = find(torch.stack([moved(tracking.pose, 0.5), tracking.pose]), [10.0, 12.0])
    for lost, level, found in ((2, "full", False), (3, "starts", False), (3, "full", True)):
        result, after = tracking.step(tracking.state(pose=moved(tracking.pose, -5.0), lost=lost), recovery=level)
        assert (result.acquired == "found", after.failed_searches == 0) == (found, found)
    torch.testing.assert_close(result.pose, tracking.pose, atol=5e-3, rtol=0)
    assert len(calls) == 1


UNKNOWN = {"num_inliers": 0.0, "ratio_in_reach": 0.0, "residual": 0.0, "sure": False}


def test_what_lies_beside_its_data_is_searched_again_until_a_pose_explains_them(tracking, find):
    """The first search leads to where no data are, the second to the truth, and there is no third."""
    calls = find(lambda number: moved(tracking.pose, 0.5 if number == 1 else 0.0)[None], [10.0])
    state = tracking.state(pose=torch.full_like(tracking.pose, torch.nan), **UNKNOWN)
    result, _ = tracking.step(state, torch.cat([tracking.cloud] * 11))
    torch.testing.assert_close(result.pose, tracking.pose, atol=5e-3, rtol=0)
    (num_data, first), (_, second) = calls
    assert (first.seed, second.seed) == (0, 1)
    assert second.num_candidates == 2 * first.num_candidates
    # No more data are searched than tell anything.
    assert num_data == 3000
    # Searches everywhere end without a pose.
    calls = find(moved(tracking.pose, 0.5)[None], [10.0])
    assert tracking.step(state)[0].status is tr.Status.NOT_FOUND
    assert [config.seed for _, config in calls] == [0, 1, 2, 3]


def test_noise_is_no_shape_and_a_hidden_one_is_not_searched(tracking, find):
    calls = find(torch.stack([moved(tracking.pose, 0.5), tracking.pose]), [10.0, 12.0])
    low, high = tracking.cloud.amin(0), tracking.cloud.amax(0)
    noise = low + (high - low) * torch.rand(300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for cloud, searched in ((noise[:40], 0), (noise, 1)):
        result, after = tracking.step(tracking.state(lost=3), cloud)
        assert result.status is tr.Status.LOST
        assert (len(calls), after.failed_searches, after.lost) == (searched, searched, 4)
