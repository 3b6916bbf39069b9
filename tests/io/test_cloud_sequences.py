"""Sequences of clouds: folders, lists and archives, their order, and what is refused."""

import zipfile

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.io.helpers import put
from tests.io.test_array_files import header
from tests.tables import each, refused, refusing
from torchreg.io.frames import save_frames
from torchreg.io.images import list_frames, list_pictures
from torchreg.io.limits import FileLimits
from torchreg.io.points import save_points

FormatError, InputError = tr.errors.FormatError, tr.errors.InputError


def clouds(*counts, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(count, 3, generator=generator, dtype=dtype) for count in counts]


def same(frames, expected):
    assert len(frames) == len(expected)
    return all(torch.equal(a, b) for a, b in zip(frames, expected, strict=True))


def archived(folder, **arrays):
    np.savez(folder / "s.npz", **arrays)
    return folder / "s.npz"


def test_folder_round_trip(tmp_path):
    made = clouds(5, 3, 4)
    files = save_frames(tmp_path / "frames", made)
    assert [file.name for file in files] == ["frame_0000.ply", "frame_0001.ply", "frame_0002.ply"]
    frames = tr.load_frames(tmp_path / "frames")
    assert same(frames, made)
    assert frames.names == tuple(map(str, files))
    assert same(frames[1:], made[1:])
    assert type(frames[1:]) is type(frames)
    assert frames[1:].names == frames.names[1:]
    assert torch.equal(frames[-1], made[-1])
    assert same(tr.load_frames(str(tmp_path / "frames")), made)
    refused((lambda: frames[3], None), error=IndexError)


def test_archive_round_trip_keeps_counts_and_empty_frames(tmp_path):
    made = clouds(5, 0, 7)
    assert save_frames(tmp_path / "a.npz", made) == [tmp_path / "a.npz"]
    frames = tr.load_frames(tmp_path / "a.npz")
    assert same(frames, made)
    assert frames.names[2] == f"{tmp_path / 'a.npz'}, frame 2"
    assert same(tr.load_frames([tmp_path / "a.npz"]), made)
    with np.load(tmp_path / "a.npz") as stored:
        assert stored["points"].shape == (3, 7, 3)
        assert stored["points"].dtype == np.float32
        assert stored["counts"].tolist() == [5, 0, 7]
    frames[0].zero_()
    assert float(frames[0].abs().sum()) > 0  # frames are copies of the file
    save_frames(tmp_path / "a.npz", [torch.zeros(0, 3)])
    assert tr.load_frames(tmp_path)[0].shape == (0, 3)  # a folder with one archive


@pytest.mark.parametrize("place", ["a.npz", "b"])
def test_double_precision_survives_when_asked_for(tmp_path, place):
    made = clouds(4, 6, dtype=torch.float64)
    save_frames(tmp_path / place, made)
    assert same(tr.load_frames(tmp_path / place, dtype=torch.float64), made)
    assert same(tr.load_frames(tmp_path / place), [cloud.float() for cloud in made])


def test_frames_are_read_when_asked_for(tmp_path):
    files = save_frames(tmp_path / "frames", clouds(5, 3, 4))
    frames = tr.load_frames(files)
    files[1].write_bytes(b"ply\nnot a ply at all")
    files[2].unlink()
    assert len(frames[0]) == 5
    refused((lambda: frames[1], r"frame_0001\.ply"))
    refused((lambda: frames[2], r"frame_0002\.ply"), error=FileNotFoundError)
    save_points(files[1], clouds(9)[0])
    assert len(frames[1]) == 9


def test_numbers_in_names_count_as_numbers(tmp_path):
    made = clouds(1, 2, 3, 4)
    names = ["frame1.ply", "frame2.ply", "frame10.ply", "frame11.ply"]
    for name, cloud in zip(names, made, strict=True):
        save_points(tmp_path / name, cloud)
    assert same(tr.load_frames(tmp_path), made)
    as_a_shell_lists_them = [tmp_path / name for name in sorted(names)]
    assert same(tr.load_frames(as_a_shell_lists_them), made)
    assert same(tr.load_frames(tuple(as_a_shell_lists_them), sort=False), [made[0], made[2], made[3], made[1]])
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for time in (0.3, 0.05, 0.25, 0.1):
            (tmp_path / side / f"t={time}.png").touch()
    assert [path.name for path in list_pictures(tmp_path / "left")] == [f"t={t}.png" for t in (0.05, 0.1, 0.25, 0.3)]
    (tmp_path / "left" / "t=0.05.png").rename(tmp_path / "left" / "t=5e-2.png")
    first = list_frames([tmp_path / "left", tmp_path / "right"])[0]
    assert [path.name for path in first] == ["t=5e-2.png", "t=0.05.png"]


@each(
    ["frame_0.5.xyz", "frame_1.0.xyz", "frame_1.25.xyz", "frame_1.5.xyz", "frame_10.0.xyz"],
    ["t=0.05.png", "t=0.1.png", "t=0.25.png", "t=0.3.png"],
    ["t=-2.ply", "t=-0.5.ply", "t=0.ply", "t=1.ply"],
    ["scan-2.ply", "scan-9.ply", "scan-10.ply"],
    ["2024.01.15.ply", "2024.02.01.ply", "2024.10.01.ply"],
    ["take1.1.ply", "take1.2.ply", "take1.10.ply", "take1.100.ply", "take2.1.ply"],
    ["walk.1.ply", "walk.2.ply", "walk.10.ply"],
    ["a1b2.ply", "a1b10.ply", "a2b1.ply"],
    ["9.ply", "10.ply", "10a.ply", "b.ply"],
    ["0.0.xyz", "5e-05.xyz", "0.0001.xyz", "0.00015.xyz", "1.5E-3.xyz", "1e+02.xyz", "1.25e3.xyz"],
    ["t=-1e-3.ply", "t=-2e-04.ply", "t_0.ply", "t_1e-3_b2.ply", "t_1e-3_b10.ply", "t_0.01.ply"],
    ["s1e2.ply", "s1e10.ply", "s2e1.ply"],
    ["3e-9f.ply", "3e-10f.ply"],
    ["12_95000000.ply", "12_100000000.ply", "13_5.ply"],
    ["v1.2.9.ply", "v1.2.10.ply", "v1.10.1.ply"],
)
def test_names_sort_as_a_person_would(tmp_path, names):
    pictures = [f"{name.rpartition('.')[0]}.png" for name in names]
    for name in pictures:
        (tmp_path / name).touch()
    assert [path.name for path in list_pictures(tmp_path)] == pictures


@pytest.mark.parametrize("name", ["points", "vertices", "whatever"])
def test_stacks_of_other_programs(tmp_path, name):
    stack = np.random.default_rng(0).normal(size=(3, 4, 3))
    path = archived(tmp_path, **{name: stack, "faces": np.zeros((2, 3), int), "names": np.array(["x", "y"])})
    np.testing.assert_array_equal(torch.stack(list(tr.load_frames(path, dtype=torch.float64))), stack)
    np.save(tmp_path / "s.npy", stack)
    frames = tr.load_frames(tmp_path / "s.npy", scale=0.5, dtype=torch.float64)
    np.testing.assert_array_equal(torch.stack(list(frames)), stack / 2)
    assert frames.names[1].endswith("s.npy, frame 1")


def test_masks_counts_and_packed_archives(tmp_path):
    stack, mask = np.arange(24.0).reshape(2, 4, 3), np.array([[True, False, True, False], [False] * 4])
    np.savez_compressed(tmp_path / "m.npz", points=stack, mask=mask)
    frames = tr.load_frames(tmp_path / "m.npz", dtype=torch.float64)
    np.testing.assert_array_equal(frames[0].numpy(), stack[0, [0, 2]])
    assert frames[1].shape == (0, 3)
    path = archived(tmp_path, points=stack.astype(">f4"), counts=np.array([1.0, 4.0]))
    assert [len(frame) for frame in tr.load_frames(path)] == [1, 4]


@pytest.mark.parametrize("name", ["frame_{}", "arr_{}", "cloud{}", "{}"])
def test_lists_of_arrays_are_in_order_of_their_numbers(tmp_path, name):
    made = clouds(*range(50, 62))
    path = archived(tmp_path, **{name.format(number): cloud.numpy() for number, cloud in enumerate(made)}, fps=20)
    assert same(tr.load_frames(path), made)


def test_numbered_arrays_of_one_cloud_are_no_frames(tmp_path):
    points = clouds(20)[0].numpy()
    for other in (points / np.linalg.norm(points, axis=1, keepdims=True), np.array([[0, 1, 2]])):
        assert len(tr.load_frames(archived(tmp_path, arr_0=points, arr_1=other))) == 1


@pytest.mark.parametrize(("vertices", "faces"), [("verts", "faces"), ("vertices", "f"), ("v", "f")])
def test_bodies_of_one_topology_are_meshes(tmp_path, vertices, faces):
    stack = np.random.default_rng(0).normal(size=(3, 5, 3)).astype("f4")
    path = archived(tmp_path, **{vertices: stack, faces: np.array([[0, 1, 2, 3], [2, 3, 4, 0]], "u4")})
    frames = tr.load_frames(path, scale=0.5)
    assert torch.equal(frames[1], torch.from_numpy(stack[1]) / 2)
    meshes = frames[1:].clouds()
    assert len(meshes) == 2
    assert torch.equal(meshes[1].points, frames[2])
    assert meshes[1].faces.tolist() == [[0, 1, 2], [0, 2, 3], [2, 3, 4], [2, 4, 0]]
    refused((lambda: tr.load_points(path), "load_frames reads it as a sequence"))
    assert tr.load_mesh(archived(tmp_path, **{vertices: stack[0], faces: [[0, 1, 2]]})).num_faces == 1


def test_frames_that_are_not_finite(tmp_path):
    stack = np.ones((2, 3, 3))
    stack[1, 1, 2], stack[1, 2] = np.nan, np.inf
    path = archived(tmp_path, points=stack)
    assert len(tr.load_frames(path)[0]) == 3
    refused((lambda: tr.load_frames(path)[1], r"s\.npz, frame 1: 2 of 3 points are not finite"))
    assert len(tr.load_frames(path, nan_policy="omit")[1]) == 1
    assert len(tr.load_frames(put(tmp_path, "a.xyz", "0 0 0\nnan 0 0\n"), nan_policy="omit")[0]) == 1


STACK = np.zeros((2, 4, 3))


test_damaged_archives = refusing(lambda folder, arrays: tr.load_frames(archived(folder, **arrays)), file="s.npz: ")(
    ({"points": STACK[..., :2]}, r"frame 0 must have shape \(M, 3\), got \(4, 2\)"),
    ({"points": STACK[:0]}, "holds no frames"),
    ({"points": STACK, "counts": [1, 5]}, "counts must be 2 numbers from 0 to 4"),
    ({"points": STACK, "counts": [1]}, "counts must be 2 numbers"),
    ({"points": STACK, "counts": [1.5, 2]}, "counts must be whole numbers"),
    ({"points": STACK, "mask": np.ones((2, 3), bool)}, r"mask must have the shape \(2, 4\)"),
    ({"points": STACK, "mask": np.ones((2, 4))}, "'mask' must hold truth values"),
    ({"points": STACK, "mask": np.ones((2, 4), bool), "counts": [1, 2]}, "not both"),
    ({"points": STACK.astype(complex)}, "'points' must hold real numbers"),
    ({"points": np.full((2, 4, 3), None)}, "pickled objects are never loaded"),
    ({"frame_0": STACK[0], "frame_1": STACK[0, :, :2]}, "frame 1 must have shape"),
)


def test_archives_that_are_none_or_claim_more_than_they_hold(tmp_path):
    for content in (b"", b"PK\x03\x04 cut off", b"\x00" * 100):
        path = put(tmp_path, "x.npz", content)
        refused((lambda path=path: tr.load_frames(path), r"x\.npz: "))
    with zipfile.ZipFile(tmp_path / "big.npz", "w") as archive:
        archive.writestr("points.npy", header("(1000000, 1000000, 3)", "'<f8'"))
    refused((lambda: tr.load_frames(tmp_path / "big.npz"), r"claims the shape \(1000000, 1000000, 3\)"))


def test_damaged_archives_name_the_file(tmp_path):
    save_frames(tmp_path / "a.npz", clouds(5, 6))
    content = (tmp_path / "a.npz").read_bytes()
    for place in range(0, len(content), 7):
        damaged = content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :]
        try:
            widths = {frame.shape[1] for frame in tr.load_frames(put(tmp_path, "b.npz", damaged), nan_policy="omit")}
        except FormatError as error:
            widths = {3} if "b.npz" in str(error) else {str(error)}
        assert widths <= {3}, place


def test_limits_hold_for_archives_and_files(tmp_path):
    save_frames(tmp_path / "a.npz", clouds(5, 6))
    five, path = FileLimits(max_points=5), tmp_path / "a.npz"
    frames = tr.load_frames(save_frames(tmp_path / "f", clouds(5, 6)), limits=five)
    assert len(frames[0]) == 5
    refused(
        (lambda: frames[1], r"frame_0001\.ply: claims 6 points"),
        (lambda: tr.load_frames(path, limits=five), r"a\.npz: claims 6 points, allowed are 0 to 5"),
        (lambda: tr.load_frames(path, limits=FileLimits(max_bytes=100)), "the limit is 100"),
    )


def loading(folder, path, options):
    notes = put(folder, "notes.md", "no cloud")
    inside = {".": folder, "none.ply": folder / "none.ply", "notes.md": notes}
    tr.load_frames([folder] if path == ["."] else path if path == [] else inside.get(path, path), **options)


test_what_cannot_be_loaded = refusing(loading)(
    ("none.ply", {}, FileNotFoundError, r"none\.ply"),
    (".", {}, FormatError, "holds no frames: no file ends in one of"),
    ([], {}, FormatError, "empty list"),
    (["."], {}, IsADirectoryError, "pass it alone"),
    ("https://example.org/frames", {}, FormatError, "is an address"),
    (3, {}, tr.errors.InputTypeError, "path must be a path or a list of paths, got int"),
    (".", {"dtype": torch.float16}, tr.errors.InputTypeError, "dtype must be"),
    (".", {"nan_policy": "ignore"}, InputError, "nan_policy must be one of"),
    ("notes.md", {}, FormatError, r"unknown ending '\.md'"),
)


def test_folders_leave_other_files_alone_but_mix_no_formats(tmp_path):
    made = clouds(2, 3)
    save_frames(tmp_path, made)
    put(tmp_path, "readme.md", "no cloud")
    put(tmp_path, ".frame_0009.ply", "hidden")
    assert same(tr.load_frames(tmp_path), made)
    put(tmp_path, "times.csv", "frame,time\n0,0\n")
    words = r"its 2 \.ply files are the frames; times\.csv beside them are passed over"
    with pytest.warns(tr.errors.FileWarning, match=words):
        assert same(tr.load_frames(tmp_path), made)
    (tmp_path / "times.csv").unlink()
    save_points(tmp_path / "extra.xyz", made[0])
    refused((lambda: tr.load_frames(tmp_path), r"several formats \(2 \.ply, 1 \.xyz\)"))


test_what_cannot_be_saved = refusing(lambda folder, name, frames: save_frames(folder / name, frames), leaves=0)(
    ("a.npz", [], InputError, "at least one cloud"),
    (
        "a.npz",
        [torch.zeros(2, 3), torch.zeros(2, 2)],
        InputError,
        r"frames\[1\] must have shape \(M, 3\), got \(2, 2\)",
    ),
    ("a.npz", [torch.full((1, 3), torch.nan)], InputError, r"frames\[0\] must be finite"),
    ("f", clouds(2, 0), InputError, r"frames\[1\] has no points"),
    ("a.ply", clouds(2), FormatError, r"ending '\.ply'"),
    ("no/f", clouds(2), FileNotFoundError, None),
)


def test_a_shorter_sequence_is_not_mixed_into_a_longer_one(tmp_path):
    save_frames(tmp_path / "f", clouds(2, 2, 2))
    made = clouds(3, 3, 3, seed=1)
    save_frames(tmp_path / "f", made)
    assert same(tr.load_frames(tmp_path / "f"), made)
    words = r"holds 1 other point files, such as frame_0002\.ply"
    refused((lambda: save_frames(tmp_path / "f", made[:2]), words), error=InputError)
