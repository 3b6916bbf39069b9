"""Pictures of results in one call, drawn by matplotlib: what `torchreg view` shows, of one frame, from one side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.loaded import as_points
from torchreg.geometry.mesh import TriangleMesh
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.viz.figures import draw_scene
from torchreg.viz.result_scenes import result_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot(
    result: Any,
    data: Any = None,
    *,
    shape: ArticulatedShape | None = None,
    frame: int = -1,
    up: tuple[float, float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Return matplotlib axes with a picture of a result, or of a shape, mesh, scan or cloud.

    Args:
        result: of any system, see `viz.result_scenes.result_scene`.
        data: what was measured: a cloud or mesh, or one per frame; drawn with the result.
        shape: that was aligned or tracked; by default the one that the result keeps.
        frame: to draw, of results over time and batches; the last by default.
        up: upright direction; by default as `torchreg view` guesses it.
        ax: to draw on; by default axes of a new figure, ``plot(...).figure``.

    Raises:
        InputError: if sizes do not fit, or there is no such frame.
        InputTypeError: if there is no picture of such a value.
    """
    scene = result_scene(result, shape=shape, data=_frames(data, getattr(result, "points_of", as_points)))
    if not -scene.num_frames <= frame < scene.num_frames:
        raise InputError(f"frame must be from 0 to {scene.num_frames - 1}, got {frame}")
    return draw_scene(scene if up is None else replace(scene, up=up), frame % scene.num_frames, ax)


def _frames(data: Any, points_of: Callable[[Any], Tensor]) -> Sequence[Tensor | TriangleMesh]:
    """Return measurements as one cloud or mesh per frame."""
    if data is None:
        return ()
    several = data if isinstance(data, (list, tuple)) else [data]
    return [item if isinstance(item, TriangleMesh) else points_of(item) for item in several]
