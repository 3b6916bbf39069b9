"""A hand that comes into view and leaves it: no pose is invented where it is not, and it is found when it comes."""

from itertools import groupby

import pytest

import torchreg as tr
from torchreg.datasets.sequences import hand_sequence

# Frames by whether the hand is in view; else forearm, wall and points in the air are.
PLAN = [False] * 2 + [True] * 3 + [False] * 12 + [True] * 2


@pytest.fixture(scope="module")
def seen():
    """Whether the hand is in view, its result, and its true keypoints, of each frame."""
    hand = tr.Hand()
    clouds = hand_sequence("bending_palm", len(PLAN), shape=hand, seed=0)
    tracker, rows = tr.Tracker(hand), []
    for there, cloud in zip(PLAN, clouds, strict=True):
        points = cloud.points if there else cloud.points[~cloud.inliers]
        rows.append((there, tracker.step(points), cloud.keypoints))
    return rows


def test_statuses_tell_when_it_is_there(seen):
    statuses = [(there, result.status) for there, result, _ in seen]
    assert all(status.usable is there for there, status in statuses)
    told = [status for status, _ in groupby(status for _, status in statuses if not status.usable)]
    assert told == [tr.Status.NOT_FOUND, tr.Status.LOST, tr.Status.NOT_FOUND]


def test_no_pose_is_invented_and_it_is_found_in_the_first_frame_that_shows_it(seen):
    for there, result, truth in seen:
        if there:
            assert float((result.keypoints - truth).norm(dim=-1).mean()) < 0.004
        elif result.status is tr.Status.NOT_FOUND:
            assert bool(result.pose.isnan().all())
            assert (float(result.confidence), result.inlier_ratio) == (0.0, 0.0)
    assert [result.acquired for there, result, _ in seen if there].count("found") == 2
