"""Tables, OBJ, OFF and PTX, line by line: what columns mean, what is left out, what is refused."""

import gzip
import io

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import torchreg as tr
from tests.io.helpers import read
from tests.tables import each, each_row, refused, refusing
from torchreg.io.limits import FileLimits
from torchreg.io.points import save_points

FormatError, FileWarning = tr.errors.FormatError, tr.errors.FileWarning
RNG = np.random.default_rng(4)
POINTS = RNG.normal(size=(50, 3)).round(4)
COLORS = RNG.integers(0, 256, (50, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)


def rows(*columns, sep=" ", fmt="%.6g"):
    table = np.concatenate([np.asarray(column).reshape(50, -1) for column in columns], axis=1)
    return "".join(sep.join(fmt % value for value in row) + "\n" for row in table.tolist())


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(*[st.floats(0.5, allow_infinity=False)] * 3), min_size=1, max_size=5))
def test_numbers_are_read_as_python_reads_them(tmp_path, numbers):
    content = "".join(" ".join(map(repr, row)) + "\n" for row in numbers)
    np.testing.assert_array_equal(read(tmp_path, "a.xyz", content).points, np.array(numbers))


@each(
    "1 -2 3e1\n0.5 0 +6",
    "\n1,-2,30\r\n\r\n0.5,0,6\r\n",
    "# x y z\n  # indented\n1 -2 30 # behind numbers\n\n0.5 0 6#close\n# last",
    "// one\n1,-2,30 // two # three\n0.5;0;6\n",
    "2\nX;Y;Z\n1;-2;30\n0.5;0;6\n",
    " 'x' 'y' 'z'\n1\t-2\t30\n0.5\t0\t6",
    "2 # points\n1 -2 30\n0.5 0 6\n",
    "label,x,y,z,when\nwall,1,-2,30,12:30\nfloor,0.5,0,6,12:31\n",
    "\ufeff1 -2 30\r0.5 0 6\r",
    "1 -2 30\n0.5 0 6\n".encode("utf-16"),
    ",0,1,2\n0,1,-2,30\n1,0.5,0,6\n",
    "0,1,2\n1.0,-2.0,30.0\n0.5,0.0,6.0\n",
    "x,y,z,intensity\n1,-2,30,0.3\n0.5,0,6,0.7\n",
    "1 -2 30 0.3 0\n0.5 0 6 0.7 1\n",
    "1,0;-2,0;30,0\n0,5;0,0;6,0\n",
    "1,0 -2,0 30,0\n0,5 0,0 6,0\n",
)
def test_points_are_read_whatever_stands_between_and_beside_them(tmp_path, content):
    cloud = read(tmp_path, "a.txt", content)
    assert cloud.points.tolist() == [[1, -2, 30], [0.5, 0, 6]]
    assert (cloud.normals, cloud.colors) == (None, None)


@each_row(
    ("cloud.csv", "X,Y,Z,R,G,B\n" + rows(POINTS, COLORS, sep=","), "colors"),
    ("cloud.csv", "//X,Y,Z,R,G,B,Intensity\n" + rows(POINTS, COLORS, np.arange(50), sep=","), "colors"),
    ("cloud.csv", "time;x [m];y [m];z [m];r;g;b\n" + rows(np.arange(50), POINTS, COLORS, sep=";"), "colors"),
    ("cloud.pts", "50\n" + rows(POINTS, -np.arange(50), COLORS), "colors"),
    ("cloud.pts", "50\n" + rows(POINTS, np.arange(50), COLORS), "colors"),
    ("cloud.xyz", rows(POINTS, COLORS), "colors"),
    ("cloud.xyz", rows(POINTS, COLORS, NORMALS), "colors, normals"),
    ("cloud.txt", rows(POINTS, NORMALS, COLORS, sep="\t"), "colors, normals"),
    ("cloud.asc", rows(POINTS, COLORS, 300 + np.arange(50)), "colors"),
    ("cloud.xyz", "x y z nx ny nz\n" + rows(POINTS, NORMALS), "normals"),
    ("cloud.xyz", "X,Y,Z,Normal_X,Normal_Y,Normal_Z\n" + rows(POINTS, NORMALS, sep=","), "normals"),
)
def test_columns_of_colors_and_normals_are_recognized(tmp_path, name, content, kept):
    cloud = read(tmp_path, name, content)
    np.testing.assert_allclose(cloud.points, POINTS)
    assert ((cloud.colors is not None), (cloud.normals is not None)) == ("colors" in kept, "normals" in kept)
    if cloud.colors is not None:
        np.testing.assert_allclose(cloud.colors, COLORS / 255, atol=1e-12)
    if cloud.normals is not None:
        np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-5)


test_damaged_tables = refusing(lambda folder, text: read(folder, "a.xyz", text), file="a.xyz: ")(
    ("", "holds no points"),
    ("0\n", "holds no points"),
    ("# nothing\n", "holds no points"),
    ("x y z\n", "holds no points"),
    ("0.5\n", r"a row of 3 numbers or more \(x y z first\), got 1"),
    ("1 2\n3 4\n", r"a point must be a row of 3 numbers or more \(x y z first\), got 2"),
    ("0 0 0\n0 0 0 0 0 1\n", "a point is not a row of equally many numbers"),
    ("0 0 0\n0 0 # 0\n", "a point is not a row of equally many numbers"),
    ("0 0 0\n1 0 0\n0 1\n0 0 1\n", r"line 3 holds 2 \('0 1'\), the first row 3"),
    ("# c\n0 0 0\n1 zero 0\n", "line 3 holds 'zero'"),
    ("0 0 0\n0 0 0x10\n", "line 2 holds '0x10'"),
    ("1 2 3\n1 2 \u0663\n", "a point is not a row"),
    ("1 2 3\n\xff", "not a row"),
    ("7\n", "the first line says 7 points, the file holds 0: it is cut off"),
    ("3\n1 2 3\n4 5 6\n", "the first line says 3 points, the file holds 2"),
    ("1\nx y z\n0 0 0\n1 1 1\n", "the first line says 1 points, the file holds 2"),
    ("y x\n0 0\n", "the columns must name x, y and z, got y x"),
    ("x,y,q\n1,2,3\n", "the columns must name x, y and z, got x y q"),
    ("ply\nformat ascii 1.0\n", "must start with 'ply'|the columns must name x, y and z, got ply"),
    ("1.234,5;2;3\n4;5;6\n", "numbers with commas stand between semicolons or tabs"),
    ("0,123,0,456,0,789\n1,100,3,200,1,300\n", "commas separate the columns and, it seems, the decimals too"),
)


def test_packed_text(tmp_path):
    np.testing.assert_allclose(read(tmp_path, "a.csv.gz", gzip.compress(rows(POINTS, sep=",").encode())).points, POINTS)
    refused(
        (lambda: read(tmp_path, "b.xyz.gz", gzip.compress(rows(POINTS).encode())[:-20]),
         r"b\.xyz\.gz: cannot be unpacked by gzip: it is cut off"),
        (lambda: read(tmp_path, "c.xyz.gz", gzip.compress(b"0 0 0\n" * 1_000_000)), "would expand"),
    )  # fmt: skip


def test_columns_four_to_six_are_colors_normals_or_left_out(tmp_path):
    fractions = RNG.random((50, 3)).round(3)
    cloud = read(tmp_path, "a.xyz", rows(POINTS, fractions))
    assert cloud.normals is None
    np.testing.assert_allclose(cloud.colors, fractions)
    assert read(tmp_path, "b.xyz", rows(POINTS, NORMALS)).colors is None
    for others in (900 * POINTS, 200 * fractions + 0.001, 70000 + np.arange(150).reshape(50, 3)):
        with pytest.warns(FileWarning, match=r"a\.xyz: columns 4 to 6 are left out: numbers from .* to .* are neither"):
            cloud = read(tmp_path, "a.xyz", rows(POINTS, others))
        assert (cloud.normals, cloud.colors) == (None, None)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("with_normals", [False, True])
def test_numpy_reads_the_written_table_exactly(tmp_path, dtype, with_normals):
    points = np.random.default_rng(0).normal(size=(20, 3)).astype(dtype)
    points *= np.logspace(-30, 30, 20, dtype=dtype)[:, None]
    normals = (points / np.abs(points).max(axis=-1, keepdims=True)).astype(dtype) if with_normals else None
    save_points(tmp_path / "a.xyz", torch.from_numpy(points), None if normals is None else torch.from_numpy(normals))
    table = np.genfromtxt(io.BytesIO((tmp_path / "a.xyz").read_bytes()), dtype=dtype)
    np.testing.assert_array_equal(table, points if normals is None else np.concatenate([points, normals], 1))


def test_tables_and_scales_are_written_and_read_again(tmp_path):
    save_points(tmp_path / "a.csv", torch.from_numpy(POINTS), torch.from_numpy(NORMALS), torch.from_numpy(COLORS / 255))
    cloud = tr.load_points(tmp_path / "a.csv", dtype=torch.float64, scale=0.001)
    np.testing.assert_allclose(cloud.points, POINTS / 1000)
    np.testing.assert_allclose(cloud.normals, NORMALS)
    np.testing.assert_allclose(cloud.colors, COLORS / 255, atol=1e-12)
    refused((lambda: tr.load_points(tmp_path / "a.csv", scale=0.0), "scale must be positive"), error=ValueError)


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
NAMED = "mtllib none.mtl\no square\ng top\ns off\n" + SQUARE + "vt 0 0\nvt 1 1\nvn 0 0 1\nusemtl red\nf {}\n"


@each_row(
    (SQUARE + "v 0.5 2 0\nf 1 2 3 4\nf 1 2 3 5 4\nf 1 2 3\n",
     [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 4], [0, 4, 3], [0, 1, 2]]),
    ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\nf -6 2 -4\n",
     [[0, 1, 2], [3, 4, 5], [0, 1, 2]]),
    ("v 0 0 0\nf 3 2 1\nv 1 0 0\nv 0 1 0\n", [[2, 1, 0]]),  # named ahead of their lines
    ("v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3/1/1 -2/2/1 -1/3/1\nv 0 1 0\nvt 0 0\nvt 1 1\nvt 1 0\nvn 0 0 1\n"
     "f 1/2 3/1 4/1 # quad next\nf 1 2 3 4\n", [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 3]]),
    *((NAMED.format(corners), [[0, 1, 2], [0, 2, 3]]) for corners in (
        "1 2 3 4", "1/1 2/2 3/1 4/2", "1/1/1 2/2/1 3/1/1 4/2/1", "1//1 2//1 3//1 4//1"
    )),
    *((text, None) for text in ("v\t1 \\\n 2 3", "v 1 2 3 1\n", "v 1 2 3 # 0 0 1\n", "v 1.0 2e0 3 1\r\no x\r\n")),
)  # fmt: skip
def test_vertices_and_faces_of_obj(tmp_path, text, faces):
    cloud = read(tmp_path, "a.obj", text)
    assert len(cloud) == text.count("v ") + text.count("v\t")
    assert faces is not None or cloud.points.tolist() == [[1, 2, 3]]
    assert cloud.colors is None
    assert (cloud.faces if faces is None else cloud.faces.tolist()) == faces
    assert cloud.normals is None  # or several vertices share one


@each_row(
    ("f 1//1 2//2 3//3\n", True), ("f -3//-3 -2//2 3//-1\n", True), ("f 1/9/1 2/9/2 3/9/3\n", True), ("", True),
    ("f 1//1 2//2 3//1\n", False), ("f 1//3 2//2 3//1\n", False),
    ("f 1//1 2//2 3\n", False), ("f 1/1 2/2 3/3\n", False),
)  # fmt: skip
def test_normals_of_obj_are_read_where_each_vertex_has_its_own(tmp_path, faces, kept):
    normals = read(tmp_path, "a.obj", "v 0 0 0\nvn 1 0 0\nv 1 0 0\nvn 0 1 0 # up\nv 0 1 0\nvn 0 0 1\n" + faces).normals
    assert (normals is not None) == kept
    if kept:
        assert normals.tolist() == torch.eye(3).tolist()


test_damaged_obj = refusing(lambda folder, text: read(folder, "a.obj", text), file="a.obj")(
    ("# nothing\n", "holds no points"),
    ("f 1 2 3\n", "outside 1 to 0"),
    (SQUARE + "f 1 2 5\n", "a face names a vertex outside 1 to 4: the file is cut off or damaged"),
    (SQUARE + "f 1 0 1\n", "a face names a vertex outside 1 to 4"),
    ("v 0 0 0\nf -2 -1 -1\nv 1 0 0\n", "a face names a vertex outside 1 to 2"),
    (SQUARE + "f 1/1 /2 3/3\n", "each vertex index must hold 1 numbers|a vertex index is not a row"),
    (SQUARE + "f a b c\n", "a vertex index is not a row"),
    (SQUARE + "f 1 2 1e300\n", "vertex indices are out of range"),
    (SQUARE + "f 1 2 nan\n", "vertex indices must be whole numbers"),
    (SQUARE + "f 1 1.5 1\n", "vertex indices must be whole numbers"),
    ("v 0 0 0\nvn 0 0 1\nf 1//2 1//1 1//1\n", "a face names a normal outside 1 to 1"),
    ("v 0 0 0\nvn 0 0 1\nf 1//0 1//1 1//1\n", "a face names a normal outside 1 to 1"),
    ("v 0 0 0\nvn 0 1\nf 1//1 1//1 1//1\n", "each normal must hold 3 numbers, got 2"),
    ("v 1 2\n", "a vertex must be 3 numbers"),
    ("v 0 0 0 0 0\n", r"a vertex must be 3 numbers \(with w 4, with a color 6 or 7\), got 5"),
    ("v 0 0 0\nv 0 0 0 1 1\n", "a vertex is not a row of equally many numbers: row 2 holds 5"),
    ("v 0 0 0\nv\n", "each vertex must hold"),
)


@pytest.mark.parametrize("shape", ["box", "icosphere", "capsule"])
def test_obj_of_trimesh_with_its_vertex_normals(tmp_path, shape):
    mesh = getattr(trimesh.creation, shape)()
    cloud = read(tmp_path, "a.obj", trimesh.exchange.obj.export_obj(mesh, include_normals=True, digits=12))
    np.testing.assert_allclose(cloud.points, mesh.vertices, atol=1e-11)
    np.testing.assert_array_equal(cloud.faces, mesh.faces)
    np.testing.assert_allclose(cloud.normals, mesh.vertex_normals, atol=1e-11)


def test_faces_of_two_corners_and_colors_of_some_vertices_are_left_out(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2\n"
    with pytest.warns(FileWarning, match=r"a\.obj: 1 of 2 faces are left out: they have fewer than 3 corners"):
        assert read(tmp_path, "a.obj", text).faces.tolist() == [[0, 1, 2]]
    with pytest.warns(FileWarning, match="colors are left out: 1 of 3 vertices have one"):
        cloud = read(tmp_path, "c.obj", text.replace("v 0 0 0", "v 0 0 0 1 0 0").replace("f 1 2\n", ""))
    assert (cloud.colors, len(cloud)) == (None, 3)
    for line in ("v 1 2 3 0.1 0.2 0.3\n", "v 1 2 3 1 0.1 0.2 0.3\n"):  # with a weight, too
        assert read(tmp_path, "c.obj", line).colors.tolist() == [[0.1, 0.2, 0.3]]


def test_limits_are_checked_before_numbers_are(tmp_path):
    points, faces = {"limits": FileLimits(max_points=3)}, {"limits": FileLimits(max_faces=1)}
    refused(
        (lambda: read(tmp_path, "a.obj", SQUARE.replace("1", "?"), **points), "claims 4 points, allowed are 0 to 3"),
        (lambda: read(tmp_path, "a.obj", SQUARE + "f ? ? ?\nf ? ? ?\n", **faces), "claims 2 faces, allowed are 0 to 1"),
        (lambda: read(tmp_path, "a.xyz", "? ? ?\n" * 4, **points), "claims 4 points, allowed are 0 to 3"),
    )
    assert len(read(tmp_path, "a.xyz", "1 2 3\n" * 3, **points)) == 3


def test_off_meshes(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=1)
    content = sphere.export(file_type="off")
    for text in (content, content.replace("OFF\n", "OFF # a comment\n", 1), content.replace("OFF\n", "OFF ", 1)):
        cloud = read(tmp_path, "a.off", text)
        np.testing.assert_allclose(cloud.points, sphere.vertices, atol=1e-6)
        assert cloud.faces.tolist() == sphere.faces.tolist()
    cut = "\n".join(content.splitlines()[:60])
    words = r"a\.off: the header says 42 vertices and 80 faces, 58 lines follow: it is cut off"
    refused((lambda: read(tmp_path, "a.off", cut), words))
    colored = "COFF\n4 2 0\n0 0 0 1 0 0 1\n1 0 0 1 0 0 1\n1 1 0 1 0 0 1\n0 1 0 1 0 0 1\n4 0 1 2 3 9 9 9\n3 0 1 2\n"
    cloud = read(tmp_path, "a.off", colored)
    assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert cloud.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    assert read(tmp_path, "a.off", "OFF 1 0 0\n1 2 3\n").points.tolist() == [[1, 2, 3]]
    for old, new, words in (
        ("3 0 1 2\n", "3 0 1\n", "a face has fewer corners than it says"),
        ("3 0 1 2\n", "-3 0 1 2\n", "a face has fewer corners"),
        ("3 0 1 2\n", "3 0 1 x\n", "a vertex index is not a row of 1 numbers"),
        ("3 0 1 2\n", "3 0 1 4\n", "a face names vertex 4"),
        ("1 0 0 1 0 0 1", "1 0", "a vertex is not a row of 3 numbers"),
    ):
        refused((lambda old=old, new=new: read(tmp_path, "a.off", colored.replace(old, new)), words))


def ptx(points, pose, tail="", counts=None):
    """Return a scan as text; the pose (4, 4) moves columns."""
    head = [pose[:3, 3], *pose[:3, :3].T, *pose.T]
    lines = [" ".join(f"{v:.9f}" for v in row) for row in head]
    lines += [" ".join(f"{v:.6f}" for v in row) + f" 0.5{tail}" for row in points]
    return "\n".join([*map(str, counts or (1, len(points))), *lines]) + "\n"


def turned(angle, place):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = place
    return pose


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("name", ["a.ptx", "a.txt"])
def test_scans_of_laser_scanners_stand_where_they_were_registered(tmp_path, newline, name):
    poses = turned(0.7, [10, -4, 1.5]), turned(-1.2, [3, 2, 1])
    measured = np.concatenate([POINTS, np.zeros((1, 3))])  # one direction without an echo
    text = ptx(measured, poses[0], " 255 0 51", (3, 17)) + ptx(POINTS, poses[1], " 0 255 51", (5, 10))
    with pytest.warns(FileWarning, match=r"1 of 101 points are 0 0 0, where nothing was measured"):
        cloud = read(tmp_path, name, text.replace("\n", newline))
    expected = np.concatenate([POINTS @ pose[:3, :3].T + pose[:3, 3] for pose in poses])
    np.testing.assert_allclose(cloud.points, expected, atol=1e-5)
    np.testing.assert_allclose(cloud.colors[[0, -1]], [[1, 0, 0.2], [0, 1, 0.2]])


def damaged_ptx(folder, old, new):
    whole = ptx(POINTS, turned(0.7, [10, -4, 1.5]), counts=(10, 5))
    read(folder, "a.ptx", new.join(whole.rsplit(old, 1) if old == "1.000000000\n" else whole.split(old, 1)))


test_damaged_scans = refusing(damaged_ptx, file="a.ptx: ")(
    ("10\n5\n", "10\n6\n", r"a scan's head says 60 points, each of 3, 4, 6, 7 numbers; it holds 50 of 4"),
    ("10\n5\n", "10\n4\n", "line 51 must begin a scan"),
    (" 0.5", " x", "'x'"),
    ("1.000000000\n", "2.000000000\n", "the motion of a scan must end in 0 0 0 1"),
    ("10\n5\n", "99999999\n5\n", "claims 499999995 points"),
)


def test_colors_of_some_scans_and_scans_of_points_alone(tmp_path):
    text = ptx(POINTS, np.eye(4)) + ptx(POINTS, np.eye(4), " 1 2 3")
    with pytest.warns(FileWarning, match="colors are left out: 1 of 2 scans have them"):
        assert read(tmp_path, "a.ptx", text).colors is None
    text = ptx(POINTS, turned(0.3, (1, 2, 3))).replace(" 0.5\n", "\n")
    np.testing.assert_allclose(read(tmp_path, "b.ptx", text).points[:, 2], POINTS[:, 2] + 3, atol=1e-5)
    empty = ptx(np.zeros((4, 3)), turned(0.3, (1, 2, 3)))
    refused((lambda: read(tmp_path, "a.ptx", empty), "all of its 4 points are 0 0 0: nothing was measured"))
