"""Pictures of spines: a frame with its surface translucent and its limbs in colors that stay, and all as a movie."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_shape
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton
from torchreg.geometry.visibility import View
from torchreg.spines.results import SpineSequence
from torchreg.viz.animation import save_animation
from torchreg.viz.bone_colors import bone_palette
from torchreg.viz.figures import new_figure, render_mesh, save_picture, watch

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_OVERSAMPLING, _OPACITY, _GRAY = 2, 0.45, 0.82
_FEW_POINTS = 2000
# Points per limb of a single skeleton.
_SAMPLES = 64


def draw_spine_frame(
    ax: Axes, mesh: TriangleMesh, curves: Tensor, num_tips: int, *, view: View, own: Tensor | None = None
) -> None:
    """Draw a translucent surface and the limbs in it, each in its color; tips are dots with their numbers.

    Args:
        ax: matplotlib axes.
        mesh: the surface.
        curves: (L, S, 3), those of the K tips first.
        num_tips: K.
        view: see `spine_view`.
        own: (L,) False for limbs that were carried over from other frames, which are dashed; None: all own.
    """
    curves = as_float_tensor(curves, "curves").detach().cpu()
    check_shape(curves, "curves", ("L", "S", 3))
    paint = torch.full((mesh.num_vertices, 3), _GRAY)
    picture = render_mesh(mesh, view, paint, oversampling=_OVERSAMPLING)
    picture[..., 3] *= _OPACITY
    ax.imshow(picture.cpu().numpy(), extent=(0, view.width, view.height, 0), interpolation="antialiased", zorder=1)
    for limb, (curve, color) in enumerate(zip(curves, bone_palette(len(curves)).tolist(), strict=True)):
        pixels, _ = view.project(curve)
        style = "-" if own is None or bool(own[limb]) else "--"
        ax.plot(*pixels.mT.numpy(), style, color=color, linewidth=2.2, zorder=2)
        if limb < num_tips:
            x, y = pixels[0].tolist()
            ax.plot([x], [y], "o", color=color, markersize=6, zorder=3)
            ax.annotate(str(limb), (x, y), xytext=(4, -4), textcoords="offset points", fontsize=7, zorder=4)
    ax.set_xlim(0, view.width)
    ax.set_ylim(view.height, 0)
    ax.set_aspect("equal")
    ax.set_axis_off()


def spine_view(
    meshes: Sequence[TriangleMesh], *, camera: Tensor | None = None, up: Tensor | None = None,
    size: tuple[int, int] = (480, 480),
) -> View:  # fmt: skip
    """Return the view that shows the surfaces of all frames; see `watch`."""
    points = [mesh.vertices[:: max(1, mesh.num_vertices // _FEW_POINTS)].detach().cpu() for mesh in meshes]
    return watch(torch.cat(points), camera=camera, up=up, size=size)


def save_skeleton_picture(
    path: str | Path, mesh: TriangleMesh, skeleton: Skeleton, *, view: View | None = None
) -> Path:
    """Return the path of a picture of a skeleton in its translucent surface, each limb in a color of its own.

    Raises:
        InputError: if the skeleton is a single node.
    """
    shown = spine_view([mesh]) if view is None else view
    figure, (ax,) = new_figure(shown.width // _OVERSAMPLING, shown.height // _OVERSAMPLING)
    draw_spine_frame(ax, mesh, skeleton.resample(_SAMPLES)[0], len(skeleton.tips), view=shown)
    return save_picture(figure, Path(path))


def save_spine_pictures(
    folder: str | Path,
    spine: SpineSequence,
    meshes: Sequence[TriangleMesh],
    *,
    view: View | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Return the paths of one picture per frame, frame_0000.png and so on, in a folder, which is made if need be.

    Raises:
        InputError: if there is not one surface per frame.
    """
    draw = _drawings(spine, meshes, view)
    place = Path(folder)
    place.mkdir(exist_ok=True)
    paths = []
    for number, (drawn, width, height) in enumerate(draw):
        figure, (ax,) = new_figure(width, height)
        drawn(ax)
        paths.append(save_picture(figure, place / f"frame_{number:04d}.png"))
        if on_frame is not None:
            on_frame(number + 1, len(meshes))
    return paths


def save_spine_movie(
    path: str | Path,
    spine: SpineSequence,
    meshes: Sequence[TriangleMesh],
    *,
    view: View | None = None,
    fps: float = 12.0,
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Return the path of a moving picture, .gif or .mp4, of all frames.

    Raises:
        InputError: if there is not one surface per frame.
    """
    draw = _drawings(spine, meshes, view)
    _, width, height = draw[0]
    return save_animation(path, [drawn for drawn, _, _ in draw], fps, size=(width, height), on_frame=on_frame)


def _drawings(
    spine: SpineSequence, meshes: Sequence[TriangleMesh], view: View | None
) -> list[tuple[Callable[[Axes], object], int, int]]:
    if len(meshes) != len(spine.curves):
        raise InputError(f"meshes must hold one surface per frame ({len(spine.curves)}), got {len(meshes)}")
    shown = spine_view(meshes) if view is None else view

    def drawing(number: int) -> Callable[[Axes], object]:
        return lambda ax: draw_spine_frame(
            ax, meshes[number], spine.curves[number], spine.num_tips, view=shown, own=spine.own[number]
        )

    size = shown.width // _OVERSAMPLING, shown.height // _OVERSAMPLING
    return [(drawing(number), *size) for number in range(len(meshes))]
