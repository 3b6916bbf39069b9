"""The demonstration: what it prints and writes, also when it is interrupted."""

import subprocess
import sys

import torchreg.pipelines.demo as demo_module
from torchreg.models.articulated import ArticulatedShape
from torchreg.pipelines.align import AlignConfig
from torchreg.pipelines.storage import load


def test_the_demonstration_runs(run, tmp_path):
    out = tmp_path / "made" / "demo"
    command = [sys.executable, "-m", "torchreg", "demo", "--frames", "2", "-o", str(out)]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert answer.returncode == 0, answer.stderr
    names = ["alignment.gif", "hand.glb", "poses.json", "poses.safetensors"]
    assert sorted(path.name for path in out.iterdir()) == names
    result = load(out / "poses.safetensors")
    lines = answer.stdout.splitlines()
    assert lines[0].startswith(f"2 frames of 750 points: {2 / float(result.seconds.sum()):.1f} frames/s")
    mean, largest = 1000 * float(result.tip_errors.mean()), 1000 * float(result.tip_errors.max())
    assert lines[1] == f"fingertip error, all: mean {mean:.1f} mm, max {largest:.1f} mm (10 fingertips)"
    assert all(name in lines[-1] for name in names)
    assert run("demo", "--frames", "1", "-o", out).exit_code == 2
    skin = ArticulatedShape.from_gltf(out / "hand.glb")
    assert skin.part_names[0] == "palm"


def test_an_interrupted_demonstration_writes_what_is_done(run, tmp_path, monkeypatch):
    original, calls = demo_module.align, []

    def interrupted(*arguments, **options):
        if calls:
            raise KeyboardInterrupt
        calls.append(1)
        return original(*arguments, **{**options, "config": AlignConfig(search="never")})

    monkeypatch.setattr(demo_module, "align", interrupted)
    answer = run("demo", "--frames", "3", "-o", tmp_path, "--no-picture")
    assert answer.exit_code == 130
    assert "torchreg: interrupted; 1 of 3 frames are done" in answer.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand.glb", "poses.json", "poses.safetensors"]
    assert load(tmp_path / "poses.safetensors").poses.shape == (1, 27)
