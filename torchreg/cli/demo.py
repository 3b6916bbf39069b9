"""``torchreg demo``: the main job on built-in data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.outputs import Force, Quiet, check_outputs, counted, written_to
from torchreg.cli.reporting import OptionalOutput, interruption, reporting
from torchreg.cli.writers import Source, write_optional

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.tracking.results import DemoResult


@reporting
def demo(
    output: Annotated[Path, written_to("FOLDER", "Where to write; made if it does not exist.")] = Path("torchreg_demo"),
    frames: Annotated[int, typer.Option(min=1, help="Number of frames, 20 per second.")] = 40,
    seed: Annotated[int, typer.Option(help="Seed of motion and measurements.")] = 0,
    no_movie: Annotated[bool, typer.Option("--no-movie", help="Do not draw the animation.")] = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Run the main job on built-in data: find a hand and follow it, as a noisy pair of cameras sees it, with outliers.

    Writes poses.json, poses by name of degree of freedom, metres and radians; track.safetensors, all that was found
    (torchreg.load reads it, torchreg view shows it); hand.glb and tracking.gif. Ctrl-C ends the sequence early; what
    was done is written.
    """
    track, poses = output / "track.safetensors", output / "poses.json"
    scene, movie = output / "hand.glb", output / "tracking.gif"
    wanted = [poses, track, track.with_suffix(".json"), *([] if no_movie else [movie]), scene]
    check_outputs([path for path in wanted if output.exists()], force)
    output.mkdir(parents=True, exist_ok=True)

    from tqdm import tqdm

    from torchreg.shapes.hand import Hand
    from torchreg.tracking.demo import DEMO_FPS, run_demo
    from torchreg.viz.tracking import animate_track

    with tqdm(total=frames, unit="frame", desc="tracking", leave=False, disable=quiet) as bar:
        result = run_demo(frames, seed, on_frame=lambda done, planned: bar.update())
    count, hand = len(result.clouds), Hand()
    result.save(track)
    source = Source([result.track], shape=hand)
    write_optional([poses], source)
    if not quiet:
        typer.echo(_speed(result))
        _print_tip_errors("all", result.tip_errors.flatten())
        _print_tip_errors("seen by the cameras", result.tip_errors[result.tips_seen])
    write_optional([scene], source)
    if not no_movie:
        bar = tqdm(total=count, unit="frame", desc="drawing", leave=False, disable=quiet)
        with OptionalOutput(movie), bar:
            animate_track(
                movie, hand, result.track, result.clouds, inliers=result.inliers, fps=DEMO_FPS,
                on_frame=lambda done, planned: bar.update(),
            )  # fmt: skip
    if not quiet:
        typer.echo(f"wrote {', '.join(str(path) for path in wanted if path.exists())}")
    if count < frames:
        raise interruption(f"{count} of {frames} frames are done")


def _speed(result: DemoResult) -> str:
    sizes, seconds = sorted(len(cloud) for cloud in result.clouds), result.track.seconds
    points = f"{sizes[0]} to {sizes[-1]} points" if sizes[0] < sizes[-1] else f"{sizes[0]} points"
    text = f"{counted(len(seconds), 'frame')} of {points}: {float(seconds[0]):.1f} s to find the hand in the first"
    return text if len(seconds) == 1 else f"{text}, then {1 / float(seconds[1:].mean()):.1f} frames/s"


def _print_tip_errors(which: str, errors: Tensor) -> None:
    errors = errors[errors.isfinite()]
    if len(errors):
        values = f"mean {1e3 * float(errors.mean()):.1f} mm, max {1e3 * float(errors.max()):.1f} mm"
        typer.echo(f"fingertip error, {which}: {values} ({len(errors)} fingertips)")
