"""``torchreg export``: files of other programs, tables and pictures from saved results."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import Scale
from torchreg.cli.cameras import DepthOptions
from torchreg.cli.outputs import Force, Quiet, check_outputs, result_file, with_ending, written_to
from torchreg.cli.reporting import reporting
from torchreg.cli.shape_argument import ShapeOptions, chosen_skin
from torchreg.cli.upright import Up, check_up
from torchreg.cli.writers import Source, writer_of
from torchreg.errors import InputError, TorchregWarning

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torchreg.shapes.articulated import ArticulatedShape

# An option of another command that export stands for: it works for one release more.
Old = Annotated[Path | None, typer.Option(hidden=True, help="Write it by torchreg export.")]
OldWord = Annotated[str | None, typer.Option(hidden=True, help="Write it by torchreg export.")]
_NEEDED = {
    "data": "--data with what was measured, a file per frame or a folder",
    "shape": "--shape with what was aligned",
}


@reporting
def export(
    results: Annotated[
        list[Path],
        typer.Argument(metavar="RESULT", help="What a command wrote (.safetensors); alignments may be several."),
    ],
    output: Annotated[Path, written_to("OUT.ENDING", "The file, or a folder for pictures.")],
    *,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="What was measured, once per frame, or a folder: clouds, the target scan, the meshes."),
    ] = None,
    views: DepthOptions,
    shape: Annotated[
        str | None, typer.Option(help="What was aligned or tracked; by default the one that the result keeps.")
    ] = None,
    options: ShapeOptions,
    rig: Annotated[
        Path | None,
        typer.Option(help="Rigged character whose bones were fitted: its file is written with the bones found."),
    ] = None,
    color: Annotated[
        str, typer.Option(metavar="bones|distance", help="What colors a moved scan: bones, or distance.")
    ] = "bones",
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 20.0,
    scale: Scale = 1.0,
    up: Up = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Write a file from a saved result; its ending says what.

    Exit codes: 0; 2 for an error.
    """
    from torchreg._checks import check_choice, check_positive
    from torchreg.storage import load

    check_positive(fps, "--fps")
    check_choice(color, "--color", ("bones", "distance"))
    files = [result_file(path) for path in results]
    found: list[Any] = [load(path) for path in files]
    writer = writer_of(output, found[-1])
    if len(found) > 1 and (not writer.several or len({type(result) for result in found}) > 1):
        raise InputError(f"{output} takes one result, got {len(found)}")
    source = Source(
        found, () if data is None else _measured(data, views, scale, found[-1]),
        None if shape is None else _shape(options.load(shape), found[-1]),
        None if rig is None else (rig, chosen_skin(options.skin)),
        up=check_up(up), fps=fps, color=color,
    )  # fmt: skip
    for name in writer.needs:
        if not getattr(source, name):
            raise InputError(f"{output} needs what the result does not hold; pass {_NEEDED[name]}")
    if output.with_suffix(".safetensors") in files and output.suffix.lower() == ".json":
        raise InputError(f"{output} is a part of the result; name another output")
    if not output.suffix:
        output.mkdir(exist_ok=True)
    check_outputs(writer.files(output, source), force)
    writer.write(output, source)
    if not quiet:
        typer.echo(f"{writer.holds} -> {output}")


def _shape(shape: ArticulatedShape, result: Any) -> ArticulatedShape:
    """Return a shape with the coefficients that a result found."""
    coefficients = getattr(result, "coefficients", None)
    if coefficients is None:
        return shape
    return (shape if shape.coefficient_names else shape.with_bone_coefficients()).with_coefficients(coefficients)


def _measured(paths: list[Path], views: DepthOptions, scale: float, result: Any) -> Sequence[Any]:
    """Return clouds, meshes or depth pictures as the command had them that wrote the result."""
    from torchreg.cli.track_run import Clouds
    from torchreg.cli.view import read_frames
    from torchreg.spines.frames.frame_surfaces import FrameSurfaces

    kind = type(result).__name__
    if kind not in ("TrackResult", "SpineSequence"):
        return views.source(paths) if views.depth else read_frames(paths, scale)
    frames = views.frames(paths, scale, "omit")
    if kind == "SpineSequence":
        return FrameSurfaces.of_frames(frames.clouds(), frames.names)
    clouds = Clouds(frames)
    clouds.origin = result.origin
    return clouds


def check_old(options: Mapping[str, tuple[Any, str]], result: Path, extra: str = "") -> None:
    """Check the endings of options that `torchreg export` stands for, and warn of each that is given."""
    from torchreg.viz.animation import check_animation_path

    for name, (value, endings) in options.items():
        if value is not None:
            path = with_ending(Path(value), endings.split() or [Path(value).suffix])
            if path.suffix == ".mp4":
                check_animation_path(path)
            command = f"torchreg export {result}{extra} -o {value}"
            warnings.warn(f"{name} goes with the next release; `{command}` writes it", TorchregWarning, stacklevel=2)
