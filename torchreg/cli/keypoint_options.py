"""Options of keypoints that a detector measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence, Sized

    from torch import Tensor

    from torchreg.capture.depth_frame import DepthFrame

Keypoints = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.json",
        help="Where a detector saw the shape's keypoints, as evidence beside the points: a list of [x, y, z] in metres "
        "or, with --depth, [column, row] in pixels, null for unseen ones; or a list of such lists, one per frame. Of "
        "hands also what MediaPipe or OpenPose wrote, in one file or a folder of one for each frame.",
    ),
]
KeypointStd = Annotated[
    float | None,
    typer.Option(
        metavar="STD",
        help="Standard deviation of --keypoints, in their unit; by default 5 pixels, or 3 % of the shape's size.",
    ),
]


@dataclass(frozen=True)
class MeasuredFrames:
    """The measured keypoints (F, K, C) of all frames, or None, and their standard deviation."""

    table: Tensor | None = None
    std: float | None = None

    def of(self, number: int) -> dict[str, Any]:
        """Return the keypoints of a frame as `align` takes them; nothing where none was seen."""
        if self.table is None:
            return {}
        row = self.table[number]
        return {"keypoints": row, "keypoint_std": self.std} if bool(row.isfinite().all(-1).any()) else {}

    def part(self, numbers: range, origin: Tensor | None) -> dict[str, Any]:
        """Return the keypoints of some frames as a tracker's run takes them, about the origin (3,) of its clouds."""
        if self.table is None:
            return {}
        rows = self.table[numbers.start : numbers.stop]
        moved = rows if origin is None or rows.shape[-1] != len(origin) else rows - origin
        return {"keypoints": moved, "keypoint_std": self.std}

    def job(self) -> dict[str, Any]:
        """Return all that they are, as plain data."""
        if self.table is None:
            return {}
        return {"--keypoints": str(self.table.tolist()), "--keypoint-std": self.std}


def read_keypoints(
    path: Path | None, std: float | None, frames: Sized, shape: Any, pictures: Sequence[DepthFrame] | None
) -> MeasuredFrames:
    """Return the keypoints of all frames; InputError if there are not as many.

    Args:
        path: of the file or folder.
        std: standard deviation, or None.
        frames: as many as there are.
        shape: whose side tells which hand it is, where a detector saw several; None for the surest.
        pictures: of the frames, if they are pictures.
    """
    if path is None:
        if std is not None:
            raise InputError("--keypoint-std has no meaning without --keypoints; leave it out")
        return MeasuredFrames()
    from torchreg._checks import check_positive
    from torchreg.io.keypoints import load_keypoints

    if std is not None:
        check_positive(std, "--keypoint-std")
    camera = pictures[0].camera if pictures else None
    size = None if camera is None else (camera.width, camera.height)
    table = load_keypoints(path, side=getattr(shape, "side", None), picture=size)
    if len(table) != len(frames):
        raise InputError(f"{path} must hold the keypoints of every frame, {len(frames)}; got those of {len(table)}")
    return MeasuredFrames(table, std)
