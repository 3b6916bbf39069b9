"""Sequences of clouds: many files, a folder of them or one archive, read frame by frame; and their counterpart."""

from __future__ import annotations

import hashlib
import io
import math
import os
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_finite, check_positive, check_shape
from torchreg.errors import FileWarning, FormatError, InputError, InputTypeError
from torchreg.io.atomic import write_atomic
from torchreg.io.file_format import check_stand_in, ending_of
from torchreg.io.limits import (
    DEFAULT_LIMITS,
    FILE_BUDGET,
    FileLimits,
    check_allowed,
    check_budget,
    local_path,
    open_zip,
    read_bytes,
)
from torchreg.io.npz import array_of, read_npy_header
from torchreg.io.points import ENDINGS, PARSER_ERRORS, check_dtype, load_points, needed_dtype, save_points
from torchreg.io.raw_cloud import Array, as_indices

# A number in a name: with a decimal point, or a sign that is no hyphen between words.
_NUMBER = re.compile(r"((?:(?<![^\W_])-)?\d+(?:\.\d+)*)")
# Beside meshes and clouds in one folder, files of these endings tell of them: times, poses, notes.
_NOTES = (".csv", ".txt", ".dat", ".tsv", ".npy", ".asc")
_NUMBERED = re.compile(r"frame_?(\d+)")
_ARRAY = b"\x93NUMPY"
PathLike = str | os.PathLike[str]


class Frames(Sequence[Tensor]):
    """Clouds in the order of time, each read on request, and not kept.

    Indexing and iterating give (M, 3) tensors on the CPU, a slice gives `Frames` again. M may be zero in archives.
    Reading raises what `load_points` raises; every message names the file, and in an archive the frame. Made by
    `load_frames`.

    Args:
        names: of the frames: the path of its file, in an archive also its number.
        sources: per frame the path of its file, or its rows (M, 3).
        nan_policy: see `load_points`.
        limits: see `load_points`.
        dtype: of the tensors.
        scale: see `load_points`.
    """

    def __init__(
        self, names: Sequence[str], sources: Sequence[Path | Array], nan_policy: str, limits: FileLimits,
        dtype: torch.dtype | None, scale: float = 1.0,
    ) -> None:  # fmt: skip
        self.names, self._scale = tuple(names), scale
        self._sources, self._nan_policy, self._limits, self._dtype = tuple(sources), nan_policy, limits, dtype

    def __len__(self) -> int:
        return len(self._sources)

    @overload
    def __getitem__(self, index: int) -> Tensor: ...

    @overload
    def __getitem__(self, index: slice) -> Frames: ...

    def __getitem__(self, index: int | slice) -> Tensor | Frames:
        if isinstance(index, slice):
            sources = self._sources[index]
            return Frames(self.names[index], sources, self._nan_policy, self._limits, self._dtype, self._scale)
        source = self._sources[index]
        if isinstance(source, Path):
            options = {"nan_policy": self._nan_policy, "limits": self._limits, "dtype": self._dtype}
            return load_points(source, scale=self._scale, **options).points  # type: ignore[arg-type]
        return self._rows(self.names[index], source)

    def __iter__(self) -> Iterator[Tensor]:
        return (self[index] for index in range(len(self)))

    def fingerprint(self, index: int) -> str:
        """Return a digest of what a frame holds now; empty if its file cannot be read."""
        source = self._sources[index]
        return file_fingerprint(source) if isinstance(source, Path) else _digest(np.ascontiguousarray(source).tobytes())

    def _rows(self, name: str, rows: Array) -> Tensor:
        with np.errstate(all="ignore"):  # what overflows becomes infinite and is judged as that
            points = torch.from_numpy(rows.astype(np.float64)) * self._scale
            points = points.to(self._dtype or needed_dtype(points))
        finite = torch.isfinite(points).all(dim=-1)
        bad = len(points) - int(finite.sum())
        if bad and self._nan_policy == "raise":
            raise FormatError(f'{name}: {bad} of {len(points)} points are not finite; nan_policy="omit" drops them')
        return points[finite] if bad else points


def load_frames(
    path: PathLike | Sequence[PathLike],
    *,
    sort: bool = True,
    scale: float = 1.0,
    nan_policy: str = "raise",
    limits: FileLimits = DEFAULT_LIMITS,
    dtype: torch.dtype | None = None,
) -> Frames:
    """Return the clouds of a sequence, read one by one on request.

    Args:
        path: a folder whose files are frames, all of one format; a list of files; one file; one NPY of shape
            (T, M, 3); or one NPZ of frames: an array ``points`` (or ``vertices``, or the only one of three dimensions)
            of shape (T, M, 3), with ``counts`` (T,), the rows of each frame that count, or ``mask`` (T, M), or neither;
            or T arrays (M, 3) called ``frame_0``, ``frame_1``, ... An archive is read at once, the rest is not.
        sort: order files by their paths with numbers counted as numbers, so that frame2 comes before frame10, as they
            rarely do where a shell wrote the list. False keeps the order of a list.
        scale: see `load_points`.
        nan_policy: see `load_points`.
        limits: see `load_points`; they hold for every file and frame.
        dtype: see `load_points`; None decides frame by frame.

    Returns:
        The sequence, at least one frame; points keep the order and the unit of the file.

    Raises:
        FileNotFoundError: if a file is missing.
        IsADirectoryError: if a list holds a folder.
        FormatError: if there is nothing to read, a folder mixes formats, an ending is unknown or an archive is damaged
            or holds no frames; other defects of files are found when they are read.
        InputError: if ``nan_policy`` is unknown.
        InputTypeError: if ``path`` or ``dtype`` is of another type.
    """
    check_choice(nan_policy, "nan_policy", ("raise", "omit"))
    check_dtype(dtype)
    check_positive(scale, "scale")
    if isinstance(path, (str, os.PathLike)):
        target = local_path(path)
        files = frames_in(target) if target.is_dir() else _checked([target])
    else:
        files = _listed(path)
    if sort:
        files = natural_sorted(files)
    if len(files) == 1 and files[0].suffix.lower() in (".npz", ".npy"):
        stacked = _read_archive(files[0], limits)
        if stacked is not None:
            names = [f"{files[0]}, frame {number}" for number in range(len(stacked))]
            return Frames(names, stacked, nan_policy, limits, dtype, scale)
    return Frames([str(file) for file in files], files, nan_policy, limits, dtype, scale)


def save_frames(path: PathLike, frames: Sequence[Any]) -> list[Path]:
    """Write a sequence of clouds and return the files: one NPZ of frames, or a folder with one PLY per frame.

    Args:
        path: an archive ending in .npz, which is replaced, or a folder, which is made if it does not exist; in it the
            files ``frame_0000.ply``, ``frame_0001.ply``, ... are replaced.
        frames: T clouds (M_t, 3), finite; a folder cannot hold frames without points.

    Returns:
        Paths of the files, in order.

    Raises:
        InputError: if there are no frames, one is not finite, of the wrong shape or, for a folder, empty; or if the
            folder holds other point files, which `load_frames` would take for frames.
        FormatError: if the path is an address or has another ending than .npz.
        FileNotFoundError: if the folder of ``path`` does not exist.
    """
    target = local_path(path)
    clouds = [as_float_tensor(frame, f"frames[{number}]").detach().cpu() for number, frame in enumerate(frames)]
    if not clouds:
        raise InputError("frames must hold at least one cloud, got none")
    for number, cloud in enumerate(clouds):
        check_shape(cloud, f"frames[{number}]", ("M", 3))
        check_finite(cloud, f"frames[{number}]")
    if target.suffix.lower() == ".npz":
        write_atomic(target, _archive(clouds))
        return [target]
    if target.suffix:
        raise FormatError(f"{target} has the ending {target.suffix!r}; name an archive ending in .npz or a folder")
    return _save_folder(target, clouds)


def file_fingerprint(*files: Path) -> str:
    """Return a digest of the contents of files, at a gigabyte per second; empty if one cannot be read."""
    try:
        return _digest(*(read_bytes(file) for file in files))
    except (FormatError, OSError):
        return ""


def _digest(*contents: bytes) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for content in contents:
        digest.update(content)
    return digest.hexdigest()


def natural_sorted(paths: Iterable[Path]) -> list[Path]:
    """Return paths in the order of the numbers in their names: frame2 before frame10, 1.25 before 1.5.

    Where two names would be one number, as 1.1 and 1.10, the point separates two counters.
    """
    files = list(paths)
    values = [tuple((kind, value) for kind, value, _ in natural_key(file)) for file in files]
    return sorted(files, key=natural_key if len(set(values)) == len(files) else partial(natural_key, decimals=False))


def natural_key(path: PathLike, *, decimals: bool = True) -> list[tuple[int, Any, str]]:
    """Return a key that sorts paths with the numbers in them as numbers: frame2 before frame10, 1.25 before 1.5.

    Args:
        path: of a file.
        decimals: whether one point between digits is a decimal point; several, as in dates, never are.
    """
    key = list[tuple[int, Any, str]]()
    for number, piece in enumerate(_NUMBER.split(os.fspath(path))):
        # Digits of other scripts and leading zeros are distinguished by the text itself.
        if number % 2 == 0:
            key.append((1, piece, piece))
        elif decimals and piece.count(".") == 1:
            key.append((0, Decimal(piece), piece))
        else:
            key += [(0, Decimal(part), part) for part in piece.split(".")]
    return key


def frames_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are frames, all of one format, in any order; FormatError if there are none."""
    files = [file for file in folder.iterdir() if ending_of(file) in ENDINGS and not file.name.startswith(".")]
    kinds = Counter(ending_of(file) for file in files)
    if not files:
        raise FormatError(f"{folder} holds no frames: no file ends in one of {', '.join(ENDINGS)}")
    geometry = [kind for kind in kinds if kind not in _NOTES]
    if len(kinds) > 1 and len(geometry) == 1:
        beside = sorted(file.name for file in files if ending_of(file) != geometry[0])
        warnings.warn(
            f"{folder}: its {kinds[geometry[0]]} {geometry[0]} files are the frames; {', '.join(beside[:3])} "
            f"{'and others ' if len(beside) > 3 else ''}beside them are passed over",
            FileWarning,
            stacklevel=3,
        )
        return [file for file in files if ending_of(file) == geometry[0]]
    if len(kinds) > 1:
        found = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        raise FormatError(f"{folder} holds files of several formats ({found}); pass a list of those that are frames")
    return files


def _listed(paths: Any) -> list[Path]:
    if isinstance(paths, bytes) or not isinstance(paths, Sequence):
        raise InputTypeError(f"path must be a path or a list of paths, got {type(paths).__name__}")
    files = [local_path(path) for path in paths]
    if not files:
        raise FormatError("path is an empty list: there is nothing to read; does the pattern match any file?")
    return _checked(files)


def _checked(files: list[Path]) -> list[Path]:
    """Return the files; raise unless each exists and has the ending of a cloud."""
    for file in files:
        file.stat()  # a missing file is reported first
        if file.is_dir():
            raise IsADirectoryError(f"{file} is a folder; pass it alone, or the files in it")
        if ending_of(file) not in ENDINGS:
            raise FormatError(f"{file} has the unknown ending {file.suffix!r}; known: {', '.join(ENDINGS)}")
    return files


def _read_archive(file: Path, limits: FileLimits) -> list[Array] | None:
    """Return the rows of each frame of an archive, None if it does not hold frames."""
    content = read_bytes(file, limits)
    try:
        if content.startswith(_ARRAY):
            return _frames_of(content, limits)
        check_stand_in(content)
        with open_zip(content, limits) as archive:
            return _frames_in(archive, limits)
    except FormatError as error:
        raise FormatError(f"{file}: {error}") from error
    except PARSER_ERRORS as error:
        raise FormatError(f"{file}: cannot be read as NPZ ({type(error).__name__}: {error})") from error


def _frames_of(content: bytes, limits: FileLimits) -> list[Array] | None:
    """Return the frames of an array (T, M, 3), None if it is one of another shape."""
    array = array_of(content, "the array")
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype.names is not None or not len(array):
        return None
    check_allowed(array.shape[1], "points", limits)
    return list(array)


def _frames_in(archive: zipfile.ZipFile, limits: FileLimits) -> list[Array] | None:
    shapes = {
        info.filename.removesuffix(".npy"): _shape_of(archive, info)
        for info in archive.infolist()
        if info.filename.endswith(".npy")
    }
    numbered = {int(match[1]): key for key in shapes if (match := _NUMBERED.fullmatch(key))}
    if numbered:
        frames = [_array(archive, numbered[number], "iuf") for number in sorted(numbered)]
    else:
        named: list[str] = [key for key in ("points", "vertices") if key in shapes]
        stacks = named[:1] or [key for key, shape in shapes.items() if len(shape) == 3 and shape[2] == 3]
        if len(stacks) != 1 or len(shapes[stacks[0]]) != 3:
            return None
        frames = _cut(archive, _array(archive, stacks[0], "iuf"), stacks[0], shapes)
    if not frames:
        raise FormatError("holds no frames")
    for number, frame in enumerate(frames):
        if frame.ndim != 2 or frame.shape[1] != 3:
            raise FormatError(f"frame {number} must have shape (M, 3), got {frame.shape}")
        check_allowed(len(frame), "points", limits)
    return frames


def _cut(archive: zipfile.ZipFile, points: Array, name: str, shapes: dict[str, tuple[int, ...]]) -> list[Array]:
    """Return the frames of a stack (T, M, 3) without their padding."""
    count, most = points.shape[:2]
    check_budget(count, FILE_BUDGET.frames, "frames")
    if "counts" in shapes and "mask" in shapes:
        raise FormatError("must hold counts or mask, not both")
    if "counts" in shapes:
        counts = as_indices(_array(archive, "counts", "iuf"), "counts")
        if counts.shape != (count,) or (count and not (counts.min() >= 0 and counts.max() <= most)):
            raise FormatError(f"counts must be {count} numbers from 0 to {most}, one per frame of {name}")
        return [frame[:rows] for frame, rows in zip(points, counts.tolist(), strict=True)]
    if "mask" in shapes:
        mask = _array(archive, "mask", "biu")
        if mask.shape != (count, most):
            raise FormatError(f"mask must have the shape {(count, most)}, got {mask.shape}")
        return [frame[rows] for frame, rows in zip(points, mask.astype(bool), strict=True)]
    return list(points)


def _shape_of(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[int, ...]:
    """Return the shape that a member claims, compared with its bytes before memory is allocated."""
    with archive.open(info) as stream:
        shape, _, dtype = read_npy_header(stream, f"member {info.filename!r}")
        held = info.file_size - stream.tell()
    if not dtype.hasobject and (any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != held):
        raise FormatError(f"member {info.filename!r} claims the shape {shape} of {dtype} but holds {held} bytes")
    return shape


def _array(archive: zipfile.ZipFile, key: str, kinds: str) -> Array:
    with archive.open(f"{key}.npy") as stream:
        try:
            array = np.lib.format.read_array(stream, allow_pickle=False)
        except ValueError as error:  # objects among others
            raise FormatError(
                f"array {key!r} must hold numbers, and pickled objects are never loaded ({error})"
            ) from error
    if array.dtype.kind not in kinds:
        raise FormatError(
            f"array {key!r} must hold {'truth values' if 'b' in kinds else 'real numbers'}, got {array.dtype}"
        )
    return array


def _archive(clouds: list[Tensor]) -> bytes:
    dtype = np.float64 if any(cloud.dtype == torch.float64 for cloud in clouds) else np.float32
    counts = np.array([len(cloud) for cloud in clouds], dtype=np.int64)
    points = np.zeros((len(clouds), int(counts.max()), 3), dtype=dtype)
    for frame, cloud in zip(points, clouds, strict=True):
        frame[: len(cloud)] = cloud.to(torch.float64).numpy()
    stream = io.BytesIO()
    np.savez(stream, points=points, counts=counts)
    return stream.getvalue()


def _save_folder(folder: Path, clouds: list[Tensor]) -> list[Path]:
    for number, cloud in enumerate(clouds):
        if not len(cloud):
            raise InputError(f"frames[{number}] has no points, which PLY files must have; write an archive (.npz)")
    folder.mkdir(exist_ok=True)
    files = [folder / f"frame_{number:04d}.ply" for number in range(len(clouds))]
    unlisted = {file for file in folder.iterdir() if ending_of(file) in ENDINGS} - set(files)
    if unlisted:
        raise InputError(
            f"path {folder} holds {len(unlisted)} other point files, such as {min(unlisted).name}, which would be "
            f"taken for frames; name an empty folder"
        )
    for file, cloud in zip(files, clouds, strict=True):
        save_points(file, cloud)
    return files
