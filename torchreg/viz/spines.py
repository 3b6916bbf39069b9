"""Pictures of spines: translucent surfaces with limbs in constant colors, frame by frame or as a moving picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton
from torchreg.geometry.visibility import View
from torchreg.spines.measurements import SpineMeasurements
from torchreg.spines.results import SpineSequence
from torchreg.viz.animation import save_animation
from torchreg.viz.bone_colors import bone_palette, scale_colors
from torchreg.viz.figures import draw_mesh, draw_rendered, new_figure, picture_size, render_mesh, save_picture, watch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class _SpinePicture:
    """Surface and curves of a picture."""

    gray: float = 0.82  # of the surface, from 0 to 1
    opacity: float = 0.45  # of the surface
    num_samples: int = 64  # points per limb of a single skeleton
    # Colors of geodesic distances from the tip to the farthest point.
    distances: tuple[tuple[float, float, float], ...] = (
        (0.15, 0.25, 0.6), (0.2, 0.65, 0.7), (0.95, 0.9, 0.4), (0.85, 0.25, 0.15),
    )  # fmt: skip
    dark: float = 0.55  # brightness of every second level set


_STYLE = _SpinePicture()


def draw_spine_frame(
    ax: Axes, mesh: TriangleMesh, curves: Tensor, num_tips: int, *, view: View, transferred: Tensor | None = None
) -> None:
    """Draw a translucent surface and its limbs, each in its color; tips are dots with their numbers.

    Args:
        ax: matplotlib axes.
        mesh: the surface.
        curves: (L, S, 3), those of the K tips first.
        num_tips: K.
        view: see `spine_view`.
        transferred: (L,) bool, True for limbs transferred from other frames, which are dashed; none by default.
    """
    curves = curves.detach().cpu()
    picture = render_mesh(mesh, view, torch.full((mesh.num_vertices, 3), _STYLE.gray))
    picture[..., 3] *= _STYLE.opacity
    draw_rendered(ax, picture, view)
    for limb, (curve, color) in enumerate(zip(curves, bone_palette(len(curves)).tolist(), strict=True)):
        if bool(curve.isnan().any()):
            continue  # an organ that is not there
        pixels, _ = view.project(curve)
        style = "-" if transferred is None or not bool(transferred[limb]) else "--"
        ax.plot(*pixels.mT.numpy(), style, color=color, linewidth=2.2, zorder=2)
        if limb < num_tips:
            x, y = pixels[0].tolist()
            ax.plot([x], [y], "o", color=color, markersize=6, zorder=3)
            ax.annotate(str(limb), (x, y), xytext=(4, -4), textcoords="offset points", fontsize=7, zorder=4)


def draw_tip_distance(ax: Axes, mesh: TriangleMesh, tip: Tensor, *, view: View, levels: int | None = None) -> None:
    """Draw a surface in the colors of the geodesic distance from a tip.

    Args:
        ax: matplotlib axes.
        mesh: the surface.
        tip: (3,) the vertex nearest to it is where distances begin.
        view: see `spine_view`.
        levels: number of level sets, drawn light and dark in turn; None draws the distance itself.

    References: Brostow, Essa, Steedly and Kwatra 2004, figures 2 and 6.
    """
    start = (mesh.vertices - tip.to(mesh.vertices)).norm(dim=-1).argmin()
    share = GeodesicGraph.from_mesh(mesh).distances(start[None])[0].float()
    share = share / share.max().clamp_min(torch.finfo(share.dtype).tiny)
    if levels is None:
        draw_mesh(ax, mesh, view, scale_colors(share, _STYLE.distances))
        return
    level = (share * levels).floor().clamp(max=levels - 1)
    shade = torch.where(level % 2 == 0, 1.0, _STYLE.dark)
    draw_mesh(ax, mesh, view, shade[:, None] * scale_colors(level / levels, _STYLE.distances))


def spine_view(
    meshes: Sequence[TriangleMesh], *, camera: Tensor | None = None, up: Tensor | None = None,
    size: tuple[int, int] = (480, 480),
) -> View:  # fmt: skip
    """Return the view that shows the surfaces of all frames; see `watch`."""
    points = [mesh.vertices[:: max(1, mesh.num_vertices // 2000)].detach().cpu() for mesh in meshes]
    return watch(torch.cat(points), camera=camera, up=up, size=size)


def save_skeleton_picture(
    path: str | Path, mesh: TriangleMesh, skeleton: Skeleton, *, view: View | None = None
) -> Path:
    """Return the path of a picture of a skeleton in its translucent surface, limbs in different colors."""
    shown = spine_view([mesh]) if view is None else view
    figure, (ax,) = new_figure(*picture_size(shown))
    draw_spine_frame(ax, mesh, skeleton.resample(_STYLE.num_samples)[0], len(skeleton.tips), view=shown)
    return save_picture(figure, Path(path))


def draw_measurements(measurements: SpineMeasurements) -> Figure:
    """Return a figure of lengths, radii and angles over time, limbs in the colors that they have in pictures.

    An angle is drawn in the color of the first of its limbs, dashed in that of the second. What grows has lines from
    its birth to its end. A single frame is drawn as dots.
    """
    figure, axes = new_figure(720, 720, 3)
    times = measurements.times.detach().cpu()
    colors = bone_palette(measurements.lengths.shape[1]).tolist()
    marker = "o" if len(times) == 1 else None
    panels = (
        ("length of limbs", measurements.lengths),
        ("mean radius of limbs", measurements.radii),
        ("angle between limbs, degrees", measurements.angles.rad2deg()),
    )
    for row, (ax, (title, values)) in enumerate(zip(axes, panels, strict=True)):
        ax.set_position((0.1, 0.71 - 0.32 * row, 0.75, 0.25))
        ax.set_axis_on()
        ax.set_title(title, fontsize=9, loc="left")
        drawn = values.detach().cpu()
        for column, line in enumerate(drawn.unbind(1)):
            if row < len(panels) - 1:
                ax.plot(times, line, color=colors[column], marker=marker, label=str(column))
            else:
                first, second = measurements.pairs[column].tolist()
                ax.plot(times, line, color=colors[first], marker=marker)
                ax.plot(times, line, color=colors[second], dashes=(3, 3), marker=marker)
        ax.margins(x=0.01)
    axes[-1].set_xlabel("time")
    axes[0].legend(title="limb", loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=8, frameon=False)
    return figure


def save_spine_pictures(
    folder: str | Path,
    spine: SpineSequence,
    meshes: Sequence[TriangleMesh],
    *,
    view: View | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Return the paths of one picture per frame, frame_0000.png and so on, in a folder, which is made if need be."""
    draw, size = _drawings(spine, meshes, view)
    Path(folder).mkdir(exist_ok=True)
    paths = []
    for number, drawn in enumerate(draw):
        figure, (ax,) = new_figure(*size)
        drawn(ax)
        paths.append(save_picture(figure, Path(folder) / f"frame_{number:04d}.png"))
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
    """Return the path of a moving picture, .gif or .mp4, of all frames."""
    draw, size = _drawings(spine, meshes, view)
    return save_animation(path, draw, fps, size=size, on_frame=on_frame)


def _drawings(
    spine: SpineSequence, meshes: Sequence[TriangleMesh], view: View | None
) -> tuple[list[Callable[[Axes], object]], tuple[int, int]]:
    """Return functions that draw each frame, and the size of the pictures."""
    if len(meshes) != len(spine.curves):
        raise InputError(f"meshes must hold one surface per frame ({len(spine.curves)}), got {len(meshes)}")
    up = None if spine.up is None else torch.tensor(spine.up)
    shown = spine_view(meshes, up=up) if view is None else view

    def drawing(number: int) -> Callable[[Axes], object]:
        return lambda ax: draw_spine_frame(
            ax, meshes[number], spine.curves[number], spine.num_tips, view=shown, transferred=~spine.own[number]
        )

    return [drawing(number) for number in range(len(meshes))], picture_size(shown)
