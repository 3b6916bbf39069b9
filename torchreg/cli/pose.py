"""``torchreg pose``: what was registered, posed anew by dragging points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from torchreg.cli.outputs import Force, Quiet, check_outputs, with_ending
from torchreg.cli.reporting import reporting


@reporting
def pose(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="What register wrote (.safetensors).")],
    handle: Annotated[
        list[str],
        typer.Option(metavar="X,Y,Z", help="Point of the source scan to drag; repeat both options for several."),
    ],
    to: Annotated[list[str], typer.Option(metavar="X,Y,Z", help="Where it should go.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT.ply", help="The posed source, colored by bones.")
    ] = Path("posed.ply"),
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Pose a registered scan: points of it come to lie at targets, joints hold, and the rest moves little.

    Exit codes: 0; 2 for an error.
    """
    path = with_ending(output, (".ply",))
    check_outputs([path], force)
    import torch

    from torchreg.errors import FormatError, InputError
    from torchreg.pipelines.solve_pose import solve_pose
    from torchreg.pipelines.storage import load
    from torchreg.results import ScanRegistration
    from torchreg.viz.bone_colors import save_weight_ply

    if len(handle) != len(to):
        raise InputError(f"--handle and --to must be given equally often, got {len(handle)} and {len(to)}")
    place = result if result.suffix else result.with_suffix(".safetensors")
    found = load(place)
    if not isinstance(found, ScanRegistration):
        raise FormatError(f"{place} holds a {type(found).__name__}; a pose is solved for a ScanRegistration")
    handles, targets = (torch.tensor([_place(text) for text in texts]) for texts in (handle, to))
    solution = solve_pose(found.model, handles, targets)
    found.model.set_transforms_(solution.transforms)
    save_weight_ply(path, found.model, found.points, found.faces, moved=True)
    if not quiet:
        typer.echo(f"handles miss their targets by at most {float(solution.misses.max()):.3g} -> {path}")


def _place(text: str) -> list[float]:
    """Return three numbers, separated by commas or blanks."""
    from torchreg.errors import InputError

    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise InputError(f"a place must be three numbers such as 0.1,0,-2, got {text!r}")
    return numbers
