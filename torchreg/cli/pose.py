"""``torchreg pose``: a registered scan, posed anew by dragging points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.outputs import Force, Quiet, check_outputs, result_file, with_ending, written_to
from torchreg.cli.reporting import reporting
from torchreg.cli.upright import Up, check_up
from torchreg.cli.view import Browser, Port, wait_for_interrupt
from torchreg.errors import FormatError, InputError

if TYPE_CHECKING:
    from torchreg.registration.results import PoseSolution, ScanRegistration, SequenceRegistration
    from torchreg.viz.pose_editor import PoseEditor


@reporting
def pose(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="What register wrote (.safetensors).")],
    handle: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Point of the source scan to drag; repeat both options for several. Without any, a page opens on "
            "which points are dragged.",
        ),
    ] = None,
    to: Annotated[list[str] | None, typer.Option(metavar="X,Y,Z", help="Where it should go.")] = None,
    output: Annotated[Path, written_to("OUT.ply", "The posed source, colored by bones.")] = Path("posed.ply"),
    start: Annotated[
        Path | None, typer.Option(help="Pose to start from: what the page saved; by default that of RESULT.")
    ] = None,
    frame: Annotated[int, typer.Option(min=0, help="Of a registered sequence, the pose to start from.")] = 0,
    port: Port = 8080,
    browser: Browser = True,
    up: Up = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Pose a registered scan by inverse kinematics: its points go to targets, and joints constrain the rest.

    With --handle and --to once and for all; without them on a page in the browser, where points are clicked and
    dragged, pinned, undone, and kept as key poses. The page writes OUT.safetensors, OUT.ply and OUT.glb, numbered where
    they exist, needs the extra torchreg-articulated[viewer], and is served to this machine alone until Ctrl-C.

    Exit codes: 0; 2 for an error.
    """
    path = with_ending(output, (".ply",))
    direction = check_up(up)
    if handle or to:
        check_outputs([path], force)
    from torchreg.viz.pose_editor import PoseEditor

    found, first = _load(result, start)
    editor = PoseEditor(found, frame=frame, start=None if first is None else first.transforms, up=direction)
    if handle or to:
        _pose_once(editor, handle or [], to or [], path, quiet)
        return
    from torchreg.viz.pose_app import PoseApp

    with PoseApp(editor, output=path.with_suffix(""), port=port) as app:
        wait_for_interrupt(app.url, browser, quiet)


def _load(result: Path, start: Path | None) -> tuple[ScanRegistration | SequenceRegistration, PoseSolution | None]:
    """Return a registration and, if one is given, a pose to start from."""
    from torchreg.registration.results import PoseSolution, ScanRegistration, SequenceRegistration
    from torchreg.storage import load

    path = result_file(result)
    found = load(path)
    if not isinstance(found, (ScanRegistration, SequenceRegistration)):
        raise FormatError(f"{path} holds a {type(found).__name__}; a pose is solved for a ScanRegistration")
    if start is None:
        return found, None
    first = load(result_file(start))
    if not isinstance(first, PoseSolution):
        raise FormatError(f"{start} holds a {type(first).__name__}; a pose to start from is a PoseSolution")
    return found, first


def _pose_once(editor: PoseEditor, handle: list[str], to: list[str], path: Path, quiet: bool) -> None:
    import torch

    from torchreg.registration.solve_pose import solve_pose
    from torchreg.viz.bone_colors import save_weight_ply

    if len(handle) != len(to):
        raise InputError(f"--handle and --to must be given equally often, got {len(handle)} and {len(to)}")
    handles, targets = (torch.tensor([_point(text) for text in texts]) for texts in (handle, to))
    solution = solve_pose(editor.model, handles, targets)
    editor.model.set_transforms_(solution.transforms)
    save_weight_ply(path, editor.model, editor.points, editor.faces, moved=True)
    if not quiet:
        typer.echo(f"handles miss their targets by at most {float(solution.residuals.max()):.3g} -> {path}")


def _point(text: str) -> list[float]:
    """Return three numbers, separated by commas or blanks."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise InputError(f"a place must be three numbers such as 0.1,0,-2, got {text!r}")
    return numbers
