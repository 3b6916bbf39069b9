"""``torchreg info``: the degrees of freedom and the parts of a shape."""

from __future__ import annotations

import math

import typer

from torchreg.cli.reporting import reporting
from torchreg.cli.shape_argument import FreeBase, PackageDir, Parents, Shape, Skin, load_shape


@reporting
def info(
    shape: Shape, parents: Parents = None, package_dir: PackageDir = None, free_base: FreeBase = None, skin: Skin = None
) -> None:
    """Show the degrees of freedom of a shape with their limits, and its parts."""
    model = load_shape(shape, parents, package_dir, free_base, skin)
    rest = model.surface.vertices if model.surface is not None else model.surface_mesh().vertices
    size = float((rest.amax(0) - rest.amin(0)).norm())
    surface = "the file's mesh" if model.surface is not None else "fused solids"
    typer.echo(f"{shape}: {model.num_parts} parts, {model.num_dofs} degrees of freedom, {surface}, {size:.3f} m across")
    sliding = {joint.name for joint in model.kinematics.tree.joints if joint.kind == "prismatic"}
    width = max(len(name) for name in (*model.dof_names, *model.part_names))
    typer.echo("\ndegrees of freedom")
    limits = zip(model.dof_names, model.lower.tolist(), model.upper.tolist(), strict=True)
    for index, (name, lower, upper) in enumerate(limits):
        unit, factor = ("m", 1.0) if index < 3 or name in sliding else ("deg", 180 / math.pi)
        bounds = "fixed" if lower == upper else f"{factor * lower:g} to {factor * upper:g} {unit}"
        typer.echo(f"  {name:{width}}  {'free' if math.isinf(lower) and math.isinf(upper) else bounds}")
    typer.echo("\nparts")
    for name, kind, parent in zip(model.part_names, model.primitives.part_kinds, model.part_parents, strict=True):
        typer.echo(f"  {name:{width}}  {kind}{f' on {model.part_names[parent]}' if parent >= 0 else ''}")
