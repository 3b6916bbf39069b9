"""The demonstration: the sequence that anyone can make, errors computed independently, interruptions."""

import pytest
import torch

import torchreg as tr
import torchreg.tracking.demo as demo
from torchreg.datasets.sequences import hand_sequence


@pytest.fixture(scope="module")
def three():
    calls = []
    result = demo.run_demo(3, seed=1, on_frame=lambda *arguments: calls.append(arguments))
    return result, calls


def test_frames_are_those_of_the_sequence_that_anyone_can_make(three):
    result, calls = three
    sequence = hand_sequence("bending_palm", 3, seed=1)
    assert all(torch.equal(points, cloud.points) for points, cloud in zip(result.clouds, sequence, strict=True))
    assert torch.equal(result.truths, torch.stack([cloud.pose for cloud in sequence]))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert result.seed == 1
    assert result.track.times.tolist() == [0.0, 0.05, 0.1]
    for finger, part in enumerate(tr.Hand().fingertip_parts):
        seen = [int((cloud.part_labels == part).sum()) >= 8 for cloud in sequence]
        assert result.tips_seen[:, finger].tolist() == seen


def test_the_hand_is_found_and_followed(three):
    result, _ = three
    hand, track = tr.Hand(), result.track
    assert track.poses.shape == (3, 27)
    assert track.acquired[0] == "found"
    assert all(status.usable for status in track.statuses)
    # The keypoints in the usual order: every fourth after the wrist is a tip.
    for frame in range(3):
        found, true = hand.keypoints(track.poses[frame]), hand.keypoints(result.truths[frame])
        errors = [(found[k] - true[k]).norm().item() for k in (4, 8, 12, 16, 20)]
        assert result.tip_errors[frame].tolist() == pytest.approx(errors, abs=1e-6)
    assert result.tip_errors[result.tips_seen].mean() < 0.003
    for cloud, inliers, share in zip(result.clouds, result.inliers, track.inlier_ratios.tolist(), strict=True):
        assert inliers.sum().item() / len(cloud) == pytest.approx(share)
        assert 0.6 < share < 0.8


def test_an_interruption_keeps_the_frames_that_are_done(monkeypatch):
    """The keyboard interrupts the tracker while it works on the third frame; before the first, nothing is kept."""
    step, stop = tr.Tracker.step, 2

    def stopped(self, points, time=None, **keypoints):
        if self.state.frame == stop:
            raise KeyboardInterrupt
        return step(self, points, time)

    monkeypatch.setattr(tr.Tracker, "step", stopped)
    result = demo.run_demo(4, config=tr.TrackConfig(recovery="none"))
    assert len(result.track.poses) == len(result.truths) == len(result.clouds) == len(result.inliers) == 2
    # Without a search nothing is found.
    assert not result.track.poses.isfinite().any()
    assert result.tip_errors.isnan().all()
    stop = 0
    with pytest.raises(KeyboardInterrupt):
        demo.run_demo(2)
