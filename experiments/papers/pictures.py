"""Pictures of a block: captioned panels of surfaces side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

import torchreg as tr
from torchreg.viz.figures import draw_scene, new_figure, save_picture, watch
from torchreg.viz.scene import MovingMesh, Scene

PANEL = 260
SOURCE, TARGET = (0.85, 0.45, 0.40), (0.45, 0.55, 0.85)
# What draws a panel.
Drawing = Callable[[Any], object]


def panels(path: Path, drawings: Sequence[tuple[str, Drawing]], rows: int = 1) -> str:
    """Write captioned square pictures in rows, and return the name of the file."""
    columns = -(-len(drawings) // rows)
    figure, _ = new_figure(columns * PANEL, rows * (PANEL + 24), 0)
    for number, (caption, draw) in enumerate(drawings):
        row, column = divmod(number, columns)
        height = PANEL / (rows * (PANEL + 24))
        bottom = 1 - (row + 1) / rows + 24 / (rows * (PANEL + 24))
        ax = figure.add_axes((column / columns, bottom, 1 / columns, height))
        ax.set_axis_off()
        draw(ax)
        figure.text((column + 0.5) / columns, bottom - 16 / (rows * (PANEL + 24)), caption, ha="center", fontsize=9)
    save_picture(figure, path)
    return path.name


def square_view(points: Tensor) -> Any:
    """Return the view of square panels that shows all points (N, 3)."""
    return watch(points[:: max(1, len(points) // 20000)], size=(PANEL, PANEL))


def mesh_drawing(mesh: tr.TriangleMesh, view: Any, color: tuple[float, float, float] | Tensor) -> Drawing:
    """Return what draws a surface in one color, or in colors (V, 3)."""
    scene = Scene("", (MovingMesh("surface", mesh.vertices, mesh.faces, color),))
    return lambda ax: draw_scene(scene, ax=ax, view=view)


def line_plot(
    path: Path, lines: Mapping[str, Sequence[float]], xlabel: str, ylabel: str, *, logarithmic: bool = False
) -> str:
    """Write a plot of numbers over steps, and return the name of the file; a logarithm leaves out zeros."""
    figure, _ = new_figure(640, 300, 0)
    ax = figure.add_axes((0.1, 0.17, 0.86, 0.76))
    for number, (name, values) in enumerate(lines.items()):
        shown = [value if value > 0 or not logarithmic else float("nan") for value in values]
        ax.plot(range(len(shown)), shown, "o-", markersize=4, linewidth=1.3, label=name, color=f"C{number}")
    ax.set(xlabel=xlabel, ylabel=ylabel, yscale="log" if logarithmic else "linear")
    if not logarithmic:
        ax.set_ylim(bottom=0)
    ax.grid(alpha=0.3)
    ax.legend(frameon=False)
    save_picture(figure, path)
    return path.name
