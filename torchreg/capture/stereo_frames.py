"""Sequences of stereo pictures as clouds: pair after pair read, rectified, matched, and what is no shape cut off."""

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
from torchreg.io.images import list_frames, load_image

# Nearer to the border of what both cameras see, pixels, a thing may go on beyond it.
_BORDER = 12
# The far end is the outermost corner with so many others within this distance, metres.
_COMPANIONS, _COMPANY = 3, 0.015


@dataclass(frozen=True, eq=False)
class StereoSight:
    """What a frame shows.

    Args:
        left: (H, W) or (H, W, 3) the left picture, rectified.
        pair: the rectified cameras.
        corners: all that was found in it.
        points: of those, what is within reach.
    """

    left: Tensor
    pair: StereoPair
    corners: StereoPoints
    points: StereoPoints


class StereoFrames(Sequence[Tensor]):
    """The clouds (M, 3) of a sequence of stereo pictures, float32, in world coordinates; made when asked for, and kept.

    Reading raises what `load_image` and `stereo_points` raise, the latter as FormatError that names the picture.

    Args:
        left: folder with the pictures of the left camera, in the order of the numbers in their names.
        right: likewise.
        pair: the cameras; pictures are rectified if they are not.
        config: what to look for.
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
        self._straight = pair.is_rectified
        self._clouds: dict[int, Tensor] = {}
        self._last: tuple[int, StereoSight] | None = None
        self._checked = False

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: Any) -> Any:
        """Return the cloud of a frame, or those of a slice."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        number = range(len(self))[index]
        if number not in self._clouds:
            self._clouds[number] = self.sight(number).points.points.float()
        return self._clouds[number]

    def sight(self, number: int) -> StereoSight:
        """Return all that is seen in a frame; the frame asked for last is kept."""
        if self._last is None or self._last[0] != number:
            self._last = number, self._seen(number)
        return self._last[1]

    def pictures(self, number: int) -> tuple[Tensor, Tensor]:
        """Return both pictures (H, W) of a frame as they are, in gray."""
        left, right = (load_image(file) for file in self._files[number])
        return as_gray(left, self.pair.left, "left"), as_gray(right, self.pair.right, "right")

    def _seen(self, number: int) -> StereoSight:
        first, second = self._files[number]
        left, right = load_image(first), load_image(second)
        try:
            pair = self.pair
            if not self._straight:
                left, right, pair = rectify(left, right, pair)
            order = not self._checked
            found = stereo_points(left, right, pair, config=self.config, box=self.box, check_order=order)
        except InputError as error:
            raise FormatError(f"{first} and {second}: {error}") from error
        self._checked = True
        kept = found
        if self.reach is not None:
            kept = found.subset(far_end(found, pair, self.config, self.reach))
        return StereoSight(left, pair, found, kept)


def far_end(found: StereoPoints, pair: StereoPair, config: StereoConfig, reach: float) -> Tensor:
    """Return which points (N,) lie within a reach of the end of what comes in through the border, as a hand on an arm.

    All of them, if nothing of the wanted depth touches the border of what both cameras see. Else the end is the point
    farthest from there, and the reach is measured along the line between.

    Args:
        found: of a pair.
        pair: the cameras.
        config: the depths that are wanted.
        reach: metres.
    """
    dense = found.dense
    depth = pair.depth(dense)
    row, column = ((depth >= config.nearest) & (depth <= config.farthest)).nonzero().unbind(-1)
    seen_right = column - dense[row, column]
    last_row, last_column = dense.shape[0] - 1 - _BORDER, dense.shape[1] - 1 - _BORDER
    rim = (row <= _BORDER) | (row >= last_row) | (column >= last_column) | (seen_right <= _BORDER)
    everything = torch.ones(len(found), dtype=torch.bool, device=dense.device)
    if not bool(rim.any()) or len(found) <= _COMPANIONS:
        return everything
    pixels = torch.stack((column, row), dim=-1)[rim].to(dense)
    entry = pair.left.unproject(pixels, depth[row, column][rim]).median(0).values
    away = found.points - entry
    company = k_nearest_others(found.points, _COMPANIONS)[1][:, -1] < _COMPANY
    if not bool(company.any()):
        return everything
    farthest = torch.where(company, away.norm(dim=-1), -1.0).argmax()
    along = away @ torch.nn.functional.normalize(away[farthest], dim=0)
    return along >= along[farthest] - reach
