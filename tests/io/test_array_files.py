"""Archives and arrays of numpy: which array is the cloud, and that nothing but plain numbers is ever loaded."""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.io.helpers import put, read
from tests.tables import each, refused, refusing
from torchreg.io.images import load_depth, load_mask
from torchreg.io.limits import FileLimits
from torchreg.io.points import save_points

FormatError = tr.errors.FormatError
POINTS = np.random.default_rng(0).normal(size=(4, 3))


def archive(**arrays):
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def zipped(members, method=zipfile.ZIP_DEFLATED):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return stream.getvalue()


def npy(array, version=(1, 0)):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version=version)
    return stream.getvalue()


def header(shape="(2, 3)", descr="'<f4'", order="False", body=bytes(24), more=""):
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, {more}}}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + body


@pytest.mark.parametrize("dtype", ["<f2", "<f4", ">f8", "<i2", ">u4"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_numbers_come_as_numpy_wrote_them(tmp_path, dtype, order):
    values = np.asarray(np.arange(12).reshape(4, 3), dtype, order=order)
    for name, content in (("a.npz", archive(points=values)), ("a.npy", npy(values))):
        cloud = read(tmp_path, name, content)
        np.testing.assert_array_equal(cloud.points, values.astype(float))
        assert (cloud.normals, cloud.colors, cloud.faces) == (None, None, None)


def test_points_go_before_vertices_and_only_known_companions_are_read(tmp_path):
    known = {"normals": -POINTS, "colors": np.eye(3, dtype=np.uint8)[[0, 1, 2, 0]] * 255, "note": np.array("text")}
    faces = np.array([[0, 1, 2]], np.uint8)
    cloud = read(tmp_path, "a.npz", archive(vertices=POINTS + 1, points=POINTS, faces=faces, **known))
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.normals, -POINTS)
    np.testing.assert_array_equal(cloud.colors, known["colors"] / 255)
    assert cloud.faces.tolist() == [[0, 1, 2]]
    for arrays in ({"vertices": POINTS}, {"scan": POINTS, "pose": np.eye(4), "time": np.ones(4)}):
        np.testing.assert_array_equal(read(tmp_path, "a.npz", archive(**arrays)).points, POINTS)
    old = zipped({"points.npy": npy(POINTS, (2, 0)), "readme.txt": b"x"})
    np.testing.assert_array_equal(read(tmp_path, "a.npz", old).points, POINTS)


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
        read(tmp_path, "a.npz", content)
    assert not (tmp_path / "sprung").exists()


def sized(shape, size):
    return zipped({"points.npy": header(str(shape), "'<f8'", body=b"\0" * size)})


test_damaged_archives = refusing(lambda folder, content: tr.load_points(put(folder, "a.npz", content)), file="a.npz")(
    (archive(one=POINTS, two=POINTS), r"must hold an array 'points' of shape \(N, 3\), .* got one, two"),
    (archive(world=POINTS, scan=POINTS, faces=[[0, 1, 2]]), "array of that shape; got faces, scan, world"),
    (archive(other=POINTS[:, :2]), "must hold an array 'points'"),
    (archive(), "got no arrays"),
    (archive(points=POINTS[:, :2]), r"points must have shape \(N, 3\), got \(4, 2\)"),
    (archive(points=np.float64(3)), r"points must have shape"),
    (archive(points=POINTS, normals=POINTS[:3]), r"normals must have shape \(4, 3\), got \(3, 3\)"),
    (archive(points=POINTS, faces=[[0, 1, 5]]), "a face names vertex 5, outside 0 to 3"),
    (archive(points=POINTS, faces=[[0, 1, -1]]), "a face names vertex -1, outside 0 to 3"),
    (archive(points=POINTS, faces=[[0, 1]]), r"faces must have shape \(F, 3\)"),
    *((archive(points=POINTS, faces=[[0, 1, bad]]), "faces must be whole numbers") for bad in (1.5, np.nan, np.inf)),
    *((archive(points=POINTS, faces=np.array([[0, 1, value]], kind)), "faces are out of range") for kind, value in (
        ("f8", 2.0**53), ("i8", -(2**53)), ("u8", 2**64 - 1), ("i8", -(2**63))
    )),
    (archive(points=POINTS, faces=np.array([[0, 1, 2**53 - 1]])), f"a face names vertex {2**53 - 1}"),
    *((archive(points=np.zeros((2, 3), kind)), r"member 'points\.npy' must hold real numbers") for kind in (
        bool, complex, "U4", "M8[s]", [("x", "f4")]
    )),
    (zipped({"points.npy": npy(POINTS, (3, 0))}), r"member 'points.npy' has the unknown array format \(3, 0\)"),
    *((sized((rows, cols), size), rf"shape \({rows}, {cols}\) of .* but holds {size} bytes") for rows, cols, size in (
        (4, 3, 95), (4, 3, 97), (4, 3, 0), (10**12, 3, 96), (-4, -3, 96), (2**62, 4, 0)
    )),
    *((cut, "is not a readable zip archive") for cut in (b"", b"PK\x03\x04 cut off", archive(points=POINTS)[:-30])),
)  # fmt: skip


def test_zip_bombs_and_odd_archives_are_refused_before_expanding(tmp_path):
    noise = np.random.default_rng(0).normal(size=(1000, 3))
    assert len(read(tmp_path, "a.npz", zipped({"points.npy": npy(noise), "b": b"0" * 5000}))) == 1000
    bomb = zipped({"points.npy": npy(np.ones((1_250_000, 3)))})
    assert len(read(tmp_path, "a.npz", bomb, limits=FileLimits(max_zip_ratio=2000.0))) == 1_250_000
    stored = zipped({"points.npy": npy(POINTS), "a": b"0123456789" * 101}, zipfile.ZIP_STORED)
    encrypted = bytearray(zipped({"points.npy": npy(POINTS)}))
    encrypted[encrypted.index(b"PK\x01\x02") + 8] |= 1
    double = zipped({"one": b"1", "two": b"2"}).replace(b"two", b"one")
    small = FileLimits(max_expanded_bytes=1000)
    refused(
        (lambda: read(tmp_path, "a.npz", bomb), r"would expand \d+ bytes to 30000128; .* 200-fold"),
        (lambda: read(tmp_path, "a.npz", stored, limits=small), "allowed are 1000 bytes"),
        (lambda: read(tmp_path, "a.npz", double), "several members of one name"),
        (
            lambda: read(tmp_path, "a.npz", zipped({"a": b"1"}, zipfile.ZIP_BZIP2)),
            "is packed by method 12; use deflate",
        ),
        (lambda: read(tmp_path, "a.npz", bytes(encrypted)), "is encrypted; save the archive without a password"),
    )


def test_numpy_reads_what_is_written(tmp_path):
    points, faces = torch.from_numpy(POINTS).float(), torch.tensor([[0, 1, 3]])
    save_points(tmp_path / "a.npz", points, points, torch.full((4, 3), 7 / 255), faces=faces)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as loaded:
        assert set(loaded.files) == {"points", "normals", "colors", "faces"}
        np.testing.assert_array_equal(loaded["points"], points)
        np.testing.assert_array_equal(loaded["normals"], points)
        assert (loaded["colors"] == 7).all()
        assert loaded["faces"].tolist() == [[0, 1, 3]]


def test_arrays_of_maps_of_columns_and_of_fields(tmp_path):
    grid, colors = np.arange(60.0).reshape(4, 5, 3), np.arange(12).reshape(4, 3)
    np.testing.assert_array_equal(read(tmp_path, "c.npy", npy(grid + 1)).points, grid.reshape(-1, 3) + 1)
    np.testing.assert_allclose(read(tmp_path, "d.npy", npy(np.c_[POINTS, 9 * colors])).colors, 9 * colors / 255)
    fields = np.zeros(4, [("intensity", "f4"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    fields["x"], fields["y"], fields["z"] = POINTS.T
    np.testing.assert_array_equal(read(tmp_path, "e.npy", npy(fields)).points, POINTS)
    two = npy(POINTS[:, :2])
    refused(
        (lambda: read(tmp_path, "f.npy", two), r"must have shape \(N, 3\) or more columns, got \(4, 2\)"),
        (lambda: read(tmp_path, "f.npy", npy(POINTS * 1j)), "must hold real numbers, got complex128"),
        (lambda: read(tmp_path, "f.npy", npy(POINTS)[:-8]), "holds 88 bytes: it is cut off"),
    )


@each(
    header()[:60], header()[:9], header("(-2, -3)"), header("(True, 6)"), header("(2, 3.0)"), header("[2, 3]"),
    header(descr="[('x', '<f4')]"), header(descr="('<f4', (2,))"), header(descr="'O'"), header(descr="'nonsense'"),
    header(order="None"), header(more="'x': 1"), header("(2, 3"), header("(2, 3)" + "+1" * 40),
)  # fmt: skip
def test_headers_of_arrays_are_no_python(tmp_path, content):
    path = put(tmp_path, "a.npy", content)
    refused((lambda: load_depth(path), r"a\.npy"), (lambda: load_mask(path), r"a\.npy"))
