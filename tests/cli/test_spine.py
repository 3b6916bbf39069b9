"""Spines from the command line: what is printed and written, order of frames, resumed runs, errors."""

import numpy as np
import pytest

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.io.points import save_points
from torchreg.io.swc import load_swc
from torchreg.pipelines.storage import load


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """A folder with three meshes of a starfish, the second of them number 10 to be last but one by name alone."""
    folder = tmp_path_factory.mktemp("starfish")
    for number, mesh in zip((2, 10, 11), creature_sequence(STARFISH, 3, resolution=32).meshes, strict=True):
        save_points(folder / f"frame{number}.ply", mesh.vertices, faces=mesh.faces)
    return folder


def test_everything_is_written(run, frames, tmp_path):
    options = ("--swc", "a.swc", "--npz", "a.npz", "--movie", "a.gif", "--pictures", "pictures")
    options = [tmp_path / option if not option.startswith("--") else option for option in options]
    answer = run("spine", frames, "-o", tmp_path / "a.glb", *options)
    assert answer.exit_code == 0, answer.output
    assert "5 tips, 1 junctions, 5 limbs; 3 of 3 frames" in answer.output
    found = load(tmp_path / "a.safetensors")
    assert found.num_tips == 5
    trees = [load_swc(tmp_path / f"a_{number}.swc") for number in (1, 2, 3)]
    assert {tree.topology for tree in trees} == {"(()()()()())"}
    with np.load(tmp_path / "a.npz") as archive:
        np.testing.assert_array_equal(archive["curves"], found.curves.numpy())
        assert archive["tips"].shape == (3, 5, 3)
    assert len(list((tmp_path / "pictures").glob("frame_*.png"))) == 3
    for name in ("a.glb", "a.json", "a.gif"):
        assert (tmp_path / name).stat().st_size > 0


def test_files_are_put_in_order_and_work_goes_on(run, frames, tmp_path):
    files = sorted(frames.iterdir())  # by name: frame10, frame11, frame2
    options = ("-o", tmp_path / "b", "--progress", tmp_path / "kept", "--tips", 5, "--samples", 12)
    assert run("spine", *files, *options).exit_code == 0
    whole = load(tmp_path / "b.safetensors")
    assert whole.curves.shape == (3, 5, 12, 3)
    assert run("spine", frames, *options, "--force", "--quiet").output == ""
    assert (load(tmp_path / "b.safetensors").curves == whole.curves).all()
    assert len(list((tmp_path / "kept").glob("*.safetensors"))) == 3


def test_nothing_is_overwritten_unasked(error_of, frames, tmp_path):
    (tmp_path / "a.glb").write_bytes(b"")
    assert "exists; pass --force" in error_of("spine", frames, "-o", tmp_path / "a.glb")


def test_errors_take_one_line(error_of, frames, tmp_path):
    out = ("-o", tmp_path / "a.glb")
    assert "not of arrays" in error_of("spine", tmp_path / "x.npz", *out)
    assert "must end in .swc" in error_of("spine", frames, *out, "--swc", tmp_path / "a.txt")
    assert "num_tips must be what a frame shows" in error_of("spine", frames, *out, "--tips", 9)
    assert "--fps must be positive" in error_of("spine", frames, *out, "--fps", 0)
