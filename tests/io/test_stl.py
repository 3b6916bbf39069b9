"""STL, binary and text, against files written by hand and by trimesh."""

import io
import struct

import numpy as np
import pytest
import trimesh

from torchreg.errors import FormatError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.stl import read_stl

TRIANGLES = [[(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(1, 0, 0), (1, 1, 0), (0, 1, 0)]]
VERTICES = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
FACES = [[0, 1, 2], [1, 3, 2]]


def binary(triangles, header: bytes = b"", attribute: int = 0, count: int | None = None) -> bytes:
    facets = [struct.pack("<12fH", 0, 0, 1, *np.ravel(triangle), attribute) for triangle in triangles]
    return header.ljust(80) + struct.pack("<I", len(facets) if count is None else count) + b"".join(facets)


def text(triangles, name: str = "part") -> str:
    lines = [f"solid {name}"]
    for triangle in triangles:
        lines += ["facet normal 0 0 1", "  outer loop"]
        lines += ["    vertex " + " ".join(map(repr, map(float, corner))) for corner in triangle]
        lines += ["  endloop", "endfacet"]
    return "\n".join([*lines, f"endsolid {name}", ""])


@pytest.mark.parametrize(
    "content",
    [
        binary(TRIANGLES),
        binary(TRIANGLES, b"solid facet, but binary", attribute=0xFFFF),
        text(TRIANGLES).encode(),
        text(TRIANGLES, "").encode(),
        text(TRIANGLES).replace("\n", "\r\n").upper().encode(),
        b"\n \t" + text(TRIANGLES).replace("    ", "\t").encode() + b"\n\n",
        text(TRIANGLES).replace("1.0", "+10.0E-1").encode(),
        (text(TRIANGLES[:1], "one") + text(TRIANGLES[1:], "two")).encode(),
        text(TRIANGLES, "p\xfcrt").encode("latin-1"),
    ],
)
def test_corners_are_joined_in_order_of_first_occurrence(content):
    cloud = read_stl(content, DEFAULT_LIMITS)
    assert cloud.points.tolist() == VERTICES
    assert cloud.faces.tolist() == FACES
    assert cloud.faces.dtype == np.int64
    assert (cloud.normals, cloud.colors) == (None, None)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_trimesh_reads_the_same_triangles(kind):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    content = mesh.export(file_type=kind)
    content = content if isinstance(content, bytes) else content.encode()
    cloud = read_stl(content, DEFAULT_LIMITS)
    loaded = trimesh.load_mesh(io.BytesIO(content), file_type="stl", process=False)
    np.testing.assert_array_equal(cloud.points[cloud.faces].astype(np.float32), loaded.triangles.astype(np.float32))
    joined = trimesh.Trimesh(cloud.points, cloud.faces, process=False)
    assert joined.is_watertight
    assert joined.is_winding_consistent
    assert len(joined.vertices) == len(mesh.vertices)


def test_precision_is_that_of_the_file():
    triangle = [[(1 / 3, 0, 0), (1, 0, 0), (0, 1, 0)]]
    assert read_stl(binary(triangle), DEFAULT_LIMITS).points.dtype == np.float32
    written = read_stl(text(triangle).encode(), DEFAULT_LIMITS).points
    assert written.dtype == np.float64
    assert written[0, 0] == 1 / 3


def test_only_equal_corners_are_joined():
    after = np.nextafter(np.float32(1), np.float32(2))
    cloud = read_stl(
        binary([[(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(-0.0, 0, -0.0), (after, 0, 0), (0, 1, 0)]]), DEFAULT_LIMITS
    )
    assert cloud.faces.tolist() == [[0, 1, 2], [0, 3, 2]]
    assert not np.signbit(cloud.points).any()


def test_degenerate_and_non_finite_triangles_are_handed_over():
    cloud = read_stl(binary([[(1, 2, 3)] * 3, [(np.nan, 0, 0), (np.inf, 0, 0), (1, 2, 3)]]), DEFAULT_LIMITS)
    assert cloud.faces.tolist() == [[0, 0, 0], [1, 2, 0]]
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [np.nan, 0, 0], [np.inf, 0, 0]])


def test_a_file_without_facets_has_no_points():
    cloud = read_stl(binary([]), DEFAULT_LIMITS)
    assert cloud.points.shape == (0, 3)
    assert cloud.faces.shape == (0, 3)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (binary(TRIANGLES)[:-1], r"must hold 84 \+ 50 x 2 bytes .*, got 183: it is cut off, damaged or not STL"),
        (binary(TRIANGLES)[:-50], r"84 \+ 50 x 2 bytes .*, got 134"),
        (binary(TRIANGLES) + b"\0", r"84 \+ 50 x 2 bytes .*, got 185"),
        (binary(TRIANGLES, count=1), r"84 \+ 50 x 1 bytes .*, got 184"),
        (binary(TRIANGLES, count=2**32 - 1), r"84 \+ 50 x 4294967295 bytes .*, got 184"),
        (binary(TRIANGLES)[:83], "got 83"),
        (b"", "got 0"),
        (b"solid nothing\nendsolid\n", "not STL"),
    ],
)
def test_binary_files_hold_what_they_say(content, words):
    with pytest.raises(FormatError, match=words):
        read_stl(content, DEFAULT_LIMITS)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
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
    ],
)
def test_damaged_text_is_refused(old, new, words):
    content = text(TRIANGLES)
    assert old in content
    with pytest.raises(FormatError, match=words):
        read_stl(content.replace(old, new).encode(), DEFAULT_LIMITS)


def test_no_text_cut_in_its_lines_passes():
    content = text(TRIANGLES).rstrip()
    for cut in range(len(content) - len("endsolid part") + 1):
        with pytest.raises(FormatError):
            read_stl(content[:cut].encode(), DEFAULT_LIMITS)


@pytest.mark.parametrize("content", [binary(TRIANGLES), text(TRIANGLES).encode()])
def test_the_limit_of_faces_applies(content):
    assert len(read_stl(content, FileLimits(max_faces=2)).faces) == 2
    with pytest.raises(FormatError, match=r"claims 2 faces, allowed are 0 to 1; .* FileLimits\(max_faces=\.\.\.\)"):
        read_stl(content, FileLimits(max_faces=1))


def test_every_facet_needs_its_own_three_corners():
    four = b"facet normal 0 0 1\nouter loop\n" + b"vertex 0 0 0\n" * 4 + b"endloop\nendfacet\n"
    two = b"facet normal 0 0 1\nouter loop\n" + b"vertex 1 0 0\n" * 2 + b"endloop\nendfacet\n"
    with pytest.raises(FormatError, match="cut off or damaged"):
        read_stl(b"solid x\n" + four + two + b"endsolid x\n", DEFAULT_LIMITS)
