"""Tables, indices and polygons as the readers of single formats take them apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchreg.errors import FileWarning, FormatError
from torchreg.io.columns import stack_named
from torchreg.io.raw_cloud import RawCloud, as_indices, as_integers, fan_triangles, parse_table, strip_triangles


@given(st.lists(st.tuples(*[st.floats(width=64)] * 3), min_size=1, max_size=5))
def test_numbers_are_read_as_python_reads_them(rows):
    lines = [" ".join(map(repr, row)).encode() for row in rows]
    table = parse_table(lines, 3, "point")
    assert table.dtype == np.float64
    np.testing.assert_array_equal(table, np.array(rows))


def test_tables_keep_two_axes():
    assert parse_table([], None, "point").shape == (0, 0)
    assert parse_table([], 3, "point").shape == (0, 3)
    assert parse_table([b"1"], 1, "index").tolist() == [[1]]
    assert parse_table([b"1", b"2", b"3"], 1, "index").tolist() == [[1], [2], [3]]
    assert parse_table([b" 1\t-2.5e1  +3 \r"], None, "point").tolist() == [[1, -25, 3]]


@pytest.mark.parametrize(
    ("lines", "columns", "words"),
    [
        ([b"1 2 3", b"4 5"], None, "a point is not a row of equally many numbers"),
        ([b"1 2 3", b"4 5"], 3, "a point is not a row of 3 numbers"),
        ([b"1 2", b"3 4"], 3, "each point must hold 3 numbers, got 2"),
        ([b"1 2 3 4"], 3, "each point must hold 3 numbers, got 4"),
        ([b"1 2 3", b""], 3, "each point must hold 3 numbers"),
        ([b"1 2 three"], 3, "a point is not a row of 3 numbers"),
        ([b"1 2 0x10"], 3, "a point is not a row of 3 numbers"),
        ([b"1 2 #3"], 3, "a point is not a row of 3 numbers: row 1 holds '#3'"),
        ([b"1 2 # 3"], 3, "each point must hold 3 numbers, got 4"),
        ([b"1,2,3"], 3, "each point must hold 3 numbers, got 1"),
        ([b"1 2 \xd9\xa3"], 3, "a point is not a row of 3 numbers"),
    ],
)
def test_bad_rows_are_refused(lines, columns, words):
    with pytest.raises(FormatError, match=words):
        parse_table(lines, columns, "point")


@pytest.mark.parametrize("dtype", ["i1", "u1", ">i2", "<u4", "i8", "u8", "f4", ">f8"])
def test_whole_numbers_become_int64(dtype):
    indices = as_indices(np.array([[0, 1], [7, 100]], dtype), "faces")
    assert indices.dtype == np.int64
    assert indices.tolist() == [[0, 1], [7, 100]]


@pytest.mark.parametrize("value", [-(2**53) + 1, 2**53 - 1])
def test_the_largest_exact_whole_numbers_pass(value):
    assert as_indices(np.array([float(value)]), "faces").tolist() == [value]
    assert as_indices(np.array([value]), "faces").tolist() == [value]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.array([0.5]), "faces must be whole numbers"),
        (np.array([np.nan]), "faces must be whole numbers"),
        (np.array([-np.inf]), "faces must be whole numbers"),
        (np.array([True]), "faces must be whole numbers, got bool"),
        (np.array([1j]), "faces must be whole numbers, got complex128"),
        (np.array(["1"]), "faces must be whole numbers, got <U1"),
        (np.array([2.0**53]), "faces are out of range"),
        (np.array([-(2**53)]), "faces are out of range"),
        (np.array([2**64 - 1], np.uint64), "faces are out of range"),
        (np.array([-(2**63)]), "faces are out of range"),
    ],
)
def test_what_is_no_index_is_refused(values, words):
    with pytest.raises(FormatError, match=words):
        as_indices(values, "faces")


@pytest.mark.parametrize(("kind", "low", "high"), [("u1", 0, 255), ("i1", -128, 127), ("i2", -32768, 32767)])
def test_integers_must_fit_their_type(kind, low, high):
    fitting = as_integers(np.array([low, high], np.float64), kind, "red")
    assert fitting.dtype == np.dtype(kind)
    assert fitting.tolist() == [low, high]
    for value in (low - 1, high + 1):
        with pytest.raises(FormatError, match=f"red must lie between {low} and {high}"):
            as_integers(np.array([0.0, value]), kind, "red")
    assert as_integers(np.zeros(0), kind, "red").shape == (0,)


def test_columns_are_stacked_by_any_of_their_names():
    columns = {"z": np.array([3.0, 6.0]), "x": np.array([1, 4], np.float32), "Y": np.array([2, 5], np.float32)}
    stacked = stack_named(columns, "points")
    assert stacked.dtype == np.float64
    assert stacked.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert stack_named(columns, "normals") is None


@given(st.lists(st.lists(st.integers(-1, 5), max_size=9), max_size=4))
def test_strips_are_those_of_a_plain_loop(strips):
    expected, one = [], []
    for number in [number for strip in strips for number in [*strip, -1]]:
        one = [*one, number] if number >= 0 else []
        if len(set(one[-3:])) == 3:
            a, b, c = one[-3:]
            expected.append([a, b, c] if len(one) % 2 else [b, a, c])
    counts = np.array([len(strip) for strip in strips], np.int64)
    indices = np.array([number for strip in strips for number in strip], np.int64)
    assert strip_triangles(counts, indices).tolist() == expected


@given(st.lists(st.integers(3, 7), max_size=6), st.randoms(use_true_random=False))
def test_fans_are_those_of_a_plain_loop(counts, random):
    polygons = [[random.randrange(50) for _ in range(count)] for count in counts]
    wanted = [[p[0], p[k], p[k + 1]] for p in polygons for k in range(1, len(p) - 1)]
    flat = np.array([corner for polygon in polygons for corner in polygon], np.int64)
    triangles = fan_triangles(np.array(counts, np.int64), flat)
    assert triangles.shape == (len(wanted), 3)
    assert triangles.dtype == np.int64
    assert triangles.tolist() == wanted


def test_a_fan_covers_a_convex_polygon_once():
    angles = np.linspace(0, 2 * np.pi, 9, endpoint=False)
    a, b, c = np.stack((np.cos(angles), np.sin(angles)), -1)[fan_triangles(np.array([9]), np.arange(9))].swapaxes(0, 1)
    areas = np.linalg.det(np.stack((b - a, c - a), -1)) / 2
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(9 / 2 * np.sin(2 * np.pi / 9))


@pytest.mark.parametrize("few", [0, 1, 2])
def test_polygons_of_fewer_than_three_corners_are_left_out(few):
    with pytest.warns(FileWarning, match="1 of 3 faces are left out: they have fewer than 3 corners"):
        triangles = fan_triangles(np.array([4, few, 3]), np.arange(7 + few))
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3], [4 + few, 5 + few, 6 + few]]


def test_the_record_has_points_alone_unless_told():
    cloud = RawCloud(np.zeros((2, 3)))
    assert (cloud.normals, cloud.colors, cloud.faces) == (None, None, None)
    with pytest.raises(AttributeError):
        cloud.points = np.ones((2, 3))


def test_a_row_without_numbers_is_refused():
    with pytest.raises(FormatError, match="each vertex must hold 3 numbers"):
        parse_table([b" ", b""], 3, "vertex")
