"""NPY and NPZ: arrays and archives of numpy without pickled objects."""

from __future__ import annotations

import ast
import io
import math
import os
import zipfile
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

from torchreg.errors import FormatError, InputError
from torchreg.io.atomic import write_atomic
from torchreg.io.clouds.columns import cloud_of_columns
from torchreg.io.clouds.raw_cloud import Array, RawCloud, as_indices, fan_triangles
from torchreg.io.file_format import naming
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, check_allowed, local_path, open_zip, read_bytes

# First bytes of an array, and of an archive of arrays.
ARRAY_START, ARCHIVE_START = b"\x93NUMPY", b"PK\x03\x04"
# What arrays of points and of faces are called.
POINTS = ("points", "vertices", "verts", "v")
FACES = ("faces", "f", "triangles")


def read_npy(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the cloud of an array: (N, 3), or more columns as in a table of text, or (H, W, 3) row by row.

    A structured array is read by the names of its fields, x, y, z among them.
    """
    array = array_of(content, "the array")
    if array.dtype.names is not None:
        plain = [name for name in array.dtype.names if array.dtype[name].kind in "iuf" and not array.dtype[name].shape]
        columns = [array[name].reshape(-1).astype(np.float64) for name in plain]
        if not columns:
            raise FormatError("the array has no fields of numbers")
        check_allowed(len(columns[0]), "points", limits)
        return cloud_of_columns(np.stack(columns, axis=-1), plain)
    if array.ndim not in (2, 3) or array.shape[-1] < 3:
        raise FormatError(f"the array must have shape (N, 3) or more columns, got {array.shape}{_transposed(array)}")
    if array.ndim == 3 and array.shape[-1] != 3:
        raise FormatError(f"the array must have shape (N, 3), or (H, W, 3) for an organized cloud, got {array.shape}")
    rows = array.reshape(-1, array.shape[-1])
    check_allowed(len(rows), "points", limits)
    return _with_columns(rows)


def _transposed(array: Array) -> str:
    return "; transpose it" if array.ndim == 2 and array.shape[0] == 3 else ""


def _with_columns(rows: Array) -> RawCloud:
    """Return the cloud of rows (N, 3), which may have columns of normals and colors."""
    if rows.shape[1] == 3:
        return RawCloud(rows if rows.dtype.kind == "f" else rows.astype(np.float64))
    return cloud_of_columns(rows.astype(np.float64))


def array_of(content: bytes, what: str, kinds: str = "iufbV") -> Array:
    """Return the array in the bytes of a .npy file, of one of some kinds of dtype; structured ones are V."""
    stream = io.BytesIO(content)
    shape, fortran, dtype = read_npy_header(stream, what, kinds)
    held = len(content) - stream.tell()
    if any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != held:
        raise FormatError(
            f"{what} claims the shape {shape} of {dtype} but holds {held} bytes: it is cut off or damaged"
        )
    return np.frombuffer(content, dtype, offset=stream.tell()).reshape(shape, order="F" if fortran else "C")


def read_npz(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the cloud of an archive: the array of a name in `POINTS`, or the only (N, 3) array.

    ``normals``, ``colors`` and faces are read where present. Shapes are compared with the sizes of the members before
    memory is allocated; arrays of Python objects are refused.
    """
    with open_zip(content, limits) as archive:
        names = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
        named = [key for key in POINTS if key in names]
        key = named[0] if named else _only_points(archive, names)
        corners = next((name for name in FACES if name in names), "faces")
        wanted = [name for name in (key, "normals", "colors", corners) if name in names]
        arrays = {name: _member(archive, names[name]) for name in wanted}
    points = arrays[key]
    check_allowed(len(points) if points.ndim else 0, "points", limits)
    if points.ndim == 3 and points.shape[2] == 3:
        raise FormatError(f"{key} has the shape {points.shape}, several clouds; load_frames reads it as a sequence")
    cloud = _with_columns(points) if points.ndim == 2 and points.shape[1] > 3 else RawCloud(points)
    faces = arrays.get(corners)
    if faces is not None:
        check_allowed(len(faces) if faces.ndim else 0, "faces", limits)
        faces = triangles_of(faces)
    normals, colors = arrays.get("normals", cloud.normals), arrays.get("colors", cloud.colors)
    return RawCloud(cloud.points, normals, colors, faces)


def triangles_of(faces: Array) -> Array:
    """Return faces (F, K) as triangles (F, 3), polygons cut; what has another shape is checked with the points."""
    indices = as_indices(faces, "faces")
    if indices.ndim != 2 or indices.shape[1] <= 3:
        return indices
    return fan_triangles(np.full(len(indices), indices.shape[1]), indices.reshape(-1))


def _only_points(archive: zipfile.ZipFile, names: dict[str, str]) -> str:
    found = []
    for key, name in names.items():
        with archive.open(name) as stream:
            shape, _, dtype = read_npy_header(stream, f"member {name!r}", "iuf")
        if len(shape) == 2 and shape[1] == 3 and dtype.kind == "f":
            found.append(key)
    if len(found) != 1:
        raise FormatError(
            f"must hold an array 'points' of shape (N, 3), or one floating-point array of that shape; got "
            f"{', '.join(sorted(names)[:8]) or 'no arrays'}"
        )
    return found[0]


# Bytes of the length of a header, by the version of the format.
_LENGTHS = {(1, 0): 2, (2, 0): 4}
_MAX_HEADER = 10_000


def read_npy_header(stream: IO[bytes], what: str, kinds: str = "") -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, Fortran order and dtype, of one of some kinds if any, and leave the stream at the numbers."""
    head = stream.read(8)
    if len(head) < 8 or head[:6] != ARRAY_START:
        raise FormatError(f"{what} is no .npy file (it does not begin like one)")
    if (head[6], head[7]) not in _LENGTHS:
        raise FormatError(f"{what} has the unknown array format {head[6], head[7]}")
    size = int.from_bytes(stream.read(_LENGTHS[head[6], head[7]]), "little")
    text = stream.read(min(size, _MAX_HEADER))
    try:
        if len(text) < size:
            raise ValueError("its header is cut off or too long")
        header = ast.literal_eval(text.decode("latin-1").strip())
        shape, fortran, kind = header["shape"], header["fortran_order"], header["descr"]
        if not isinstance(shape, tuple) or not all(type(side) is int for side in shape) or len(header) != 3:
            raise ValueError(f"its shape is {shape!r:.80}")
        if not isinstance(fortran, bool) or not isinstance(kind, (str, list)):
            raise ValueError(f"its numbers are {kind!r:.80}")
        dtype = np.dtype([tuple(field) for field in kind] if isinstance(kind, list) else kind)
    except (ValueError, TypeError, LookupError, SyntaxError, RecursionError, MemoryError) as error:
        raise FormatError(f"{what} is no .npy file ({error})") from error
    if kinds and (dtype.hasobject or dtype.kind not in kinds or (dtype.kind == "V" and dtype.names is None)):
        wanted = "real numbers" if "f" in kinds else "truth values"
        raise FormatError(f"{what} must hold {wanted}, got {dtype}; pickled objects are never loaded")
    return shape, fortran, dtype


def _member(archive: zipfile.ZipFile, name: str) -> Array:
    return array_of(archive.read(name), f"member {name!r}", "iuf")


def load_arrays(
    path: str | os.PathLike[str], names: Sequence[str], *, limits: FileLimits = DEFAULT_LIMITS
) -> dict[str, Tensor]:
    """Return arrays of real numbers by name from an .npz file; all others in it are left alone."""
    file = local_path(path)
    content = read_bytes(file, limits)
    with naming(path), open_zip(content, limits) as archive:
        held = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
        lacking = [name for name in names if name not in held]
        if lacking:
            raise FormatError(f"lacks the array {lacking[0]!r}; it holds {', '.join(sorted(held)[:12]) or 'none'}")
        arrays = {name: _member(archive, held[name]) for name in names}
    return {name: torch.from_numpy(_signed(array)) for name, array in arrays.items()}


def _signed(array: Array) -> Array:
    """Return a copy of an array in a type that torch has."""
    return array.astype(np.int64 if array.dtype.kind in "iu" else array.dtype.newbyteorder("="))


def write_npz(cloud: RawCloud) -> bytes:
    """Return an archive with the arrays of a cloud."""
    arrays = {name: getattr(cloud, name) for name in ("points", "normals", "colors", "faces")}
    stream = io.BytesIO()
    np.savez(stream, **{name: array for name, array in arrays.items() if array is not None})
    return stream.getvalue()


def save_arrays(path: str | os.PathLike[str], arrays: Mapping[str, Tensor]) -> None:
    """Write tensors under their names to an .npz archive that numpy reads, whole or not at all."""
    file = local_path(path)
    if file.suffix.lower() != ".npz":
        raise InputError(f"path must end in .npz, got {file.name!r}; rename the output file")
    stream = io.BytesIO()
    plain: dict[str, Any] = {name: value.detach().cpu().numpy() for name, value in arrays.items()}
    np.savez(stream, **plain)
    write_atomic(file, stream.getvalue())
