"""The demonstration's sequence: truth and measurements, errors against an own computation, interruptions."""

import pytest
import torch

import torchreg.pipelines.demo as demo
from torchreg.datasets.hand import hand_motion
from torchreg.datasets.sequences import range_clouds
from torchreg.errors import InputError
from torchreg.models.hand import Hand
from torchreg.models.skin import sample_skin
from torchreg.pipelines.align import AlignConfig
from torchreg.pipelines.storage import load
from torchreg.results import AlignResult, Status

QUICK = AlignConfig(search="never", num_model_points=200)


@pytest.fixture(scope="module")
def three():
    calls = []
    result = demo.run_demo(3, seed=1, on_frame=lambda *arguments: calls.append(arguments))
    return result, calls


def test_frames_are_those_of_the_sequence_that_anyone_can_make(three):
    result, calls = three
    poses = hand_motion(Hand(), "bend", 3, seed=1)
    sequence = range_clouds(Hand(), poses, num_points=600, outlier_ratio=0.2, camera=torch.zeros(3), seed=1)
    assert torch.equal(result.clouds, torch.stack([cloud.points for cloud in sequence]))
    assert torch.equal(result.truths, torch.stack([cloud.pose for cloud in sequence]))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert result.seed == 1
    for finger, part in enumerate(Hand().fingertip_parts):
        seen = [int((cloud.part_labels == part).sum()) >= 8 for cloud in sequence]
        assert result.tips_seen[:, finger].tolist() == seen


def test_the_hand_is_followed(three):
    result, _ = three
    hand = Hand()
    assert result.poses.shape == (3, 27)
    assert (result.seconds > 0).all()
    assert set(result.status) <= {Status.CONVERGED, Status.MAX_STEPS}
    # The keypoints in the usual order: every fourth after the wrist is a tip.
    for frame in range(3):
        found, true = hand.keypoints(result.poses[frame]), hand.keypoints(result.truths[frame])
        errors = [(found[k] - true[k]).norm().item() for k in (4, 8, 12, 16, 20)]
        assert result.tip_errors[frame].tolist() == pytest.approx(errors, abs=1e-6)
    assert result.tip_errors[-1][result.tips_seen[-1]].median() < 0.004
    assert 0.7 < result.inliers.float().mean() < 0.9


def test_what_is_returned_can_be_saved(three, tmp_path):
    result, _ = three
    result.save(tmp_path / "poses.safetensors")
    assert torch.equal(load(tmp_path / "poses.safetensors").poses, result.poses)


class Scripted:
    """Stands in for `align`: answers with its start moved by one, unusable or interrupted at given frames."""

    def __init__(self, unusable=(), interrupted=None):
        self.starts, self.unusable, self.interrupted = [], unusable, interrupted

    def __call__(self, shape, data, initial_pose, **options):
        frame = len(self.starts)
        if frame == self.interrupted:
            raise KeyboardInterrupt
        self.starts.append(initial_pose)
        status = Status.FEW_INLIERS if frame in self.unusable else Status.MAX_STEPS
        pose, one = initial_pose + 1, torch.ones(())
        inliers = torch.ones(len(data), dtype=torch.bool)
        return AlignResult(pose, data, shape.keypoints(pose), data[:, 0], inliers, data[:, 0], one, one, status)


def test_an_interruption_keeps_the_frames_that_are_done(monkeypatch):
    monkeypatch.setattr(demo, "align", Scripted(interrupted=2))
    result = demo.run_demo(5, config=QUICK)
    assert len(result.poses) == len(result.clouds) == len(result.seconds) == len(result.status) == 2


def test_an_interruption_before_the_first_frame_leaves_nothing(monkeypatch):
    monkeypatch.setattr(demo, "align", Scripted(interrupted=0))
    with pytest.raises(KeyboardInterrupt):
        demo.run_demo(5, config=QUICK)


def test_frames_start_from_the_last_pose_that_means_something(monkeypatch):
    scripted = Scripted(unusable=(1,))
    monkeypatch.setattr(demo, "align", scripted)
    demo.run_demo(4, config=QUICK)
    first, second, third, fourth = scripted.starts
    assert torch.equal(second, first + 1)
    assert torch.equal(third, second)
    assert torch.equal(fourth, third + 1)


def test_a_pose_moves_to_the_mean_of_a_cloud_and_keeps_its_turn():
    hand = Hand()
    skin = sample_skin(hand, 50)
    pose = hand.rest_pose()
    pose[3:6] = torch.tensor([0.3, -1.0, 2.0])
    cloud = torch.randn(40, 3, generator=torch.Generator().manual_seed(0)) + 5
    moved = demo.moved_to_mean(skin, pose, cloud)
    assert torch.equal(moved[3:], pose[3:])
    assert torch.allclose(skin(moved).mean(0), cloud.mean(0), atol=1e-5)
    with pytest.raises(InputError, match="cloud must have shape"):
        demo.moved_to_mean(skin, pose, cloud[0])


def test_there_is_at_least_one_frame():
    with pytest.raises(InputError, match="num_frames must be a positive integer, got 0"):
        demo.run_demo(0)
