"""``torchreg register``: one range scan onto another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.outputs import Force, Quiet, check_outputs, with_ending
from torchreg.cli.reporting import UNUSABLE, reporting

if TYPE_CHECKING:
    from torchreg.results import ScanRegistration


@reporting
def register(
    source: Annotated[Path, typer.Argument(help="Scan to be moved (.ply, .obj, .npz, ...), in any unit.")],
    target: Annotated[Path, typer.Argument(help="Scan to be reached, in the same unit and frame.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT.glb",
            help="The moving, skinned source; OUT.safetensors and OUT.json are written beside it. Ending in "
            ".safetensors: the result alone, which scans without triangles need.",
        ),
    ] = Path("registered.glb"),
    bones: Annotated[int, typer.Option(help="Most bones.")] = 10,
    grid: Annotated[int, typer.Option(help="Cells of the grid along the longest side.")] = 50,
    weights: Annotated[Path | None, typer.Option(help="Also write the moved source, colored by bones (.ply).")] = None,
    errors: Annotated[
        Path | None, typer.Option(help="Also write the moved source, colored by its distance from the target (.ply).")
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Register two range scans of something that moves, without a template: bones, weights, the deformation.

    Exit codes: 0; 1 if too few points match to mean anything; 2 for an error; 130 for Ctrl-C.
    """
    output = with_ending(output, (".glb", ".safetensors"))
    result = output.with_suffix(".safetensors")
    scene = output if output.suffix.lower() == ".glb" else None
    weights, errors = with_ending(weights, (".ply",)), with_ending(errors, (".ply",))
    check_outputs([scene, result, result.with_suffix(".json"), weights, errors], force)
    from tqdm import tqdm

    from torchreg.errors import InputError
    from torchreg.io.scans import load_scan
    from torchreg.pipelines.register import register as run

    scans = load_scan(source), load_scan(target)
    if scene is not None and scans[0].faces is None:
        raise InputError(f"{source} has no triangles, which a .glb needs; name an output that ends in .safetensors")
    with tqdm(desc="initialize", unit="step", leave=False, disable=quiet) as bar:

        def show(record: object) -> None:
            bar.set_description(getattr(record, "stage", ""))
            bar.update()

        found = run(*scans, bones, grid, on_step=show)
    _write(found, scene, weights, errors)
    found.save(result)
    if not quiet:
        typer.echo(f"{_summary(found)} -> {scene or result}")
    if not found.status.usable:
        raise typer.Exit(UNUSABLE)


def _write(found: ScanRegistration, scene: Path | None, weights: Path | None, errors: Path | None) -> None:
    if scene is not None and found.faces is not None:
        from torchreg.viz.scan_gltf import save_grid_animation

        save_grid_animation(scene, found.model, found.points, found.faces)
    if weights is not None or errors is not None:
        from torchreg.viz.bone_colors import save_error_ply, save_weight_ply

        if weights is not None:
            save_weight_ply(weights, found.model, found.points, found.faces, moved=True)
        if errors is not None:
            save_error_ply(errors, found.deformed, found.distances, found.faces)


def _summary(found: ScanRegistration) -> str:
    status = found.status.value.replace("_", " ")
    seconds = ", ".join(
        f"{name} {value:.1f} s"
        for name, value in zip(("setup", "initialization", "align", "refine"), found.seconds.tolist(), strict=True)
    )
    share = float(found.matched.float().mean())
    return f"{status}: {found.model.num_bones} bones, {share:.0%} of the points match; {seconds}"
