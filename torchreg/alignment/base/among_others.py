"""A robot among other things: in balls that it may fill, by what moves before a camera that stands still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.base.fit import BASE_FIT
from torchreg.alignment.base.frames import BaseFrame
from torchreg.alignment.base.search import PosedModel
from torchreg.alignment.search.windows import ball_windows
from torchreg.capture.background import Background, is_still
from torchreg.capture.depth_frame import DepthFrame
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.rigid import invert_rigid, transform_points


@dataclass(frozen=True)
class _Among:
    """Numbers of a robot among other things."""

    least: int = 60  # points of a frame in a ball: fewer do not show the robot there
    drawn: int = 3000  # points of a frame of which balls are made
    band: float = 2 * BASE_FIT.stop  # of the size, around the robot where it was found coarsely: what is off is not it


_AMONG = _Among()


@dataclass(frozen=True, eq=False)
class BaseWindow:
    """The frames, by their numbers, that have data in a ball (3,) and radius, metres, which a robot may fill."""

    numbers: tuple[int, ...]
    frames: tuple[BaseFrame, ...]
    ball: tuple[Tensor, float] | None = None

    def near(
        self, frames: Sequence[BaseFrame], models: Sequence[PosedModel], base: Tensor, size: float
    ) -> list[BaseFrame]:
        """Return all frames, those of the window with the data near the robot with its base (4, 4) at a place alone."""
        found = list(frames)
        if self.ball is None:
            return found
        for number in self.numbers:
            frame, tree = frames[number], models[number].tree

            def belongs(points: Tensor, tree: NeighborTree = tree) -> Tensor:
                off = tree.nearest(transform_points(invert_rigid(base), points))[1]
                return off < _AMONG.band * size

            found[number] = (
                frame.where(belongs(frame.points))
                if frame.picture is None
                else frame.showing(frame.picture, _pixels(frame.picture, belongs))
            )
        return found


def agreement(bases: Tensor, frames: Sequence[BaseFrame], models: Sequence[PosedModel], size: float) -> Tensor:
    """Return how far whole pictures agree with bases (K, 4, 4), (K, T), at most 1.

    That is the share of the robot's side towards the camera at which a picture shows it, less the share through which
    it shows something farther; what is hidden, out of the picture or not measured counts for neither.
    """
    pictures = [frame.picture for frame in frames if frame.picture is not None]
    return torch.stack([_shown(bases, *both, size) for both in zip(pictures, models, strict=True)], dim=-1)


def _shown(bases: Tensor, picture: DepthFrame, model: PosedModel, size: float) -> Tensor:
    posed, normals = transform_points(bases, model.points), (bases[:, :3, :3] @ model.normals.mT).mT
    faces = (posed * normals).sum(-1) < 0
    pixel, depth = picture.camera.project(posed)
    column, row = pixel.nan_to_num(-1).round().long().unbind(-1)
    height, width = picture.depth.shape
    inside = faces & (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    measured = picture.depth[row.clamp(0, height - 1), column.clamp(0, width - 1)].double()
    behind = torch.where(inside & (measured > 0), measured - depth, -torch.inf)
    on, through = behind.abs() < _AMONG.band * size, behind >= _AMONG.band * size
    return (on.double() - through.double()).sum(-1) / faces.sum(-1).clamp_min(1)


def everything(frames: Sequence[BaseFrame]) -> BaseWindow:
    """Return the window that holds all data."""
    return BaseWindow(tuple(range(len(frames))), tuple(frames))


def base_windows(frames: Sequence[BaseFrame], models: Sequence[PosedModel]) -> list[BaseWindow]:
    """Return the balls in which a robot in known joints may be, all of space alone where the data fit in one.

    Of whole pictures of a camera that stands still those data count that show what moves.
    """
    reached = torch.cat([model.points for model in models])
    radius = float((reached.amax(0) - reached.amin(0)).norm()) / 2
    if len(_balls(frames, radius)) < 2:
        return [everything(frames)]
    moved = _moved(frames)
    windows = []
    for center in _balls(moved, radius):
        inside = [(frame.points - center).norm(dim=-1) < radius for frame in moved]
        numbers = tuple(number for number, kept in enumerate(inside) if int(kept.sum()) >= _AMONG.least)
        window = tuple(moved[number].where(inside[number]) for number in numbers)
        windows.append(BaseWindow(numbers, window, (center, radius)))
    return [window for window in windows if window.frames] or [everything(frames)]


def _balls(frames: Sequence[BaseFrame], radius: float) -> list[Tensor]:
    """Return the middles (3,) of the balls that frames have their data in, of all data where these fit in one."""
    points = torch.cat([frame.thinned(_AMONG.drawn).points for frame in frames])
    return [points[ball].mean(0) for ball in ball_windows(points, torch.ones(len(points), dtype=torch.bool), radius)]


def _moved(frames: Sequence[BaseFrame]) -> Sequence[BaseFrame]:
    """Return frames with what moves in their pictures alone; as they are unless these are whole ones of one camera."""
    pictures = [frame.picture for frame in frames if frame.picture is not None and frame.is_whole]
    if len(pictures) < max(len(frames), 2) or not is_still(pictures):
        return frames
    background = Background.of(pictures)
    moved = [background.moved(picture) for picture in pictures]
    return [
        frame.showing(picture, pixels)
        if int(pixels.sum()) >= _AMONG.least
        else frame.where(torch.tensor([], dtype=torch.int64))
        for frame, picture, pixels in zip(frames, pictures, moved, strict=True)
    ]


def _pixels(picture: DepthFrame, belongs: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the pixels (H, W) of a picture whose points (M, 3) belong to something."""
    found = picture.measured.clone()
    row, column = found.nonzero().unbind(-1)
    points = picture.camera.unproject(torch.stack((column, row), -1).double(), picture.depth[row, column].double())
    found[row, column] = belongs(points)
    return found
