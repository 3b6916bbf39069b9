"""Long runs: frames that changed are told, an output has one writer, and what cannot be written is known at once."""

import errno
import os
import subprocess
import sys

import pytest
import torch

from torchreg.cli import outputs
from torchreg.cli.outputs import check_outputs, claimed
from torchreg.datasets.hand import hand_motion, make_hand_cloud
from torchreg.errors import InputError
from torchreg.io.atomic import write_atomic
from torchreg.io.points import save_points
from torchreg.shapes.hand import Hand
from torchreg.tracking.tracker import Tracker


@pytest.fixture
def frames(tmp_path):
    hand = Hand()
    poses = hand_motion(hand, "bend", 3)
    paths = [tmp_path / f"f{number}.ply" for number in range(3)]
    for path, pose in zip(paths, poses, strict=True):
        save_points(path, make_hand_cloud(hand, pose, num_points=200, camera=torch.zeros(3)).points)
    (tmp_path / "start.json").write_text(str(poses[0].tolist()))
    return paths


def test_frames_that_changed_since_are_told(run, error_of, frames, tmp_path, monkeypatch):
    command = ("track", "hand", *frames, "-o", tmp_path / "r", "--start", tmp_path / "start.json", "--movie", "none",
               "--no-gltf", "--save-every", "1", "--points", "60")  # fmt: skip
    step = Tracker.step

    def stops(tracker, points, time=None, **options):
        if tracker.state.frame == 2:
            raise KeyboardInterrupt
        return step(tracker, points, time, **options)

    monkeypatch.setattr(Tracker, "step", stops)
    answer = run(*command)
    assert answer.exit_code == 130
    assert "2 of 3 frames are done; --resume goes on from there" in answer.output
    monkeypatch.setattr(Tracker, "step", step)
    kept = frames[1].read_bytes()
    save_points(frames[1], torch.rand(200, 3, generator=torch.Generator().manual_seed(0)))
    message = error_of(*command, "--resume")
    assert f"{frames[1]} changed since" in message
    assert "--force without --resume" in message
    frames[1].write_bytes(kept)
    assert run(*command, "--resume").exit_code == 0
    assert not list(tmp_path.glob(".*.lock"))


def test_an_output_has_one_writer_while_it_lives(tmp_path):
    output = tmp_path / "r.safetensors"
    words = rf"being written by another run, process {os.getpid()}"
    with claimed(output), pytest.raises(InputError, match=words), claimed(output):
        pass
    with claimed(output):  # its end lets the next one in
        pass
    code = "import os, sys, pathlib; from torchreg.cli.outputs import claimed\n"
    code += "with claimed(pathlib.Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", code, output], timeout=60, check=False).returncode == -9
    with claimed(output):  # so does a sudden one
        pass
    assert not list(tmp_path.iterdir())


def test_a_folder_that_takes_nothing_is_known_before_the_work(tmp_path, monkeypatch):
    def full(dir):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(outputs.tempfile, "TemporaryFile", full)
    with pytest.raises(OSError, match=r"nothing can be written there \(No space left") as caught:
        check_outputs([tmp_path / "a.ply"], False)
    assert caught.value.filename == str(tmp_path)


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught:
        write_atomic(tmp_path / "a.ply", b"x")
    assert caught.value.filename == str(tmp_path / "a.ply")
    assert not list(tmp_path.iterdir())
