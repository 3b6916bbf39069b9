import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.io.frames import Frames, load_frames, save_frames
from torchreg.io.limits import FileLimits
from torchreg.io.natural_order import natural_key
from torchreg.io.points import load_mesh, load_points, save_points


def clouds(*counts, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(count, 3, generator=generator, dtype=dtype) for count in counts]


def same(frames, expected):
    assert len(frames) == len(expected)
    return all(torch.equal(a, b) for a, b in zip(frames, expected, strict=True))


def test_folder_round_trip(tmp_path):
    made = clouds(5, 3, 4)
    files = save_frames(tmp_path / "frames", made)
    assert [file.name for file in files] == ["frame_0000.ply", "frame_0001.ply", "frame_0002.ply"]
    frames = load_frames(tmp_path / "frames")
    assert same(frames, made)
    assert frames.names == tuple(map(str, files))
    assert same(frames[1:], made[1:])
    assert isinstance(frames[1:], Frames)
    assert frames[1:].names == frames.names[1:]
    assert torch.equal(frames[-1], made[-1])
    assert same(load_frames(str(tmp_path / "frames")), made)
    with pytest.raises(IndexError):
        frames[3]


def test_archive_round_trip_keeps_counts_and_empty_frames(tmp_path):
    made = clouds(5, 0, 7)
    assert save_frames(tmp_path / "a.npz", made) == [tmp_path / "a.npz"]
    frames = load_frames(tmp_path / "a.npz")
    assert same(frames, made)
    assert frames.names[2] == f"{tmp_path / 'a.npz'}, frame 2"
    assert same(load_frames([tmp_path / "a.npz"]), made)
    with np.load(tmp_path / "a.npz") as stored:
        assert stored["points"].shape == (3, 7, 3)
        assert stored["points"].dtype == np.float32
        assert stored["counts"].tolist() == [5, 0, 7]


def test_a_folder_with_one_archive_and_frames_all_empty(tmp_path):
    save_frames(tmp_path / "a.npz", [torch.zeros(0, 3)])
    frames = load_frames(tmp_path)
    assert frames[0].shape == (0, 3)


def test_double_precision_survives_when_asked_for(tmp_path):
    made = clouds(4, 6, dtype=torch.float64)
    for place in (tmp_path / "a.npz", tmp_path / "b"):
        save_frames(place, made)
        assert same(load_frames(place, dtype=torch.float64), made)
        assert same(load_frames(place), [cloud.float() for cloud in made])


def test_frames_are_read_when_asked_for(tmp_path):
    files = save_frames(tmp_path / "frames", clouds(5, 3, 4))
    frames = load_frames(files)
    files[1].write_bytes(b"ply\nnot a ply at all")
    files[2].unlink()
    assert len(frames[0]) == 5
    with pytest.raises(FormatError, match=r"frame_0001\.ply"):
        frames[1]
    with pytest.raises(FileNotFoundError, match=r"frame_0002\.ply"):
        frames[2]
    save_points(files[1], clouds(9)[0])
    assert len(frames[1]) == 9


def test_numbers_in_names_count_as_numbers(tmp_path):
    made = clouds(1, 2, 3, 4)
    names = ["frame1.ply", "frame2.ply", "frame10.ply", "frame11.ply"]
    for name, cloud in zip(names, made, strict=True):
        save_points(tmp_path / name, cloud)
    assert same(load_frames(tmp_path), made)
    as_a_shell_lists_them = [tmp_path / name for name in sorted(names)]
    assert same(load_frames(as_a_shell_lists_them), made)
    assert same(load_frames(tuple(as_a_shell_lists_them), sort=False), [made[0], made[2], made[3], made[1]])


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["a", "b", "run3/"]), st.integers(0, 10**20)), min_size=1))
def test_natural_order_sorts_by_text_then_number(pairs):
    names = [f"{text}{number}.ply" for text, number in pairs]
    # Of the texts, "run3/" is last and so no digit of it meets another's number.
    assert sorted(names, key=natural_key) == [f"{text}{number}.ply" for text, number in sorted(pairs)]


def test_one_file_is_one_frame(tmp_path):
    (cloud,) = clouds(6)
    for name in ("a.ply", "a.xyz", "a.npz"):
        save_points(tmp_path / name, cloud)
        frames = load_frames(tmp_path / name, dtype=torch.float64)
        assert len(frames) == 1
        torch.testing.assert_close(frames[0].float(), cloud)


@pytest.mark.parametrize("name", ["points", "vertices", "whatever"])
def test_stacks_of_other_programs(tmp_path, name):
    stack = np.random.default_rng(0).normal(size=(3, 4, 3))
    np.savez(tmp_path / "s.npz", **{name: stack, "faces": np.zeros((2, 3), int), "names": np.array(["x", "y"])})
    frames = load_frames(tmp_path / "s.npz", dtype=torch.float64)
    np.testing.assert_array_equal(np.stack([frame.numpy() for frame in frames]), stack)


def test_masks_counts_and_packed_archives(tmp_path):
    stack = np.arange(24.0).reshape(2, 4, 3)
    mask = np.array([[True, False, True, False], [False] * 4])
    np.savez_compressed(tmp_path / "m.npz", points=stack, mask=mask)
    frames = load_frames(tmp_path / "m.npz", dtype=torch.float64)
    np.testing.assert_array_equal(frames[0].numpy(), stack[0, [0, 2]])
    assert frames[1].shape == (0, 3)
    np.savez(tmp_path / "c.npz", points=stack.astype(">f4"), counts=np.array([1.0, 4.0]))
    assert [len(frame) for frame in load_frames(tmp_path / "c.npz")] == [1, 4]


def test_arrays_per_frame(tmp_path):
    made = {f"frame_{number}": np.full((number + 1, 3), float(number)) for number in range(12)}
    np.savez(tmp_path / "f.npz", **made, fps=20)
    frames = load_frames(tmp_path / "f.npz")
    assert [len(frame) for frame in frames] == list(range(1, 13))
    assert all(bool((frame == number).all()) for number, frame in enumerate(frames))


@pytest.mark.parametrize("name", ["arr_{}", "cloud{}", "{}"])
def test_lists_as_numpy_saves_them_are_in_order_of_their_numbers(tmp_path, name):
    made = clouds(*range(50, 62))
    np.savez(tmp_path / "f.npz", **{name.format(number): cloud.numpy() for number, cloud in enumerate(made)})
    assert same(load_frames(tmp_path / "f.npz"), made)


def test_numbered_arrays_of_one_cloud_are_no_frames(tmp_path):
    points = clouds(20)[0].numpy()
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    for other in (normals, np.array([[0, 1, 2]])):
        np.savez(tmp_path / "f.npz", points, other)
        assert len(load_frames(tmp_path / "f.npz")) == 1


@pytest.mark.parametrize(("vertices", "faces"), [("verts", "faces"), ("vertices", "f"), ("v", "f")])
def test_bodies_of_one_topology_are_meshes(tmp_path, vertices, faces):
    stack = np.random.default_rng(0).normal(size=(3, 5, 3)).astype("f4")
    np.savez(tmp_path / "b.npz", **{vertices: stack, faces: np.array([[0, 1, 2, 3], [2, 3, 4, 0]], "u4")})
    frames = load_frames(tmp_path / "b.npz", scale=0.5)
    assert torch.equal(frames[1], torch.from_numpy(stack[1]) / 2)
    meshes = frames[1:].clouds()
    assert len(meshes) == 2
    assert torch.equal(meshes[1].points, frames[2])
    assert meshes[1].faces.tolist() == [[0, 1, 2], [0, 2, 3], [2, 3, 4], [2, 4, 0]]
    np.savez(tmp_path / "one.npz", **{vertices: stack[0], faces: [[0, 1, 2]]})
    assert load_mesh(tmp_path / "one.npz").num_faces == 1
    with pytest.raises(FormatError, match="load_frames reads it as a sequence"):
        load_points(tmp_path / "b.npz")


def test_frames_that_are_not_finite(tmp_path):
    stack = np.ones((2, 3, 3))
    stack[1, 1, 2], stack[1, 2] = np.nan, np.inf
    np.savez(tmp_path / "n.npz", points=stack)
    frames = load_frames(tmp_path / "n.npz")
    assert len(frames[0]) == 3
    with pytest.raises(FormatError, match=r"n\.npz, frame 1: 2 of 3 points are not finite"):
        frames[1]
    assert len(load_frames(tmp_path / "n.npz", nan_policy="omit")[1]) == 1
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "a.xyz").write_text("0 0 0\nnan 0 0\n")
    assert len(load_frames(tmp_path / "f", nan_policy="omit")[0]) == 1


def test_frames_are_read_only_copies_of_the_file(tmp_path):
    save_frames(tmp_path / "a.npz", clouds(5))
    frames = load_frames(tmp_path / "a.npz")
    frames[0].zero_()
    assert float(frames[0].abs().sum()) > 0


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": np.zeros((2, 4, 2))}, r"frame 0 must have shape \(M, 3\), got \(4, 2\)"),
        ({"points": np.zeros((0, 4, 3))}, "holds no frames"),
        ({"points": np.zeros((2, 4, 3)), "counts": [1, 5]}, "counts must be 2 numbers from 0 to 4"),
        ({"points": np.zeros((2, 4, 3)), "counts": [1]}, "counts must be 2 numbers"),
        ({"points": np.zeros((2, 4, 3)), "counts": [1.5, 2]}, "counts must be whole numbers"),
        ({"points": np.zeros((2, 4, 3)), "mask": np.ones((2, 3), bool)}, r"mask must have the shape \(2, 4\)"),
        ({"points": np.zeros((2, 4, 3)), "mask": np.ones((2, 4))}, "'mask' must hold truth values"),
        ({"points": np.zeros((2, 4, 3)), "mask": np.ones((2, 4), bool), "counts": [1, 2]}, "not both"),
        ({"points": np.zeros((2, 4, 3), complex)}, "'points' must hold real numbers"),
        ({"points": np.full((2, 4, 3), None)}, "pickled objects are never loaded"),
        ({"frame_0": np.zeros((4, 3)), "frame_1": np.zeros((4, 2))}, "frame 1 must have shape"),
    ],
)
def test_archives_that_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(FormatError, match=rf"bad\.npz: .*{message}"):
        load_frames(tmp_path / "bad.npz")


def test_an_array_that_claims_more_than_it_holds(tmp_path):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6, 3)})
    with zipfile.ZipFile(tmp_path / "big.npz", "w") as archive:
        archive.writestr("points.npy", stream.getvalue() + bytes(24))
    with pytest.raises(FormatError, match=r"claims the shape \(1000000, 1000000, 3\)"):
        load_frames(tmp_path / "big.npz")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut off", b"\x00" * 100])
def test_archives_that_are_none(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(FormatError, match=r"x\.npz: "):
        load_frames(tmp_path / "x.npz")


def readable_or_named(path):
    try:
        return all(frame.shape[1] == 3 for frame in load_frames(path, nan_policy="omit"))
    except FormatError as error:
        return path.name in str(error)


def test_damaged_archives_name_the_file(tmp_path):
    save_frames(tmp_path / "a.npz", clouds(5, 6))
    content = (tmp_path / "a.npz").read_bytes()
    for place in range(0, len(content), 7):
        (tmp_path / "b.npz").write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        assert readable_or_named(tmp_path / "b.npz"), place


def test_limits_hold_for_archives_and_files(tmp_path):
    save_frames(tmp_path / "a.npz", clouds(5, 6))
    with pytest.raises(FormatError, match=r"a\.npz: claims 6 points, allowed are 0 to 5"):
        load_frames(tmp_path / "a.npz", limits=FileLimits(max_points=5))
    with pytest.raises(FormatError, match="the limit is 100"):
        load_frames(tmp_path / "a.npz", limits=FileLimits(max_bytes=100))
    frames = load_frames(save_frames(tmp_path / "f", clouds(5, 6)), limits=FileLimits(max_points=5))
    assert len(frames[0]) == 5
    with pytest.raises(FormatError, match=r"frame_0001\.ply: claims 6 points"):
        frames[1]


def test_what_cannot_be_loaded(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.ply"):
        load_frames(tmp_path / "none.ply")
    with pytest.raises(FormatError, match="holds no frames: no file ends in one of"):
        load_frames(tmp_path)
    with pytest.raises(FormatError, match="empty list"):
        load_frames([])
    with pytest.raises(IsADirectoryError, match="pass it alone"):
        load_frames([tmp_path])
    with pytest.raises(FormatError, match="is an address"):
        load_frames("https://example.org/frames")
    with pytest.raises(InputTypeError, match="path must be a path or a list of paths, got int"):
        load_frames(3)
    with pytest.raises(InputTypeError, match="dtype must be"):
        load_frames(tmp_path, dtype=torch.float16)
    with pytest.raises(InputError, match="nan_policy must be one of"):
        load_frames(tmp_path, nan_policy="ignore")
    (tmp_path / "notes.md").write_text("no cloud")
    with pytest.raises(FormatError, match=r"unknown ending '\.md'"):
        load_frames(tmp_path / "notes.md")


def test_folders_leave_other_files_alone_but_mix_no_formats(tmp_path):
    made = clouds(2, 3)
    save_frames(tmp_path, made)
    (tmp_path / "readme.md").write_text("no cloud")
    (tmp_path / ".frame_0009.ply").write_text("hidden")
    assert same(load_frames(tmp_path), made)
    save_points(tmp_path / "extra.xyz", made[0])
    with pytest.raises(FormatError, match=r"several formats \(2 \.ply, 1 \.xyz\)"):
        load_frames(tmp_path)


def test_what_cannot_be_saved(tmp_path):
    with pytest.raises(InputError, match="at least one cloud"):
        save_frames(tmp_path / "a.npz", [])
    with pytest.raises(InputError, match=r"frames\[1\] must have shape \(M, 3\), got \(2, 2\)"):
        save_frames(tmp_path / "a.npz", [torch.zeros(2, 3), torch.zeros(2, 2)])
    with pytest.raises(InputError, match=r"frames\[0\] must be finite"):
        save_frames(tmp_path / "a.npz", [torch.full((1, 3), torch.nan)])
    with pytest.raises(InputError, match=r"frames\[1\] has no points"):
        save_frames(tmp_path / "f", clouds(2, 0))
    with pytest.raises(FormatError, match=r"ending '\.ply'"):
        save_frames(tmp_path / "a.ply", clouds(2))
    with pytest.raises(FileNotFoundError):
        save_frames(tmp_path / "no" / "f", clouds(2))
    assert list(Path(tmp_path).iterdir()) == []


def test_a_shorter_sequence_is_not_mixed_into_a_longer_one(tmp_path):
    save_frames(tmp_path / "f", clouds(2, 2, 2))
    made = clouds(3, 3, 3, seed=1)
    save_frames(tmp_path / "f", made)
    assert same(load_frames(tmp_path / "f"), made)
    with pytest.raises(InputError, match=r"holds 1 other point files, such as frame_0002\.ply"):
        save_frames(tmp_path / "f", made[:2])
