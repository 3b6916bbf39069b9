"""XYZ tables and OBJ files, line by line."""

import io

import numpy as np
import pytest
import trimesh

from torchreg.errors import FormatError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.raw_cloud import RawCloud
from torchreg.io.text_formats import read_obj, read_table, write_xyz

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def xyz(text: str, limits: FileLimits = DEFAULT_LIMITS) -> RawCloud:
    return read_table(text.encode(), limits)


def obj(text: str, limits: FileLimits = DEFAULT_LIMITS) -> RawCloud:
    return read_obj(text.encode(), limits)


@pytest.mark.parametrize(
    "text",
    [
        "1 -2 3e1\n0.5 0 +6\n",
        "# x y z\n  # indented\n1 -2 30 # behind numbers\n\n0.5 0 6#close\n# last",
        "// one\n1,-2,30 // two # three\n0.5;0;6\n",
        "2\nX;Y;Z\n1;-2;30\n0.5;0;6\n",
        " 'x' 'y' 'z'\n1\t-2\t30\n0.5\t0\t6",
        "2 # points\n1 -2 30\n0.5 0 6\n",
    ],
)
def test_tables_with_comments_counts_and_names(text):
    cloud = xyz(text)
    assert cloud.points.dtype == np.float64
    assert cloud.points.tolist() == [[1, -2, 30], [0.5, 0, 6]]
    assert cloud.normals is None


@pytest.mark.parametrize("names", ["", "x y z nx ny nz\n", "X,Y,Z,Normal_X,Normal_Y,Normal_Z\n"])
def test_six_columns_are_points_and_normals(names):
    cloud = xyz(names + "1 2 3 0 0 -1\n4 5 6 0.6 0.8 0\n")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.normals.tolist() == [[0, 0, -1], [0.6, 0.8, 0]]


def test_missing_values_are_handed_over():
    cloud = xyz("nan 1 2 nan nan nan\n1 inf -inf 0 0 1\n")
    np.testing.assert_array_equal(cloud.points, [[np.nan, 1, 2], [1, np.inf, -np.inf]])
    np.testing.assert_array_equal(cloud.normals, [[np.nan] * 3, [0, 0, 1]])


@pytest.mark.parametrize("text", ["", "\n \n", "# nothing\n", "0\n", "x y z\n"])
def test_tables_without_rows_are_empty(text):
    assert xyz(text).points.shape == (0, 3)


@pytest.mark.parametrize("columns", [1, 2])
def test_fewer_than_three_columns_are_refused(columns):
    with pytest.raises(FormatError, match=rf"a row of 3 numbers or more \(x y z first\), got {columns}"):
        xyz(" ".join(["0.5"] * columns) + "\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0 0 0\n0 0 0 0 0 1\n", "a point is not a row of equally many numbers"),
        ("0 0 0\n0 0 # 0\n", "a point is not a row of equally many numbers"),
        ("0 0 0\nx y z\n", "a point is not a row of equally many numbers"),
        ("7\n", "the first line says 7 points, the file holds 0: it is cut off"),
        ("1\n0 0 0\n1 1 1\n", "the first line says 1 points, the file holds 2"),
        ("1\nx y z\n0 0 0\n1 1 1\n", "the first line says 1 points, the file holds 2"),
        ("y x\n0 0\n", "the columns must name x, y and z, got y x"),
        ("ply\nformat ascii 1.0\n", "the columns must name x, y and z, got ply"),
    ],
)
def test_damaged_tables_are_refused(text, words):
    with pytest.raises(FormatError, match=words):
        xyz(text)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("with_normals", [False, True])
def test_numpy_reads_the_written_table_exactly(dtype, with_normals):
    points = (
        np.random.default_rng(0).normal(size=(20, 3)).astype(dtype) * np.logspace(-30, 30, 20, dtype=dtype)[:, None]
    )
    normals = (points / np.abs(points).max(axis=-1, keepdims=True)).astype(dtype) if with_normals else None
    content = write_xyz(RawCloud(points, normals))
    table = np.genfromtxt(io.BytesIO(content), dtype=dtype)
    np.testing.assert_array_equal(table[:, :3], points)
    assert table.shape == (20, 6 if with_normals else 3)
    if with_normals:
        np.testing.assert_array_equal(table[:, 3:], normals)
    np.testing.assert_array_equal(read_table(content, DEFAULT_LIMITS).points.astype(dtype), points)


def test_quads_and_larger_polygons_are_cut_into_fans():
    cloud = obj(SQUARE + "v 0.5 2 0\nf 1 2 3 4\nf 1 2 3 5 4\nf 1 2 3\n")
    assert cloud.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 4], [0, 4, 3], [0, 1, 2]]
    assert cloud.faces.dtype == np.int64


def test_negative_indices_count_back_from_the_line():
    cloud = obj("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\nf -6 2 -4\n")
    assert cloud.faces.tolist() == [[0, 1, 2], [3, 4, 5], [0, 1, 2]]
    assert obj("v 0 0 0\nf 3 2 1\nv 1 0 0\nv 0 1 0\n").faces.tolist() == [[2, 1, 0]]  # named ahead of their lines


@pytest.mark.parametrize("corners", ["1 2 3 4", "1/1 2/2 3/1 4/2", "1/1/1 2/2/1 3/1/1 4/2/1", "1//1 2//1 3//1 4//1"])
def test_corners_with_texture_and_normal_keep_the_vertices(corners):
    cloud = obj(f"mtllib none.mtl\no square\ng top\ns off\n{SQUARE}vt 0 0\nvt 1 1\nvn 0 0 1\nusemtl red\nf {corners}\n")
    assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert cloud.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert cloud.normals is None  # four vertices share one


@pytest.mark.parametrize(
    ("faces", "kept"),
    [
        ("f 1//1 2//2 3//3\n", True),
        ("f -3//-3 -2//2 3//-1\n", True),
        ("f 1/9/1 2/9/2 3/9/3\n", True),
        ("", True),
        ("f 1//1 2//2 3//1\n", False),
        ("f 1//1 2//2 3\n", False),
        ("f 1/1 2/2 3/3\n", False),
        ("f 1//3 2//2 3//1\n", False),
    ],
)
def test_normals_are_read_where_each_vertex_has_its_own(faces, kept):
    cloud = obj("v 0 0 0\nvn 1 0 0\nv 1 0 0\nvn 0 1 0 # up\nv 0 1 0\nvn 0 0 1\n" + faces)
    assert (cloud.normals is not None) == kept
    if kept:
        assert cloud.normals.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


@pytest.mark.parametrize(
    ("rows", "colors"),
    [
        ("v 1 2 3 1\n", None),
        ("v 1 2 3 # 0 0 1\n", None),
        ("v 1 2 3 0.1 0.2 0.3\n", [[0.1, 0.2, 0.3]]),
        ("v 1 2 3 1 0.1 0.2 0.3\n", [[0.1, 0.2, 0.3]]),
        ("  v\t1 2 \\\r\n3\r\n", None),
    ],
)
def test_vertices_with_weights_and_colors(rows, colors):
    cloud = obj(rows)
    assert cloud.points.tolist() == [[1, 2, 3]]
    assert (cloud.colors if colors is None else cloud.colors.tolist()) == colors
    assert cloud.faces is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (SQUARE + "f 1 2 5\n", "a face names a vertex outside 1 to 4: the file is cut off or damaged"),
        ("v 0 0 0\nf -2 -1 -1\nv 1 0 0\n", "a face names a vertex outside 1 to 2"),
        (SQUARE + "f 1/1 /2 3/3\n", "each vertex index must hold 1 numbers|a vertex index is not a row"),
        (SQUARE + "f 1 2 1e300\n", "vertex indices are out of range"),
        (SQUARE + "f 1 2 nan\n", "vertex indices must be whole numbers"),
        ("v 0 0 0\nvn 0 0 1\nf 1//2 1//1 1//1\n", "a face names a normal outside 1 to 1"),
        ("v 0 0 0\nvn 0 0 1\nf 1//0 1//1 1//1\n", "a face names a normal outside 1 to 1"),
        ("v 0 0 0\nvn 0 1\nf 1//1 1//1 1//1\n", "each normal must hold 3 numbers, got 2"),
        ("v 0 0 0 0 0\n", r"a vertex must be 3 numbers \(with w 4, with a color 6 or 7\), got 5"),
        ("v 0 0 0\nv 0 0 0 1 1\n", "a vertex is not a row of equally many numbers: row 2 holds 5"),
        ("v 0 0 0\nv\n", "each vertex must hold"),
    ],
)
def test_damaged_obj_is_refused(text, words):
    with pytest.raises(FormatError, match=words):
        obj(text)


@pytest.mark.parametrize("shape", ["box", "icosphere", "capsule"])
def test_obj_of_trimesh_with_its_vertex_normals(shape):
    mesh = getattr(trimesh.creation, shape)()
    cloud = obj(trimesh.exchange.obj.export_obj(mesh, include_normals=True, digits=12))
    np.testing.assert_allclose(cloud.points, mesh.vertices, atol=1e-11)
    np.testing.assert_array_equal(cloud.faces, mesh.faces)
    np.testing.assert_allclose(cloud.normals, mesh.vertex_normals, atol=1e-11)


def test_limits_are_checked_before_numbers_are():
    with pytest.raises(FormatError, match="claims 4 points, allowed are 0 to 3"):
        obj(SQUARE.replace("1", "?"), FileLimits(max_points=3))
    with pytest.raises(FormatError, match="claims 2 faces, allowed are 0 to 1"):
        obj(SQUARE + "f ? ? ?\nf ? ? ?\n", FileLimits(max_faces=1))
    with pytest.raises(FormatError, match="claims 4 points, allowed are 0 to 3"):
        xyz("? ? ?\n" * 4, FileLimits(max_points=3))
    assert len(xyz("1 2 3\n" * 3, FileLimits(max_points=3)).points) == 3
