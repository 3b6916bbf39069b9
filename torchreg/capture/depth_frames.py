"""Sequences of depth pictures, each read on request."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, overload

from torchreg.capture.depth_frame import DepthFrame
from torchreg.errors import FormatError
from torchreg.io.frames import file_fingerprint
from torchreg.io.images import list_pictures
from torchreg.io.natural_order import natural_sorted

PathLike = str | os.PathLike[str]


class DepthFrames(Sequence[DepthFrame]):
    """Depth pictures of one camera in the order of the numbers in their names, each read on request, and not kept.

    Args:
        paths: pictures, folders of them, or patterns such as ``frames/*.png``.
        intrinsics: the camera's file, see `load_depth_camera`.
        masks: one mask for all, or a folder or pattern of as many as there are pictures; None for all pixels.
        nearest, farthest: range of depths that is kept, metres.
    """

    def __init__(
        self,
        paths: Sequence[PathLike],
        intrinsics: PathLike,
        masks: PathLike | None = None,
        *,
        nearest: float = 0.0,
        farthest: float = float("inf"),
    ) -> None:
        self._files = _found(paths)
        self._masks: list[Path | None] = [None] * len(self._files)
        if masks is not None:
            self._masks[:] = _matched(masks, self._files)
        self._intrinsics, self.depths = Path(intrinsics), (nearest, farthest)
        for file in (self._intrinsics, *self._files):
            file.stat()  # a missing file is reported before the first is read
        self.names = tuple(str(file) for file in self._files)
        self.masks = tuple(None if mask is None else str(mask) for mask in self._masks)

    def __len__(self) -> int:
        return len(self._files)

    @overload
    def __getitem__(self, index: int) -> DepthFrame: ...

    @overload
    def __getitem__(self, index: slice) -> list[DepthFrame]: ...

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        nearest, farthest = self.depths
        return DepthFrame.load(
            self._files[index], self._intrinsics, self._masks[index], nearest=nearest, farthest=farthest
        )

    def __iter__(self) -> Iterator[DepthFrame]:
        return (self[index] for index in range(len(self)))

    def fingerprint(self, index: int) -> str:
        """Return a digest of what a frame's files hold now; empty if one cannot be read."""
        mask = self._masks[index]
        return file_fingerprint(self._files[index], self._intrinsics, *([] if mask is None else [mask]))


def _found(paths: Sequence[PathLike]) -> list[Path]:
    """Return the files that paths, folders and patterns name, each list in the order of its numbers."""
    files: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            files += list_pictures(path)
        elif not path.exists() and glob.has_magic(str(path)):
            matching = natural_sorted(Path(name) for name in glob.glob(str(path)))
            if not matching:
                raise FileNotFoundError(f"no file matches {path}")
            files += matching
        else:
            files.append(path)
    return files


def _matched(masks: PathLike, files: Sequence[Path]) -> list[Path]:
    """Return the mask of each file: the one of its name where all have one, else in order."""
    found = _found([masks])
    if len(found) == 1 and not Path(masks).is_dir():
        return found * len(files)
    by_name = {mask.stem: mask for mask in found}
    if all(file.stem in by_name for file in files):
        return [by_name[file.stem] for file in files]
    if len(found) != len(files):
        raise FormatError(f"{masks}: holds {len(found)} masks for {len(files)} pictures, of other names; give one each")
    return found
