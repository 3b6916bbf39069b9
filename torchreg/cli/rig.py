"""``torchreg rig``: one skinned, animated mesh from a sequence of meshes that share nothing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.align_options import NanPolicy, Scale, cloud_files
from torchreg.cli.outputs import Force, Quiet, check_outputs, claimed, counted, with_ending, written_to
from torchreg.cli.reporting import ExitCode, reporting
from torchreg.cli.upright import Up, known_up
from torchreg.cli.writers import Source, write_optional
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torchreg.registration.rigging.results import SequenceRig


@reporting
def rig(
    frames: Annotated[
        list[Path],
        typer.Argument(
            metavar="FRAMES",
            help="The meshes of one moving thing, in any unit: files, which are put in the order of the numbers in "
            "their names, one folder of them, or one .npz of them. Some may be clouds.",
        ),
    ],
    output: Annotated[
        Path,
        written_to("OUT.glb", "The skinned mesh with its clip; OUT.safetensors and OUT.json are written beside it."),
    ] = Path("rig.glb"),
    template: Annotated[
        int | None, typer.Option(min=0, help="Number of the frame that is rigged, from 0; chosen by default.")
    ] = None,
    bones: Annotated[int, typer.Option(help="Most bones.")] = 32,
    scale: Scale = 1.0,
    nan_policy: NanPolicy = "raise",
    up: Up = None,
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 20.0,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Make a rig with a clip from a sequence of meshes that share neither vertices nor triangles.

    OUT.glb holds one mesh, one skin and one clip; `torchreg export OUT.safetensors -o OUT.bvh` writes the motion alone.
    Frames of another unit or another thing are left out, with a sentence each.

    Exit codes: 0; 1 if the rig does not explain some frames; 2 for an error.
    """
    from torchreg._checks import check_positive

    check_positive(fps, "--fps")
    glb = with_ending(output, (".glb",), add=True)
    result = glb.with_suffix(".safetensors")
    check_outputs([glb, result, result.with_suffix(".json")], force)
    from torchreg.io.frames import load_frames

    clouds = load_frames(cloud_files(frames), scale=scale, nan_policy=nan_policy).clouds()
    if template is not None and template >= len(clouds):
        raise InputError(f"--template must be below the number of frames {len(clouds)}, got {template}")
    from tqdm import tqdm

    from torchreg.registration.rigging.rig_sequence import rig_sequence

    with claimed(glb), tqdm(desc="rig", unit="step", leave=False, disable=quiet) as bar:
        found = rig_sequence(
            clouds, template=template, num_bones=bones, up=known_up(up, frames), on_step=lambda _: bar.update()
        )
        found.save(result)
        write_optional([glb], Source([found], fps=fps))
    if not quiet:
        typer.echo(_summary(found, glb))
    if not found.status.usable:
        raise typer.Exit(ExitCode.UNUSABLE)


def _summary(found: SequenceRig, glb: Path) -> str:
    known = found.errors[found.errors.isfinite()]
    return (
        f"{found.status}: {counted(len(found.joints), 'bone')} in the mesh of frame {found.template}; "
        f"{len(known)} of {counted(len(found.errors), 'frame')}, {float(known.mean()):.2%} of the size away, "
        f"{float(known.max()):.2%} in the worst -> {glb}"
    )
