"""What the columns of a table of points mean: by their names, or where there are none by the numbers in them."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchreg.errors import FileWarning, FormatError
from torchreg.io.clouds.raw_cloud import Array, RawCloud

# What x, y, z, normals and colors are called, without units and punctuation.
_NAMES: dict[str, tuple[tuple[str, ...], ...]] = {
    "points": (
        ("x", "y", "z"), ("points0", "points1", "points2"), ("posx", "posy", "posz"), ("px", "py", "pz"),
        ("xcoord", "ycoord", "zcoord"), ("xcoordinate", "ycoordinate", "zcoordinate"), ("coordx", "coordy", "coordz"),
        ("positionx", "positiony", "positionz"), ("easting", "northing", "elevation"),
        ("easting", "northing", "height"), ("easting", "northing", "altitude"), ("easting", "northing", "z"),
        ("0", "1", "2"),
    ),
    "normals": (
        ("nx", "ny", "nz"), ("normalx", "normaly", "normalz"), ("normals0", "normals1", "normals2"),
        ("normal0", "normal1", "normal2"), ("xnormal", "ynormal", "znormal"),
    ),
    "colors": (
        ("r", "g", "b"), ("red", "green", "blue"), ("rgb0", "rgb1", "rgb2"), ("colorr", "colorg", "colorb"),
        ("diffusered", "diffusegreen", "diffuseblue"), ("rf", "gf", "bf"),
    ),
}  # fmt: skip
_DECIMAL_COMMA = re.compile(rb"[+-]?\d*,\d+([eE][+-]?\d+)?|[+-]?\d+([eE][+-]?\d+)?|[+-]?nan")
_UNIT = re.compile(r"[\[(][^\])]*[\])]|_(m|mm|cm)$")


@dataclass(frozen=True)
class _Evidence:
    """Thresholds by which columns without names are recognized."""

    unit_length: float = 0.02  # of normals, from one: they are often written with two digits
    share: float = 0.99  # of rows that must agree; a few may be damaged


_EVIDENCE = _Evidence()


def column_name(name: str) -> str:
    """Return a column's name as it is compared: lower case, without quotes, unit and punctuation."""
    return re.sub(r"[^a-z0-9]", "", _UNIT.sub("", name.strip().strip("\"'").strip().lower()))


def named_columns(names: Sequence[str], kind: str) -> list[int] | None:
    """Return the numbers of three columns among named ones: those of "points", "normals" or "colors"; None without."""
    plain = [column_name(name) for name in names]
    found = next((triple for triple in _NAMES[kind] if all(name in plain for name in triple)), None)
    return None if found is None else [plain.index(name) for name in found]


def stack_named(columns: Mapping[str, Array], kind: str) -> Array | None:
    """Return the columns (N, 3) of a kind, see `named_columns`, among those of a file; None without."""
    found, names = named_columns(list(columns), kind), list(columns)
    return None if found is None else np.stack([columns[names[k]] for k in found], axis=-1)


def have_decimal_commas(fields: Iterable[bytes]) -> bool:
    """Return whether all fields of a table are numbers, whole ones or with decimals behind a comma."""
    return all(_DECIMAL_COMMA.fullmatch(field) for field in fields)


def names_points(names: Sequence[str]) -> bool:
    """Return whether the names of columns say where x, y and z are."""
    return named_columns(names, "points") is not None


def wanted_columns(names: Sequence[str]) -> list[int]:
    """Return the numbers of the columns, among named ones, that a cloud is made of."""
    return [column for kind in _NAMES for column in named_columns(names, kind) or ()]


def cloud_of_columns(table: Array, names: Sequence[str] | None = None, *, intensity_first: bool = False) -> RawCloud:
    """Return the cloud in a table (N, C): x y z and, where they are there, normals and colors.

    Without names x y z come first; unit vectors are normals, whole numbers up to 255 (or 65535) or numbers from 0 to 1
    colors. An intensity may stand before colors where both orders are possible, as in .pts files.
    """
    if names is not None:
        where = {kind: named_columns(names, kind) for kind in _NAMES}
        if where["points"] is None:
            raise FormatError(
                f"the columns must name x, y and z, got {' '.join(names)[:80]}; rename three of them, or remove the "
                f"line of names if x y z come first"
            )
    else:
        if len(table) and table.shape[1] < 3:
            raise FormatError(f"a point must be a row of 3 numbers or more (x y z first), got {table.shape[1]}")
        where = {"points": [0, 1, 2], **_guessed(table, intensity_first)}
        table = table if len(table) else np.zeros((0, 3))
    parts = {kind: None if columns is None else table[:, columns] for kind, columns in where.items()}
    points, colors = parts["points"], parts["colors"]
    if points is None:
        raise FormatError("holds no columns x, y and z")
    return RawCloud(points.reshape(-1, 3), parts["normals"], None if colors is None else typed_colors(colors))


def _guessed(table: Array, intensity_first: bool) -> dict[str, list[int] | None]:
    """Return the columns of normals and of colors behind x y z, recognized by their numbers."""
    width = table.shape[1] if len(table) else 0
    begins = range(3, width - 2)
    normals = next((k for k in begins if are_normals(table[:, k : k + 3])), None)
    order = reversed(begins) if intensity_first else begins
    taken = set() if normals is None else {normals, normals + 1, normals + 2}
    colors = next((k for k in order if not taken & {k, k + 1, k + 2} and _are_colors(table[:, k : k + 3])), None)
    if width == 6 and normals is None and colors is None:
        low, high = (float(f(table[:, 3:], initial=0.0, where=np.isfinite(table[:, 3:]))) for f in (np.min, np.max))
        warnings.warn(
            f"columns 4 to 6 are left out: numbers from {low:g} to {high:g} are neither unit normals nor colors; name "
            f"the columns in a first line, as in 'x y z nx ny nz', if they are",
            FileWarning,
            stacklevel=2,
        )
    found = {"normals": normals, "colors": colors}
    return {kind: None if k is None else [k, k + 1, k + 2] for kind, k in found.items()}


def are_normals(columns: Array) -> bool:
    """Return whether nearly all rows (N, 3) that are finite and not zero are of length one."""
    length = np.linalg.norm(columns, axis=-1)
    directed = np.isfinite(length) & (length > 0)
    unit = np.abs(length - 1) < _EVIDENCE.unit_length
    return bool(directed.any() and (unit & directed).sum() >= _EVIDENCE.share * directed.sum())


def _are_colors(columns: Array) -> bool:
    """Return whether all numbers (N, 3) are from 0 to 1, or whole ones up to 65535."""
    finite = columns[np.isfinite(columns)]
    if not finite.size or finite.min() < 0:
        return False
    return bool(finite.max() <= 1 or (finite.max() <= 65535 and np.all(finite == np.floor(finite))))


def typed_colors(colors: Array) -> Array:
    """Return colors read as text in the integer type that they were written in; fractions of one stay."""
    known = np.isfinite(colors)
    largest = colors.max(initial=0.0, where=known)
    whole = bool(known.all() and np.all(colors == np.floor(colors)))
    # A picture that is all 0 and 1 is black, or one of fractions: the latter is more frequent.
    if not whole or largest <= 1 or largest > 65535 or colors.min(initial=0.0) < 0:
        return colors
    return colors.astype(np.uint8 if largest <= 255 else np.uint16)
