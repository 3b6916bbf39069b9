"""One loader for point clouds, meshes and scans: formats, counts, rows that were not measured, what is refused."""

import io
import tracemalloc
import warnings

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import torchreg as tr
from tests.io.helpers import put
from tests.tables import each_row, refused, refusing
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.frames import save_frames
from torchreg.io.limits import FileLimits
from torchreg.io.points import save_points

FormatError, FileWarning, InputError = tr.errors.FormatError, tr.errors.FileWarning, tr.errors.InputError
SPHERE = unit_sphere(1, dtype=torch.float64)
PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty {} x\nproperty float y\nproperty float z\nend_header\n{}"
PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n"


def exported(kind, **options):
    mesh = trimesh.Trimesh(SPHERE.vertices.numpy(), SPHERE.faces.numpy(), process=False)
    return mesh.export(file_type=kind, **options)


@each_row(
    ("binary.ply", exported("ply")), ("text.PLY", exported("ply", encoding="ascii")),
    ("surface.obj", exported("obj")), ("surface.glb", exported("glb")), ("surface.stl", exported("stl")),
    ("text.stl", exported("stl_ascii")),
)  # fmt: skip
def test_meshes_and_scans_written_by_trimesh(tmp_path, name, content):
    mesh = tr.load_mesh(put(tmp_path, name, content))
    assert (mesh.vertices.dtype, mesh.faces.dtype) == (torch.float32, torch.int64)
    torch.testing.assert_close(mesh.vertices[mesh.faces], SPHERE.vertices[SPHERE.faces].float())
    assert mesh.num_vertices == 42
    if "stl" not in name:
        torch.testing.assert_close(mesh.vertices, SPHERE.vertices.float())
    scan = tr.load_scan(tmp_path / name)
    assert torch.equal(scan.points[scan.faces], mesh.vertices[mesh.faces])
    assert float((scan.normals * scan.points).sum(-1).min()) > 0.97
    assert not bool(scan.boundary.any())


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
    cloud = tr.load_points(path, dtype=dtype)
    assert torch.equal(cloud.points, wanted)
    assert (cloud.normals is None) == (normals is None)
    if normals is not None:
        assert torch.equal(cloud.normals, normals)
    assert (cloud.colors is None) == (colors is None)
    if colors is not None:
        torch.testing.assert_close(cloud.colors, colors, atol=0.5 / 255 + 1e-6, rtol=0)
    if ending in ("ply", "npz") and len(wanted) > 2:
        save_points(path, wanted, faces=[[0, 1, 2], [2, 1, 0]])
        assert tr.load_mesh(str(path)).faces.tolist() == [[0, 1, 2], [2, 1, 0]]


@pytest.mark.parametrize("ending", ["ply", "npz", "pcd", "xyz"])
def test_scans_keep_normals_or_compute_them(tmp_path, ending):
    path = tmp_path / f"scan.{ending}"
    normals = torch.nn.functional.normalize(SPHERE.vertices + torch.tensor([0.0, 0.0, 3.0]), dim=-1)
    save_points(path, SPHERE.vertices, normals)
    scan = tr.load_scan(str(path), dtype=torch.float64)
    torch.testing.assert_close(scan.normals, normals)
    assert scan.faces is None
    save_points(path, SPHERE.vertices)
    bare = tr.load_scan(path, dtype=torch.float64)
    torch.testing.assert_close(bare.normals, tr.RangeScan(SPHERE.vertices).normals)
    inside = tr.load_scan(path, viewpoint=[0.0, 0.0, 0.0])
    assert float((inside.normals * inside.points).sum(-1).max()) < -0.9
    refused(
        (lambda: tr.load_scan(path, viewpoint=[0.0, float("nan"), 0.0]), "viewpoint must be finite"), error=InputError
    )


@pytest.mark.parametrize("ending", ["ply", "pcd", "xyz", "npz", "obj"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_points_are_refused_or_dropped(tmp_path, ending, bad):
    values = np.array([[0.0, 0, 0], [1, bad, 0], [0, 1, 0]], np.float32)
    stream = io.BytesIO()
    np.savez(stream, points=values)
    rows = "".join(" ".join(map(str, row)) + "\n" for row in values.tolist())
    content = {
        "ply": PLY.format("ascii", 3, "float", rows), "pcd": PCD.format(3, "ascii") + rows, "xyz": rows,
        "npz": stream.getvalue(), "obj": "".join("v " + row + "\n" for row in rows.splitlines()),
    }[ending]  # fmt: skip
    path = put(tmp_path, f"a.{ending}", content)
    words = rf"a\.{ending}: 1 of 3 points are not finite in float32 .* nan_policy"
    refused((lambda: tr.load_points(path), words))
    assert tr.load_points(path, nan_policy="omit").points.tolist() == [[0, 0, 0], [0, 1, 0]]


def test_omit_drops_faces_and_renumbers(tmp_path):
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header"
    text = PLY.format("ascii", 4, "float", "").replace("end_header", faces) + "0 0 0\nnan 0 0\n1 0 0\n0 1 0\n"
    mesh = tr.load_mesh(put(tmp_path, "a.ply", text + "3 0 1 2\n3 0 2 3\n"), nan_policy="omit")
    assert mesh.faces.tolist() == [[0, 1, 2]]
    path = put(tmp_path, "a.ply", text + "3 0 1 2\n3 1 2 3\n")
    none, large = put(tmp_path, "a.xyz", "nan 1 2\n"), put(tmp_path, "b.xyz", "1e300 0 0\n0 0 0\n")
    refused(
        (lambda: tr.load_mesh(path, nan_policy="omit"), "holds 3 points but no faces"),
        (lambda: tr.load_points(none, nan_policy="omit"), "none of its 1 points is finite"),
        (lambda: tr.load_points(large), "1 of 2 points are not finite in float32"),
    )
    assert float(tr.load_points(large, dtype=torch.float64).points[0, 0]) == 1e300


@each_row(
    ("a.ply", PLY.format("binary_little_endian", 10**12, "float", "")),
    ("a.ply", PLY.format("ascii", 10**12, "float", "1 2 3\n")),
    ("a.ply", PLY.format("binary_little_endian", 10**7, "float", "1 2 3\n")),
    ("a.pcd", PCD.format(10**12, "binary")),
    ("a.pcd", PCD.format(10**7, "binary")),
    ("a.pcd", PCD.format(10**7, "binary_compressed") + "\0" * 50),
    ("a.stl", b"\0" * 80 + b"\xff\xff\xff\xff" + b"\0" * 100),
)
def test_claims_are_refused_before_allocation(tmp_path, name, content):
    path = put(tmp_path, name, content)
    tracemalloc.start()
    try:
        with pytest.raises(FormatError):
            tr.load_points(path)
        assert tracemalloc.get_traced_memory()[1] < 3_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", ["ply", "pcd", "xyz", "npz", "obj", "glb", "stl"])
def test_limits_apply_to_points_faces_and_bytes(tmp_path, kind):
    path = tmp_path / f"a.{kind}"
    if kind in ("pcd", "xyz", "npz"):
        save_points(path, SPHERE.vertices, faces=SPHERE.faces if kind == "npz" else None)
    else:
        path.write_bytes(content if isinstance(content := exported(kind), bytes) else content.encode())
    refused(
        (lambda: tr.load_points(path, limits=FileLimits(max_points=41)), r"claims (42|240) points|claims 80 faces"),
        (lambda: tr.load_points(path, limits=FileLimits(max_bytes=100)), "the limit is 100;"),
    )
    if kind not in ("pcd", "xyz"):
        refused((lambda: tr.load_points(path, limits=FileLimits(max_faces=79)), "claims 80 faces"))


def test_what_is_not_a_readable_file(tmp_path):
    path, tiny, same = (
        put(tmp_path, f"{k}.xyz", text) for k, text in enumerate(("1 2 3", "0 0 0\n1 0 0\n", "1 2 3\n" * 9))
    )
    (tmp_path / "folder.ply").mkdir()
    letter, places = put(tmp_path, "a.docx", "a letter"), "a scan needs points at 3 places or more, it holds"
    for call in (tr.load_points, tr.load_mesh, tr.load_scan):
        for name in ("none.ply", "none.docx"):
            refused((lambda call=call, name=name: call(tmp_path / name), name), error=FileNotFoundError)
        refused((lambda call=call: call("http://host/a.ply"), "is an address"))
        refused((lambda call=call: call(tmp_path / "folder.ply"), "folder"), error=IsADirectoryError)
    refused(
        (lambda: tr.load_points(letter), r"unknown ending '\.docx', .* known: \.ply, \.pcd"),
        (lambda: tr.load_mesh(path), r"0\.xyz: holds 1 points but no faces"),
        (lambda: tr.load_scan(tiny), rf"1\.xyz: {places} 2 points"),
        (lambda: tr.load_scan(same), rf"2\.xyz: {places} 9 points"),
    )
    refused(
        (lambda: tr.load_points(path, nan_policy="drop"), "nan_policy must be one of raise, omit"), error=InputError
    )
    words = r"dtype must be torch\.float32 or torch\.float64"
    refused((lambda: tr.load_points(path, dtype=torch.int64), words), error=tr.errors.InputTypeError)


test_what_cannot_be_saved = refusing(
    lambda folder, name, changes: save_points(folder / name, **{"points": torch.zeros(2, 3), **changes}), leaves=0
)(
    ("a.glb", {}, FormatError, r"has the ending '\.glb'; points are written as"),
    ("a.xyz", {"colors": torch.zeros(2, 3)}, InputError, r"colors cannot be held by \.xyz"),
    ("a.pcd", {"faces": [[0, 1, 1]]}, InputError, r"faces cannot be held by \.pcd"),
    ("a.ply", {"colors": torch.full((2, 3), 2.0)}, InputError, "colors must lie between 0 and 1"),
    ("a.ply", {"normals": torch.zeros(1, 3)}, InputError, r"normals must have shape \(2, 3\)"),
    ("a.ply", {"points": torch.full((2, 3), torch.nan)}, InputError, "points must be finite"),
    ("no/a.ply", {}, FileNotFoundError, "does not exist"),
)


def test_clouds_become_meshes_where_they_have_faces():
    assert tr.PointCloud(torch.zeros(3, 3), faces=torch.tensor([[0, 1, 2]], dtype=torch.int32)).to_mesh().num_faces == 1
    refused(
        (lambda: tr.PointCloud(torch.zeros(3, 3)).to_mesh(), "the cloud of 3 points has no faces"),
        (lambda: tr.PointCloud(torch.zeros(3, 3), faces=[[0, 1, 3]]), "faces must index the 3 vertices"),
        error=InputError,
    )


def test_content_decides_where_the_ending_is_wrong(tmp_path):
    save_points(tmp_path / "real.ply", SPHERE.vertices, faces=SPHERE.faces)
    for name in ("scan.obj", "scan", "scan.bin", "scan.stl"):
        assert len(tr.load_mesh(put(tmp_path, name, (tmp_path / "real.ply").read_bytes())).faces) == 80
    for kind in ("glb", "stl", "stl_ascii", "off"):
        for ending in (".dat", ".csv", ".ply", ".npy"):
            assert len(tr.load_mesh(put(tmp_path, f"scan{ending}", exported(kind))).faces) == 80


@pytest.mark.parametrize("ending", [".dat", ".csv", ".txt", ".pts", ".obj", ".ply", ".png", ".bin"])
@pytest.mark.parametrize("save", [np.save, np.savez, np.savez_compressed])
def test_arrays_are_recognized_whatever_the_file_is_called(tmp_path, ending, save):
    path = tmp_path / f"real{ending}"
    for values in (np.ones((12, 3)), POINTS, np.ones((300, 3), "u1")):
        with path.open("wb") as stream:
            save(stream, values)
        np.testing.assert_allclose(tr.load_points(path).points, values, rtol=1e-6) if save is np.save else None
    stack = np.arange(1, 61.0).reshape(4, 5, 3)
    with path.open("wb") as stream:
        save(stream, stack)
    if ending not in (".png", ".bin"):  # which no sequence is called
        np.testing.assert_allclose(torch.stack(list(tr.load_frames(path))), stack)


@each_row(
    ("a.scan", b"version https://git-lfs.github.com/spec/v1\noid a\nsize 9\n", "Git LFS pointer.*git lfs pull"),
    ("a.scan", b"<!DOCTYPE html><html><body>Not found</body></html>", "is a web page"),
    ("a.scan", b"\0\1\2\3", "has the unknown ending '.scan'.*known: .ply, .pcd"),
    *((name, content, rf"{name}: is of a format that is not read \(.*{words}") for name, content, words in (
        ("a.e57", b"ASTM-E57" + bytes(40), "E57.*CloudCompare.*PLY.*pye57"),
        ("a.E57", b"", "E57.*CloudCompare"),
        ("a.xyz", b"ASTM-E57" + bytes(40), "E57.*CloudCompare"),
        ("a.laz", b"LASF" + bytes(40), "LAS or LAZ.*CloudCompare.*laspy"),
        ("a.rcs", bytes(9), "scanner's own format.*PTX or PLY"),
        ("a.bag", b"#ROSBAG V2.0", "ROS recording.*PCD"),
        ("a.fbx", b"Kaydara FBX Binary", r"glTF \(\.glb\)"),
        ("a.step", b"ISO-10303-21;", "CAD model.*STL"),
    )),
)  # fmt: skip
def test_other_formats_are_named_with_a_way_to_convert_them(tmp_path, name, content, words):
    path = put(tmp_path, name, content)
    refused((lambda: tr.load_points(path), words), (lambda: tr.load_mesh(path), words))
    if name not in ("a.xyz", "a.scan"):
        refused((lambda: tr.load_frames(path), words), (lambda: tr.load_frames(tmp_path), words.split("is of")[-1]))


RNG = np.random.default_rng(0)
POINTS = RNG.normal((0, 0, 2), size=(12, 3)).round(3)
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
COLORS = RNG.integers(0, 256, (12, 3))
MEASURED = np.sort(RNG.permutation(20)[:12])


def gappy(values, like=None):
    """Return rows (20, C) with values at the measured ones, and zeros between."""
    rows = np.zeros((20, values.shape[1]), like or values.dtype)
    rows[MEASURED] = values
    return rows


def text(rows, separator=" "):
    return "".join(separator.join(f"{v:.9g}" for v in row) + "\n" for row in rows.tolist())


def gappy_file(path):
    """Write the gappy cloud, with normals and colors where the format has them."""
    rows, names = gappy(POINTS), ("normal_x", "normal_y", "normal_z")
    both = np.concatenate([rows, gappy(NORMALS)], 1)
    head = PLY.format("ascii", 20, "float", "").replace("end", "".join(f"property float {n}\n" for n in names) + "end")
    fields = PCD.format(20, "ascii").replace("x y z", "x y z " + " ".join(names)).replace("\nCOUNT 1 1 1", "")
    fields = fields.replace("4 4 4", "4 4 4 4 4 4").replace("F F F", "F F F F F F")
    colored = "x,y,z,nx,ny,nz,r,g,b\n" + text(np.concatenate([both, gappy(COLORS)], 1), ",")
    {
        ".xyz": lambda: path.write_text(text(rows).replace("0 0 0\n", "0.0 -0.0 0\n")),
        ".csv": lambda: path.write_text(colored),
        ".ply": lambda: path.write_text(head + text(both)),
        ".pcd": lambda: path.write_text(fields + text(both)),
        ".npz": lambda: np.savez(path, points=rows, normals=gappy(NORMALS), colors=gappy(COLORS, "u1")),
        ".npy": lambda: np.save(path, rows.reshape(4, 5, 3)),
        ".obj": lambda: path.write_text("".join(f"v {line}\n" for line in text(rows).splitlines())),
    }[path.suffix]()
    return path


@pytest.mark.parametrize("ending", ["xyz", "csv", "ply", "pcd", "npz", "npy", "obj"])
@pytest.mark.parametrize("scale", [1.0, 0.001])
def test_rows_without_a_measurement_are_left_out_with_all_that_goes_with_them(tmp_path, ending, scale):
    path = gappy_file(tmp_path / f"a.{ending}")
    with pytest.warns(FileWarning, match=rf"a\.{ending}: 8 of 20 points are 0 0 0, where nothing was measured; they"):
        cloud = tr.load_points(path, scale=scale, dtype=torch.float64)
    np.testing.assert_allclose(cloud.points, POINTS * scale, rtol=1e-6)
    assert (cloud.normals is None) == (ending in ("xyz", "npy", "obj"))
    if cloud.normals is not None:
        np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-6)
    if cloud.colors is not None:
        np.testing.assert_allclose(cloud.colors, COLORS / 255, atol=1e-6)


def test_whole_millimeters_points_of_maps_and_rows_that_are_not_finite(tmp_path):
    np.save(tmp_path / "a.npy", np.round(gappy(POINTS) * 1000).astype("i2").reshape(4, 5, 3))
    np.save(tmp_path / "m.npy", gappy(POINTS + np.array([4e5, 5e6, 0])))
    with pytest.warns(FileWarning, match="8 of 20 points are 0 0 0"):
        scan = tr.load_scan(tmp_path / "a.npy", scale=0.001)
    np.testing.assert_allclose(scan.points, np.round(POINTS * 1000) / 1000, atol=1e-6)
    with pytest.warns(FileWarning, match="8 of 20"):  # zeros are no reason to read maps in single precision
        assert tr.load_points(tmp_path / "m.npy").points.dtype == torch.float64
    rows = gappy(POINTS)
    rows[MEASURED[0]] = np.nan
    np.save(tmp_path / "a.npy", rows)
    refused((lambda: tr.load_points(tmp_path / "a.npy"), "1 of 12 points are not finite"))
    with pytest.warns(FileWarning, match="8 of 20"):
        assert len(tr.load_points(tmp_path / "a.npy", nan_policy="omit")) == 11
    (tmp_path / "scan.xyz").write_text("0 0 0\nnan nan nan\n1 0 0\n0 1 0\n1 1 0\n")
    assert len(tr.load_scan(tmp_path / "scan.xyz", nan_policy="omit")) == 4
    np.save(tmp_path / "a.npy", np.zeros((4, 5, 3), "i2"))
    np.savez(tmp_path / "a.npz", points=np.zeros((2, 5, 3)))
    refused(
        (lambda: tr.load_points(tmp_path / "a.npy"), r"a\.npy: all of its 20 points are 0 0 0: nothing was measured"),
        (lambda: tr.load_frames(tmp_path / "a.npz"), r"a\.npz: all of its 10 points are 0 0 0"),
    )


def test_the_origin_itself_and_corners_of_faces_stay(tmp_path):
    assert len(tr.load_points(put(tmp_path, "a.xyz", "0 0 0\n1 0 0\n0 1 0\n"))) == 3
    assert tr.load_points(put(tmp_path, "one.xyz", "0 0 0\n")).points.tolist() == [[0, 0, 0]]
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1]], float)
    save_points(tmp_path / "m.ply", vertices, faces=[[0, 1, 2], [3, 2, 4]])
    assert len(tr.load_mesh(tmp_path / "m.ply").vertices) == 5
    grid = np.concatenate([np.zeros((4, 3)), vertices])
    save_points(tmp_path / "g.ply", grid, faces=[[4, 5, 6], [7, 6, 8]])
    with pytest.warns(FileWarning, match="4 of 9 points are 0 0 0"):
        mesh = tr.load_mesh(tmp_path / "g.ply")
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 2, 4]]
    np.testing.assert_array_equal(mesh.vertices, vertices)


@pytest.mark.parametrize("ending", ["npz", "npy"])
def test_padding_of_stacks_is_reported_once_with_its_total(tmp_path, ending):
    def saved(stack):
        np.savez(tmp_path / "a.npz", points=stack) if ending == "npz" else np.save(tmp_path / "a.npy", stack)
        return tmp_path / f"a.{ending}"

    stack = np.zeros((4, 12, 3), "f4")
    for frame, count in enumerate((12, 11, 9, 0)):
        stack[frame, :count] = POINTS[:count]
    with pytest.warns(FileWarning) as warned:
        frames = tr.load_frames(saved(stack))
    assert [len(frame) for frame in frames] == [12, 11, 9, 0]
    words = "16 of 48 points in 3 of 4 frames are 0 0 0, where nothing was measured; they are left out"
    assert [str(row.message).split(f"a.{ending}: ")[1] for row in warned] == [words]
    np.testing.assert_allclose(frames[2], POINTS[:9], rtol=1e-6)
    organized = np.stack([gappy(POINTS), gappy(POINTS + 1)]).reshape(2, 4, 5, 3)
    with pytest.warns(FileWarning, match="16 of 40 points in 2 of 2 frames"):
        frames = tr.load_frames(saved(organized))
    np.testing.assert_allclose(frames[1], POINTS + 1, rtol=1e-6)
    stack = np.stack([POINTS, POINTS + 1])
    stack[:, 0] = 0  # wrists of hands, say
    assert [len(frame) for frame in tr.load_frames(saved(stack))] == [12, 12]


def test_files_of_a_sequence_warn_at_the_first_that_it_concerns(tmp_path):
    for number in range(5):
        (tmp_path / f"f{number}.xyz").write_text(text(POINTS if number == 0 else gappy(POINTS + number)))
    frames = tr.load_frames(tmp_path)
    with pytest.warns(FileWarning) as warned:
        assert [len(frame) for frame in [*frames, *frames[2:]]] == [12] * 8
    assert len(warned) == 1
    words = (
        "f1.xyz: 8 of 20 points are 0 0 0, where nothing was measured; they are left out; of other frames this is not"
    )
    assert words in str(warned[0].message)
    save_frames(tmp_path / "a.npz", [torch.from_numpy(POINTS), torch.from_numpy(POINTS[:5])])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [len(frame) for frame in tr.load_frames(tmp_path / "a.npz")] == [12, 5]
