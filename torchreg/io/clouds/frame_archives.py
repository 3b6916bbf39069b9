"""Sequences of clouds in one archive or array of numpy."""

from __future__ import annotations

import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.clouds.columns import are_normals
from torchreg.io.clouds.npz import ARCHIVE_START, ARRAY_START, FACES, POINTS, array_of, read_npy_header, triangles_of
from torchreg.io.clouds.raw_cloud import Array, as_indices, not_measured
from torchreg.io.file_format import check_stand_in, naming, warn
from torchreg.io.limits import FILE_BUDGET, FileLimits, check_allowed, check_budget, open_zip, read_bytes
from torchreg.io.points import PARSER_ERRORS

_NUMBERED = re.compile(r"(.*?)_?(\d+)")


@dataclass(frozen=True, eq=False)
class FrameArchive:
    """The frames of an archive."""

    rows: list[Array]  # per frame (M, 3)
    faces: Array | None = None  # (F, 3) of all frames, which are then meshes; None for clouds


def may_be_archive(file: Path) -> bool:
    """Return whether a file is an array or an archive by its first bytes, or is called one."""
    if file.suffix.lower() in (".npz", ".npy"):
        return True
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return stream.read(8).startswith((ARRAY_START, ARCHIVE_START))


def read_frame_archive(file: Path, limits: FileLimits) -> FrameArchive | None:
    """Return the frames of an archive, None if it does not hold frames."""
    content = read_bytes(file, limits)
    with naming(file):
        try:
            if content.startswith(ARRAY_START):
                found = _frames_of(content)
            else:
                check_stand_in(content)
                with open_zip(content, limits) as archive:
                    found = _frames_in(archive)
        except FormatError:
            raise
        except PARSER_ERRORS as error:
            raise FormatError(f"cannot be read as NPZ ({type(error).__name__}: {error})") from error
        if found is None:
            return None
        for number, frame in enumerate(found.rows):
            if frame.ndim != 2 or frame.shape[1] != 3:
                raise FormatError(f"frame {number} must have shape (M, 3), got {frame.shape}")
            check_allowed(len(frame), "points", limits)
        return found if found.faces is not None else FrameArchive(_measured(found.rows))


def _measured(frames: list[Array]) -> list[Array]:
    """Return clouds without rows 0 0 0, unless no frame has more than one, which may be the origin."""
    measured = [np.asarray(frame.any(axis=1)) for frame in frames]
    missing = [len(rows) - int(rows.sum()) for rows in measured]
    if max(missing, default=0) < 2:
        return frames
    count, concerned = sum(map(len, frames)), sum(map(bool, missing))
    if sum(missing) == count:
        raise FormatError(f"all of its {count} points are 0 0 0: nothing was measured")
    warn(not_measured(sum(missing), count, f" in {concerned} of {len(frames)} frames"))
    return [frame[rows] for frame, rows in zip(frames, measured, strict=True)]


def _frames_of(content: bytes) -> FrameArchive | None:
    """Return the frames of an array (T, M, 3), or (T, H, W, 3); None if it is one of another shape."""
    array = array_of(content, "the array")
    if array.ndim not in (3, 4) or array.shape[-1] != 3 or array.dtype.names is not None or not len(array):
        return None
    return FrameArchive(list(array.reshape(len(array), -1, 3)))


def _frames_in(archive: zipfile.ZipFile) -> FrameArchive | None:
    shapes = {
        info.filename.removesuffix(".npy"): _shape_of(archive, info)
        for info in archive.infolist()
        if info.filename.endswith(".npy")
    }
    numbered = _numbered(shapes)
    if numbered:
        frames = [_array(archive, key, "iuf") for key in numbered]
        return None if _are_parts(frames) else FrameArchive(frames)
    named = [key for key in POINTS if key in shapes]
    stacks = named[:1] or [key for key, shape in shapes.items() if len(shape) == 3 and shape[2] == 3]
    if len(stacks) != 1 or len(shapes[stacks[0]]) not in (3, 4):
        return None
    points = _array(archive, stacks[0], "iuf")
    if not len(points):
        raise FormatError("holds no frames")
    points = points.reshape(len(points), -1, points.shape[-1])
    frames = _cut(archive, points, stacks[0], shapes)
    faces = next((key for key in FACES if len(shapes.get(key, ())) == 2), None)
    if faces is None or {"counts", "mask"} & set(shapes):
        return FrameArchive(frames)
    return FrameArchive(frames, triangles_of(_array(archive, faces, "iuf")))


def _numbered(shapes: dict[str, tuple[int, ...]]) -> list[str]:
    """Return the names of arrays that number frames (frame_0, ...; numpy: arr_0, ...), in order, of (M, 3) each."""
    sequences = dict[str, dict[int, str]]()
    for key in shapes:
        if match := _NUMBERED.fullmatch(key):
            sequences.setdefault(match[1], {})[int(match[2])] = key
    chosen = [sequences["frame"]] if "frame" in sequences else []
    if not chosen and not set(POINTS) & set(shapes):
        chosen = [
            keys
            for keys in sequences.values()
            if len(keys) > 1 and all(len(shapes[key]) == 2 and shapes[key][1] == 3 for key in keys.values())
        ]
    return [keys[number] for keys in chosen for number in sorted(keys)] if len(chosen) == 1 else []


def _are_parts(frames: list[Array]) -> bool:
    """Return whether arrays of numbered names are vertices and faces, or points and their normals, of one cloud."""
    if len({frame.dtype.kind == "f" for frame in frames}) > 1:
        return True
    one = frames[0]
    return (
        len(frames) == 2
        and one.shape == frames[1].shape
        and one.dtype.kind == "f"
        and are_normals(frames[1])
        and not are_normals(one)
    )


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
    return array_of(archive.read(f"{key}.npy"), f"array {key!r}", kinds)
