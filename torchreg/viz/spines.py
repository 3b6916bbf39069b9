"""Pictures of spines: limbs in constant colors in their surfaces, frame by frame or moving, and their measurements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import View
from torchreg.spines.measurements import SpineMeasurements
from torchreg.spines.results import SpineSequence
from torchreg.viz.animation import animate_scene
from torchreg.viz.bone_colors import bone_palette, scale_colors
from torchreg.viz.figures import new_figure, save_scene, scene_view
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Colors of geodesic distances from the tip to the farthest point.
_DISTANCES = ((0.15, 0.25, 0.6), (0.2, 0.65, 0.7), (0.95, 0.9, 0.4), (0.85, 0.25, 0.15))


def tip_distance_paint(mesh: TriangleMesh, tip: Tensor, levels: int | None = None) -> Tensor:
    """Return colors (V, 3) of the geodesic distance from the vertex nearest to a tip (3,), or of its level sets.

    References: Brostow, Essa, Steedly and Kwatra 2004, figures 2 and 6.
    """
    start = (mesh.vertices - tip.to(mesh.vertices)).norm(dim=-1).argmin()
    share = GeodesicGraph.from_mesh(mesh).distances(start[None])[0].float()
    share = share / share.max().clamp_min(torch.finfo(share.dtype).tiny)
    if levels is None:
        return scale_colors(share, _DISTANCES)
    level = (share * levels).floor().clamp(max=levels - 1)
    return torch.where(level % 2 == 0, 1.0, 0.55)[:, None] * scale_colors(level / levels, _DISTANCES)


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
    scene = _scene(spine, meshes)
    shown = scene_view(scene) if view is None else view
    Path(folder).mkdir(exist_ok=True)
    paths = []
    for number in range(len(meshes)):
        paths.append(save_scene(Path(folder) / f"frame_{number:04d}.png", scene, number, view=shown))
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
    return animate_scene(path, _scene(spine, meshes), fps, view=view, size=(480, 480), on_frame=on_frame)


def _scene(spine: SpineSequence, meshes: Sequence[TriangleMesh]) -> Scene:
    if not len(meshes):
        raise InputError(f"data must hold one surface per frame ({len(spine.curves)}), got none")
    return replace(result_scene(spine, data=meshes), title="")
