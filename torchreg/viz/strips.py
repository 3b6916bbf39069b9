"""Pictures in a row: sigma as it is annealed, registered scans by bone and by error, spines over time, convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_points, check_shape
from torchreg.alignment.results import AlignRecord, AlignResult
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import View
from torchreg.registration.results import ScanRegistration
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.spines.results import SpineSequence
from torchreg.viz.animation import coarse_skin
from torchreg.viz.bone_colors import error_colors, weight_colors
from torchreg.viz.figures import (
    INLIER_COLOR,
    draw_mesh,
    draw_points,
    new_figure,
    posed_mesh,
    save_picture,
    watch,
)
from torchreg.viz.spines import draw_spine_frame, spine_view

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class _StripStyle:
    """Panels of a row of pictures."""

    panel: int = 300  # side of each panel, pixels
    caption: float = 0.09  # height of the captions, as a share of the figure's
    bar: float = 0.35  # width of the room for a color bar, in panels
    source: tuple[float, float, float] = (0.80, 0.78, 0.76)
    target: tuple[float, float, float] = (0.55, 0.63, 0.75)


_STYLE = _StripStyle()


def annealing_strip(
    path: str | Path,
    shape: ArticulatedShape,
    data: Tensor,
    result: AlignResult,
    *,
    start: Tensor | None = None,
    skin: LinearBlendSkin | None = None,
    columns: int = 5,
) -> Path:
    """Return the path of a row of pictures: the shape on the data as sigma shrinks, from the start to the end.

    Args:
        path: the picture to write.
        shape: that was aligned.
        data: (M, 3), metres.
        result: of `align`, with its history.
        start: (num_dofs,) pose of the first picture; that after the first step by default.
        skin: the surface to draw; by default a coarse one.
        columns: number of pictures, at least 2.

    Raises:
        InputError: if the result has no history, holds a batch, or a size does not fit.

    References: Dewaele et al. 2006, figure 4.
    """
    check_count(columns, "columns", 2)
    if isinstance(result.status, tuple) or not result.history:
        raise InputError("result must be one alignment with its history")
    data = as_float_tensor(data, "data").detach()
    check_points(data, "data", batch=False)
    surface = coarse_skin(shape) if skin is None else skin
    steps: list[tuple[Tensor, str]] = [] if start is None else [(start, "start")]
    steps += [(record.pose[0], _step_label(record)) for record in _spread(result.history, columns - len(steps))]
    meshes = [posed_mesh(shape, pose, surface) for pose, _ in steps]
    view = watch(torch.cat([mesh.vertices for mesh in meshes]), up=result.up, size=(_STYLE.panel, _STYLE.panel))
    figure, axes = _row([label for _, label in steps])
    inliers = result.inliers.cpu()
    for ax, mesh in zip(axes, meshes, strict=True):
        draw_mesh(ax, mesh, view)
        draw_points(ax, mesh, view, data.cpu(), inliers, tolerance=2 * shape.nu, point_size=3.0, color=INLIER_COLOR)
    return save_picture(figure, path)


def registration_strip(
    path: str | Path,
    result: ScanRegistration,
    target: TriangleMesh,
    *,
    errors: Tensor | None = None,
    unit: str = "",
    largest: float | None = None,
    view: View | None = None,
) -> Path:
    """Return the path of a row of pictures: source, target, the moved source by bones, and by error with a color bar.

    Args:
        path: the picture to write.
        result: a registration whose source has triangles.
        target: the scan that was reached.
        errors: (N,) of the moved points; their distances from the target by default.
        unit: of the scans, written at the color bar.
        largest: the error at the end of the scale; 98 % of the points have less by default.
        view: of square pictures, see `watch`.

    Raises:
        InputError: if the source has no triangles or a size does not fit.
    """
    if result.faces is None or not len(result.faces):
        raise InputError("result must have triangles to be drawn; register scans with faces")
    known = (result.distances if errors is None else as_float_tensor(errors, "errors")).detach().cpu()
    check_shape(known, "errors", (len(result.points),))
    known = known.nan_to_num(0.0, 0.0).clamp(min=0)
    if largest is None:
        largest = float(known.double().quantile(0.98)) or 1.0
    moved = TriangleMesh(result.deformed.detach().cpu(), result.faces.cpu())
    panels: list[tuple[str, TriangleMesh, Tensor]] = [
        ("source", TriangleMesh(result.points.detach().cpu(), moved.faces), _plain(moved, _STYLE.source)),
        ("target", target, _plain(target, _STYLE.target)),
        ("moved, by bones", moved, weight_colors(result.weights.cpu()).clamp(0, 1)),
        ("moved, by error", moved, error_colors(known, largest)),
    ]
    if view is None:
        points = torch.cat([mesh.vertices.detach().cpu() for _, mesh, _ in panels])
        view = watch(points, up=result.up, size=(_STYLE.panel, _STYLE.panel))
    figure, axes = _row([label for label, _, _ in panels], margin=_STYLE.bar)
    for ax, (_, mesh, paint) in zip(axes, panels, strict=True):
        draw_mesh(ax, facing_mesh(mesh, view), view, paint)
    _color_bar(axes[-1], largest, unit)
    return save_picture(figure, path)


def spine_strip(
    path: str | Path,
    spine: SpineSequence,
    meshes: Sequence[TriangleMesh],
    *,
    columns: int = 4,
    view: View | None = None,
) -> Path:
    """Return the path of a row of pictures of a spine over time, limbs in constant colors and numbers.

    Args:
        path: the picture to write.
        spine: of T frames.
        meshes: T surfaces.
        columns: number of frames, evenly spread.
        view: of square pictures, see `spine_view`.

    Raises:
        InputError: if there is not one surface per frame.
    """
    check_count(columns, "columns", 1)
    if len(meshes) != len(spine.curves):
        raise InputError(f"meshes must hold one surface per frame ({len(spine.curves)}), got {len(meshes)}")
    chosen = [int(number) for number in np.unique(np.linspace(0, len(meshes) - 1, columns).round())]
    size = _STYLE.panel, _STYLE.panel
    up = None if spine.up is None else torch.tensor(spine.up)
    shown = spine_view([meshes[number] for number in chosen], up=up, size=size) if view is None else view
    figure, axes = _row([f"frame {number}" for number in chosen])
    for ax, number in zip(axes, chosen, strict=True):
        curves, transferred = spine.curves[number], ~spine.own[number]
        draw_spine_frame(ax, meshes[number], curves, spine.num_tips, view=shown, transferred=transferred)
    return save_picture(figure, path)


def convergence_figure(
    path: str | Path, curves: Mapping[str, Sequence[float]], *, ylabel: str = "cost", logarithmic: bool = True
) -> Path:
    """Return the path of a plot of numbers over steps, a line for each name.

    Args:
        path: the picture to write.
        curves: numbers per step by name, such as ``[float(record.cost) for record in result.history]``.
        ylabel: name of the numbers.
        logarithmic: whether their scale is; numbers that are not positive are then omitted, and lines without others.

    Raises:
        InputError: if there is no line.
    """
    if not curves or not all(len(values) for values in curves.values()):
        raise InputError("curves must hold one line at least, and each a number")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogFormatter, MaxNLocator

    figure = Figure(figsize=(5.2, 3.2), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.add_subplot()
    for name, values in curves.items():
        line = np.asarray(values, dtype=float)
        line = np.where(line > 0, line, np.nan) if logarithmic else line
        if np.isfinite(line).any():
            ax.plot(np.arange(1, len(line) + 1), line, marker="o", markersize=3, linewidth=1.4, label=name)
    ax.set(xlabel="step", ylabel=ylabel, yscale="log" if logarithmic else "linear")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    if logarithmic:
        plain = LogFormatter(labelOnlyBase=False, minor_thresholds=(2.0, 0.5))
        ax.yaxis.set_major_formatter(plain)
        ax.yaxis.set_minor_formatter(plain)
    ax.grid(True, which="both", alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)
    if ax.lines:
        ax.legend(frameon=False)
    return save_picture(figure, path)


def _spread(history: Sequence[AlignRecord], count: int) -> list[AlignRecord]:
    """Return records spread evenly over a history, the first and the last among them."""
    steps = np.unique(np.linspace(0, len(history) - 1, max(count, 1)).round().astype(int))
    return [history[step] for step in steps] if count > 1 else [history[-1]]


def _step_label(record: AlignRecord) -> str:
    if record.stage == "em":
        return f"EM, sigma {1000 * float(record.sigma[0]):.1f} mm"
    return f"surface fit, step {record.step + 1}"


def _row(captions: Sequence[str], margin: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Return a figure with square panels side by side, captions below, and a margin on the right, in panels."""
    panel, bottom = _STYLE.panel, _STYLE.caption
    width, height = int((len(captions) + margin) * panel), int(panel / (1 - bottom))
    figure, _ = new_figure(width, height, 0)
    axes = []
    for column, caption in enumerate(captions):
        axes.append(figure.add_axes((column * panel / width, bottom, panel / width, 1 - bottom)))
        axes[-1].set_axis_off()
        figure.text((column + 0.5) * panel / width, 0.03, caption, ha="center", fontsize=10)
    return figure, axes


def _plain(mesh: TriangleMesh, color: tuple[float, float, float]) -> Tensor:
    return torch.tensor(color).expand(mesh.num_vertices, 3)


def facing_mesh(mesh: TriangleMesh, view: View) -> TriangleMesh:
    """Return a scan with all triangles turned to the camera, whatever their orientation in the file."""
    vertices = mesh.vertices.detach().cpu().double()
    corner, second, third = vertices[mesh.faces].unbind(1)
    normal = torch.linalg.cross(second - corner, third - corner)
    away = ((corner - view.position) * normal).sum(-1) > 0
    faces = torch.where(away.unsqueeze(-1), mesh.faces[:, [0, 2, 1]], mesh.faces)
    return TriangleMesh(vertices.to(mesh.vertices.dtype), faces)


def _color_bar(ax: Axes, largest: float, unit: str) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    shades = error_colors(torch.linspace(0, 1, 256), 1.0).numpy()
    scale = ScalarMappable(Normalize(0, largest), ListedColormap(shades))
    inset = ax.inset_axes((1.06, 0.1, 0.05, 0.8))
    figure = ax.get_figure()
    if figure is not None:
        figure.colorbar(scale, cax=inset, label=f"error{f', {unit}' if unit else ''}")
