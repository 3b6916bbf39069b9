"""Skeletons of many frames: the same in one process and in several, kept on disk, errors that name their frame."""

import pytest
import torch

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.spines import frame_skeletons as spine_frames
from torchreg.spines.frame_skeletons import skeletonize_frames
from torchreg.spines.skeletonize import SkeletonizeConfig

CONFIG = SkeletonizeConfig()


@pytest.fixture(scope="module")
def meshes():
    return creature_sequence(STARFISH, 4, resolution=32).meshes


@pytest.fixture(scope="module")
def alone(meshes):
    return skeletonize_frames(meshes, CONFIG, workers=1)


def same(first, second):
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in ("nodes", "edges", "radii"))


def test_several_processes_give_what_one_gives(meshes, alone):
    told = []
    shared = skeletonize_frames(meshes, CONFIG, workers=2, on_step=told.append)
    assert all(same(one, other) for one, other in zip(alone, shared, strict=True))
    assert sorted(record.frame for record in told) == [0, 1, 2, 3]
    assert {(record.num_frames, record.num_tips, record.topology) for record in told} == {(4, 5, "(()()()()())")}
    assert all(record.seconds > 0 for record in told)


def test_what_is_kept_is_not_made_again(meshes, alone, tmp_path, monkeypatch):
    folder, told = tmp_path / "kept", []

    def stop(record):
        if record.frame == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        skeletonize_frames(meshes, CONFIG, workers=1, on_step=stop, progress=folder)
    assert len(list(folder.glob("*.safetensors"))) == 2
    skeletonize_frames(meshes, CONFIG, workers=1, on_step=told.append, progress=folder)
    assert [record.seconds == 0 for record in told] == [True, True, False, False]

    def fail(*_):
        raise AssertionError("made again")

    monkeypatch.setattr(spine_frames, "skeletonize", fail)
    again = skeletonize_frames(meshes, CONFIG, workers=1, progress=folder)
    assert all(same(one, other) for one, other in zip(alone, again, strict=True))
    with pytest.raises(AssertionError, match="made again"):
        skeletonize_frames(meshes, SkeletonizeConfig(num_levels=80), workers=1, progress=folder)
    with pytest.raises(AssertionError, match="made again"):
        skeletonize_frames(meshes[1:], CONFIG, workers=1, progress=folder)


def test_a_damaged_file_is_made_again(meshes, alone, tmp_path):
    skeletonize_frames(meshes[:1], CONFIG, workers=1, progress=tmp_path)
    path = next(tmp_path.glob("*.safetensors"))
    path.write_bytes(path.read_bytes()[:-7])
    assert same(skeletonize_frames(meshes[:1], CONFIG, workers=1, progress=tmp_path)[0], alone[0])


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_names_its_frame(meshes, workers):
    flat = TriangleMesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))
    with pytest.raises(InputError, match=r"meshes\[3\]: "):
        skeletonize_frames([*meshes[:3], flat], CONFIG, workers=workers)
    assert spine_frames._job is None
