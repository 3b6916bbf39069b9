"""Tables of poses as spreadsheets save them."""

import math

from tests.io.helpers import put
from tests.tables import each, refusing
from torchreg.io.pose_table import load_pose_table, save_pose_table

NAMES = ("pan", "lift", "elbow")
ROWS = [[0.5, -1.25, 3.0], [1e-3, 0.7, -2.0]]


def read(tmp_path, content, names=NAMES):
    return load_pose_table(put(tmp_path, "joints.csv", content), names)


def table(separator, decimals=".", newline="\n", extra=()):
    lines = [[*NAMES, *(name for name, _ in extra)]]
    lines += [[*(f"{v:g}".replace(".", decimals) for v in row), *(word for _, word in extra)] for row in ROWS]
    return newline.join(separator.join(line) for line in lines) + newline


@each(
    table(","),
    table(";"),
    table(";", ","),
    table("\t", ",", "\r\n"),
    b"\xef\xbb\xbf" + table(";", ",", "\r\n").encode(),
    table("\t", ",").encode("utf-16"),
    table(";", ",", extra=[("time", "12:00:03.5"), ("note", "a, b")]),
    table(";", ",").replace("\n", ";\n"),
    table(";", ",").replace("lift;", "lift ;").replace("0,5", '"0,5"'),
    'pan,lift,elbow\n"0,5","-1,25",3\n"0,001","0,7",-2\n',
)
def test_numbers_have_points_or_commas(tmp_path, content):
    assert [list(row.values()) for row in read(tmp_path, content)] == ROWS


def test_one_column_and_entries_that_are_missing(tmp_path):
    assert read(tmp_path, "pan\n0,5\n-1\n") == [{"pan": 0.5}, {"pan": -1.0}]
    first, second = read(tmp_path, "pan;lift\n0,5;\n;2\n")
    assert (first["pan"], second["lift"]) == (0.5, 2.0)
    assert math.isnan(first["lift"])


test_what_can_be_read_in_two_ways_is_refused = refusing(read, file="joints.csv: ")(
    ("pan;lift\n0,5;1.5\n", "row 2, pan must be a number, got '0,5'"),
    ("pan;lift\n1.234,5;0,5\n", r"row 2, pan must be a number, got '1\.234,5'"),
    ("pan,lift\n0,5,0,7\n", "row 2 holds 4 entries, the line of names 2; .* write semicolons"),
    ("pan,lift\n0.5,inf\n", "row 2, lift must be finite"),
    ("tilt\n1\n", "must hold a line of names, such as pan, lift, elbow"),
)


def test_what_is_saved_is_read(tmp_path):
    save_pose_table(tmp_path / "a.csv", NAMES, ROWS)
    assert [list(row.values()) for row in load_pose_table(tmp_path / "a.csv", NAMES)] == ROWS
