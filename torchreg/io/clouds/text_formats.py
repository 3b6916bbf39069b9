"""Formats of lines of text: XYZ tables and Wavefront OBJ."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.clouds.columns import cloud_of_columns, have_decimal_commas, names_points, wanted_columns
from torchreg.io.clouds.raw_cloud import Array, RawCloud, as_indices, fan_triangles, parse_numbers, parse_table
from torchreg.io.file_format import plain_text, warn
from torchreg.io.limits import FileLimits, check_allowed

_COMMENT = re.compile(rb"(#|//).*")
_SEPARATORS = bytes.maketrans(b",;\t", b"   ")
_FIELDS = re.compile(rb"[;\s]+")
# Lines that decide on the separator.
_TOLD_BY = 50


def read_table(content: bytes, limits: FileLimits, *, intensity_first: bool = False) -> RawCloud:
    """Return the points of a table of text: x y z and, where they are there, normals and colors.

    Columns are separated by blanks, tabs, commas or semicolons, decimal commas are understood where another separator
    stands between numbers; ``#`` and ``//`` begin comments; the first line may hold column names, also behind ``//`` or
    ``#``, or the number of points alone. See `cloud_of_columns` for tables without names.
    """
    text = plain_text(content)
    text = text if b"\n" in text else text.replace(b"\r", b"\n")
    check_allowed(0 if text.isspace() else text.count(b"\n"), "points", limits)
    names = _names_in_comment(text)
    if b"#" in text or b"//" in text:
        text = _COMMENT.sub(b"", text)
    claimed, before, headed = None, 0, False
    while line := _first_line(text):
        words = _words(line)
        if claimed is None and len(words) == 1 and words[0].isdigit():
            claimed = int(words[0][:20])
        elif not headed and (_is_header(line) or _numbers_columns(line, text)):
            headed = True
            names = _names(line)
        else:
            break
        end = text.index(line) + len(line)
        before, text = before + text.count(b"\n", 0, end) + 1, text[end + 1 :]
    table = _numbers(text, names, before)
    if claimed is not None and claimed != len(table):
        raise FormatError(
            f"the first line says {claimed} points, the file holds {len(table)}: it is cut off or damaged"
        )
    return cloud_of_columns(table, names, intensity_first=intensity_first)


def _numbers(text: bytes, names: list[str] | None, before: int) -> Array:
    """Return the rows (N, C) below a line of names; columns of words, which no cloud is made of, are not numbers."""
    if names is None:
        return parse_numbers(_separated(text), None, "point", before=before)
    wanted = wanted_columns(names)
    if not names_points(names):
        cloud_of_columns(np.zeros((0, len(names))), names)  # raises, with the names
    try:
        return parse_numbers(_separated(text), len(names), "point", before=before)
    except FormatError:
        lines = [(number, _words(line)) for number, line in enumerate(text.split(b"\n"), before + 1) if line.strip()]
        picked = [b" ".join(row[k] or b"nan" for k in wanted) for _, row in lines if len(row) > max(wanted)]
        if len(picked) < len(lines):
            raise
    table = np.full((len(picked), len(names)), np.nan)
    table[:, wanted] = parse_numbers(b"\n".join(picked), len(wanted), "point", before=before)
    return table


def looks_like_table(content: bytes) -> bool:
    """Return whether the first lines of a text are rows of three numbers or more, below names or a count at most."""
    head = plain_text(content[:4096]).replace(b"\r", b"\n")
    if b"\0" in head:  # binary numbers, between which bytes may look like separators
        return False
    lines = [line for line in _COMMENT.sub(b"", head).split(b"\n")[:-1] or [head] if line.strip()]
    if lines and (lines[0].strip().isdigit() or names_points(_names(lines[0]))):
        del lines[0]
    lines = lines[:4]
    return bool(lines) and all(len(_words(line)) >= 3 and not _is_header(line) for line in lines)


def _first_line(text: bytes) -> bytes:
    """Return the first line that is not blank; empty if there is none."""
    found = re.search(rb"[^\n]*\S[^\n]*", text)
    return b"" if found is None else found.group()


def _words(line: bytes) -> list[bytes]:
    """Return the fields of a line: between commas or semicolons where there are any, else between blanks."""
    for separator in (b";", b",", b"\t"):
        if separator in line:
            return [word.strip() for word in line.strip().rstrip(separator).split(separator)]
    return line.split()


def _names(line: bytes) -> list[str]:
    """Return the fields of a line as names of columns."""
    return [word.decode("utf-8", "replace").strip("\"'") for word in _words(line)]


def _is_header(line: bytes) -> bool:
    """Return whether a line holds names of columns: it begins with a word, or with an empty field as pandas writes."""
    first = _words(line)[0].strip(b"\"'").lower()
    return not first or (re.match(rb"[a-z_]", first) is not None and re.match(rb"(nan|inf|infinity)\b", first) is None)


def _numbers_columns(line: bytes, text: bytes) -> bool:
    """Return whether a first line numbers the columns, 0,1,2, above rows with decimals, as pandas writes."""
    words = [word.strip(b"\"'") for word in _words(line)]
    following = text[text.index(line) + len(line) :][:200]
    return (
        len(words) >= 3 and words == [b"%d" % k for k in range(len(words))] and b"." in following.split(b"\n")[:2][-1]
    )


def _names_in_comment(text: bytes) -> list[str] | None:
    """Return the names of columns in the first line, where that is a comment that names them."""
    line = _first_line(text).strip()
    if not line.startswith((b"#", b"//")):
        return None
    names = _names(line.lstrip(b"#/ "))
    return names if names_points(names) else None


def _separated(text: bytes) -> bytes:
    """Return a table whose numbers are separated by blanks and have decimal points."""
    if not any(separator in text for separator in (b",", b";", b"\t")):
        return text
    for separator in (b",", b";"):
        if separator * 2 in text:  # a missing value
            text = re.sub(separator + rb"(?=[ \t]*" + separator + rb")", separator + b"nan", text)
    if b"," not in text:
        return text.translate(_SEPARATORS)
    lines = [line for line in text[: 200 * _TOLD_BY].split(b"\n")[:_TOLD_BY] if line.strip()]
    fields = [_FIELDS.split(line.strip().strip(b";")) for line in lines]
    mixed = [line for line, row in zip(lines, fields, strict=True) if len(row) >= 3 and re.search(rb"\d,\d", line)]
    if mixed and have_decimal_commas(field for row in fields[:-1] or fields for field in row):
        return text.replace(b",", b".").translate(_SEPARATORS)
    if mixed and any(re.search(rb"[;\t]", line) for line in mixed):
        shown = mixed[0].strip()[:60].decode("utf-8", "replace")
        raise FormatError(
            f"numbers with commas stand between semicolons or tabs, as in {shown!r}; "
            f"write decimal points, and one separator between the columns"
        )
    _refuse_paired_integers(lines)
    return text.translate(_SEPARATORS)


def _refuse_paired_integers(lines: Sequence[bytes]) -> None:
    """Raise FormatError where commas separate the columns and are decimal commas too: 0,123,0,456,0,789."""
    rows = [re.fullmatch(rb"\s*-?\d+,(\d{3,}),-?\d+,(\d{3,}),-?\d+,(\d{3,})\s*", line) for line in lines[:-1] or lines]
    decimals = [word for row in rows if row is not None for word in row.groups()]
    if rows and all(rows) and len({len(word) for word in decimals}) == 1 and max(map(int, decimals)) > 255:
        raise FormatError(
            f"commas separate the columns and, it seems, the decimals too, as in {lines[0].strip()[:60].decode()!r}; "
            f"write decimal points, or semicolons between the columns"
        )


def write_xyz(cloud: RawCloud) -> bytes:
    """Return a text table of x y z (nx ny nz) with all digits of the precision."""
    table, head = cloud.points, b""
    if cloud.normals is not None:
        table, head = np.concatenate((cloud.points, cloud.normals), axis=-1), b"# x y z nx ny nz\n"
    digits = 9 if table.dtype.itemsize <= 4 else 17
    row = " ".join([f"%.{digits}g"] * table.shape[1])
    return head + "".join(row % tuple(values) + "\n" for values in table.tolist()).encode("ascii")


def write_csv(cloud: RawCloud) -> bytes:
    """Return a table with the names of its columns in the first line: x, y, z, nx, ny, nz, r, g, b."""
    digits = 9 if cloud.points.dtype.itemsize <= 4 else 17
    columns, formats, names = [cloud.points], [f"%.{digits}g"] * 3, ["x", "y", "z"]
    if cloud.normals is not None:
        columns, formats, names = [*columns, cloud.normals], formats * 2, [*names, "nx", "ny", "nz"]
    if cloud.colors is not None:
        columns, formats, names = [*columns, cloud.colors], [*formats, *["%d"] * 3], [*names, "r", "g", "b"]
    row = ",".join(formats)
    rows = np.concatenate([values.astype(np.float64) for values in columns], axis=-1).tolist()
    return "\n".join([",".join(names), *(row % tuple(values) for values in rows)]).encode("ascii") + b"\n"


# Characters of a number of a vertex.
_MAX_DIGITS = 12


def read_obj(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the vertices and faces of an OBJ file, in the file's order and numbering, without materials.

    Vertex colors after the coordinates are read, and normals if every vertex has exactly one, of its own number.
    Polygons are cut into fans.
    """
    vertices, normals, corners = list[bytes](), list[bytes](), list[bytes]()
    sizes, seen = list[int](), list[tuple[int, int]]()
    joined = plain_text(content).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    for line in joined.replace(b"\t", b" ").splitlines():
        key, _, rest = line.strip().partition(b" ")
        if key == b"v":
            vertices.append(rest.partition(b"#")[0])
        elif key == b"vn":
            normals.append(rest.partition(b"#")[0])
        elif key == b"f":
            words = rest.partition(b"#")[0].split()
            corners += words
            sizes.append(len(words))
            seen.append((len(vertices), len(normals)))
    del joined
    check_allowed(len(vertices), "points", limits)
    check_allowed(len(sizes), "faces", limits)
    table = _vertex_table(vertices)
    colors = table[:, -3:] if table.shape[1] in (6, 7) else None
    counts = np.array(sizes, dtype=np.int64)
    before = np.repeat(np.array(seen, dtype=np.int32).reshape(-1, 2), counts, axis=0)
    indices = _resolve([corner.partition(b"/")[0] for corner in corners], before[:, 0], len(table), "vertex")
    vertex_normals = None
    if normals and len(normals) == len(table):
        named = [corner.split(b"/")[2] if corner.count(b"/") == 2 else b"" for corner in corners]
        if all(named) and np.array_equal(_resolve(named, before[:, 1], len(normals), "normal"), indices):
            vertex_normals = parse_table(normals, 3, "normal")
    del corners, before  # ten times what they become
    faces = fan_triangles(counts, indices) if sizes else None
    return RawCloud(table[:, :3].reshape(-1, 3), vertex_normals, colors, faces)


def _vertex_table(rows: list[bytes]) -> Array:
    """Return the numbers of vertices: x y z, with w 4, with a color 6 or 7; colors of some vertices are left out."""
    widths = np.array([len(row.split()) for row in rows])
    colored = widths >= 6
    if colored.any() and not colored.all() and np.isin(widths, (3, 4, 6, 7)).all():
        warn(f"colors are left out: {int(colored.sum())} of {len(rows)} vertices have one")
        rows = [b" ".join(row.split()[:3]) for row in rows]
    table = parse_table(rows, None, "vertex")
    if len(table) and table.shape[1] not in (3, 4, 6, 7):
        raise FormatError(f"a vertex must be 3 numbers (with w 4, with a color 6 or 7), got {table.shape[1]}")
    return table


def _resolve(words: list[bytes], before: Array, count: int, what: str) -> Array:
    """Return 0-based indices; negative numbers count back from the items before the line."""
    if not words:
        return np.zeros(0, dtype=np.int64)
    values = _whole_numbers(words)
    if values is None:
        values = as_indices(parse_table(words, 1, f"{what} index")[:, 0], f"{what} indices")
    # In place: as many numbers as a file may hold.
    behind, lost = np.flatnonzero(values < 0), bool(np.any(values == 0))
    values[behind] += before[behind] + 1
    indices = np.subtract(values, 1, out=values)
    if lost or np.any(indices < 0) or np.any(indices >= count):
        raise FormatError(f"a face names a {what} outside 1 to {count}: the file is cut off or damaged")
    return indices


def _whole_numbers(words: list[bytes]) -> Array | None:
    """Return words as int64, None unless each is a plain whole number; five times faster than any table."""
    if max(map(len, words)) > _MAX_DIGITS:
        return None
    try:
        return np.array(words, dtype=bytes).astype(np.int64)
    except ValueError:
        return None
