"""Unchecked numpy arrays of a file: the result of the readers of single formats.

Readers raise FormatError without the name of the file, which their callers add.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchreg.errors import FormatError
from torchreg.io.file_format import warn

Array = NDArray[Any]


@dataclass(frozen=True)
class RawCloud:
    """Arrays of one file."""

    points: Array  # (N, 3) floating point, in the precision of the file
    normals: Array | None = None  # (N, 3) or None
    colors: Array | None = None  # (N, 3), integers over their full range or floats from 0 to 1, or None
    faces: Array | None = None  # (F, 3) int64, 0-based, or None


def not_measured(missing: int, count: int, where: str = "") -> str:
    """Return the sentence about rows that are left out, as depth cameras and padding leave them."""
    return f"{missing} of {count} points{where} are 0 0 0, where nothing was measured; they are left out"


def parse_table(lines: Sequence[bytes], columns: int | None, what: str) -> Array:
    """Return lines of numbers as a float64 (rows, columns) table, by default as wide as the first line."""
    if not lines:
        return np.zeros((0, columns or 0))
    if not all(line.strip() for line in lines):
        raise FormatError(f"each {what} must hold {columns or 'equally many'} numbers, got a blank row")
    return parse_numbers(b"\n".join(lines), columns, what, unit="row")


def parse_numbers(text: bytes, columns: int | None, what: str, *, unit: str = "line", before: int = 0) -> Array:
    """Return the numbers of a text, one row a line, as a float64 (rows, columns) table; blank lines are passed over."""
    counts = _counts(text)
    rows = counts.nonzero()[0]
    if not len(rows):
        return np.zeros((0, columns or 0))
    width = int(columns or counts[rows[0]])
    uneven = rows[counts[rows] != width]
    if columns and len(uneven) == len(rows) and len(set(counts[rows])) == 1:
        raise FormatError(f"each {what} must hold {columns} numbers, got {counts[rows[0]]}")
    if len(uneven):
        number = int(uneven[0])
        line = _shown(text.split(b"\n", number + 1)[number])
        raise FormatError(
            f"a {what} is not a row of {columns or 'equally many'} numbers: {unit} {before + number + 1} holds "
            f"{counts[number]} ({line!r}), {'they must be' if columns else 'the first row'} {width}"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # older numpy only warns of text that is no number
        try:
            values = np.fromstring(text, sep=" ") if text.isascii() else np.zeros(0)
        except (ValueError, DeprecationWarning):
            values = np.zeros(0)
    if len(values) != width * len(rows):
        raise _no_number(text, what, columns, unit, before)
    return values.reshape(-1, width)


def _counts(text: bytes) -> Array:
    """Return the number of words in every line."""
    letters = np.frombuffer(text + b"\n", np.uint8)
    blank = letters <= 32
    starts = ~blank
    starts[1:] &= blank[:-1]
    before = np.searchsorted(np.flatnonzero(starts), np.flatnonzero(letters == 10))
    return np.diff(before, prepend=0)


def _no_number(text: bytes, what: str, columns: int | None, unit: str, before: int) -> FormatError:
    """Return the error that names the first word that is no number."""
    row = f"a {what} is not a row of {columns or 'equally many'} numbers"
    for number, line in enumerate(text.split(b"\n"), start=before + 1):
        for word in line.split():
            try:
                float(word)
            except ValueError:
                return FormatError(f"{row}: {unit} {number} holds {_shown(word)!r}")
    return FormatError(f"{row}: a word in it is no number")


def _shown(line: bytes) -> str:
    return line.strip().decode("utf-8", "replace")[:60]


def as_indices(values: Array, what: str) -> Array:
    """Return numbers read as text or in any integer type as int64; FormatError unless they are whole and in range."""
    if values.dtype.kind == "f":
        if not np.all(np.isfinite(values)) or np.any(values != np.floor(values)):
            raise FormatError(f"{what} must be whole numbers")
    elif values.dtype.kind not in "iu":
        raise FormatError(f"{what} must be whole numbers, got {values.dtype}")
    exact = 2 / np.finfo(np.float64).eps  # beyond this, float64 does not hold every integer
    if values.size and (values.max() >= exact or values.min() <= -exact):
        raise FormatError(f"{what} are out of range")
    return values.astype(np.int64)


def as_integers(values: Array, kind: str, what: str) -> Array:
    """Return whole numbers read as text in the integer type ``kind``; FormatError unless they fit."""
    integers, bounds = as_indices(values, what), np.iinfo(kind)
    if integers.size and (integers.min() < bounds.min or integers.max() > bounds.max):
        raise FormatError(f"{what} must lie between {bounds.min} and {bounds.max}")
    return integers.astype(kind)


# Polygons that are cut together.
_POLYGONS = 4096


def fan_triangles(counts: Array, indices: Array) -> Array:
    """Return the (F, 3) triangles of polygons of ``counts`` (P,) corners, cut as fans; warn of those of under 3."""
    small = int(np.count_nonzero(counts < 3))
    if small:
        warn(f"{small} of {len(counts)} faces are left out: they have fewer than 3 corners")
    before = start = 0
    result = np.empty((int(np.maximum(counts - 2, 0).sum()), 3), indices.dtype)
    # A part after the other, as numbers of corners take more memory than corners.
    for first in range(0, len(counts), _POLYGONS):
        part = counts[first : first + _POLYGONS]
        count = _fill_fans(result[before:], part, indices[start:])
        before, start = before + count, start + int(part.sum())
    return result


def strip_triangles(counts: Array, indices: Array) -> Array:
    """Return the (F, 3) triangles of lists of ``counts`` (S,) entries, where -1 begins a strip; flat ones go."""
    number = np.arange(len(indices))
    begins = np.isin(number, np.cumsum(counts) - counts)
    begins[1:] |= indices[:-1] < 0
    start = np.maximum.accumulate(np.where(begins, number, 0))
    corners = np.stack([indices[k : max(len(indices) - 2 + k, 0)] for k in range(3)], axis=-1)
    a, b, c = corners.T
    first = number[: len(corners)]
    whole = (corners >= 0).all(axis=1) & (start[: len(corners)] == start[2:]) & (a != b) & (b != c) & (c != a)
    odd = ((first - start[: len(corners)]) % 2 == 1)[:, None]
    return np.where(odd, corners[:, [1, 0, 2]], corners)[whole]


def _fill_fans(triangles: Array, counts: Array, indices: Array) -> int:
    """Fill the first triangles (F, 3) with those of polygons with counts (P,) of corners; return how many these are."""
    per_polygon = np.maximum(counts - 2, 0)
    total = int(per_polygon.sum())
    corner = np.repeat(np.cumsum(counts) - counts, per_polygon)
    triangles[:total, 0] = indices[corner]
    # A column after the other, and in place: triangles of a large polygon take enough memory by themselves.
    corner += np.arange(total)
    corner -= np.repeat(np.cumsum(per_polygon) - per_polygon, per_polygon)
    for column in (1, 2):
        corner += 1
        triangles[:total, column] = indices[corner]
    return total
