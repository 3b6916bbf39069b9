"""Point clouds and meshes from files of any known format, and the counterpart that writes them."""

from __future__ import annotations

import os
import struct
import tokenize
import zipfile
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import all_finite, as_float_tensor, check_choice, check_finite, check_positive, check_shape
from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.geometry.far_origin import far_origin
from torchreg.geometry.mesh import TriangleMesh
from torchreg.io.atomic import write_atomic
from torchreg.io.clouds.cloud_formats import FORMATS
from torchreg.io.clouds.raw_cloud import Array, RawCloud, not_measured
from torchreg.io.file_format import FileFormat, choose, naming, unpacked, warn
from torchreg.io.gltf_file.glb import read_gltf
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, check_allowed, local_path, read_bytes

# Exceptions that struct, json, zipfile and numpy's text and header readers raise on damaged bytes.
PARSER_ERRORS = (
    ValueError, TypeError, LookupError, AttributeError, ArithmeticError, EOFError, MemoryError, RecursionError,
    NotImplementedError, RuntimeError, SyntaxError, OSError, struct.error, tokenize.TokenError, zipfile.BadZipFile,
    zlib.error,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with the normals, faces and colors of a file.

    Args:
        points: (N, 3) finite coordinates, float32 or float64.
        normals: (N, 3) or None.
        faces: (F, 3) int64 vertex indices or None.
        colors: (N, 3) red, green, blue from 0 to 1, or None.

    Raises:
        InputError: if shapes do not agree, a number is not finite or a face refers to a point that does not exist.
    """

    points: Tensor
    normals: Tensor | None = None
    faces: Tensor | None = None
    colors: Tensor | None = None

    def __post_init__(self) -> None:
        points = as_float_tensor(self.points, "points")
        check_shape(points, "points", ("N", 3))
        check_finite(points, "points")
        object.__setattr__(self, "points", points)
        for name in ("normals", "colors"):
            if getattr(self, name) is not None:
                values = as_float_tensor(getattr(self, name), name, like=points)
                check_shape(values, name, (points.shape[0], 3))
                check_finite(values, name)
                object.__setattr__(self, name, values)
        if self.faces is not None:
            object.__setattr__(self, "faces", TriangleMesh(points, self.faces).faces)

    def __len__(self) -> int:
        return self.points.shape[0]

    def to_mesh(self) -> TriangleMesh:
        """Return points and faces as a mesh; InputError if there are no faces."""
        if self.faces is None or self.faces.shape[0] == 0:
            raise InputError(f"the cloud of {len(self)} points has no faces, so it is not a mesh")
        return TriangleMesh(self.points, self.faces)


def load_points(
    path: str | os.PathLike[str],
    *,
    scale: float = 1.0,
    nan_policy: str = "raise",
    limits: FileLimits = DEFAULT_LIMITS,
    dtype: torch.dtype | None = None,
    time: float | None = None,
    frame: int | None = None,
) -> PointCloud:
    """Return the points of a file, with normals, faces and colors where it has them.

    The content decides on the format, or the ending where the content does not; ``torchreg formats`` lists the formats.
    Files may be packed by gzip. Points keep the order and the unit of the file. What cannot be used - normals that are
    not finite or zero, faces of two corners, colors of some vertices only, and points 0 0 0, where organized clouds and
    padded ones have nothing - is left out with a warning that counts it; a single point at the origin stays.

    Args:
        path: a local file; addresses are refused.
        scale: metres per unit of the file, or other units wanted; 0.001 for millimeters.
        nan_policy: ``"raise"`` refuses points that are not finite; ``"omit"`` drops them, those whose normals or colors
            are not finite, and the faces that use them.
        limits: bounds on size and counts, checked before memory is allocated.
        dtype: torch.float32 or torch.float64; None takes float32 unless the points lie so far from the origin, as in
            maps, that it would round them.
        time: seconds of the animation of a glTF file at which it is shown; None shows it at rest, as viewers do before
            they play it.
        frame: number of the keyframe of the animation of a glTF file, instead of ``time``.

    Returns:
        The cloud, on the CPU, at least one point.

    Raises:
        FileNotFoundError: if there is no such file.
        IsADirectoryError: if it is a folder.
        FormatError: if the file is damaged, cut off, too large, of unknown format, empty or not finite; names the file.
        InputError: if ``nan_policy`` is neither of the two, or ``scale`` is not positive.
        InputTypeError: if ``dtype`` is neither of the two.

    Warns:
        FileWarning: if part of the file was left out; names the file.
    """
    check_choice(nan_policy, "nan_policy", ("raise", "omit"))
    check_dtype(dtype)
    check_positive(scale, "scale")
    file = local_path(path)
    content = read_bytes(file, limits)
    with naming(file):
        content = unpacked(content, limits)
        kind = choose(FORMATS, content, file)
        try:
            with np.errstate(all="ignore"):  # overflowing numbers become infinite and are treated as such
                raw = kind.read(content, file, limits, **_clip(kind, time, frame))
                return checked_cloud(raw, scale, nan_policy, limits, dtype)
        except (FormatError, InputError):
            raise
        except PARSER_ERRORS as error:
            raise FormatError(f"cannot be read as {kind.name} ({type(error).__name__}: {error})") from error


def _clip(kind: FileFormat, time: float | None, frame: int | None) -> dict[str, Any]:
    """Return the options of a reader that choose a time; InputError if it has none."""
    given = {name: value for name, value in (("time", time), ("frame", frame)) if value is not None}
    if given and kind.read is not read_gltf:
        raise InputError(f"{' and '.join(given)} choose a moment of an animation, which {kind.name} files do not have")
    return given


def check_dtype(dtype: torch.dtype | None) -> None:
    """Raise InputTypeError unless a dtype is None or one that points are read in."""
    if dtype not in (None, torch.float32, torch.float64):
        raise InputTypeError(f"dtype must be torch.float32 or torch.float64, got {dtype}")


def load_mesh(
    path: str | os.PathLike[str],
    *,
    scale: float = 1.0,
    nan_policy: str = "raise",
    limits: FileLimits = DEFAULT_LIMITS,
    dtype: torch.dtype | None = None,
    time: float | None = None,
    frame: int | None = None,
) -> TriangleMesh:
    """Return the triangle mesh of a file; polygons are cut into triangles.

    Args:
        path: a local file; see ``load_points`` for the formats.
        scale: see ``load_points``.
        nan_policy: see ``load_points``.
        limits: see ``load_points``.
        dtype: see ``load_points``.
        time: see ``load_points``.
        frame: see ``load_points``.

    Returns:
        The mesh, on the CPU, at least one face.

    Raises:
        FormatError: if the file holds no faces, and as ``load_points``.
    """
    cloud = load_points(path, scale=scale, nan_policy=nan_policy, limits=limits, dtype=dtype, time=time, frame=frame)
    if cloud.faces is None or cloud.faces.shape[0] == 0:
        raise FormatError(f"{os.fspath(path)}: holds {len(cloud)} points but no faces; load_points reads it as a cloud")
    return cloud.to_mesh()


def checked_cloud(
    raw: RawCloud,
    scale: float,
    nan_policy: str,
    limits: FileLimits,
    dtype: torch.dtype | None,
    *,
    may_be_empty: bool = False,
) -> PointCloud:
    """Return the cloud of a file's arrays, see `load_points`; without any points only where it may be."""
    points = _rows(raw.points, "points", None)
    count = len(points)
    check_allowed(count, "points", limits)
    if count == 0 and not may_be_empty:
        raise FormatError("holds no points")
    normals = None if raw.normals is None else _rows(raw.normals, "normals", count)
    shares = None if raw.colors is None else _unit_colors(raw.colors)
    colors = None if shares is None else _rows(shares, "colors", count)
    faces = None if raw.faces is None else _face_rows(raw.faces, count, limits)
    measured = _measured_rows(points, faces)
    points, normals, colors, faces = _of_rows(measured, points, normals, colors, faces)
    points = points if scale == 1 else points.double() * scale
    dtype = dtype or needed_dtype(points)
    points = points.to(dtype)
    normals, colors = (None if values is None else values.to(dtype) for values in (normals, colors))
    finite = _finite_rows(points, [values for values in (normals, colors) if values is not None], nan_policy)
    if not finite.any() and not may_be_empty:
        raise FormatError(f"none of its {count} points is finite")
    points, normals, colors, faces = _of_rows(finite, points, normals, colors, faces)
    normals = None if normals is None else _usable_normals(normals, points, faces)
    if colors is not None and not bool(colors.isfinite().all()):
        damaged = int((~colors.isfinite()).any(-1).sum())
        warn(f"colors are left out: {damaged} of {len(colors)} are not finite")
        colors = None
    return PointCloud(points=points, normals=normals, faces=faces, colors=colors)


def _of_rows(
    kept: Tensor, points: Tensor, normals: Tensor | None, colors: Tensor | None, faces: Tensor | None
) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """Return the parts of a cloud at the rows (N,) that are kept, and the faces between these, renumbered."""
    if kept.all():
        return points, normals, colors, faces
    if faces is not None:
        faces = (torch.cumsum(kept, 0) - 1)[faces[kept[faces].all(dim=-1)]]
    normals, colors = (None if values is None else values[kept] for values in (normals, colors))
    return points[kept], normals, colors, faces


def _measured_rows(points: Tensor, faces: Tensor | None) -> Tensor:
    """Return which rows (N,) were measured: corners of faces, and all but 0 0 0; a single one may be the origin."""
    measured = points.any(dim=-1)
    if faces is not None and not measured.all():
        measured[faces.reshape(-1)] = True
    missing = len(points) - int(measured.sum())
    if missing < 2:
        return torch.ones_like(measured)
    if missing == len(points):
        raise FormatError(f"all of its {missing} points are 0 0 0: nothing was measured")
    warn(not_measured(missing, len(points)))
    return measured


def _finite_rows(points: Tensor, others: list[Tensor], nan_policy: str) -> Tensor:
    """Return which rows (N,) are finite, where they are omitted also in other values; raise where they are not."""
    tables = [points, *others] if nan_policy == "omit" else [points]
    finite = torch.ones(len(points), dtype=torch.bool)
    for values in tables:
        if not all_finite(values):
            finite &= torch.isfinite(values).all(dim=-1)
    bad = len(points) - int(finite.sum())
    if bad and nan_policy == "raise":
        raise FormatError(
            f"{bad} of {len(points)} points are not finite in {str(points.dtype).removeprefix('torch.')} (NaN, "
            f'infinity or overflow); nan_policy="omit" drops them'
        )
    return finite


def needed_dtype(points: Tensor) -> torch.dtype:
    """Return float64 where float32 would round points (N, 3), float64, by a noticeable share of their spread."""
    return torch.float32 if far_origin(points) is None else torch.float64


def _usable_normals(normals: Tensor, points: Tensor, faces: Tensor | None) -> Tensor | None:
    """Return normals (N, 3); those that have no direction come from the faces, or all are left out."""
    infinite, zero = ~normals.isfinite().all(-1), ~normals.any(-1)
    bad = infinite | zero
    if not bool(bad.any()):
        return normals
    counts = [f"{int(rows.sum())} of {len(normals)} normals are {what}" for rows, what in
              ((infinite, "not finite"), (zero, "of length zero")) if bool(rows.any())]  # fmt: skip
    if faces is not None and len(faces):
        computed = TriangleMesh(points, faces).vertex_normals()
        if bool(computed[bad].any(-1).all()):
            warn(f"{', '.join(counts)}; they are computed from the faces")
            return torch.where(bad.unsqueeze(-1), computed, normals)
    warn(f"normals are left out: {', '.join(counts)}")
    return None


def _rows(values: Array, what: str, count: int | None) -> Tensor:
    """Return numbers (N, 3) as float64, or float32 where they are that already."""
    if values.ndim != 2 or values.shape[1] != 3 or (count is not None and len(values) != count):
        raise FormatError(f"{what} must have shape ({count or 'N'}, 3), got {values.shape}")
    kind = np.float32 if values.dtype in (np.float32, np.float16) else np.float64
    with np.errstate(over="ignore"):  # what becomes infinite is counted
        return torch.from_numpy(np.array(values, dtype=kind))


def _unit_colors(colors: Array) -> Array | None:
    """Return colors from 0 to 1, by the range of the numbers if not bytes; None, with a warning, if they are none."""
    if colors.dtype == np.uint8:
        return colors / 255.0
    known = colors[np.isfinite(colors)] if colors.dtype.kind == "f" else colors
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    if low < 0 or high > 65535:
        warn(f"colors are left out: they run from {low:g} to {high:g}, not from 0 to 1 or 255")
        return None
    if colors.dtype.kind == "f" and high <= 1 + 1e-6:
        return np.clip(colors, 0.0, 1.0)
    return colors.astype(np.float64) / (255.0 if high <= 255 else 65535.0)


def _face_rows(faces: Array, count: int, limits: FileLimits) -> Tensor:
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise FormatError(f"faces must have shape (F, 3), got {faces.shape}")
    check_allowed(len(faces), "faces", limits)
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        wrong = int(faces.max() if faces.max() >= count else faces.min())
        raise FormatError(f"a face names vertex {wrong}, outside 0 to {count - 1}: the file is cut off or damaged")
    return torch.from_numpy(np.require(faces, np.int64, ["C", "W"]))


def save_points(
    path: str | os.PathLike[str], points: Any, normals: Any = None, colors: Any = None, *, faces: Any = None
) -> None:
    """Write points (N, 3), normals (N, 3), colors (N, 3) from 0 to 1 and faces (F, 3); whole or not at all.

    The path ends in .ply, .pcd, .xyz, .txt, .csv or .npz; colors are stored as bytes.
    """
    file = local_path(path)
    ending = file.suffix.lower()
    writable = {known: row for row in FORMATS if row.write is not None for known in row.endings}
    write = None if ending not in writable else writable[ending].write
    if write is None:
        raise FormatError(f"{file} has the ending {file.suffix!r}; points are written as {', '.join(writable)}")
    for name, value in (("colors", colors), ("faces", faces)):
        able = [known for known, row in writable.items() if name in row.written]
        if value is not None and ending not in able:
            raise InputError(f"{name} cannot be held by {ending}; use one of {', '.join(able)}")
    cloud = PointCloud(points, normals, faces, colors)
    if cloud.colors is not None and bool(((cloud.colors < 0) | (cloud.colors > 1)).any()):
        raise InputError("colors must lie between 0 and 1; divide bytes by 255")
    write_atomic(file, write(_to_raw(cloud)))


def _to_raw(cloud: PointCloud) -> RawCloud:
    """Return the arrays of a cloud as they are written."""
    dtype = torch.float64 if cloud.points.dtype == torch.float64 else torch.float32
    normals, colors, faces = cloud.normals, cloud.colors, cloud.faces
    return RawCloud(
        points=cloud.points.detach().cpu().to(dtype).numpy(),
        normals=None if normals is None else normals.detach().cpu().to(dtype).numpy(),
        colors=None if colors is None else (colors.detach().cpu().double() * 255).round().to(torch.uint8).numpy(),
        faces=None if faces is None else faces.cpu().numpy(),
    )
