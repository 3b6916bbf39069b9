"""NPZ archives: which array is the cloud, and that nothing but plain numbers is ever loaded."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from torchreg.errors import FormatError, InputError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.npz import read_npz, save_arrays, write_npz
from torchreg.io.raw_cloud import RawCloud

POINTS = np.random.default_rng(0).normal(size=(4, 3))


def archive(**arrays) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def members(**contents: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        for name, content in contents.items():
            file.writestr(name.replace("__", "."), content)
    return stream.getvalue()


def npy(array: np.ndarray, version: tuple[int, int] = (1, 0)) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version=version)
    return stream.getvalue()


def claim(shape: tuple[int, ...], body: bytes) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue() + body


@pytest.mark.parametrize("dtype", ["<f2", "<f4", ">f8", "<i2", ">u4"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_numbers_come_as_numpy_wrote_them(dtype, order):
    values = np.asarray(np.arange(12).reshape(4, 3), dtype, order=order)
    cloud = read_npz(archive(points=values), DEFAULT_LIMITS)
    assert cloud.points.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(cloud.points, values)
    assert (cloud.normals, cloud.colors, cloud.faces) == (None, None, None)


def test_points_go_before_vertices_and_only_known_companions_are_read():
    cloud = read_npz(
        archive(vertices=POINTS + 1, points=POINTS, normals=-POINTS, colors=np.eye(3, dtype=np.uint8)[[0, 1, 2, 0]],
                faces=np.array([[0, 1, 2]], np.uint8), note=np.array("text")),
        DEFAULT_LIMITS,
    )  # fmt: skip
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.normals, -POINTS)
    assert cloud.colors.dtype == np.uint8
    assert cloud.faces.dtype == np.int64
    assert cloud.faces.tolist() == [[0, 1, 2]]


def test_a_single_table_is_found_among_other_arrays():
    cloud = read_npz(archive(scan=POINTS, faces=np.array([[0, 1, 2]]), pose=np.eye(4), time=np.ones(4)), DEFAULT_LIMITS)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.faces.tolist() == [[0, 1, 2]]
    with pytest.raises(FormatError, match=r"one floating-point array of that shape; got faces, scan, world"):
        read_npz(archive(world=POINTS, scan=POINTS, faces=np.array([[0, 1, 2]])), DEFAULT_LIMITS)


def test_format_versions():
    np.testing.assert_array_equal(
        read_npz(members(points__npy=npy(POINTS, (2, 0)), readme__txt=b"x"), DEFAULT_LIMITS).points, POINTS
    )
    with pytest.raises(FormatError, match=r"member 'points.npy' has the unknown array format \(3, 0\)"):
        read_npz(members(points__npy=npy(POINTS, (3, 0))), DEFAULT_LIMITS)


class Trap:
    """Writes a file when it is unpickled."""

    def __init__(self, place: Path):
        self.place = place

    def __reduce__(self):
        return Path.touch, (self.place,)


@pytest.mark.parametrize("key", ["points", "only", "normals", "faces"])
def test_pickled_objects_are_refused_without_being_loaded(tmp_path, key):
    trap = np.array([[Trap(tmp_path / "sprung")] * 3], dtype=object)
    content = archive(**({"points": POINTS} if key in ("normals", "faces") else {}), **{key: trap})
    np.load(io.BytesIO(content), allow_pickle=True)[key]  # the trap works
    (tmp_path / "sprung").unlink()
    with pytest.raises(FormatError, match=rf"'{key}.npy' must hold real numbers, got object; pickled .* never loaded"):
        read_npz(content, DEFAULT_LIMITS)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dtype", [bool, complex, "U4", "M8[s]", [("x", "f4")]])
def test_what_is_not_a_real_number_is_refused(dtype):
    with pytest.raises(FormatError, match=r"member 'points\.npy' must hold real numbers"):
        read_npz(archive(points=np.zeros((2, 3), dtype)), DEFAULT_LIMITS)


@pytest.mark.parametrize(
    ("shape", "size"), [((4, 3), 95), ((4, 3), 97), ((4, 3), 0), ((10**12, 3), 96), ((-4, -3), 96), ((2**62, 4), 0)]
)
def test_shapes_must_agree_with_the_bytes_behind_them(shape, size):
    with pytest.raises(FormatError, match=rf"claims the shape \({shape[0]}, {shape[1]}\) of .* but holds {size} bytes"):
        read_npz(members(points__npy=claim(shape, b"\0" * size)), DEFAULT_LIMITS)


def test_limits_and_what_is_no_archive():
    for limits, words in (
        (FileLimits(max_points=3), "claims 4 points, allowed are 0 to 3"),
        (FileLimits(max_faces=1), "claims 2 faces, allowed are 0 to 1"),
    ):
        with pytest.raises(FormatError, match=words):
            read_npz(archive(points=POINTS, faces=np.zeros((2, 3), int)), limits)
    for content in (b"", npy(POINTS), archive(points=POINTS)[:-30]):
        with pytest.raises(FormatError, match="is not a readable zip archive"):
            read_npz(content, DEFAULT_LIMITS)


def test_numpy_reads_what_is_written():
    full = RawCloud(POINTS.astype(np.float32), POINTS, np.full((4, 3), 7, np.uint8), np.array([[0, 1, 3]]))
    with np.load(io.BytesIO(write_npz(full)), allow_pickle=False) as loaded:
        assert set(loaded.files) == {"points", "normals", "colors", "faces"}
        for name in loaded.files:
            assert loaded[name].dtype == getattr(full, name).dtype
            np.testing.assert_array_equal(loaded[name], getattr(full, name))
    with np.load(io.BytesIO(write_npz(RawCloud(POINTS)))) as loaded:
        assert loaded.files == ["points"]


def test_an_empty_cloud_comes_back_empty():
    assert read_npz(write_npz(RawCloud(np.zeros((0, 3)))), DEFAULT_LIMITS).points.shape == (0, 3)


def test_tensors_are_saved_under_their_names(tmp_path):
    save_arrays(tmp_path / "a.npz", {"x": torch.arange(6).reshape(2, 3), "flags": torch.tensor([True, False])})
    with np.load(tmp_path / "a.npz") as archive:
        assert archive["x"].tolist() == [[0, 1, 2], [3, 4, 5]]
        assert archive["flags"].dtype == bool
    with pytest.raises(InputError, match=r"must end in \.npz"):
        save_arrays(tmp_path / "a.txt", {})
