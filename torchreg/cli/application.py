"""The application ``torchreg``: its commands, its version, and the environment it computes in."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from torchreg import __version__
from torchreg.cli.align import align
from torchreg.cli.calibrate import calibrate
from torchreg.cli.demo import demo
from torchreg.cli.figure import figure
from torchreg.cli.formats import formats
from torchreg.cli.info import info
from torchreg.cli.label import label
from torchreg.cli.pose import pose
from torchreg.cli.register import register
from torchreg.cli.spine import spine
from torchreg.cli.track import track
from torchreg.cli.view import view

app = typer.Typer(
    name="torchreg",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
    no_args_is_help=True,
)


def main() -> None:
    """Run the command line."""
    # Before torch is loaded. The problems are small: threads that wait for a busy core slow them down twentyfold.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    app(prog_name="torchreg")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"torchreg {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Register articulated, bending shapes to 3-D point data.

    Commands compute on one thread unless the environment variable OMP_NUM_THREADS asks for more, which pays for clouds
    of many thousands of points on idle cores.
    """


app.command(short_help="Align a shape to point clouds.")(align)
app.command(short_help="Find a robot's base in a camera, or the size of a hand.")(calibrate)
app.command(short_help="Run the main job on built-in data.")(demo)
app.command(short_help="Draw the bending skin, or the picture of the README.")(figure)
app.command(short_help="Show the formats of files that are read.")(formats)
app.command(short_help="Show the degrees of freedom and the parts of a shape.")(info)
app.command(short_help="Label point clouds with poses, to train networks on.")(label)
app.command(short_help="Extract the moving skeleton of a sequence of meshes.")(spine)
app.command(short_help="Pose a registered scan by dragging points.")(pose)
app.command(short_help="Register two range scans of something that moves.")(register)
app.command(short_help="Follow a shape through a sequence of clouds.")(track)
app.command(short_help="Show a result in the browser, or write it as one HTML file.")(view)
