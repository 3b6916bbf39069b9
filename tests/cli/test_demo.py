"""The demonstration: what it prints and writes, also when it is interrupted."""

import json

import torch

import torchreg as tr
from torchreg.datasets.sequences import hand_sequence
from torchreg.tracking.demo import DEMO_FPS


def test_the_demonstration_runs(run, tmp_path):
    out = tmp_path / "made" / "demo"
    answer = run("demo", "--frames", "3", "-o", out)
    assert answer.exit_code == 0, answer.output
    lines = answer.stdout.splitlines()
    names = ["hand.glb", "poses.json", "track.json", "track.safetensors", "tracking.gif"]
    assert sorted(path.name for path in out.iterdir()) == names
    result = tr.load(out / "track.safetensors")
    poses = json.loads((out / "poses.json").read_text(encoding="utf-8"))
    assert tuple(poses["poses"]) == tr.Hand().dof_names
    assert poses["poses"]["index_pip_flexion"] == result.track.named_poses["index_pip_flexion"].tolist()
    first, second, third = result.track.seconds.tolist()
    sizes = [len(cloud) for cloud in result.clouds]
    speed = f"{first:.1f} s to find the hand in the first, then {2 / (second + third):.1f} frames/s"
    assert lines[0] == f"3 frames of {min(sizes)} to {max(sizes)} points: {speed}"
    for line, which, errors in (
        (lines[1], "all", result.tip_errors.flatten()),
        (lines[2], "seen by the cameras", result.tip_errors[result.tips_seen]),
    ):
        mean, largest = 1000 * float(errors.mean()), 1000 * float(errors.max())
        values = f"mean {mean:.1f} mm, max {largest:.1f} mm ({len(errors)} fingertips)"
        assert line == f"fingertip error, {which}: {values}"
    assert all(name in lines[-1] for name in names)
    assert run("demo", "--frames", "1", "-o", out).exit_code == 2
    skin = tr.ArticulatedShape.from_gltf(out / "hand.glb")
    assert skin.part_names[0] == "palm"


def test_an_interrupted_demonstration_writes_what_is_done(run, tmp_path, monkeypatch):
    step = tr.Tracker.step

    def interrupted(self, points, time=None, **told):
        if self.state.frame == 1:
            raise KeyboardInterrupt
        return step(self, points, time, **told)

    # Where the hand is in the first frame is told, not searched for.
    truth = hand_sequence("bending_palm", 2, DEMO_FPS, seed=0)[0].pose[None]
    starts = tr.PoseStarts(truth, torch.zeros(1), torch.ones(()))
    monkeypatch.setattr("torchreg.tracking.recovery.find_pose", lambda *arguments, **options: starts)
    monkeypatch.setattr(tr.Tracker, "step", interrupted)
    answer = run("demo", "--frames", "2", "-o", tmp_path, "--no-movie")
    assert answer.exit_code == 130
    assert "torchreg: interrupted; 1 of 2 frames are done" in answer.output
    names = ["hand.glb", "poses.json", "track.json", "track.safetensors"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert tr.load(tmp_path / "track.safetensors").track.poses.shape == (1, 27)
