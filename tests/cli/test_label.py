"""``torchreg label``: labels that the dataset reads, errors in one line."""

import torch

from torchreg.datasets.pose_labels import PoseLabels
from torchreg.shapes.hand import Hand


def test_frames_become_labels(run, folder, tmp_path, error_of):
    clouds = [folder / "cloud0.ply", folder / "cloud1.ply"]
    command = ["label", "hand", *clouds, "-o", tmp_path / "labels", "--start", folder / "truth0.json", "--trusted", "0"]
    answer = run(*command)
    assert answer.exit_code == 0, answer.output
    labels = PoseLabels(tmp_path / "labels")
    assert len(labels) == 2
    hand = Hand().requires_grad_(False)
    for label in labels:
        torch.testing.assert_close(hand.keypoints(label["pose"]), label["keypoints"])
        assert label["parts"].shape == label["points"].shape[:1]
    assert "exists; pass --force" in error_of(*command)
    assert "missing.ply" in error_of("label", "hand", "missing.ply")
