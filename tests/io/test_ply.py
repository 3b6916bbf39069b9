"""PLY: byte orders, extra properties, polygons, damaged headers."""

import struct

import numpy as np
import pytest
import torch

from torchreg.errors import FormatError
from torchreg.io.limits import DEFAULT_LIMITS
from torchreg.io.ply import read_ply
from torchreg.io.points import load_points

HEADER = """ply
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
POINTS = np.array([[1 / 3, 0, 0], [1, 0.1, 0], [1, 1, 2 / 7], [0, 1, 0]])


def body(order: str, polygons: list[list[int]]) -> bytes:
    content = struct.pack(f"{order}Hhhhd", 3, -1, 2, 3, 0.5)
    for index, (x, y, z) in enumerate(POINTS):
        content += struct.pack(f"{order}BdfddBB", 50 * index, x, 0.9, y, z, 255, 0)
    for polygon in polygons:
        content += struct.pack(f"{order}BB{len(polygon)}i", 7, len(polygon), *polygon)
    return content + struct.pack(f"{order}ii", 0, 1)


def text_body(polygons: list[list[int]]) -> bytes:
    rows = ["3 -1 2 3 0.5"]
    rows += [f"{50 * k} {x!r} 0.9 {y!r} {z!r} 255 0" for k, (x, y, z) in enumerate(POINTS.tolist())]
    rows += [f"7 {len(polygon)} {' '.join(map(str, polygon))}" for polygon in polygons]
    return "\n".join([*rows, "0 1", ""]).encode()


def file(form: str, polygons: list[list[int]], newline: str = "\n") -> bytes:
    data = {
        "ascii": lambda: text_body(polygons),
        "binary_little_endian": lambda: body("<", polygons),
        "binary_big_endian": lambda: body(">", polygons),
    }[form]()
    return HEADER.format(form=form).replace("\n", newline).encode() + data


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize(
    ("polygons", "triangles"),
    [
        ([[0, 1, 2], [0, 2, 3]], [[0, 1, 2], [0, 2, 3]]),
        ([[0, 1, 2, 3], [3, 1, 0]], [[0, 1, 2], [0, 2, 3], [3, 1, 0]]),
        ([[3, 1, 0], [3, 2, 1, 0]], [[3, 1, 0], [3, 2, 1], [3, 1, 0]]),
    ],
)
def test_all_encodings_agree_in_full_precision(tmp_path, form, newline, polygons, triangles):
    path = tmp_path / "a.ply"
    path.write_bytes(file(form, polygons, newline))
    cloud = load_points(path, dtype=torch.float64)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.faces.tolist() == triangles
    np.testing.assert_allclose(cloud.colors, [[50 * k / 255, 1, 0] for k in range(4)])
    assert cloud.normals is None
    single = load_points(path)
    assert torch.equal(single.points, torch.tensor(POINTS, dtype=torch.float32))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("polygons", [[[0, 1, 2], [0, 2, 3]], [[0, 1, 2, 3], [3, 1, 0]]])
def test_files_cut_off_or_too_long_are_refused(form, polygons):
    whole = file(form, polygons)
    start = whole.index(b"end_header")
    for end in range(start, len(whole) - (3 if form == "ascii" else 0)):
        with pytest.raises(FormatError):
            read_ply(whole[:end], DEFAULT_LIMITS)
    with pytest.raises(FormatError, match=r"the header says \d+ rows|more than its header says"):
        read_ply(whole + b"1 2 3 4\n", DEFAULT_LIMITS)
    read_ply(whole + b"\n", DEFAULT_LIMITS)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
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
        ("150 0.0", "450 0.0", "colors must lie between 0 and 255"),
        ("150 0.0 0.9", "150 0.0", "is not a row of 7 numbers"),
    ],
)
def test_damaged_text_is_refused(old, new, words):
    whole = file("ascii", [[0, 1, 2], [0, 2, 3]]).decode()
    assert old in whole
    with pytest.raises(FormatError, match=words):
        read_ply(whole.replace(old, new, 1).encode(), DEFAULT_LIMITS)


def test_negative_list_length_is_refused():
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty list char int skip\n"
    header += "property float x\nproperty float y\nproperty float z\nend_header\n"
    good = struct.pack("<bfff", 0, 1, 2, 3) + struct.pack("<bifff", 1, 9, 4, 5, 6)
    np.testing.assert_array_equal(
        read_ply(header.encode() + good, DEFAULT_LIMITS).points, np.arange(1, 7).reshape(2, 3)
    )
    bad = struct.pack("<bfff", -1, 1, 2, 3) + struct.pack("<bifff", 1, 9, 4, 5, 6)
    with pytest.raises(FormatError, match="is cut off or damaged"):
        read_ply(header.encode() + bad, DEFAULT_LIMITS)


def test_float_colors_and_normals_and_empty_faces():
    names = ["x", "y", "z", "nx", "ny", "nz", "r", "g", "b"]
    header = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {name}\n" for name in names)
    header += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    cloud = read_ply(header.encode() + b"1 2 3 0 0 1 0.25 0.5 1\n", DEFAULT_LIMITS)
    assert cloud.normals.tolist() == [[0, 0, 1]]
    assert cloud.colors.tolist() == [[0.25, 0.5, 1]]
    assert cloud.faces.shape == (0, 3)
    binary = header.replace("ascii", "binary_big_endian").encode() + struct.pack(">9f", *range(9))
    cloud = read_ply(binary, DEFAULT_LIMITS)
    assert cloud.points.tolist() == [[0, 1, 2]]
    assert cloud.faces.shape == (0, 3)


@pytest.mark.parametrize("names", [("normal_x", "normal_y", "normal_z"), ("Nx", "Ny", "Nz"), ("nx", "ny", "nz")])
@pytest.mark.parametrize("colors", [("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")])
def test_names_of_other_programs(names, colors):
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", *names))
    header += "".join(f"property uchar {name}\n" for name in colors) + "end_header\n"
    cloud = read_ply(header.encode() + b"1 2 3 0 0 1 10 20 30\n", DEFAULT_LIMITS)
    assert cloud.normals.tolist() == [[0, 0, 1]]
    assert cloud.colors.dtype == np.uint8
    assert cloud.colors.tolist() == [[10, 20, 30]]


@pytest.mark.parametrize("kind", ["int", "uint"])
@pytest.mark.parametrize("also_faces", [False, True])
def test_triangle_strips_are_cut_with_one_side_outward(kind, also_faces):
    # Corners of a strip of a grid, then after a restart a triangle alone, and a strip joined by a flat triangle.
    corners = np.array([[x, y, 0.0] for x in range(4) for y in range(2)])
    strips = [0, 2, 1, 3, -1, 2, 4, 3, -1, 4, 6, 5, 7, 7]
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n"
    header += "".join(f"property float {name}\n" for name in "xyz")
    body = corners.astype("<f4").tobytes()
    if also_faces:
        header += "element face 1\nproperty list uchar int vertex_indices\n"
        body += struct.pack("<B3i", 3, 3, 4, 5)
    header += f"element tristrips 1\nproperty list int {kind} vertex_indices\nend_header\n"
    body += struct.pack("<i", len(strips)) + np.array(strips, "<i4").tobytes()
    faces = read_ply(header.encode() + body, DEFAULT_LIMITS).faces
    assert len(faces) == 5 + also_faces
    a, b, c = (corners[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[also_faces:, 2] == 1).all()
