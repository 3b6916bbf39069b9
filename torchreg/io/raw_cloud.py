"""Unchecked numpy arrays of a file: the result of the readers of single formats.

Readers raise FormatError without the name of the file, which their callers add.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchreg.errors import FormatError

Array = NDArray[Any]


@dataclass(frozen=True)
class RawCloud:
    """Arrays of one file.

    Args:
        points: (N, 3) floating point, in the precision of the file.
        normals: (N, 3) or None.
        colors: (N, 3), integers over their full range or floats from 0 to 1, or None.
        faces: (F, 3) int64, 0-based, or None.
    """

    points: Array
    normals: Array | None = None
    colors: Array | None = None
    faces: Array | None = None


def parse_table(lines: Sequence[bytes], columns: int | None, what: str) -> Array:
    """Return lines of numbers as a float64 (rows, columns) table.

    Args:
        lines: non-blank lines.
        columns: numbers per line; None takes the number of the first line.
        what: name of a row, for messages.
    """
    if not lines:
        return np.zeros((0, columns or 0))
    if not all(line.strip() for line in lines):
        raise FormatError(f"each {what} must hold {columns or 'equally many'} numbers, got a blank row")
    try:
        table = np.loadtxt((line.decode("ascii") for line in lines), dtype=np.float64, comments=None, ndmin=2)
    except ValueError as error:  # also what is not ASCII
        raise FormatError(f"a {what} is not a row of {columns or 'equally many'} numbers ({error})") from error
    if len(table) != len(lines) or (columns is not None and table.shape[1] != columns):
        raise FormatError(f"each {what} must hold {columns} numbers, got {table.shape[1]}")
    return table


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


def stack_columns(columns: dict[str, Array], names: Sequence[str]) -> Array | None:
    """Return the named columns side by side in their common type, or None if one of them is missing."""
    if not all(name in columns for name in names):
        return None
    return np.stack([columns[name] for name in names], axis=-1)


# Polygons that are cut together.
_POLYGONS = 4096


def fan_triangles(counts: Array, indices: Array) -> Array:
    """Return the (F, 3) triangles of polygons, each cut as a fan from its first corner.

    Args:
        counts: (P,) corners of each polygon, int64.
        indices: (sum of counts,) vertex indices of all polygons, one after the other.
    """
    if counts.size and counts.min() < 3:
        raise FormatError(f"a face must have at least 3 corners, got {int(counts.min())}")
    ends = np.cumsum(counts - 2)
    result = np.empty((int(ends[-1]) if len(ends) else 0, 3), indices.dtype)
    # A part after the other, as numbers of corners take more memory than corners.
    for first in range(0, len(counts), _POLYGONS):
        part = counts[first : first + _POLYGONS]
        before = int(ends[first - 1]) if first else 0
        numbers = _fan_corners(part) + before + 2 * first
        result[before : before + len(numbers)] = indices[numbers]
    return result


def _fan_corners(counts: Array) -> Array:
    """Return the (F, 3) numbers of the corners of the triangles of polygons with counts (P,) of corners."""
    triangles = counts - 2
    start = np.repeat(np.cumsum(counts) - counts, triangles)
    step = np.arange(int(triangles.sum())) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack((start, start + step + 1, start + step + 2), axis=-1)
