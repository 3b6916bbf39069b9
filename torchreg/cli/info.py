"""``torchreg info``: the degrees of freedom and the parts of a shape, or what a result holds."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.outputs import result_file
from torchreg.cli.reporting import reporting
from torchreg.cli.shape_argument import ShapeOptions
from torchreg.cli.view import is_result

if TYPE_CHECKING:
    from torchreg.shapes.articulated import ArticulatedShape


@reporting
def info(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="hand, hand-left, a robot (.urdf), a rigged character (.glb, .gltf), or a result (.safetensors).",
        ),
    ],
    options: ShapeOptions,
) -> None:
    """Show the degrees of freedom of a shape with their limits, and its parts; or what a result holds."""
    if is_result(Path(what)):
        _show_result(Path(what))
    else:
        _show_shape(what, options.load(what))


def _show_shape(name: str, model: ArticulatedShape) -> None:
    rest = model.surface.vertices if model.surface is not None else model.surface_mesh().vertices
    size = float((rest.amax(0) - rest.amin(0)).norm())
    surface = "the file's mesh" if model.surface is not None else "fused solids"
    typer.echo(f"{name}: {model.num_parts} parts, {model.num_dofs} degrees of freedom, {surface}, {size:.3f} m across")
    width = max(len(word) for word in (*model.dof_names, *model.part_names))
    typer.echo("\ndegrees of freedom")
    limits = zip(model.dof_names, model.lower.tolist(), model.upper.tolist(), _units(model), strict=True)
    for dof, lower, upper, (unit, factor) in limits:
        bounds = "fixed" if lower == upper else f"{factor * lower:g} to {factor * upper:g} {unit}"
        typer.echo(f"  {dof:{width}}  {'free' if math.isinf(lower) and math.isinf(upper) else bounds}")
    typer.echo("\nparts")
    for part, kind, parent in zip(model.part_names, model.primitives.part_kinds, model.part_parents, strict=True):
        typer.echo(f"  {part:{width}}  {kind}{f' on {model.part_names[parent]}' if parent >= 0 else ''}")


def _units(model: ArticulatedShape) -> list[tuple[str, float]]:
    """Return the unit of each degree of freedom as it is shown, and the factor to it."""
    return [("m", 1.0) if slides else ("deg", 180 / math.pi) for slides in model.is_sliding.tolist()]


def _show_result(path: Path) -> None:
    from torchreg.storage import load

    found: Any = load(result_file(path))
    typer.echo(f"{path}: {type(found).__name__}\n")
    rows = found.summary()
    width = max(len(name) for name, _ in rows)
    for name, text in rows:
        typer.echo(f"  {name:{width}}  {text}")
    pose, shape = getattr(found, "pose", None), getattr(found, "shape", None)
    if pose is None or pose.ndim != 1 or shape is None:
        return
    typer.echo("\npose")
    width = max(len(name) for name in shape.dof_names)
    for (name, value), (unit, factor) in zip(found.named_pose.items(), _units(shape), strict=True):
        typer.echo(f"  {name:{width}}  {factor * value:.4g} {unit}")
