"""PLY, PCD and STL, binary and text, against files packed by hand and by trimesh."""

import struct

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import torchreg as tr
from tests.io.helpers import read
from tests.tables import each, refused, refusing, swap
from torchreg.io.clouds.pcd import decompress_lzf
from torchreg.io.limits import FileLimits

FormatError, FileWarning = tr.errors.FormatError, tr.errors.FileWarning

PLY = """ply
format {form} 1.0
comment written by hand, Größe
element sensor 1
property list ushort short shape
property double weight
element vertex 4
property uchar red
property double x
property float confidence
property double y
property double z
property uchar green
property uchar blue
element face 2
property uchar flags
property list uchar int vertex_index
element edge 1
property int a
property int b
end_header
"""
CORNERS = np.array([[1 / 3, 0, 0], [1, 0.1, 0], [1, 1, 2 / 7], [0, 1, 0]])
PAIR, QUAD = [[0, 1, 2], [0, 2, 3]], [[0, 1, 2, 3], [3, 1, 0]]


def ply(form, polygons=PAIR, newline="\n"):
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}[form]
    if order:
        body = struct.pack(f"{order}Hhhhd", 3, -1, 2, 3, 0.5)
        for index, (x, y, z) in enumerate(CORNERS):
            body += struct.pack(f"{order}BdfddBB", 50 * index, x, 0.9, y, z, 255, 0)
        for polygon in polygons:
            body += struct.pack(f"{order}BB{len(polygon)}i", 7, len(polygon), *polygon)
        body += struct.pack(f"{order}ii", 0, 1)
    else:
        rows = [f"{50 * k} {x!r} 0.9 {y!r} {z!r} 255 0" for k, (x, y, z) in enumerate(CORNERS.tolist())]
        rows += [f"7 {len(polygon)} {' '.join(map(str, polygon))}" for polygon in polygons]
        body = "\n".join(["3 -1 2 3 0.5", *rows, "0 1", ""]).encode()
    return PLY.format(form=form).replace("\n", newline).encode() + body


def ascii_ply(names, rows, faces=""):
    """Return a PLY of columns such as "x y:uchar", which are float by default, and of lines of faces."""
    columns = [(*name.split(":"), "float")[:2] for name in names.split()]
    head = "".join(f"property {kind} {name}\n" for name, kind in columns)
    tail = f"element face {len(faces.splitlines())}\nproperty list uchar int vertex_indices\n" if faces else ""
    body = "".join(" ".join(f"{v:g}" for v in row) + "\n" for row in np.asarray(rows).tolist())
    return f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{head}{tail}end_header\n{body}{faces}"


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize(
    ("polygons", "triangles"),
    [
        (PAIR, PAIR),
        (QUAD, [[0, 1, 2], [0, 2, 3], [3, 1, 0]]),
        ([[3, 1, 0], [3, 2, 1, 0]], [[3, 1, 0], [3, 2, 1], [3, 1, 0]]),
    ],
)
def test_encodings_of_ply_agree_in_full_precision(tmp_path, form, newline, polygons, triangles):
    cloud = read(tmp_path, "a.ply", ply(form, polygons, newline))
    np.testing.assert_array_equal(cloud.points, CORNERS)
    assert cloud.faces.tolist() == triangles
    np.testing.assert_allclose(cloud.colors, [[50 * k / 255, 1, 0] for k in range(4)])
    assert cloud.normals is None
    single = tr.load_points(tmp_path / "a.ply")
    assert torch.equal(single.points, torch.tensor(CORNERS, dtype=torch.float32))


test_damaged_ply = refusing(
    lambda folder, old, new: read(folder, "a.ply", swap(ply("ascii").decode(), old, new)), file="a.ply"
)(
    ("ply\n", "plo\n", "must start with 'ply'"),
    ("end_header", "end_heather", "must start with 'ply' and a header closed"),
    ("format ascii 1.0", "format ascii 2.0", "the header line 'format ascii 2.0' is not understood"),
    ("format ascii 1.0\n", "", "must name one format"),
    ("element vertex 4", "element vertex -4", "header line 'element vertex -4'"),
    ("element vertex 4", "element vertex 5", "the header says 9 rows, the file holds 8"),
    ("element vertex 4", "element vertex 99999999999999", "claims 99999999999999 points"),
    ("element face 2", "element face 99999999999999", "claims 99999999999999 faces"),
    ("element edge 1", "element face 1", "two elements of one name"),
    ("element edge 1\nproperty int a\nproperty int b", "element edge 1", "'edge' has no properties"),
    ("property int a", "property int b", "or two of one name"),
    ("property double y", "property double yy", "must have an element 'vertex' with the properties x, y and z"),
    ("property double y", "property decimal y", "header line 'property decimal y'"),
    ("list uchar int", "list float int", "is counted in float; an integer type is needed"),
    ("\n3 -1", "\n4 -1", "shorter than its list says"),
    ("\n3 -1", "\n2 -1", "longer than its list says"),
    ("\n3 -1", "\nnan -1", "shorter than its list says"),
    ("7 3 0", "7 2 0", "longer than its list says"),
    ("7 3 0 1 2", "7 3 0 1 1.5", "vertex indices must be whole numbers"),
    ("7 3 0 1 2", "7 3 0 x 2", "is not a row of 1 numbers"),
    ("7 3 0 1 2", "7 3 0 1 9", "a face names vertex 9|a face names a vertex"),
    ("150 0.0", "256 0.0", "colors must lie between 0 and 255"),
    ("150 0.0", "-1 0.0", "colors must lie between 0 and 255"),
    ("150 0.0 0.9", "150 0.0", "is not a row of 7 numbers"),
    ("\n0 1\n", "\n0 1\n1 2 3 4\n", "the header says 8 rows"),
)


def test_lists_of_ply_have_a_length_that_is_not_negative(tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty list char int skip\n"
    head += "".join(f"property float {name}\n" for name in "xyz") + "end_header\n"
    second = struct.pack("<bifff", 1, 9, 4, 5, 6)
    cloud = read(tmp_path, "a.ply", head.encode() + struct.pack("<bfff", 0, 1, 2, 3) + second)
    np.testing.assert_array_equal(cloud.points, np.arange(1, 7).reshape(2, 3))
    with pytest.raises(FormatError, match="is cut off or damaged"):
        read(tmp_path, "a.ply", head.encode() + struct.pack("<bfff", -1, 1, 2, 3) + second)


def test_binary_rows_of_equal_length_and_no_faces(tmp_path):
    head = ascii_ply("x y z nx ny nz r g b", [], "-\n").split("end_header")[0].replace("ascii", "binary_big_endian")
    head = head.replace("vertex 0", "vertex 1").replace("face 1", "face 0") + "end_header\n"
    cloud = read(tmp_path, "a.ply", head.encode() + struct.pack(">9f", 1, 2, 3, 0, 0, 1, 0.25, 0.5, 1))
    assert (cloud.points.tolist(), cloud.normals.tolist()) == ([[1, 2, 3]], [[0, 0, 1]])
    assert cloud.colors.tolist() == [[0.25, 0.5, 1]]
    assert cloud.faces is None or cloud.faces.shape == (0, 3)


@pytest.mark.parametrize("names", ["normal_x normal_y normal_z", "Nx Ny Nz", "nx ny nz"])
@pytest.mark.parametrize(
    "colors", ["r:uchar g:uchar b:uchar", "diffuse_red:uchar diffuse_green:uchar diffuse_blue:uchar"]
)
def test_names_of_columns_in_other_programs(tmp_path, names, colors):
    cloud = read(tmp_path, "a.ply", ascii_ply(f"x y z {names} {colors}", [[1, 2, 3, 0, 0, 1, 10, 20, 30]]))
    assert cloud.normals.tolist() == [[0, 0, 1]]
    np.testing.assert_allclose(cloud.colors * 255, [[10, 20, 30]])


@pytest.mark.parametrize("kind", ["int", "uint"])
@pytest.mark.parametrize("also_faces", [False, True])
def test_triangle_strips_are_cut_with_one_side_outward(tmp_path, kind, also_faces):
    # Corners of a strip of a grid, then after a restart a triangle alone, and a strip joined by a flat triangle.
    corners = np.array([[x, y, 0.0] for x in range(4) for y in range(2)])
    strips = [0, 2, 1, 3, -1, 2, 4, 3, -1, 4, 6, 5, 7, 7]
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n"
    head += "".join(f"property float {name}\n" for name in "xyz")
    body = corners.astype("<f4").tobytes()
    if also_faces:
        head += "element face 1\nproperty list uchar int vertex_indices\n"
        body += struct.pack("<B3i", 3, 3, 4, 5)
    head += f"element tristrips 1\nproperty list int {kind} vertex_indices\nend_header\n"
    body += struct.pack("<i", len(strips)) + np.array(strips, "<i4").tobytes()
    faces = read(tmp_path, "a.ply", head.encode() + body).faces
    assert len(faces) == 5 + also_faces
    a, b, c = (corners[faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[also_faces:, 2] == 1).all()


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.lists(st.integers(-1, 5), max_size=9), min_size=1, max_size=4))
def test_strips_are_those_of_a_plain_loop(tmp_path, strips):
    expected, one = [], []
    for number in [number for strip in strips for number in [*strip, -1]]:
        one = [*one, number] if number >= 0 else []
        if len(set(one[-3:])) == 3:
            a, b, c = one[-3:]
            expected.append([a, b, c] if len(one) % 2 else [b, a, c])
    lists = "".join(" ".join(map(str, [len(strip), *strip])) + "\n" for strip in strips)
    content = ascii_ply("x y z", np.arange(1, 19.0).reshape(6, 3), lists).replace("element face", "element tristrips")
    faces = read(tmp_path, "a.ply", content.replace("list uchar", "list int")).faces
    assert ([] if faces is None else faces.tolist()) == expected


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(3, 7), min_size=1, max_size=6), st.randoms(use_true_random=False))
def test_fans_are_those_of_a_plain_loop(tmp_path, counts, random):
    polygons = [[random.randrange(6) for _ in range(count)] for count in counts]
    lists = "".join(" ".join(map(str, [len(corners), *corners])) + "\n" for corners in polygons)
    faces = read(tmp_path, "a.ply", ascii_ply("x y z", np.arange(1, 19.0).reshape(6, 3), lists)).faces
    assert faces.tolist() == [[p[0], p[k], p[k + 1]] for p in polygons for k in range(1, len(p) - 1)]


@pytest.mark.parametrize("few", ["0\n", "1 0\n", "2 0 1\n"])
def test_polygons_of_fewer_than_three_corners_are_left_out(tmp_path, few):
    with pytest.warns(FileWarning, match="1 of 3 faces are left out: they have fewer than 3 corners"):
        cloud = read(tmp_path, "a.ply", ascii_ply("x y z", CORNERS, f"4 0 1 2 3\n{few}3 1 2 3\n"))
    assert cloud.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 2, 3]]


@pytest.mark.parametrize("kind", ["float", "double", "int", "ushort"])
def test_bytes_written_in_other_types_are_colors_from_zero_to_one(tmp_path, kind):
    columns = f"x y z red:{kind} green:{kind} blue:{kind}"
    colors = np.array([[0, 20, 255], [7, 8, 9], [1, 1, 1], [200, 0, 3]])
    cloud = read(tmp_path, "a.ply", ascii_ply(columns, np.concatenate([CORNERS, colors], 1)))
    np.testing.assert_allclose(cloud.colors, colors / 255, atol=1e-6)
    content = ascii_ply("x y z red green blue", np.concatenate([CORNERS, -np.ones((4, 3))], 1))
    with pytest.warns(FileWarning, match="colors are left out: they run from -1"):
        assert read(tmp_path, "b.ply", content).colors is None


@pytest.mark.parametrize("names", ["nx ny nz", "normal_x normal_y normal_z"])
def test_normals_that_are_none_come_from_the_faces_or_are_left_out(tmp_path, names):
    def loaded(normals, faces=""):
        rows = np.concatenate([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], normals], 1)
        return read(tmp_path, "a.ply", ascii_ply(f"x y z {names}", rows, faces)).normals

    bad = np.array([[0, 0, 1], [np.nan, 0, 0], [0, 0, 1]])
    for normals, words in (
        (np.zeros((3, 3)), r"a\.ply: normals are left out: 3 of 3 normals are of length zero"),
        (bad, "normals are left out: 1 of 3 normals are not finite"),
        (bad * [[0], [1], [1]], "left out: 1 of 3 normals are not finite, 1 of 3 normals are of length zero"),
    ):
        with pytest.warns(FileWarning, match=words):
            assert loaded(normals) is None
        with pytest.warns(FileWarning, match="(of length zero|not finite); they are computed from the faces"):
            assert loaded(normals, "3 0 1 2\n").tolist() == [[0, 0, 1]] * 3
    assert loaded(np.array([[0, 0, 2.0]] * 3)).tolist() == [[0, 0, 2]] * 3


PCD = (
    "# .PCD v.7\nVERSION .7\nFIELDS x normal_x y rgb z normal_y extra normal_z\nSIZE 8 4 8 4 8 4 2 4\n"
    "TYPE F F F {rgb} F F U F\nCOUNT 1 1 1 1 1 1 2 1\nWIDTH 3\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\n"
    "POINTS 6\nDATA {data}\n"
)
RNG = np.random.default_rng(0)
POINTS, NORMALS = RNG.normal(size=(6, 3)), RNG.normal(size=(6, 3)).astype(np.float32)
COLORS = np.array([[1, 2, 3], [255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7], [127, 128, 129]])


def compress(data):
    """Encode as LZF in a simple way: runs of one byte become copies of what stands just before, all else literals."""
    out, place = bytearray(), 0
    while place < len(data):
        run = 1
        while place + run < len(data) and data[place + run] == data[place] and run < 265:
            run += 1
        out += bytes([0, data[place]])
        if run >= 4:
            length = run - 1 - 2
            out += bytes([(7 << 5), length - 7, 0]) if length >= 7 else bytes([length << 5, 0])
        place += run if run >= 4 else 1
    return bytes(out)


def pcd(data, rgb="F"):
    packed = ((COLORS[:, 0] << 16) | (COLORS[:, 1] << 8) | COLORS[:, 2]).astype("<u4")
    (x, y, z), (nx, ny, nz) = POINTS.T.astype("<f8"), NORMALS.T.astype("<f4")
    columns = [x, nx, y, packed, z, ny, np.ones((6, 2), "<u2"), nz]
    header = PCD.format(data=data, rgb=rgb).encode()
    if data == "ascii":
        columns[3] = packed.view("<f4") if rgb == "F" else packed
        words = [[" ".join(repr(v) for v in np.atleast_1d(column[k]).tolist()) for column in columns] for k in range(6)]
        return header + "\n".join(map(" ".join, words)).encode() + b"\n"
    if data == "binary":
        return header + b"".join(b"".join(column[k].tobytes() for column in columns) for k in range(6))
    plain = b"".join(column.tobytes() for column in columns)
    return header + struct.pack("<II", len(compress(plain)), len(plain)) + compress(plain)


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("rgb", ["F", "U"])
def test_encodings_of_pcd_agree(tmp_path, data, rgb):
    cloud = read(tmp_path, "a.pcd", pcd(data, rgb))
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.normals, NORMALS.astype(np.float64))
    np.testing.assert_allclose(cloud.colors * 255, COLORS, atol=1e-9)


test_damaged_pcd = refusing(lambda folder, old, new: read(folder, "a.pcd", swap(pcd("ascii", "U").decode(), old, new)))(
    ("DATA ascii", "DATA", "must have a header closed by a line 'DATA ascii'"),
    ("DATA ascii", "DATA zipped", "DATA 'zipped' is unknown"),
    ("FIELDS x ", "FIELDS y ", "FIELDS are missing or not unique"),
    ("FIELDS x ", "FIELDS w ", "must have the fields x, y and z, got w, normal_x"),
    ("SIZE 8 4", "SIZE 8", "must be equally long"),
    ("SIZE 8 4", "SIZE 3 4", "'x' has an unknown TYPE 'F' of SIZE '3'"),
    ("COUNT 1", "COUNT 0", "has the COUNT '0'"),
    ("WIDTH 3", "WIDTH 4", "POINTS is not WIDTH x HEIGHT"),
    ("POINTS 6", "POINTS six", "POINTS must be a number, got 'six'"),
    ("WIDTH 3\nHEIGHT 2\n", "WIDTH 7\nHEIGHT 1\n", "POINTS is not"),
    ("VERSION .7", "VERSION .7\nVERSION .7", "says VERSION twice"),
    ("WIDTH 3\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 6", "WIDTH 0\nHEIGHT 1\nPOINTS 0", "holds no points"),
    ("\nPOINTS 6", "\nPOINTS 999999999999", "POINTS is not"),
    (" 66051 ", " 4294967296 ", "rgb must lie between 0 and 4294967295"),
    (" 66051 ", " -1 ", "rgb must lie between 0 and 4294967295"),
)


def test_defaults_of_old_headers_of_pcd(tmp_path):
    text = "FIELDS x y z _ _\nSIZE 4 4 4 1 1\nTYPE F F F U U\nWIDTH 1\nHEIGHT 1\nDATA ascii\n1 2 3 0 0\n"
    assert read(tmp_path, "a.pcd", text).points.tolist() == [[1, 2, 3]]


def test_lzf_of_known_blocks():
    # "abc" as literals, then 5 bytes from 3 back (overlapping), then 20 from 1 back in the long form.
    packed = bytes([2]) + b"abc" + bytes([(3 << 5), 2]) + bytes([(7 << 5), 11, 0])
    assert decompress_lzf(packed, 28) == b"abc" + b"abcab" + b"b" * 20
    distant = bytes([31]) + bytes(range(32))
    assert decompress_lzf(distant * 10 + bytes([(1 << 5) | 1, 63]), 323) == bytes(range(32)) * 10 + bytes(range(3))
    for wrong in (packed[:-1], packed[:-3], packed + b"\0", bytes([(1 << 5), 0])):
        refused((lambda wrong=wrong: decompress_lzf(wrong, 28), "compressed block"))
    refused((lambda: decompress_lzf(packed, 27), "does not expand to the 27 bytes"))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 255), st.integers(1, 600)), max_size=8))
def test_lzf_undoes_a_run_length_encoder(runs):
    data = b"".join(bytes([value]) * count for value, count in runs)
    assert decompress_lzf(compress(data), len(data)) == data


def test_compressed_blocks_that_claim_too_much_are_refused(tmp_path):
    whole = pcd("binary_compressed")
    start = whole.index(b"compressed\n") + 11
    claim = PCD.replace("WIDTH 3", "WIDTH 3000000").replace("POINTS 6", "POINTS 6000000")
    claim = claim.format(data="binary_compressed", rgb="F").encode()
    block = struct.pack("<II", 400, 6_000_000 * 44) + b"\0" * 400
    few = {"limits": FileLimits(max_expanded_bytes=100)}
    refused(
        (lambda: read(tmp_path, "a.pcd", claim + block), "the compressed block of 400 bytes is cut off or damaged"),
        (lambda: read(tmp_path, "a.pcd", claim + whole[start:]), "header's counts need 264000000 bytes"),
        (lambda: read(tmp_path, "a.pcd", whole, **few), r"would expand \d+ bytes to 264; allowed are 100 bytes"),
    )


TRIANGLES = [[(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(1, 0, 0), (1, 1, 0), (0, 1, 0)]]


def stl(triangles=TRIANGLES, header=b"", attribute=0, count=None):
    facets = [struct.pack("<12fH", 0, 0, 1, *np.ravel(triangle), attribute) for triangle in triangles]
    return header.ljust(80) + struct.pack("<I", len(facets) if count is None else count) + b"".join(facets)


def stl_text(triangles=TRIANGLES, name="part"):
    lines = [f"solid {name}"]
    for triangle in triangles:
        lines += ["facet normal 0 0 1", "  outer loop"]
        lines += ["    vertex " + " ".join(map(repr, map(float, corner))) for corner in triangle]
        lines += ["  endloop", "endfacet"]
    return "\n".join([*lines, f"endsolid {name}", ""])


@each(
    stl(), stl(header=b"solid facet, but binary", attribute=0xFFFF), stl_text(), stl_text(name=""),
    stl_text().replace("\n", "\r\n").upper(), "\n \t" + stl_text().replace("    ", "\t") + "\n\n",
    stl_text().replace("1.0", "+10.0E-1"), stl_text(TRIANGLES[:1], "one") + stl_text(TRIANGLES[1:], "two"),
    stl_text(name="p\xfcrt").encode("latin-1"),
)  # fmt: skip
def test_corners_of_stl_are_joined_in_order_of_first_occurrence(tmp_path, content):
    cloud = read(tmp_path, "a.stl", content)
    assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert cloud.faces.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert (cloud.normals, cloud.colors) == (None, None)
    assert len(read(tmp_path, "a.stl", content, limits=FileLimits(max_faces=2)).faces) == 2
    with pytest.raises(FormatError, match=r"claims 2 faces, allowed are 0 to 1; .* FileLimits\(max_faces=\.\.\.\)"):
        read(tmp_path, "a.stl", content, limits=FileLimits(max_faces=1))


def test_corners_of_stl_have_the_precision_of_the_file_and_only_equal_ones_are_joined(tmp_path):
    third = [[(1 / 3, 0, 0), (1, 0, 0), (0, 1, 0)]]
    assert read(tmp_path, "a.stl", stl_text(third)).points[0, 0] == 1 / 3
    assert read(tmp_path, "a.stl", stl(third)).points[0, 0] == np.float32(1 / 3)
    after = np.nextafter(np.float32(1), np.float32(2))
    cloud = read(tmp_path, "a.stl", stl([third[0], [(-0.0, 0, -0.0), (after, 0, 0), (0, 1, 0)], [(0, 0, 0)] * 3]))
    assert cloud.faces.tolist() == [[0, 1, 2], [3, 4, 2], [3, 3, 3]]
    assert not np.signbit(cloud.points.numpy()).any()
    bad = stl([TRIANGLES[0], [(np.nan, 0, 0), (np.inf, 0, 0), (0, 0, 0)]])
    with pytest.raises(FormatError, match="2 of 5 points are not finite"):
        read(tmp_path, "a.stl", bad)
    assert read(tmp_path, "a.stl", bad, nan_policy="omit").faces.tolist() == [[0, 1, 2]]


test_damaged_stl = refusing(lambda folder, content: read(folder, "a.stl", content), file="a.stl")(
    (stl()[:-1], r"must hold 84 \+ 50 x 2 bytes .*, got 183: it is cut off, damaged or not STL"),
    (stl()[:-50], r"84 \+ 50 x 2 bytes .*, got 134"),
    (stl() + b"\0", r"84 \+ 50 x 2 bytes .*, got 185"),
    (stl(count=1), r"84 \+ 50 x 1 bytes .*, got 184"),
    (stl(count=2**32 - 1), r"84 \+ 50 x 4294967295 bytes .*, got 184"),
    (stl()[:83], "got 83"),
    (stl([]), "holds no points"),
    ("solid nothing\nendsolid\n", "not STL"),
    *((stl_text().replace(old, new), words) for old, new, words in (
        ("endsolid part\n", "", "holds 2 facets, 2 of them closed, with 6 corners and no 'endsolid' at its end"),
        ("endfacet\nendsolid part\n", "", "holds 2 facets, 1 of them closed, with 6 corners and no 'endsolid'"),
        ("endfacet\nendsolid", "endsolid", "holds 2 facets, 1 of them closed, with 6 corners and an 'endsolid'"),
        ("    vertex 1.0 1.0 0.0\n", "", "holds 2 facets, 2 of them closed, with 5 corners"),
        ("    vertex 1.0 1.0 0.0\n", "vertex 1 1 0\n" * 2, "with 7 corners"),
        ("endsolid part\n", "endsolid part\nfacet", "holds 3 facets, 2 of them closed, with 6 corners and no"),
        ("1.0 1.0 0.0", "1.0 1.0", "a corner is not a row of 3 numbers"),
        ("1.0 1.0 0.0", "1.0 1.0 0.0 0.0", "a corner is not a row of 3 numbers"),
        ("1.0 1.0 0.0", "1.0 1.0 O.0", "a corner is not a row of 3 numbers"),
        (" 1.0 1.0 0.0", "", "corner"),
    )),
    ("solid x\nfacet normal 0 0 1\nouter loop\n" + "vertex 0 0 0\n" * 4 + "endloop\nendfacet\nfacet normal 0 0 1\n"
     "outer loop\n" + "vertex 1 0 0\n" * 2 + "endloop\nendfacet\nendsolid x\n", "cut off or damaged"),
)  # fmt: skip
