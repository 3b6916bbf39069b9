"""Pictures of results in one call, drawn by matplotlib: what `torchreg view` shows, of one frame, from one side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.loaded import as_points
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import View
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.viz.figures import draw_rendered, new_figure, picture_size, render_mesh, show_pixels, watch
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.scene import Cloud, Curves, Layer, Meshes, MovingMesh, Scene
from torchreg.viz.strips import facing_mesh

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


def draw_scene(scene: Scene, frame: int, ax: Axes | None = None, *, size: tuple[int, int] = (480, 480)) -> Axes:
    """Return axes with a picture of the visible layers of a scene in one frame, from the scene's camera."""
    position, _, up = scene.camera()
    view = watch(scene.sample(), camera=position, up=up, size=size)
    if ax is None:
        ax = new_figure(*picture_size(view))[1][0]
    layers = [layer for layer in scene.layers if layer.visible]
    show_pixels(ax, view)
    ax.set_aspect("equal")
    ax.set_axis_off()
    for layer in layers:
        _draw(ax, view, layer, frame)
    ax.set_title(scene.title, fontsize=9, y=0.95)
    return ax


def _frames(data: Any, points_of: Callable[[Any], Tensor]) -> Sequence[Tensor | TriangleMesh]:
    """Return measurements as one cloud or mesh per frame."""
    if data is None:
        return ()
    several = data if isinstance(data, (list, tuple)) else [data]
    return [item if isinstance(item, TriangleMesh) else points_of(item) for item in several]


def _draw(ax: Axes, view: View, layer: Layer, frame: int) -> None:
    points = layer.points(frame if layer.num_frames > 1 else 0).detach().cpu()
    if isinstance(layer, Cloud):
        _draw_cloud(ax, view, layer, points, layer.paint(frame))
    elif isinstance(layer, Curves):
        for curve, color in zip(points, layer.paint.tolist(), strict=True):
            ax.plot(*view.project(curve)[0].mT.numpy(), color=color, linewidth=2, zorder=3)
    elif bool(points.isfinite().all()):  # a shape that was not found in a frame has NaN
        faces, paint = _surface(layer, frame)
        _draw_surface(ax, view, TriangleMesh(points.double(), faces), paint, layer.opacity)


def _surface(layer: MovingMesh | Meshes, frame: int) -> tuple[Tensor, Tensor | tuple[float, float, float]]:
    if isinstance(layer, MovingMesh):
        return layer.faces.cpu(), layer.paint
    return layer.frames[frame if layer.num_frames > 1 else 0].faces.cpu(), layer.color


def _draw_surface(
    ax: Axes, view: View, mesh: TriangleMesh, paint: Tensor | tuple[float, float, float], opacity: float
) -> None:
    colors = paint.detach().cpu() if isinstance(paint, Tensor) else torch.tensor(paint).expand(mesh.num_vertices, 3)
    picture = render_mesh(facing_mesh(mesh, view), view, colors)
    picture[..., 3] *= opacity
    draw_rendered(ax, picture, view)


def _draw_cloud(ax: Axes, view: View, layer: Cloud, points: Tensor, colors: Tensor) -> None:
    pixels, depth = view.project(points)
    seen = depth > 0
    inches = min(picture_size(view)) / ax.figure.dpi
    width = max(1.0, 72 * layer.size * inches)
    x, y = pixels[seen].mT.numpy()
    ax.scatter(x, y, s=width**2, c=colors[seen].numpy(), linewidths=0, zorder=2)
