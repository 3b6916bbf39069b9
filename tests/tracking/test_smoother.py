"""A second pass over a track: every frame also counts for those before it."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.datasets.hand import hand_motion
from torchreg.datasets.sequences import range_clouds

FRAMES, GAP = 16, slice(7, 9)


@pytest.fixture(scope="module")
def truths(plain_hand):
    return hand_motion(plain_hand, "bending_palm", FRAMES, seed=2)


@pytest.fixture(scope="module")
def frames(plain_hand, plain_hand_surface, truths):
    clouds = range_clouds(
        plain_hand, truths, num_points=400, outlier_ratio=0.2, camera=torch.zeros(3), skin=plain_hand_surface
    )
    points = [cloud.points for cloud in clouds]
    points[GAP] = [torch.zeros(0, 3)] * 2
    return points


@pytest.fixture(scope="module")
def run(plain_hand, truths, frames):
    """Return the track of the frames moved by an offset, and what the second pass makes of it."""

    def tracked(offset=(0.0, 0.0, 0.0), locked=()):
        moved = [points.double() + torch.tensor(offset) for points in frames]
        moved = moved if any(offset) else frames
        start = truths[0].double()
        start[:3] += torch.tensor(offset)
        track = tr.Tracker(plain_hand, start, locked=locked).run(moved)
        return track, tr.smooth_track(track, moved)

    return tracked


@pytest.fixture(scope="module")
def smoothed(run):
    return run()


def errors(plain_hand, track, truths):
    """Return the mean errors (T,) of keypoints, metres."""
    return (track.keypoints - plain_hand.keypoints(truths)).norm(dim=-1).mean(-1)


def test_poses_are_nearer_to_the_truth_and_said_to_be(plain_hand, smoothed, truths):
    before, after = (errors(plain_hand, track, truths) for track in smoothed)
    seen = torch.ones(FRAMES, dtype=torch.bool)
    seen[GAP] = False
    assert float(after[seen].mean()) < 0.9 * float(before[seen].mean())
    assert float(after[seen].max()) < 1.1 * float(before[seen].max())
    track, other = smoothed
    assert bool((other.std[seen].mean(0) < 1.05 * track.std[seen].mean(0)).all())
    torch.testing.assert_close(other.keypoints, plain_hand.keypoints(other.poses))


def test_a_gap_is_filled_from_both_sides_and_still_called_one(plain_hand, smoothed, truths):
    before, after = (errors(plain_hand, track, truths)[GAP] for track in smoothed)
    assert float(after.max()) < 0.5 * float(before.max())
    track, other = smoothed
    assert other.statuses == track.statuses
    assert set(other.statuses[GAP]) == {tr.Status.NO_DATA}
    # Where no data are, less is known.
    assert bool((other.std[GAP].mean(0) > other.std[:5].mean(0)).float().mean() > 0.9)


def test_nothing_is_invented_before_and_after_what_was_followed(plain_hand, truths, frames):
    ends = [torch.zeros(0, 3)] * 2 + frames[:7] + [torch.zeros(0, 3)] * 2
    track = tr.Tracker(plain_hand, truths[0]).run(ends)
    other = tr.smooth_track(track, ends)
    for part in (slice(2), slice(9, None)):
        assert torch.equal(other.poses[part], track.poses[part])
    assert not torch.equal(other.poses[4], track.poses[4])


def test_coordinates_of_maps_keep_their_digits(run, smoothed):
    offset = (4.5e5, 5.4e6, 300.0)
    _, far = run(offset)
    moved = far.poses.double() - torch.nn.functional.pad(torch.tensor(offset).double(), (0, 24))
    torch.testing.assert_close(moved.float(), smoothed[1].poses, atol=5e-3, rtol=0)


def test_what_is_locked_stays(run, truths, plain_hand):
    locked = plain_hand.dof_names[10:14]
    track, other = run(locked=locked)
    torch.testing.assert_close(other.poses[:, 10:14], track.poses[:, 10:14], atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("change", "count", "message"),
    [({}, 3, "frames must be the 16 of the track, got 3"), ({"shape": None}, 16, "track must know its shape")],
)
def test_what_is_no_track_of_the_frames_is_refused(smoothed, frames, change, count, message):
    with pytest.raises(tr.errors.InputError, match=message):
        tr.smooth_track(replace(smoothed[0], **change), frames[:count])
