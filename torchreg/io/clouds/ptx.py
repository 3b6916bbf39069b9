"""PTX: scans of laser scanners as text, one after the other, each on its grid and with its registered place."""

from __future__ import annotations

import re

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.clouds.columns import typed_colors
from torchreg.io.clouds.raw_cloud import Array, RawCloud, not_measured, parse_numbers
from torchreg.io.file_format import plain_text, warn
from torchreg.io.limits import FILE_BUDGET, FileLimits, check_allowed, check_budget

_NUMBER = rb"[-+.\deE]{1,40}"
# Columns and rows of the grid, place and axes of the scanner (4 x 3), and its motion (4 x 4).
_HEAD = re.compile(
    rb"\s*(\d{1,12})[ \t]*\n\s*(\d{1,12})[ \t]*\n"
    + rb"".join(rb"[ \t]*" + rb"[ \t]+".join([_NUMBER] * width) + rb"[ \t]*\n" for width in (3,) * 4)
    + rb"((?:[ \t]*"
    + rb"[ \t]+".join([_NUMBER] * 4)
    + rb"[ \t]*\n){4})"
)
_WORD = re.compile(rb"\S")
# Numbers of a point: with intensity, with colors, with both.
_WIDTHS = (3, 4, 6, 7)


def is_ptx(content: bytes) -> bool:
    """Return whether content begins with the head of a scan."""
    return _HEAD.match(_lines(content[:4096])) is not None


def read_ptx(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the points of all scans, moved to their places; those at the scanner, 0 0 0, were not measured."""
    text = _lines(content)
    check_allowed(text.count(b"\n"), "points", limits)
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n")) + 1
    points, colors, position, before, count = list[Array](), list[Array | None](), 0, 0, 0
    while _WORD.search(text, position):
        head = _HEAD.match(text, position)
        if head is None:
            raise FormatError(
                f"line {before + 1} must begin a scan: columns, rows, place and axes of the scanner (4 x 3), its "
                f"motion (4 x 4), each row on a line of its own; the file is cut off or damaged"
            )
        check_budget(len(points) + 1, FILE_BUDGET.scans, "scans")
        size = int(head[1]) * int(head[2])
        check_allowed(count + size, "points", limits)
        before, count = before + head.group().count(b"\n"), count + size
        position = int(ends[min(before + size, len(ends)) - 1])
        table = _points(text[head.end() : position], size, before)
        measured = table[table[:, :3].any(axis=1)]
        points.append(_moved(measured[:, :3], np.array(head[3].split(), dtype=np.float64).reshape(4, 4)))
        colors.append(measured[:, -3:] if table.shape[1] in (6, 7) else None)
        before += size
    return _cloud(points, colors, count)


def _points(text: bytes, size: int, before: int) -> Array:
    """Return the numbers (size, C) of the points of a scan."""
    table = parse_numbers(text, None, "point", before=before)
    if len(table) != size or (size and table.shape[1] not in _WIDTHS):
        raise FormatError(
            f"a scan's head says {size} points, each of {', '.join(map(str, _WIDTHS))} numbers; it holds {len(table)} "
            f"of {table.shape[1]}: it is cut off or damaged"
        )
    return table if size else np.zeros((0, 3))


def _lines(content: bytes) -> bytes:
    """Return text whose lines end by one character, also the last one."""
    return plain_text(content).replace(b"\r\n", b"\n").replace(b"\r", b"\n") + b"\n"


def _moved(points: Array, motion: Array) -> Array:
    """Return points (N, 3) moved by a motion (4, 4) of rows, as the format has it, or of columns, as some write it."""
    last = [0.0, 0.0, 0.0, 1.0]
    if motion[:, 3].tolist() != last and motion[3].tolist() == last:
        motion = motion.T
    if motion[:, 3].tolist() != last or not np.isfinite(motion).all():
        raise FormatError(f"the motion of a scan must end in 0 0 0 1, got {motion[:, 3].tolist()}")
    with np.errstate(all="ignore"):  # what is not finite is judged with the points
        return points @ motion[:3, :3] + motion[3, :3]


def _cloud(points: list[Array], colors: list[Array | None], count: int) -> RawCloud:
    """Return the scans as one cloud; colors only where all have them."""
    found = np.concatenate(points) if points else np.zeros((0, 3))
    if count and not len(found):
        raise FormatError(f"all of its {count} points are 0 0 0: nothing was measured")
    if len(found) < count:
        warn(not_measured(count - len(found), count))
    known = [values for values in colors if values is not None]
    if not known or len(known) < len(colors):
        if known:
            warn(f"colors are left out: {len(known)} of {len(colors)} scans have them")
        return RawCloud(found)
    return RawCloud(found, colors=typed_colors(np.concatenate(known)))
