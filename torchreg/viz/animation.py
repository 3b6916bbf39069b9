"""Moving pictures of scenes, as animated GIF or MP4."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.errors import InputError, MissingExtraError
from torchreg.geometry.visibility import View
from torchreg.io.atomic import write_atomic
from torchreg.viz.figures import draw_scene, new_figure, picture_size, scene_view
from torchreg.viz.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ANIMATION_ENDINGS = (".gif", ".mp4")

Frame = Callable[["Axes"], object] | NDArray[Any] | Tensor


def save_animation(
    path: str | Path,
    frames: Sequence[Frame],
    fps: float = 20.0,
    *,
    size: tuple[int, int] = (360, 360),
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Return the path of a moving picture: an animated GIF that plays in a loop, or an MP4.

    Args:
        path: to write; the suffix must be .gif or .mp4, for which the program ffmpeg must be installed. The file is
            written whole or not at all; an interruption by the keyboard leaves the frames drawn so far in it.
        frames: pictures (H, W, 3) of one size, uint8 or in [0, 1], or functions that draw on given matplotlib axes.
        fps: frames per second; GIF rounds the time of a frame to 0.01 s.
        size: width and height of frames that are functions, pixels.
        on_frame: called with (frames done, all frames) after each.

    Raises:
        InputError: if there are no frames, sizes differ, or the suffix is another.
        FileNotFoundError: if the folder does not exist.
        MissingExtraError: if ffmpeg is needed and not found.
        OSError: if ffmpeg fails.
    """
    path = check_animation_path(path)
    check_positive(fps, "fps")
    if not len(frames):
        raise InputError("frames must hold at least one frame, got none")
    first = _picture(frames[0], size, 0)
    height, width = first.shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"animation{path.suffix.lower()}"
        writer = _writer(path, fps)
        figure, (canvas,) = new_figure(width, height)
        shown = canvas.imshow(first, extent=(0, width, height, 0), aspect="auto", interpolation="nearest")
        writer.setup(figure, str(file), dpi=figure.dpi)
        grabbed = 0
        try:
            for index, frame in enumerate(frames):
                picture = _picture(frame, size, index) if index else first
                if picture.shape != first.shape:
                    raise InputError(f"frames[{index}] must be {first.shape} like frames[0], got {picture.shape}")
                shown.set_data(_few_tones(picture) if file.suffix == ".gif" else picture)
                writer.grab_frame()
                grabbed = index + 1
                if on_frame is not None:
                    on_frame(grabbed, len(frames))
        except BaseException as error:
            # An encoder outside of this process must end in any case.
            with contextlib.suppress(subprocess.CalledProcessError, IndexError):
                writer.finish()
                if isinstance(error, KeyboardInterrupt) and grabbed:
                    write_atomic(path, file.read_bytes())
            raise
        _finish(writer, path)
        write_atomic(path, file.read_bytes())
    return path


def animate_scene(
    path: str | Path,
    scene: Scene,
    fps: float = 20.0,
    *,
    view: View | None = None,
    size: tuple[int, int] = (360, 360),
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Return the path of a moving picture of all frames of a scene, drawn as by `draw_scene`, in one view.

    Args:
        path: to write; see `save_animation`.
        scene: to draw.
        fps: frames per second.
        view: camera and pixels; by default `scene_view`.
        size: width and height, pixels, of the default view.
        on_frame: called with (frames done, all frames) after each.

    Raises:
        InputError: as for `save_animation`.

    Cost: about 0.1 s and 25 kB per frame.
    """
    path = check_animation_path(path)
    shown = scene_view(scene, size=size, margin=0.1) if view is None else view
    frames = [partial(_draw_frame, scene, number, shown) for number in range(scene.num_frames)]
    return save_animation(path, frames, fps, size=picture_size(shown), on_frame=on_frame)


def _draw_frame(scene: Scene, number: int, view: View, ax: Axes) -> None:
    draw_scene(scene, number, ax, view=view)


def _picture(frame: Frame, size: tuple[int, int], index: int) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) of a frame."""
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
    """Return a picture with 32 tones per channel: GIFs compress runs of equal pixels."""
    step = 255 / 31
    return np.round(np.round(picture / step) * step).astype(np.uint8)


def check_animation_path(path: str | Path) -> Path:
    """Return the path of a moving picture; raises the errors of `save_animation` about it, before frames are drawn."""
    path = Path(path)
    if path.suffix.lower() not in ANIMATION_ENDINGS:
        raise InputError(f"path must end in .gif or .mp4, got {path.name!r}; rename the output file")
    if path.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise MissingExtraError(f"{path.name} needs the program ffmpeg, which is not there; install it or write a .gif")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist; create it first")
    return path


def _writer(path: Path, fps: float) -> Any:
    from matplotlib.animation import FFMpegWriter, PillowWriter

    if path.suffix.lower() == ".mp4":
        return FFMpegWriter(fps=round(fps, 3), codec="h264", bitrate=-1)  # type: ignore[arg-type]
    return PillowWriter(fps=round(fps, 3))  # type: ignore[arg-type]


def _finish(writer: Any, path: Path) -> None:
    try:
        writer.finish()
    except subprocess.CalledProcessError as error:
        said = (error.stderr or "").strip().splitlines()
        raise OSError(f"{path}: ffmpeg failed ({said[-1] if said else error.returncode}); write a .gif") from error
