"""Sequences of stereo pictures as clouds: each pair is read, rectified and matched, and an arm is cut off."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.capture.stereo import StereoConfig, StereoPoints, as_gray, rectify, stereo_points
from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera_rig import StereoPair
from torchreg.geometry.neighbors import k_nearest_others
from torchreg.io.frames import file_fingerprint
from torchreg.io.images import list_frames, load_image


@dataclass(frozen=True)
class _FarEnd:
    """Search for the far end of an arm."""

    border: int = 12  # pixels this near to the border of the common view may belong to an object that extends beyond
    num_neighbors: int = 3  # the end is the outermost corner with so many neighbors,
    neighbor_distance: float = 0.015  # none farther away, metres


_FAR_END = _FarEnd()


@dataclass(frozen=True, eq=False)
class StereoSight:
    """The points of a frame: all corners, and those within reach of the far end; picture and pair are rectified."""

    left: Tensor
    pair: StereoPair
    corners: StereoPoints
    points: StereoPoints


class StereoFrames(Sequence[Tensor]):
    """The clouds (M, 3) of a sequence of stereo pictures, float32, in world coordinates; made on request, and kept.

    Reading raises what `load_image` and `stereo_points` raise, the latter as FormatError that names the picture.

    Args:
        left: folder with the pictures of the left camera, in the order of the numbers in their names.
        right: likewise.
        pair: the cameras; pictures are rectified if they are not.
        config: of `stereo_points`.
        box: (2, 3) lower and upper corner of the volume of interest in world coordinates, or None.
        reach: see `far_end`; None keeps all.

    Raises:
        FormatError: if a folder holds no pictures, or they do not go together, see `list_frames`.
        FileNotFoundError: if a folder does not exist.
        InputError: if ``reach`` is not positive.
    """

    def __init__(
        self,
        left: str | os.PathLike[str],
        right: str | os.PathLike[str],
        pair: StereoPair,
        *,
        config: StereoConfig | None = None,
        box: Tensor | None = None,
        reach: float | None = None,
    ) -> None:
        self._files = list_frames((left, right))
        if reach is not None:
            check_positive(reach, "reach")
        self.names = tuple(str(first) for first, _ in self._files)
        self.pair, self.config, self.box, self.reach = pair, config or StereoConfig(), box, reach
        self._is_rectified = pair.is_rectified
        self._clouds: dict[int, Tensor] = {}
        self._last: tuple[int, StereoSight] | None = None
        self._order_checked = False

    def __len__(self) -> int:
        return len(self._files)

    def fingerprint(self, index: int) -> str:
        """Return a digest of what the pictures of a frame hold now; empty if one cannot be read."""
        return file_fingerprint(*self._files[index])

    def __getitem__(self, index: Any) -> Any:
        """Return the cloud of a frame, or those of a slice."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        number = range(len(self))[index]
        if number not in self._clouds:
            self._clouds[number] = self.sight(number).points.points.float()
        return self._clouds[number]

    def sight(self, number: int) -> StereoSight:
        """Return the points of a frame with their picture and cameras; the last frame is kept."""
        if self._last is None or self._last[0] != number:
            self._last = number, self._matched(number)
        return self._last[1]

    def pictures(self, number: int) -> tuple[Tensor, Tensor]:
        """Return both pictures (H, W) of a frame in gray, not rectified."""
        left, right = (load_image(file) for file in self._files[number])
        return as_gray(left, self.pair.left, "left"), as_gray(right, self.pair.right, "right")

    def _matched(self, number: int) -> StereoSight:
        first, second = self._files[number]
        left, right = load_image(first), load_image(second)
        try:
            pair = self.pair
            if not self._is_rectified:
                left, right, pair = rectify(left, right, pair)
            check = not self._order_checked
            corners = stereo_points(left, right, pair, config=self.config, box=self.box, check_order=check)
        except InputError as error:
            raise FormatError(f"{first} and {second}: {error}") from error
        self._order_checked = True
        points = corners
        if self.reach is not None:
            points = corners.subset(far_end(corners, pair, self.config, self.reach))
        return StereoSight(left, pair, corners, points)


def far_end(corners: StereoPoints, pair: StereoPair, config: StereoConfig, reach: float) -> Tensor:
    """Return the mask (N,) of points near the far end of an object that enters through the border, as an arm does.

    The far end is farthest from where the object enters, and the reach, metres, is measured along the line between the
    two. All points, if nothing in the depths of interest touches the border.
    """
    dense = corners.dense
    depth = pair.depth(dense)
    row, column = ((depth >= config.nearest) & (depth <= config.farthest)).nonzero().unbind(-1)
    seen_right = column - dense[row, column]
    border = _FAR_END.border
    last_row, last_column = dense.shape[0] - 1 - border, dense.shape[1] - 1 - border
    rim = (row <= border) | (row >= last_row) | (column >= last_column) | (seen_right <= border)
    everything = torch.ones(len(corners), dtype=torch.bool, device=dense.device)
    if not bool(rim.any()) or len(corners) <= _FAR_END.num_neighbors:
        return everything
    pixels = torch.stack((column, row), dim=-1)[rim].to(dense)
    entry = pair.left.unproject(pixels, depth[row, column][rim]).median(0).values
    offset = corners.points - entry
    distances = k_nearest_others(corners.points, _FAR_END.num_neighbors)[1]
    supported = distances[:, -1] < _FAR_END.neighbor_distance
    if not bool(supported.any()):
        return everything
    farthest = torch.where(supported, offset.norm(dim=-1), -1.0).argmax()
    along = offset @ torch.nn.functional.normalize(offset[farthest], dim=0)
    return along >= along[farthest] - reach
