"""Sequences of clouds: many files, a folder of them or one archive, read frame by frame; and their counterpart."""

from __future__ import annotations

import copy
import hashlib
import io
import os
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_finite, check_positive, check_shape
from torchreg.errors import FileWarning, FormatError, InputError, InputTypeError
from torchreg.io.atomic import write_atomic
from torchreg.io.clouds.cloud_formats import ENDINGS
from torchreg.io.clouds.frame_archives import may_be_archive, read_frame_archive
from torchreg.io.clouds.raw_cloud import Array, RawCloud
from torchreg.io.file_format import ending_of, naming, refuse_foreign
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes
from torchreg.io.natural_order import natural_sorted
from torchreg.io.points import PointCloud, check_dtype, checked_cloud, load_points, save_points

# In a folder of meshes or clouds, files of these endings describe them: times, poses, notes.
_NOTES = (".csv", ".txt", ".dat", ".tsv", ".npy", ".asc")
PathLike = str | os.PathLike[str]


class Frames(Sequence[Tensor]):
    """Clouds in the order of time, each read on request, and not kept.

    Indexing and iterating give (M, 3) tensors on the CPU, a slice gives `Frames` again. M may be zero in archives.
    Reading raises what `load_points` raises; every message names the file, and in an archive the frame. What is left
    out of frames is reported for the first that it concerns. Made by `load_frames`.

    Args:
        names: of the frames: the path of its file, in an archive also its number.
        sources: per frame the path of its file, or its rows (M, 3).
        nan_policy: see `load_points`.
        limits: see `load_points`.
        dtype: of the tensors.
        scale: see `load_points`.
        faces: (F, 3) that all frames of an archive share; None where they are clouds.
    """

    def __init__(
        self, names: Sequence[str], sources: Sequence[Path | Array], nan_policy: str, limits: FileLimits,
        dtype: torch.dtype | None, scale: float = 1.0, faces: Array | None = None,
    ) -> None:  # fmt: skip
        self.names, self._sources, self._faces = tuple(names), tuple(sources), faces
        self._options: dict[str, Any] = {"scale": scale, "nan_policy": nan_policy, "limits": limits, "dtype": dtype}
        self._told = set[str]()

    def __len__(self) -> int:
        return len(self._sources)

    @overload
    def __getitem__(self, index: int) -> Tensor: ...

    @overload
    def __getitem__(self, index: slice) -> Frames: ...

    def __getitem__(self, index: int | slice) -> Tensor | Frames:
        if isinstance(index, slice):
            chosen = copy.copy(self)
            chosen.names, chosen._sources = self.names[index], self._sources[index]
            return chosen
        return self.cloud(index).points

    def __iter__(self) -> Iterator[Tensor]:
        return (self[index] for index in range(len(self)))

    def cloud(self, index: int) -> PointCloud:
        """Return a frame with its faces, normals and colors where it has them."""
        source, name = self._sources[index], self.names[index]
        with self._telling_once(name):
            if isinstance(source, Path):
                return load_points(source, **self._options)
            with naming(name), np.errstate(all="ignore"):  # what overflows becomes infinite and is judged as that
                return checked_cloud(RawCloud(source, faces=self._faces), **self._options, may_be_empty=True)

    def clouds(self) -> Sequence[PointCloud]:
        """Return the frames as `cloud` gives them, each read on request."""
        return _Clouds(self)

    @contextmanager
    def _telling_once(self, name: str) -> Iterator[None]:
        """Report what is left out of a frame unless the same was reported for an earlier one."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", FileWarning)
            yield
        for row in caught:
            text = str(row.message)
            kind = re.sub(r"[\d.,]+", "", text.removeprefix(name))
            if issubclass(row.category, FileWarning) and kind not in self._told:
                self._told.add(kind)
                more = "; of other frames this is not told again" if len(self) > 1 else ""
                warnings.warn(f"{text}{more}", row.category, stacklevel=5)
            elif not issubclass(row.category, FileWarning):
                warnings.warn(row.message, row.category, stacklevel=5)

    def fingerprint(self, index: int) -> str:
        """Return a digest of what a frame holds now; empty if its file cannot be read."""
        source = self._sources[index]
        return file_fingerprint(source) if isinstance(source, Path) else _digest(np.ascontiguousarray(source).tobytes())


@dataclass(frozen=True, eq=False)
class _Clouds(Sequence[PointCloud]):
    """Frames with all that they hold."""

    frames: Frames

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> PointCloud:  # type: ignore[override]
        return self.frames.cloud(index)


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
            (T, M, 3) or (T, H, W, 3); or one NPZ of frames: an array ``points`` (or ``vertices``, ``verts``, ``v``, or
            the only one of three dimensions) of such a shape, with ``counts`` (T,), the rows of each frame that count,
            or ``mask`` (T, M), or ``faces`` (or ``f``) (F, 3), which make every frame a mesh, or none of these; or T
            arrays (M, 3) called ``frame_0``, ``frame_1``, ..., or ``arr_0``, ``arr_1``, ..., as ``numpy.savez`` calls
            those of a list. An archive is read at once, the rest is not.
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

    Warns:
        FileWarning: if points 0 0 0 are left out, of an archive at once, of files at the first that is read.
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
    names, sources, faces = [str(file) for file in files], list[Path | Array](files), None
    if len(files) == 1 and may_be_archive(files[0]):
        archive = read_frame_archive(files[0], limits)
        if archive is not None:
            names = [f"{files[0]}, frame {number}" for number in range(len(archive.rows))]
            sources, faces = list(archive.rows), archive.faces
    return Frames(names, sources, nan_policy, limits, dtype, scale=scale, faces=faces)


def save_frames(path: PathLike, frames: Sequence[Any]) -> list[Path]:
    """Write T clouds (M_t, 3) as an .npz of frames or as a folder of files frame_0000.ply, ...; return the files."""
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


def frames_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are frames, all of one format, in any order; FormatError if there are none."""
    files = [file for file in folder.iterdir() if ending_of(file) in ENDINGS and not file.name.startswith(".")]
    kinds = Counter(ending_of(file) for file in files)
    if not files:
        for file in sorted(folder.iterdir()):
            with naming(file):
                refuse_foreign(file)
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
            with naming(file):
                refuse_foreign(file)
            raise FormatError(f"{file} has the unknown ending {file.suffix!r}; known: {', '.join(ENDINGS)}")
    return files


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
