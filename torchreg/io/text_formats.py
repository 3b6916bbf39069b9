"""Formats of lines of text: XYZ tables and Wavefront OBJ."""

from __future__ import annotations

import re

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.limits import FileLimits, check_allowed
from torchreg.io.raw_cloud import Array, RawCloud, as_indices, fan_triangles, parse_table

_COMMENT = re.compile(rb"(#|//).*$")
_SEPARATORS = bytes.maketrans(b",;", b"  ")


def read_xyz(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the points of a table with the columns x y z or x y z nx ny nz.

    Columns are separated by blanks, commas or semicolons; ``#`` and ``//`` begin comments; the first line may hold
    column names, or the number of points alone.
    """
    check_allowed(0 if content.isspace() else content.count(b"\n"), "points", limits)
    commented = b"#" in content or b"//" in content
    lines = content.translate(_SEPARATORS).splitlines()
    lines = [line for line in (_COMMENT.sub(b"", line) if commented else line for line in lines) if line.strip()]
    claimed = None
    if lines and len(lines[0].split()) == 1 and lines[0].strip().isdigit():
        claimed = int(lines.pop(0)[:20])
    if lines and re.match(rb"\s*[\"']?[A-Za-z_]{1,}", lines[0]) and not re.match(rb"\s*(nan|inf)\b", lines[0].lower()):
        _check_names(lines.pop(0))
    if claimed is not None and claimed != len(lines):
        raise FormatError(
            f"the first line says {claimed} points, the file holds {len(lines)}: it is cut off or damaged"
        )
    table = parse_table(lines, None, "point")
    if len(table) and table.shape[1] not in (3, 6):
        raise FormatError(
            f"a point must be a row of 3 numbers (x y z) or 6 (x y z nx ny nz), got {table.shape[1]}; drop the other "
            f"columns or save as PLY, which names them"
        )
    if len(table) == 0 or table.shape[1] == 3:
        return RawCloud(table[:, :3].reshape(-1, 3))
    longest = np.nanmax(np.abs(table[:, 3:]), initial=0.0)
    if longest > 1.01 and np.isfinite(longest):
        raise FormatError(
            f"columns 4 to 6 must be unit normals, got components up to {longest:g}; drop them, or if they are colors "
            f"save as PLY, which names its columns"
        )
    return RawCloud(table[:, :3], table[:, 3:])


def _check_names(line: bytes) -> None:
    names = [name.strip("\"'").lower() for name in line.decode("latin-1").split()]
    if names[:3] != ["x", "y", "z"] or names[3:] not in ([], ["nx", "ny", "nz"], ["normal_x", "normal_y", "normal_z"]):
        raise FormatError(f"the columns must be x y z or x y z nx ny nz, got {' '.join(names)[:80]}")


def write_xyz(cloud: RawCloud) -> bytes:
    """Return a text table of x y z (nx ny nz) with all digits of the precision."""
    table = cloud.points if cloud.normals is None else np.concatenate((cloud.points, cloud.normals), axis=-1)
    digits = 9 if table.dtype.itemsize <= 4 else 17
    row = " ".join([f"%.{digits}g"] * table.shape[1])
    return "".join(row % tuple(values) + "\n" for values in table.tolist()).encode("ascii")


# Characters of a number of a vertex.
_MAX_DIGITS = 12


def read_obj(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the vertices and faces of an OBJ file, in the file's order and numbering, without materials.

    Vertex colors after the coordinates are read, and normals if every vertex has exactly one, of its own number.
    Polygons are cut into fans.
    """
    content = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    vertices, normals, corners = list[bytes](), list[bytes](), list[bytes]()
    sizes, seen = list[int](), list[tuple[int, int]]()
    for line in content.replace(b"\t", b" ").splitlines():
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
    check_allowed(len(vertices), "points", limits)
    check_allowed(len(sizes), "faces", limits)
    table = parse_table(vertices, None, "vertex")
    if len(table) and table.shape[1] not in (3, 4, 6, 7):
        raise FormatError(f"a vertex must be 3 numbers (with w 4, with a color 6 or 7), got {table.shape[1]}")
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


def _resolve(words: list[bytes], before: Array, count: int, what: str) -> Array:
    """Return 0-based indices; negative numbers count back from the items before the line."""
    if not words:
        return np.zeros(0, dtype=np.int64)
    values = _whole_numbers(words)
    if values is None:
        values = as_indices(parse_table(words, 1, f"{what} index")[:, 0], f"{what} indices")
    indices = np.where(values < 0, before + values, values - 1)
    if np.any(values == 0) or np.any(indices < 0) or np.any(indices >= count):
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
