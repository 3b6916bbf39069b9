"""Tables, arrays and meshes as other programs write them: what their columns mean, and what is left out."""

import gzip
import io

import numpy as np
import pytest
import torch
import trimesh

from torchreg.errors import FileWarning, FormatError, InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.frames import load_frames
from torchreg.io.points import load_mesh, load_points, save_points

RNG = np.random.default_rng(4)
POINTS = RNG.normal(size=(50, 3)).round(4)
COLORS = RNG.integers(0, 256, (50, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
SPHERE = unit_sphere(1, dtype=torch.float64)


def rows(*columns, sep=" ", fmt="%.6g"):
    table = np.concatenate([np.asarray(column).reshape(50, -1) for column in columns], axis=1)
    return "".join(sep.join(fmt % value for value in row) + "\n" for row in table.tolist())


def read(tmp_path, name, content, **options):
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_points(path, dtype=torch.float64, **options)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("cloud.csv", "X,Y,Z,R,G,B\n" + rows(POINTS, COLORS, sep=",")),
        ("cloud.csv", "//X,Y,Z,R,G,B,Intensity\n" + rows(POINTS, COLORS, np.arange(50), sep=",")),
        ("cloud.csv", ",x,y,z,red,green,blue\n" + rows(np.arange(50), POINTS, COLORS, sep=",")),
        ("cloud.csv", "time;x [m];y [m];z [m];r;g;b\n" + rows(np.arange(50), POINTS, COLORS, sep=";")),
        ("cloud.pts", "50\n" + rows(POINTS, -np.arange(50), COLORS)),
        ("cloud.pts", "50\n" + rows(POINTS, np.arange(50), COLORS)),
        ("cloud.xyz", rows(POINTS, COLORS)),
        ("cloud.xyz", rows(POINTS, COLORS, NORMALS)),
        ("cloud.txt", rows(POINTS, NORMALS, COLORS, sep="\t")),
        ("cloud.asc", rows(POINTS, COLORS, 300 + np.arange(50))),
    ],
)
def test_columns_of_colors_are_told(tmp_path, name, content):
    cloud = read(tmp_path, name, content)
    np.testing.assert_allclose(cloud.points, POINTS)
    np.testing.assert_allclose(cloud.colors, COLORS / 255, atol=1e-12)
    if cloud.normals is not None:
        np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-5)


@pytest.mark.parametrize(
    "content",
    [
        rows(POINTS),
        rows(POINTS, RNG.random(50)),
        rows(POINTS, RNG.random(50), np.arange(50)),
        "x,y,z,intensity\n" + rows(POINTS, RNG.random(50), sep=","),
        ",0,1,2\n" + rows(np.arange(50), POINTS, sep=","),
        "0,1,2\n" + rows(POINTS, sep=","),
        rows(POINTS, sep=";").replace(".", ","),
        rows(POINTS, sep="\t").replace(".", ","),
        rows(POINTS).replace(".", ","),
        "\ufeff" + rows(POINTS),
        rows(POINTS).replace("\n", "\r"),
        "# made by a scanner\n\n" + rows(POINTS, sep=", "),
    ],
)
def test_points_are_read_whatever_stands_beside_them(tmp_path, content):
    cloud = read(tmp_path, "cloud.txt", content)
    np.testing.assert_allclose(cloud.points, POINTS)
    assert cloud.normals is None
    assert cloud.colors is None


def test_text_of_windows_and_packed_text(tmp_path):
    np.testing.assert_allclose(read(tmp_path, "a.txt", rows(POINTS).encode("utf-16")).points, POINTS)
    np.testing.assert_allclose(read(tmp_path, "a.csv.gz", gzip.compress(rows(POINTS, sep=",").encode())).points, POINTS)
    with pytest.raises(FormatError, match=r"b\.xyz\.gz: cannot be unpacked by gzip: it is cut off"):
        read(tmp_path, "b.xyz.gz", gzip.compress(rows(POINTS).encode())[:-20])
    with pytest.raises(FormatError, match="would expand"):
        read(tmp_path, "c.xyz.gz", gzip.compress(b"0 0 0\n" * 1_000_000))


def test_words_among_named_columns_do_no_harm(tmp_path):
    cloud = read(tmp_path, "a.csv", "label,x,y,z,when\nwall,1,2,3,12:30\nfloor,4,5,6,12:31\n")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_fractions_of_one_are_colors_where_they_are_no_unit_vectors(tmp_path):
    fractions = RNG.random((50, 3)).round(3)
    cloud = read(tmp_path, "a.xyz", rows(POINTS, fractions))
    assert cloud.normals is None
    np.testing.assert_allclose(cloud.colors, fractions)
    assert read(tmp_path, "b.xyz", rows(POINTS, NORMALS)).colors is None


def test_columns_that_can_be_neither_are_left_out_and_told(tmp_path):
    with pytest.warns(FileWarning, match=r"a\.xyz: columns 4 to 6 are left out: numbers from -.* to .* are neither"):
        cloud = read(tmp_path, "a.xyz", rows(POINTS, 900 * POINTS))
    assert cloud.normals is None
    assert cloud.colors is None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("0 0 0\n1 0 0\n0 1\n0 0 1\n", r"line 3 holds 2 \('0 1'\), the first row 3"),
        ("# c\n0 0 0\n1 zero 0\n", "line 3 holds 'zero'"),
        ("x,y,q\n1,2,3\n", "the columns must name x, y and z, got x y q"),
        ("1.234,5;2;3\n4;5;6\n", "numbers with commas stand between semicolons or tabs"),
        ("0,123,0,456,0,789\n1,100,3,200,1,300\n", "commas separate the columns and, it seems, the decimals too"),
        ("1 2\n3 4\n", r"a point must be a row of 3 numbers or more \(x y z first\), got 2"),
    ],
)
def test_what_is_wrong_with_a_table_is_told_with_its_place(tmp_path, content, words):
    with pytest.raises(FormatError, match=rf"a\.txt: .*{words}"):
        read(tmp_path, "a.txt", content)


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def test_arrays_of_numpy(tmp_path):
    np.testing.assert_array_equal(read(tmp_path, "a.npy", npy(POINTS)).points, POINTS)
    np.testing.assert_array_equal(read(tmp_path, "b.npy", npy(np.asfortranarray(POINTS))).points, POINTS)
    np.testing.assert_array_equal(read(tmp_path, "c.npy", npy(POINTS.reshape(5, 10, 3))).points, POINTS)
    colored = read(tmp_path, "d.npy", npy(np.concatenate([POINTS, COLORS], 1)))
    np.testing.assert_allclose(colored.colors, COLORS / 255)
    fields = np.zeros(50, [("intensity", "f4"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    fields["x"], fields["y"], fields["z"] = POINTS.T
    np.testing.assert_array_equal(read(tmp_path, "e.npy", npy(fields)).points, POINTS)
    for array, words in (
        (POINTS[:, :2], r"must have shape \(N, 3\) or more columns, got \(50, 2\)"),
        (POINTS.astype(complex), "must hold real numbers, got complex128"),
    ):
        with pytest.raises(FormatError, match=words):
            read(tmp_path, "f.npy", npy(array))
    with pytest.raises(FormatError, match="holds 1192 bytes: it is cut off"):
        read(tmp_path, "g.npy", npy(POINTS)[:-8])


def test_off_meshes(tmp_path):
    content = trimesh.Trimesh(SPHERE.vertices.numpy(), SPHERE.faces.numpy(), process=False).export(file_type="off")
    for text in (content, content.replace("OFF\n", "OFF # a comment\n", 1), content.replace("OFF\n", "OFF ", 1)):
        (tmp_path / "a.off").write_text(text)
        mesh = load_mesh(tmp_path / "a.off", dtype=torch.float64)
        torch.testing.assert_close(mesh.vertices, SPHERE.vertices, atol=1e-6, rtol=0)
        assert torch.equal(mesh.faces, SPHERE.faces)
    with pytest.raises(FormatError, match=r"a\.off: the header says 42 vertices and 80 faces, the file holds 60 lines"):
        read(tmp_path, "a.off", "\n".join(content.splitlines()[:60]))


def test_content_decides_where_the_ending_is_wrong(tmp_path):
    save_points(tmp_path / "real.ply", SPHERE.vertices, faces=SPHERE.faces)
    content = (tmp_path / "real.ply").read_bytes()
    for name in ("scan.obj", "scan", "scan.bin", "scan.stl"):
        (tmp_path / name).write_bytes(content)
        assert len(load_mesh(tmp_path / name).faces) == 80
    (tmp_path / "real.dat").write_bytes(npy(POINTS))
    assert len(load_points(tmp_path / "real.dat")) == 50


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0f\nsize 48213\n", "Git LFS pointer.*git lfs pull"),
        (b"<!DOCTYPE html><html><body>Not found</body></html>", "is a web page"),
        (b"\0\1\2\3", "has the unknown ending '.scan'.*known: .ply, .pcd"),
    ],
)
def test_what_stands_in_for_a_file_is_told(tmp_path, content, words):
    with pytest.raises(FormatError, match=words):
        read(tmp_path, "a.scan", content)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.e57", b"ASTM-E57" + bytes(40), "E57.*CloudCompare.*PLY.*pye57"),
        ("a.E57", b"", "E57.*CloudCompare"),
        ("a.xyz", b"ASTM-E57" + bytes(40), "E57.*CloudCompare"),
        ("a.laz", b"LASF" + bytes(40), "LAS or LAZ.*CloudCompare.*laspy"),
        ("a.rcs", bytes(9), "scanner's own format.*PTX or PLY"),
        ("a.bag", b"#ROSBAG V2.0", "ROS recording.*PCD"),
        ("a.fbx", b"Kaydara FBX Binary", r"glTF \(\.glb\)"),
        ("a.step", b"ISO-10303-21;", "CAD model.*STL"),
    ],
)
def test_other_formats_are_told_with_a_way_to_convert_them(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    for call in (load_points, load_mesh, *([] if name.endswith("xyz") else [load_frames])):
        with pytest.raises(FormatError, match=rf"{name}: is of a format that is not read \(.*{words}"):
            call(tmp_path / name)
    if not name.endswith("xyz"):
        with pytest.raises(FormatError, match=words):
            load_frames(tmp_path)


def ascii_ply(columns, values, faces=""):
    head = "".join(f"property {kind} {name}\n" for kind, name in columns)
    count = len(faces.splitlines())
    tail = f"element face {count}\nproperty list uchar int vertex_indices\n" if faces else ""
    body = "".join(" ".join(f"{v:g}" for v in row) + "\n" for row in np.asarray(values).tolist())
    return f"ply\nformat ascii 1.0\nelement vertex {len(values)}\n{head}{tail}end_header\n{body}{faces}"


XYZ = [("float", name) for name in "xyz"]


@pytest.mark.parametrize("kind", ["float", "double", "int", "ushort"])
def test_bytes_written_in_other_types_are_colors_from_zero_to_one(tmp_path, kind):
    columns = [*XYZ, *((kind, name) for name in ("red", "green", "blue"))]
    cloud = read(tmp_path, "a.ply", ascii_ply(columns, np.concatenate([POINTS, COLORS], 1)))
    np.testing.assert_allclose(cloud.colors, COLORS / 255, atol=1e-6)


def test_colors_that_can_be_none_are_left_out(tmp_path):
    columns = [*XYZ, *(("float", name) for name in ("red", "green", "blue"))]
    with pytest.warns(FileWarning, match="colors are left out: they run from -1"):
        assert (
            read(tmp_path, "a.ply", ascii_ply(columns, np.concatenate([POINTS, -np.ones((50, 3))], 1))).colors is None
        )


def test_normals_that_are_not_finite_come_from_the_faces_or_are_left_out(tmp_path):
    values = np.array([[0, 0, 0, 0, 0, 1], [1, 0, 0, np.nan, 0, 0], [0, 1, 0, 0, 0, 1]])
    columns = [*XYZ, *(("float", name) for name in ("nx", "ny", "nz"))]
    with pytest.warns(FileWarning, match="1 of 3 normals are not finite; they are computed from the faces"):
        cloud = read(tmp_path, "a.ply", ascii_ply(columns, values, "3 0 1 2\n"))
    assert cloud.normals.tolist() == [[0, 0, 1]] * 3
    with pytest.warns(FileWarning, match="normals are left out: 1 of 3"):
        assert read(tmp_path, "b.ply", ascii_ply(columns, values)).normals is None


def test_faces_of_two_corners_and_colors_of_some_vertices_are_left_out(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2\n"
    with pytest.warns(FileWarning, match=r"a\.obj: 1 of 2 faces are left out: they have fewer than 3 corners"):
        assert read(tmp_path, "a.obj", text).faces.tolist() == [[0, 1, 2]]
    with pytest.warns(FileWarning, match="1 of 2 faces are left out"):
        assert read(tmp_path, "b.ply", ascii_ply(XYZ, POINTS[:3], "3 0 1 2\n1 0\n")).faces.tolist() == [[0, 1, 2]]
    with pytest.warns(FileWarning, match="colors are left out: 1 of 3 vertices have one"):
        cloud = read(tmp_path, "c.obj", text.replace("v 0 0 0", "v 0 0 0 1 0 0").replace("f 1 2\n", ""))
    assert cloud.colors is None
    assert len(cloud) == 3


def test_tables_and_scales_are_written_and_read_again(tmp_path):
    save_points(tmp_path / "a.csv", torch.from_numpy(POINTS), torch.from_numpy(NORMALS), torch.from_numpy(COLORS / 255))
    cloud = load_points(tmp_path / "a.csv", dtype=torch.float64, scale=0.001)
    np.testing.assert_allclose(cloud.points, POINTS / 1000)
    np.testing.assert_allclose(cloud.normals, NORMALS)
    np.testing.assert_allclose(cloud.colors, COLORS / 255, atol=1e-12)
    with pytest.raises(InputError, match="scale must be positive"):
        load_points(tmp_path / "a.csv", scale=0.0)
