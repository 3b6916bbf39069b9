"""Point clouds and meshes from files of any known format, and the counterpart that writes them."""

from __future__ import annotations

import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_finite, check_shape
from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.io.atomic import write_atomic
from torchreg.io.glb import read_gltf
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, check_allowed, local_path, read_bytes
from torchreg.io.npz import read_npz, write_npz
from torchreg.io.pcd import read_pcd, write_pcd
from torchreg.io.ply import read_ply, write_ply
from torchreg.io.raw_cloud import Array, RawCloud
from torchreg.io.stl import read_stl
from torchreg.io.text_formats import read_obj, read_xyz, write_xyz

# Exceptions that struct, json, zipfile and numpy's text and header readers raise on damaged bytes.
PARSER_ERRORS = (
    ValueError, TypeError, LookupError, AttributeError, ArithmeticError, EOFError, MemoryError, RecursionError,
    NotImplementedError, RuntimeError, SyntaxError, OSError, struct.error, tokenize.TokenError, zipfile.BadZipFile,
    zlib.error,
)  # fmt: skip

Reader = Callable[[bytes, Path, FileLimits], RawCloud]


@dataclass(frozen=True)
class CloudFormat:
    """A file format of clouds and meshes.

    Args:
        read: the content of a file; the path is that of files beside it.
        write: a cloud; None for formats that are read only.
        colors: whether `write` keeps them.
        faces: whether `write` keeps them.
    """

    read: Reader
    write: Callable[[RawCloud], bytes] | None = None
    colors: bool = False
    faces: bool = False


def _from_content(read: Callable[[bytes, FileLimits], RawCloud]) -> Reader:
    """Return a reader that needs no path."""
    return lambda content, _, limits: read(content, limits)


# By ending. A new format is one more row.
FORMATS = {
    ".ply": CloudFormat(_from_content(read_ply), write_ply, colors=True, faces=True),
    ".pcd": CloudFormat(_from_content(read_pcd), write_pcd, colors=True),
    ".xyz": CloudFormat(_from_content(read_xyz), write_xyz),
    ".txt": CloudFormat(_from_content(read_xyz), write_xyz),
    ".obj": CloudFormat(_from_content(read_obj)),
    ".stl": CloudFormat(_from_content(read_stl)),
    ".npz": CloudFormat(_from_content(read_npz), write_npz, colors=True, faces=True),
    ".glb": CloudFormat(read_gltf),
    ".gltf": CloudFormat(read_gltf),
}


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
    nan_policy: str = "raise",
    limits: FileLimits = DEFAULT_LIMITS,
    dtype: torch.dtype = torch.float32,
) -> PointCloud:
    """Return the points of a file, with normals, faces and colors where it has them.

    Formats, by the ending: PLY (ASCII, binary of both byte orders), PCD (ASCII, binary, binary_compressed), XYZ and TXT
    (x y z, or x y z nx ny nz), OBJ, STL (corners at one position become one vertex), GLB and glTF (default scene, world
    coordinates, bind pose) and NPZ (array ``points`` or the only (N, 3) array). Points keep the order and the unit of
    the file.

    Args:
        path: a local file; addresses are refused.
        nan_policy: ``"raise"`` refuses non-finite numbers; ``"omit"`` drops the points that have any, also in normals
            or colors, and the faces that use them.
        limits: bounds on size and counts, checked before memory is allocated.
        dtype: torch.float32 or torch.float64; double properties keep their full precision in the latter.

    Returns:
        The cloud, on the CPU, at least one point.

    Raises:
        FileNotFoundError: if there is no such file.
        IsADirectoryError: if it is a folder.
        FormatError: if the file is damaged, cut off, too large, of unknown format, empty or not finite; names the file.
        InputError: if ``nan_policy`` is neither of the two.
        InputTypeError: if ``dtype`` is neither of the two.
    """
    check_choice(nan_policy, "nan_policy", ("raise", "omit"))
    if dtype not in (torch.float32, torch.float64):
        raise InputTypeError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
    file = local_path(path)
    kind = FORMATS.get(file.suffix.lower())
    if kind is None:
        file.stat()  # a missing file is reported first
        raise FormatError(f"{file} has the unknown ending {file.suffix!r}; known: {', '.join(FORMATS)}")
    content = read_bytes(file, limits)
    try:
        with np.errstate(all="ignore"):  # overflowing numbers become infinite and are treated as such
            return _checked_cloud(kind.read(content, file, limits), nan_policy, limits, dtype)
    except FormatError as error:
        raise FormatError(f"{file}: {error}") from error
    except PARSER_ERRORS as error:
        name = file.suffix[1:].upper()
        raise FormatError(f"{file}: cannot be read as {name} ({type(error).__name__}: {error})") from error


def load_mesh(
    path: str | os.PathLike[str],
    *,
    nan_policy: str = "raise",
    limits: FileLimits = DEFAULT_LIMITS,
    dtype: torch.dtype = torch.float32,
) -> TriangleMesh:
    """Return the triangle mesh of a file; polygons are cut into triangles.

    Args:
        path: a local file; see ``load_points`` for the formats.
        nan_policy: see ``load_points``.
        limits: see ``load_points``.
        dtype: see ``load_points``.

    Returns:
        The mesh, on the CPU, at least one face.

    Raises:
        FormatError: if the file holds no faces, and as ``load_points``.
    """
    cloud = load_points(path, nan_policy=nan_policy, limits=limits, dtype=dtype)
    if cloud.faces is None or cloud.faces.shape[0] == 0:
        raise FormatError(f"{os.fspath(path)}: holds {len(cloud)} points but no faces; load_points reads it as a cloud")
    return cloud.to_mesh()


def _checked_cloud(raw: RawCloud, nan_policy: str, limits: FileLimits, dtype: torch.dtype) -> PointCloud:
    points = _rows(raw.points, "points", None, dtype)
    count = len(points)
    check_allowed(count, "points", limits)
    if count == 0:
        raise FormatError("holds no points")
    normals = None if raw.normals is None else _rows(raw.normals, "normals", count, dtype)
    colors = None if raw.colors is None else _rows(_to_unit_range(raw.colors), "colors", count, dtype)
    faces = None if raw.faces is None else _face_rows(raw.faces, count, limits)
    finite = torch.ones(count, dtype=torch.bool)
    for values in (points, normals, colors):
        if values is not None:
            finite &= torch.isfinite(values).all(dim=-1)
    bad = count - int(finite.sum())
    if bad and nan_policy == "raise":
        raise FormatError(
            f"{bad} of {count} points are not finite in {str(dtype).removeprefix('torch.')} (NaN, infinity or "
            f'overflow); nan_policy="omit" drops them'
        )
    if bad == count:
        raise FormatError(f"none of its {count} points is finite")
    if bad:
        faces = None if faces is None else (torch.cumsum(finite, 0) - 1)[faces[finite[faces].all(dim=-1)]]
        points = points[finite]
        normals, colors = (None if values is None else values[finite] for values in (normals, colors))
    return PointCloud(points=points, normals=normals, faces=faces, colors=colors)


def _rows(values: Array, what: str, count: int | None, dtype: torch.dtype) -> Tensor:
    if values.ndim != 2 or values.shape[1] != 3 or (count is not None and len(values) != count):
        raise FormatError(f"{what} must have shape ({count or 'N'}, 3), got {values.shape}")
    with np.errstate(over="ignore"):  # what becomes infinite is counted
        return torch.from_numpy(np.array(values, dtype=np.float64 if dtype == torch.float64 else np.float32))


def _to_unit_range(colors: Array) -> Array:
    return colors if colors.dtype.kind == "f" else colors.astype(np.float64) / np.iinfo(colors.dtype).max


def _face_rows(faces: Array, count: int, limits: FileLimits) -> Tensor:
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise FormatError(f"faces must have shape (F, 3), got {faces.shape}")
    check_allowed(len(faces), "faces", limits)
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        wrong = int(faces.max() if faces.max() >= count else faces.min())
        raise FormatError(f"a face names vertex {wrong}, outside 0 to {count - 1}: the file is cut off or damaged")
    return torch.from_numpy(np.require(faces, np.int64, ["C", "W"]))


def save_points(
    path: str | os.PathLike[str],
    points: Any,
    normals: Any = None,
    colors: Any = None,
    *,
    faces: Any = None,
) -> None:
    """Write a point cloud; the file appears whole or not at all.

    Args:
        path: a local file ending in .ply, .pcd, .xyz, .txt or .npz; an existing file is replaced.
        points: (N, 3) finite coordinates; their precision is kept.
        normals: (N, 3) or None.
        colors: (N, 3) red, green, blue from 0 to 1, or None (.ply, .pcd, .npz); stored as bytes.
        faces: (F, 3) vertex indices or None (.ply, .npz).

    Raises:
        FormatError: if the path is an address or its ending is none of these.
        InputError: if shapes do not agree, numbers are not finite or the format cannot hold colors or faces.
        FileNotFoundError: if the folder does not exist.
    """
    file = local_path(path)
    ending = file.suffix.lower()
    writable = {known: kind for known, kind in FORMATS.items() if kind.write is not None}
    write = None if ending not in writable else writable[ending].write
    if write is None:
        raise FormatError(f"{file} has the ending {file.suffix!r}; points are written as {', '.join(writable)}")
    for name, value in (("colors", colors), ("faces", faces)):
        able = [known for known, kind in writable.items() if getattr(kind, name)]
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
