"""One loader for point clouds and meshes: formats, counts, non-finite numbers, what is refused."""

import io
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.limits import FileLimits
from torchreg.io.points import PointCloud, load_mesh, load_points, save_points

SPHERE = unit_sphere(1, dtype=torch.float64)


def put(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def exported(kind: str, **options) -> bytes:
    mesh = trimesh.Trimesh(SPHERE.vertices.numpy(), SPHERE.faces.numpy(), process=False)
    content = mesh.export(file_type=kind, **options)
    return content.encode() if isinstance(content, str) else content


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("binary.ply", exported("ply")),
        ("text.PLY", exported("ply", encoding="ascii")),
        ("surface.obj", exported("obj")),
        ("surface.glb", exported("glb")),
        ("surface.stl", exported("stl")),
        ("text.stl", exported("stl_ascii")),
    ],
)
def test_meshes_written_by_trimesh(tmp_path, name, content):
    mesh = load_mesh(put(tmp_path, name, content))
    assert mesh.vertices.dtype == torch.float32
    assert mesh.faces.dtype == torch.int64
    torch.testing.assert_close(mesh.vertices[mesh.faces], SPHERE.vertices[SPHERE.faces].float())
    assert mesh.num_vertices == 42
    if "stl" not in name:
        torch.testing.assert_close(mesh.vertices, SPHERE.vertices.float())


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    points=hnp.arrays(
        np.float64, st.tuples(st.integers(1, 6), st.just(3)), elements=st.floats(-1e6, 1e6, allow_subnormal=False)
    ),
    ending=st.sampled_from(["ply", "pcd", "xyz", "txt", "npz"]),
    double=st.booleans(),
    with_normals=st.booleans(),
    with_colors=st.booleans(),
)
def test_what_is_saved_comes_back_exactly(tmp_path, points, ending, double, with_normals, with_colors):
    dtype = torch.float64 if double else torch.float32
    wanted = torch.tensor(points, dtype=dtype)
    assume(int((wanted == 0).all(-1).sum()) < 2)  # several points 0 0 0 were not measured
    normals = torch.nn.functional.normalize(wanted + 0.3, dim=-1) if with_normals else None
    colors = torch.linspace(0, 1, points.size, dtype=dtype).reshape(-1, 3) if with_colors else None
    if ending in ("xyz", "txt"):
        colors = None
    path = tmp_path / f"cloud.{ending}"
    save_points(path, wanted, normals, colors)
    cloud = load_points(path, dtype=dtype)
    assert torch.equal(cloud.points, wanted)
    assert (cloud.normals is None) == (normals is None)
    if normals is not None:
        assert torch.equal(cloud.normals, normals)
    assert (cloud.colors is None) == (colors is None)
    if colors is not None:
        torch.testing.assert_close(cloud.colors, colors, atol=0.5 / 255 + 1e-6, rtol=0)


@pytest.mark.parametrize("ending", ["ply", "npz"])
def test_faces_come_back(tmp_path, ending):
    path = tmp_path / f"m.{ending}"
    save_points(path, SPHERE.vertices, faces=SPHERE.faces)
    mesh = load_mesh(str(path), dtype=torch.float64)
    assert torch.equal(mesh.vertices, SPHERE.vertices)
    assert torch.equal(mesh.faces, SPHERE.faces)
    if ending == "ply":
        np.testing.assert_array_equal(trimesh.load_mesh(path, process=False).faces, SPHERE.faces)


def test_double_precision_is_kept_only_where_asked(tmp_path):
    value = 1 / 3
    path = put(tmp_path, "a.xyz", f"{value!r} 2 3\n")
    assert float(load_points(path, dtype=torch.float64).points[0, 0]) == value
    assert load_points(path).points.dtype == torch.float32


@pytest.mark.parametrize("encoded", [b"v 1 2 3\n", b"# a comment\r\nv 1.0 2e0 3 1.0\r\no name\r\n", b"v\t1 \\\n 2 3"])
def test_obj_of_points(tmp_path, encoded):
    cloud = load_points(put(tmp_path, "a.obj", encoded))
    assert cloud.points.tolist() == [[1, 2, 3]]
    assert cloud.faces is None


def test_obj_keeps_order_seams_and_negative_indices(tmp_path):
    text = (
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3/1/1 -2/2/1 -1/3/1\nv 0 1 0\nv 9 9 9\nvt 0 0\nvt 1 1\nvt 1 0\nvn 0 0 1\n"
        "usemtl other\nf 1/2 3/1 4/1 # quad next\nf 1 2 3 4\n"
    )
    mesh = load_mesh(put(tmp_path, "a.obj", text))
    assert mesh.num_vertices == 5
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 3]]


def test_obj_normals_and_colors(tmp_path):
    text = "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nvn 0 0 1\nvn 0 1 0\nvn 1 0 0\n"
    cloud = load_points(put(tmp_path, "a.obj", text + "f 1//1 2//2 3//3\n"))
    assert cloud.colors.tolist() == torch.eye(3).tolist()
    assert cloud.normals.tolist() == torch.eye(3).flip(0).tolist()
    assert load_points(put(tmp_path, "a.obj", text + "f 1//2 2//2 3//3\n")).normals is None


def test_stl_joins_corners_but_not_near_ones(tmp_path):
    soup = np.zeros(2, [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    soup["v"] = [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[-0.0, 0, 0], [1, 1, 0], [0, 1, 1e-7]]]
    content = b"solid but binary".ljust(80) + (2).to_bytes(4, "little") + soup.tobytes()
    mesh = load_mesh(put(tmp_path, "a.stl", content))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    with pytest.raises(FormatError, match=r"a\.stl: must hold 84 \+ 50 x 2 bytes"):
        load_points(put(tmp_path, "a.stl", content[:-1]))
    text = exported("stl_ascii")
    for cut in (len(text) // 2, len(text) - 12):
        with pytest.raises(FormatError, match="cut off or damaged"):
            load_points(put(tmp_path, "a.stl", text[:cut]))


def test_xyz_dialects(tmp_path):
    expected = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    for text in (
        "1 2 3\n4 5 6",
        "\n1,2,3\r\n\r\n4,5,6\r\n",
        "# comment\n1;2;3 // first\n4;5;6\n",
        "2\n1 2 3\n4 5 6\n",
        '"x","y","z"\n1\t2\t3\n4 5 6\n',
    ):
        assert load_points(put(tmp_path, "a.txt", text)).points.tolist() == expected
    cloud = load_points(put(tmp_path, "a.xyz", "x y z nx ny nz\n1 2 3 0 0 1\n4 5 6 0 1 0\n"))
    assert cloud.normals.tolist() == [[0, 0, 1], [0, 1, 0]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("3\n1 2 3\n4 5 6\n", "the first line says 3 points, the file holds 2"),
        ("1 2 3\n4 5\n", "not a row of equally many numbers"),
        ("1 2 3\n4 five 6\n", "not a row of equally many numbers"),
        ("1 2\n", r"a row of 3 numbers or more \(x y z first\), got 2"),
        ("x y intensity\n1 2 3\n", "the columns must name x, y and z"),
        ("", "holds no points"),
        ("# nothing\n", "holds no points"),
        ("1 2 3\n\xff", "not a row"),
    ],
)
def test_bad_xyz_is_refused(tmp_path, text, words):
    with pytest.raises(FormatError, match=rf"a\.xyz: .*{words}"):
        load_points(put(tmp_path, "a.xyz", text))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 1 2\n", "a vertex must be 3 numbers"),
        ("v 1 2 3\nv 1 2\n", "a vertex is not a row"),
        ("v 1 2 3\nf 1 1 2\n", "a face names a vertex outside 1 to 1"),
        ("v 1 2 3\nf 1 0 1\n", "a face names a vertex outside 1 to 1"),
        ("v 1 2 3\nf 1 -2 1\n", "a face names a vertex outside 1 to 1"),
        ("v 1 2 3\nf 1 1.5 1\n", "vertex indices must be whole numbers"),
        ("v 1 2 3\nf a b c\n", "a vertex index is not a row"),
        ("f 1 2 3\n", "outside 1 to 0"),
        ("# nothing\n", "holds no points"),
    ],
)
def test_bad_obj_is_refused(tmp_path, text, words):
    with pytest.raises(FormatError, match=words):
        load_points(put(tmp_path, "a.obj", text))


def test_npz_keys(tmp_path):
    def archive(**arrays) -> Path:
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)
        return put(tmp_path, "a.npz", stream.getvalue())

    cloud, other = np.random.default_rng(0).normal(size=(5, 3)), np.zeros((5, 2))
    for path in (
        archive(points=cloud, other=cloud),
        archive(scan=cloud, other=other),
        archive(vertices=cloud),
        archive(points=np.asfortranarray(cloud.astype(">f8"))),
    ):
        np.testing.assert_array_equal(load_points(path, dtype=torch.float64).points, cloud)
    colored = load_points(
        archive(points=(10 * cloud).astype(int), colors=np.full((5, 3), 255, np.uint8), normals=cloud)
    )
    assert colored.colors.eq(1).all()
    for arrays, words in (
        ({"one": cloud, "two": cloud}, r"must hold an array 'points' of shape \(N, 3\), .* got one, two"),
        ({"other": other}, "must hold an array 'points'"),
        ({}, "got no arrays"),
        ({"points": other}, r"points must have shape \(N, 3\), got \(5, 2\)"),
        ({"points": np.float64(3)}, r"points must have shape"),
        ({"points": cloud, "normals": cloud[:4]}, r"normals must have shape \(5, 3\), got \(4, 3\)"),
        ({"points": cloud, "faces": [[0, 1, 5]]}, "a face names vertex 5, outside 0 to 4"),
        ({"points": cloud, "faces": [[0, 1]]}, r"faces must have shape \(F, 3\)"),
        ({"points": cloud, "faces": [[0, 1, 1.5]]}, "faces must be whole numbers"),
        ({"points": cloud * 1j}, "must hold real numbers, got complex128"),
        ({"points": np.array([[1, "a", {}]], dtype=object)}, "pickled objects are never loaded"),
    ):
        with pytest.raises(FormatError, match=words):
            load_points(archive(**arrays))


def test_npz_bombs_are_refused(tmp_path):
    stream = io.BytesIO()
    np.savez_compressed(stream, points=np.zeros((2_000_000, 3), np.float32))
    with pytest.raises(FormatError, match="would expand"):
        load_points(put(tmp_path, "a.npz", stream.getvalue()))
    stream = io.BytesIO()
    np.savez(stream, points=np.zeros((100, 3)))
    lie = stream.getvalue().replace(b"(100, 3)", b"(9999999999, 3)").replace(b"       \n", b"\n")
    with pytest.raises(FormatError):
        load_points(put(tmp_path, "a.npz", lie))


@pytest.mark.parametrize("ending", ["ply", "pcd", "xyz", "npz", "obj"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_points_are_refused_or_dropped(tmp_path, ending, bad):
    values = np.array([[0.0, 0, 0], [1, bad, 0], [0, 1, 0]], np.float32)
    stream = io.BytesIO()
    np.savez(stream, points=values)
    rows = "".join(" ".join(map(str, row)) + "\n" for row in values.tolist())
    content = {
        "ply": PLY.format("ascii", 3, "float", rows),
        "pcd": PCD.format(3, "ascii") + rows,
        "xyz": rows,
        "npz": stream.getvalue(),
        "obj": "".join("v " + row + "\n" for row in rows.splitlines()),
    }[ending]
    path = put(tmp_path, f"a.{ending}", content)
    with pytest.raises(FormatError, match=rf"a\.{ending}: 1 of 3 points are not finite in float32 .* nan_policy"):
        load_points(path)
    assert load_points(path, nan_policy="omit").points.tolist() == [[0, 0, 0], [0, 1, 0]]


PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty {} x\nproperty float y\nproperty float z\nend_header\n{}"
PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n"


def test_omit_drops_faces_and_renumbers(tmp_path):
    rows = "0 0 0\nnan 0 0\n1 0 0\n0 1 0\n"
    text = PLY.format("ascii", 4, "float", "").replace(
        "end_header", "element face 2\nproperty list uchar int vertex_indices\nend_header"
    )
    path = put(tmp_path, "a.ply", text + rows + "3 0 1 2\n3 0 2 3\n")
    assert load_mesh(path, nan_policy="omit").faces.tolist() == [[0, 1, 2]]
    path = put(tmp_path, "a.ply", text + rows + "3 0 1 2\n3 1 2 3\n")
    with pytest.raises(FormatError, match="holds 3 points but no faces"):
        load_mesh(path, nan_policy="omit")
    with pytest.raises(FormatError, match="none of its 1 points is finite"):
        load_points(put(tmp_path, "a.xyz", "nan 1 2\n"), nan_policy="omit")


def test_what_overflows_float32_is_not_silently_infinite(tmp_path):
    path = put(tmp_path, "a.xyz", "1e300 0 0\n0 0 0\n")
    with pytest.raises(FormatError, match="1 of 2 points are not finite in float32"):
        load_points(path)
    assert float(load_points(path, dtype=torch.float64).points[0, 0]) == 1e300


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", PLY.format("binary_little_endian", 10**12, "float", "")),
        ("a.ply", PLY.format("ascii", 10**12, "float", "1 2 3\n")),
        ("a.ply", PLY.format("binary_little_endian", 10**7, "float", "1 2 3\n")),
        ("a.pcd", PCD.format(10**12, "binary")),
        ("a.pcd", PCD.format(10**7, "binary")),
        ("a.pcd", PCD.format(10**7, "binary_compressed") + "\0" * 50),
        ("a.stl", b"\0" * 80 + b"\xff\xff\xff\xff" + b"\0" * 100),
    ],
)
def test_claims_are_refused_before_allocation(tmp_path, name, content):
    path = put(tmp_path, name, content)
    tracemalloc.start()
    try:
        with pytest.raises(FormatError):
            load_points(path)
        assert tracemalloc.get_traced_memory()[1] < 3_000_000
    finally:
        tracemalloc.stop()


def test_count_limits_apply(tmp_path):
    for ending in ("ply", "pcd", "xyz", "npz"):
        save_points(tmp_path / f"a.{ending}", torch.zeros(20, 3))
        with pytest.raises(FormatError, match="claims 20 points, allowed are 0 to 19"):
            load_points(tmp_path / f"a.{ending}", limits=FileLimits(max_points=19))
    for kind in ("ply", "obj", "glb", "stl"):
        path = put(tmp_path, f"b.{kind}", exported(kind))
        with pytest.raises(FormatError, match="claims 80 faces"):
            load_points(path, limits=FileLimits(max_faces=79))
        with pytest.raises(FormatError, match="the limit is 100;"):
            load_points(path, limits=FileLimits(max_bytes=100))


def test_what_is_not_a_readable_file(tmp_path):
    for call in (load_points, load_mesh):
        with pytest.raises(FileNotFoundError):
            call(tmp_path / "none.ply")
        with pytest.raises(FileNotFoundError):
            call(tmp_path / "none.docx")
        with pytest.raises(FormatError, match="is an address"):
            call("http://host/a.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(IsADirectoryError):
        load_points(tmp_path / "folder.ply")
    with pytest.raises(FormatError, match=r"unknown ending '\.docx', .* known: \.ply, \.pcd"):
        load_points(put(tmp_path, "a.docx", "a letter"))
    path = put(tmp_path, "a.xyz", "1 2 3")
    with pytest.raises(InputError, match="nan_policy must be one of raise, omit"):
        load_points(path, nan_policy="drop")
    with pytest.raises(InputTypeError, match=r"dtype must be torch\.float32 or torch\.float64"):
        load_points(path, dtype=torch.int64)
    with pytest.raises(FormatError, match=r"a\.xyz: holds 1 points but no faces"):
        load_mesh(path)


def test_saving_what_does_not_fit_is_refused(tmp_path):
    points = torch.zeros(2, 3)
    with pytest.raises(FormatError, match=r"has the ending '\.glb'; points are written as"):
        save_points(tmp_path / "a.glb", points)
    with pytest.raises(InputError, match=r"colors cannot be held by \.xyz"):
        save_points(tmp_path / "a.xyz", points, colors=points)
    with pytest.raises(InputError, match=r"faces cannot be held by \.pcd"):
        save_points(tmp_path / "a.pcd", points, faces=[[0, 1, 1]])
    with pytest.raises(InputError, match="colors must lie between 0 and 1"):
        save_points(tmp_path / "a.ply", points, colors=points + 2)
    with pytest.raises(InputError, match=r"normals must have shape \(2, 3\)"):
        save_points(tmp_path / "a.ply", points, points[:1])
    with pytest.raises(InputError, match="points must be finite"):
        save_points(tmp_path / "a.ply", points / 0)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        save_points(tmp_path / "no" / "a.ply", points)
    assert not list(tmp_path.iterdir())


def test_point_cloud_record():
    cloud = PointCloud(torch.zeros(3, 3), faces=torch.tensor([[0, 1, 2]], dtype=torch.int32))
    assert len(cloud) == 3
    assert cloud.to_mesh().num_faces == 1
    with pytest.raises(InputError, match="the cloud of 3 points has no faces"):
        PointCloud(torch.zeros(3, 3)).to_mesh()
    with pytest.raises(InputError, match="faces must index the 3 vertices"):
        PointCloud(torch.zeros(3, 3), faces=[[0, 1, 3]])
