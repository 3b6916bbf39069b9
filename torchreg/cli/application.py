"""The application ``torchreg``: its commands, its version, and the environment it computes in."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Annotated

import typer

from torchreg import __version__
from torchreg.cli.align import align
from torchreg.cli.calibrate import calibrate
from torchreg.cli.demo import demo
from torchreg.cli.export import export
from torchreg.cli.figure import figure
from torchreg.cli.formats import formats
from torchreg.cli.info import info
from torchreg.cli.label import label
from torchreg.cli.near_options import Command
from torchreg.cli.pose import pose
from torchreg.cli.register import register
from torchreg.cli.rig import rig
from torchreg.cli.spine import spine
from torchreg.cli.track import track
from torchreg.cli.train_initializer import train_initializer
from torchreg.cli.view import view
from torchreg.cli.writers import endings_help

app = typer.Typer(
    name="torchreg", rich_markup_mode=None, pretty_exceptions_enable=False, add_completion=False, no_args_is_help=True
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


# Each command with a line on it and two examples, which end its help.
_COMMANDS: tuple[tuple[Callable[..., None], str, tuple[str, str]], ...] = (
    (align, "Align a shape to point clouds.",
     ("align hand scan.ply --scale 0.001 -o result", "align hand depth/ --depth --intrinsics camera.json")),
    (calibrate, "Find a robot's base in a camera, or the size of a hand.",
     ("calibrate robot.urdf clouds/ --joints joints.csv -o base", "calibrate hand frames/ -o my_hand")),
    (demo, "Run the main job on built-in data.", ("demo", "demo --frames 20 --seed 3 -o here")),
    (export, "Write a file of another program, a table or a picture from a result.",
     ("export moving.safetensors -o moving.bvh", "export spine.safetensors --data meshes/ -o spine.gif")),
    (figure, "Draw the bending skin, or the picture of the README.", ("figure bending", "figure readme -o readme.svg")),
    (formats, "Show the formats of files that are read.", ("formats", "formats | grep -A 3 Cameras")),
    (info, "Show the degrees of freedom and parts of a shape, or what a result holds.",
     ("info robot.urdf --fixed-base", "info result.safetensors")),
    (label, "Label point clouds with poses, to train networks on.",
     ("label hand frames/ -o labels", "label hand frames.npz --start pose.json --trusted 0.8")),
    (spine, "Extract the moving skeleton of a sequence of meshes.",
     ("spine meshes/ -o spine.glb", "spine meshes/*.obj --up y --tips 5")),
    (pose, "Pose a registered scan by dragging points.",
     ("pose moved.safetensors", "pose moved.safetensors --handle 0.1,0,2 --to 0.2,0,2 -o posed.ply")),
    (register, "Register two range scans of something that moves.",
     ("register a.ply b.ply -o moved.glb", "register --depth a.png b.png --intrinsics camera.json")),
    (rig, "Make a rig with a clip from a sequence of meshes.",
     ("rig meshes/ -o creature.glb", "rig meshes/*.obj --template 3 --bones 12")),
    (track, "Follow a shape through a sequence of clouds.",
     ("track hand frames/ -o moving",
      "track hand depth/ --depth --intrinsics camera.json")),
    (train_initializer, "Train a network that proposes poses of a shape.",
     ("train-initializer rig.glb -o rig.safetensors", "train-initializer hand --device cuda --batch 512 --minutes 5")),
    (view, "Show a result, a shape or a scan in the browser, or write one HTML file.",
     ("view moving.safetensors --data frames/", "view scan.obj --html scan.html")),
)  # fmt: skip

for _command, _help, _examples in _COMMANDS:
    # The control character keeps the lines as they are.
    _lines = "\n".join(f"  torchreg {example}" for example in _examples)
    _more = f"\n\n\b\nFiles of results:\n{endings_help()}" if _command is export else ""
    app.command(cls=Command, short_help=_help, epilog=f"\b\nExamples:\n{_lines}{_more}")(_command)
