"""Parts of a run that tracks; what whole runs do is told by test_track.py."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from torchreg.cli.track_run import Clouds, TrackFiles, summary
from torchreg.errors import FormatError, InputError
from torchreg.result import Status


class Frames(list):
    """Clouds, the second of which cannot be read."""

    names = ("a", "b", "c")

    def __getitem__(self, index):
        if index == 1:
            raise FormatError("b: is\n cut off")
        return super().__getitem__(index)


def test_outputs_lie_beside_the_result(tmp_path):
    files = TrackFiles.at(tmp_path / "r.safetensors", "gif", tmp_path / "s.glb", None)
    assert (files.movie, files.progress) == tuple(tmp_path / f"r.{ending}" for ending in ("gif", "progress"))
    assert files.gltf == tmp_path / "s.glb"
    assert files.frame(7) == Path("frame_0007.png")
    bare = TrackFiles.at(tmp_path / "r.safetensors", "none", None, tmp_path / "live")
    assert (bare.movie, bare.gltf) == (None, None)
    assert bare.frame(7) == tmp_path / "live" / "frame_0007.png"
    bare.check(force=False)
    assert (tmp_path / "live").is_dir()
    (tmp_path / "r.progress").touch()
    with pytest.raises(InputError, match="pass --resume to go on, or --force"):
        bare.check(force=False)


def test_clouds_that_cannot_be_read_are_empty():
    clouds = Clouds(Frames([torch.ones(4, 3)] * 3))
    told = []
    clouds.on_drop = lambda number, reason: told.append((number, reason))
    assert (len(clouds), clouds.names) == (3, ("a", "b", "c"))
    assert torch.allclose(clouds[0], torch.ones(4, 3))
    assert clouds[1].shape == (0, 3)
    assert told == [(1, "b: is cut off")]


def test_summary_counts_what_became_of_frames():
    statuses = (Status.CONVERGED, Status.LOST, Status.NO_DATA, Status.MAX_STEPS)
    result = SimpleNamespace(statuses=statuses, seconds=torch.tensor([0.1, 0.02, 0.02, 0.02]))
    assert summary(result) == "4 frames: 2 tracked, 1 lost, 1 no_data; 20 ms per frame"
