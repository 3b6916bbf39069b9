"""``torchreg demo``: the main job on built-in data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.outputs import Force, check_outputs
from torchreg.cli.reporting import interruption, reporting

if TYPE_CHECKING:
    from torch import Tensor


@reporting
def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where to write; made if it does not exist.")
    ] = Path("torchreg_demo"),
    frames: Annotated[int, typer.Option(min=1, help="Number of frames, 20 per second.")] = 40,
    seed: Annotated[int, typer.Option(help="Of motion and measurements.")] = 0,
    picture: Annotated[bool, typer.Option("--picture/--no-picture", help="Whether to draw the animation.")] = True,
    force: Force = False,
) -> None:
    """Run the main job on built-in data: follow a bending hand through noisy one-sided clouds with outliers.

    Writes poses.safetensors (read it with torchreg.load), hand.glb and alignment.gif. Ctrl-C ends the sequence early;
    what was done is written.
    """
    poses, scene, movie = output / "poses.safetensors", output / "hand.glb", output / "alignment.gif"
    wanted = [poses, poses.with_suffix(".json"), scene, *([movie] if picture else [])]
    check_outputs([path for path in wanted if output.exists()], force)
    output.mkdir(parents=True, exist_ok=True)

    from tqdm import tqdm

    from torchreg.models.hand import Hand
    from torchreg.pipelines.demo import DEMO_FPS, run_demo
    from torchreg.viz.gltf import save_shape_animation

    with tqdm(total=frames, unit="frame", desc="aligning", leave=False) as bar:
        result = run_demo(frames, seed, on_frame=lambda done, planned: bar.update())
    count, hand = len(result.poses), Hand()
    result.save(poses)
    typer.echo(f"{count} frames of {result.clouds.shape[1]} points: {count / float(result.seconds.sum()):.1f} frames/s")
    _print_tip_errors("all", result.tip_errors.flatten())
    _print_tip_errors("seen by the camera", result.tip_errors[result.tips_seen])
    save_shape_animation(scene, hand, result.poses, fps=DEMO_FPS)
    if picture:
        from torchreg.viz.animation import animate_alignment

        with tqdm(total=count, unit="frame", desc="drawing", leave=False) as bar:
            animate_alignment(
                movie, hand, result.poses, list(result.clouds), inliers=list(result.inliers), fps=DEMO_FPS,
                on_frame=lambda done, planned: bar.update(),
            )  # fmt: skip
    typer.echo(f"wrote {', '.join(str(path) for path in wanted)}")
    if count < frames:
        raise interruption(f"{count} of {frames} frames are done")


def _print_tip_errors(which: str, errors: Tensor) -> None:
    if len(errors):
        values = f"mean {1e3 * float(errors.mean()):.1f} mm, max {1e3 * float(errors.max()):.1f} mm"
        typer.echo(f"fingertip error, {which}: {values} ({len(errors)} fingertips)")
