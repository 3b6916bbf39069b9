"""Moving pictures: animated GIFs of shapes that follow clouds."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.datasets.hand import surface_skin
from torchreg.errors import InputError
from torchreg.geometry.visibility import View
from torchreg.io.atomic import write_atomic
from torchreg.models.articulated import ArticulatedShape
from torchreg.models.skin import LinearBlendSkin
from torchreg.viz.figures import draw_alignment, new_figure, watch

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Tones of a color channel that are kept: GIFs compress runs of equal pixels.
_TONES = 32
# Poses that decide about the common view.
_VIEW_POSES = 32
_POINT_SIZE = 2.8

Frame = Callable[["Axes"], object] | NDArray[Any] | Tensor


def save_animation(
    path: str | Path,
    frames: Sequence[Frame],
    fps: float = 20.0,
    *,
    size: tuple[int, int] = (360, 360),
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Return the path of an animated GIF that plays the frames in a loop.

    Args:
        path: where to write; the suffix must be .gif. The file is written whole or not at all; an interruption by the
            keyboard leaves the frames drawn so far in it.
        frames: pictures (H, W, 3) of one size, uint8 or in [0, 1], or functions that draw on the matplotlib axes they
            are given.
        fps: frames per second; GIF rounds the time of a frame to 0.01 s.
        size: width and height of frames that are functions, pixels.
        on_frame: is told (frames done, all frames) after each.

    Returns:
        The path written.

    Raises:
        InputError: if there are no frames, sizes differ, or the suffix is not .gif.
        FileNotFoundError: if the folder does not exist.
    """
    path = _checked_path(path)
    check_positive(fps, "fps")
    if not len(frames):
        raise InputError("frames must hold at least one frame, got none")
    first = _picture(frames[0], size, 0)
    height, width = first.shape[:2]
    from matplotlib.animation import PillowWriter

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "animation.gif"
        writer: Any = PillowWriter(fps=round(fps, 3))  # type: ignore[arg-type]
        figure, (canvas,) = new_figure(width, height)
        shown = canvas.imshow(first, extent=(0, width, height, 0), aspect="auto", interpolation="nearest")
        writer.setup(figure, str(file), dpi=figure.dpi)
        try:
            for index, frame in enumerate(frames):
                picture = _picture(frame, size, index) if index else first
                if picture.shape != first.shape:
                    raise InputError(f"frames[{index}] must be {first.shape} like frames[0], got {picture.shape}")
                shown.set_data(_few_tones(picture))
                writer.grab_frame()
                if on_frame is not None:
                    on_frame(index + 1, len(frames))
        except KeyboardInterrupt:
            _finish(writer, file, path)
            raise
        _finish(writer, file, path)
    return path


def animate_alignment(
    path: str | Path,
    shape: ArticulatedShape,
    poses: Tensor,
    clouds: Sequence[Tensor],
    *,
    inliers: Sequence[Tensor] | None = None,
    fps: float = 20.0,
    skin: LinearBlendSkin | None = None,
    camera: Tensor | None = None,
    up: Tensor | None = None,
    size: tuple[int, int] = (360, 360),
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Return the path of an animated GIF of a shape that follows clouds.

    Args:
        path: where to write; the suffix must be .gif.
        shape: the articulated shape.
        poses: (T, num_dofs), one per frame.
        clouds: T clouds (M, 3), metres.
        inliers: T masks (M,) bool; all by default.
        fps: frames per second.
        skin: the surface to draw, with faces; by default a coarse `surface_skin`.
        camera: (3,) position, see `watch`; it stays where it is.
        up: (3,) see `watch`.
        size: width and height, pixels.
        on_frame: is told (frames done, all frames) after each.

    Returns:
        The path written.

    Raises:
        InputError: if the numbers of poses, clouds and masks differ, or as for `save_animation`.

    Cost: about 0.1 s and 25 kB per frame.
    """
    path = _checked_path(path)
    poses = shape.check_pose(poses, "poses").detach()
    check_shape(poses, "poses", (len(clouds), shape.num_dofs))
    if inliers is not None and len(inliers) != len(clouds):
        raise InputError(f"inliers must hold one mask per cloud ({len(clouds)}), got {len(inliers)}")
    if not len(clouds):
        raise InputError("clouds must hold at least one cloud, got none")
    surface = surface_skin(shape, spacing=_coarse_spacing(shape)) if skin is None else skin
    view = _common_view(surface, poses, camera, up, size)

    def draw(index: int) -> Callable[[Axes], object]:
        mask = None if inliers is None else inliers[index]
        return lambda ax: draw_alignment(
            ax, shape, poses[index], clouds[index], mask, skin=surface, view=view, point_size=_POINT_SIZE
        )

    return save_animation(path, [draw(index) for index in range(len(clouds))], fps, size=size, on_frame=on_frame)


def _common_view(
    skin: LinearBlendSkin, poses: Tensor, camera: Tensor | None, up: Tensor | None, size: tuple[int, int]
) -> View:
    """Return the view that shows the surface in all poses."""
    few = poses[:: max(1, len(poses) // _VIEW_POSES)]
    with torch.no_grad():
        points = torch.cat([skin(pose) for pose in few]).cpu()
    return watch(points, camera=camera, up=up, size=size, margin=0.1)


def _coarse_spacing(shape: ArticulatedShape) -> float | None:
    """Return a grid of 1.5 fusion lengths for a fused surface, which small pictures cannot tell from a finer one."""
    return None if shape.surface is not None else 1.5 * shape.nu


def _picture(frame: Frame, size: tuple[int, int], index: int) -> NDArray[np.uint8]:
    if callable(frame):
        figure, (ax,) = new_figure(*size)
        frame(ax)
        canvas: Any = figure.canvas
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()
    picture = frame.detach().cpu().numpy() if isinstance(frame, Tensor) else np.asarray(frame)
    if picture.ndim != 3 or picture.shape[2] != 3 or 0 in picture.shape:
        raise InputError(f"frames[{index}] must have shape (H, W, 3), got {picture.shape}")
    if picture.dtype == np.uint8:
        return picture
    if not np.isfinite(picture).all() or picture.min() < 0 or picture.max() > 1:
        raise InputError(f"frames[{index}] must be uint8 or lie in [0, 1]; divide by its largest value first")
    return np.round(255 * picture).astype(np.uint8)


def _few_tones(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    step = 255 / (_TONES - 1)
    return np.round(np.round(picture / step) * step).astype(np.uint8)


def _checked_path(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise InputError(f"path must end in .gif, got {path.name!r}; rename the output file")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist; create it first")
    return path


def _finish(writer: Any, file: Path, path: Path) -> None:
    if writer._frames:
        writer.finish()
        write_atomic(path, file.read_bytes())
