"""``torchreg spine``: one graph of curves for a sequence of meshes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import NanPolicy, Scale, Support, cloud_files
from torchreg.cli.cameras import Calibration, Seen, load_calibration, seen_folder
from torchreg.cli.export import Old, check_old
from torchreg.cli.outputs import (
    Force,
    Quiet,
    check_outputs,
    check_used,
    claimed,
    counted,
    numbered,
    with_ending,
    written_to,
)
from torchreg.cli.reporting import OptionalOutput, interruption, reporting
from torchreg.cli.upright import Up, known_up, remembering
from torchreg.cli.writers import PICTURES, Source, write_optional
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torchreg.capture.silhouette_frames import SilhouetteFrames
    from torchreg.geometry.mesh import TriangleMesh
    from torchreg.geometry.skeleton import Skeleton
    from torchreg.spines.results import SpineSequence


@dataclass(frozen=True)
class HullOptions:
    """How meshes are made from pictures of several cameras."""

    silhouettes: Annotated[
        bool, typer.Option("--silhouettes", help="FRAMES are folders of masks, or with --screen of pictures.")
    ] = False
    calibration: Calibration = None
    screen: Annotated[
        bool | None, typer.Option("--screen", help="Pictures before a screen of one color stand for masks.")
    ] = None
    resolution: Annotated[
        int | None, typer.Option(min=8, help="Voxels along the longest side of a hull; 128 by default.")
    ] = None
    seen: Seen = None

    def check(self) -> None:
        """Raise InputError if options are given that have no meaning."""
        given = {"--calibration": self.calibration, "--screen": self.screen, "--resolution": self.resolution}
        check_used(self.silhouettes, "--silhouettes", given | {"--seen": self.seen})

    def source(self, folders: list[Path], scale: float) -> Any:
        """Return the silhouettes of all frames."""
        from torchreg.capture.silhouette_frames import SilhouetteFrames

        rig = load_calibration(self.calibration, "--silhouettes", scale)
        return SilhouetteFrames(folders, rig, screen=bool(self.screen), resolution=self.resolution or 128)


@reporting
def spine(
    frames: Annotated[
        list[Path],
        typer.Argument(
            metavar="FRAMES",
            help="The meshes, or clouds of points, in any unit: files, which are put in the order of the numbers in "
            "their names, one folder of them, or one .npz of them. With --silhouettes one folder of masks per camera.",
        ),
    ],
    output: Annotated[Path, written_to("OUT.glb", "OUT.glb, OUT.safetensors and OUT.json are written.")] = Path(
        "spine.glb"
    ),
    *,
    hulls: HullOptions,
    scale: Scale = 1.0,
    nan_policy: NanPolicy = "raise",
    support: Support = "auto",
    swc: Old = None,
    npz: Old = None,
    table: Old = None,
    plot: Old = None,
    movie: Old = None,
    pictures: Old = None,
    up: Up = None,
    prior: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A result of this command (.safetensors) or a skeleton (.swc) whose limbs and names are kept.",
        ),
    ] = None,
    tips: Annotated[int | None, typer.Option(min=2, help="Number of tips; without it the most frequent one.")] = None,
    growing: Annotated[
        bool, typer.Option("--growing", help="Tips may appear and end, as those of a plant; names live as long.")
    ] = False,
    samples: Annotated[int, typer.Option(min=3, help="Points along each limb.")] = 24,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core by default.")] = None,
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 20.0,
    progress: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Keep what is done in a folder; the same command goes on from there."),
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Extract the spine of a creature that moves: limbs and tips that keep their identity, from unrelated meshes.

    The glTF file shows the curves in the translucent surface of one frame, which they move. Everything is in the
    .safetensors file, which `torchreg.load` reads, and from which `torchreg export` writes curves, tables and movies.

    With --silhouettes CAMERA... --calibration FILE the meshes are visual hulls; a folder belongs to the camera of its
    name, or all are in the order of the cameras. How hulls cover masks goes to OUT_seen: white, red where a hull misses
    its mask, blue beyond it.

    Exit codes: 0; 1 if an output other than the result could not be written; 2 for an error; 130 for Ctrl-C.
    """
    from torchreg._checks import check_positive

    check_positive(fps, "--fps")
    glb = with_ending(output, (".glb",), add=True)
    result = glb.with_suffix(".safetensors")
    check_old({"--swc": (swc, ".swc"), "--npz": (npz, ".npz"), "--table": (table, ".csv")}, result)
    check_old({"--plot": (plot, " ".join(PICTURES))}, result)
    check_old({"--movie": (movie, ".gif .mp4"), "--pictures": (pictures, "")}, result, f" --data {frames[0]}")
    hulls.check()
    known, upright = _read_prior(prior, tips, growing), known_up(up, [] if hulls.silhouettes else frames)
    source = hulls.source(frames, scale) if hulls.silhouettes else _clouds(frames, scale, nan_policy)
    curves = [numbered(swc, frame, len(source)) for frame in range(len(source))] if swc is not None else []
    check_outputs([glb, result, result.with_suffix(".json"), npz, table, plot, movie, *curves], force)
    from torchreg.spines.extract_spine import SpineConfig
    from torchreg.spines.frames.frame_surfaces import FrameSurfaces

    config = SpineConfig.growing(num_samples=samples) if growing else SpineConfig(num_tips=tips, num_samples=samples)
    given = {"prior": known, "growing": growing, "config": config, "workers": workers, "support": support}
    with claimed(glb), _kept(progress):
        if hulls.silhouettes:
            meshes: Sequence[TriangleMesh] = _hulls(source, seen_folder(hulls.seen, glb, force), progress, quiet)
        else:
            meshes = FrameSurfaces.of_frames(
                source.clouds(), source.names, workers=workers, progress=progress, support=support
            )
        found = remembering(_extracted(meshes, progress, quiet, **given), upright)
        found.save(result)
        write_optional([glb, swc, npz, table, plot, pictures, movie], Source([found], meshes, fps=fps))
    if not quiet:
        for warning in found.warnings:
            typer.echo(f"torchreg: warning: {_named(warning, source.names)}", err=True)
        typer.echo(_summary(found, glb))


@contextmanager
def _kept(progress: Path | None) -> Iterator[None]:
    """Say on Ctrl-C what is kept, and how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        if progress is None:
            raise interruption("nothing was kept; --progress FOLDER keeps each frame that is done") from None
        done = len(list(progress.glob("frame_*.safetensors"))) if progress.is_dir() else 0
        kept = f"{counted(done, 'frame')} {'is' if done == 1 else 'are'} kept in {progress}"
        raise interruption(f"{kept}; the same command goes on from there") from None


def _extracted(meshes: Sequence[TriangleMesh], progress: Path | None, quiet: bool, **options: Any) -> SpineSequence:
    from tqdm import tqdm

    from torchreg.spines.extract_spine import extract_spine

    with tqdm(total=len(meshes), unit="frame", desc="skeletons", leave=False, disable=quiet) as bar:
        return extract_spine(meshes, progress=progress, on_step=lambda _: bar.update(), **options)


def _read_prior(path: Path | None, tips: int | None, growing: bool) -> Skeleton | SpineSequence | None:
    """Return the skeleton of a file, whose ends are numbered in the order of its lines, or the spine of a result."""
    from torchreg.io.swc import load_swc
    from torchreg.spines.results import SpineSequence
    from torchreg.storage import load

    if growing and (path is not None or tips is not None):
        name = "--tips" if path is None else "--prior"
        raise InputError(f"--growing cannot be used with {name}, which fixes the number of limbs; leave out either")
    if path is None:
        return None
    if path.suffix.lower() == ".swc":
        return load_swc(path)
    spine = load(path) if path.suffix.lower() == ".safetensors" else None
    if not isinstance(spine, SpineSequence):
        raise InputError(f"--prior must be a spine (.safetensors) or a skeleton (.swc), got {path}")
    return spine


def _clouds(paths: list[Path], scale: float, nan_policy: str) -> Any:
    from torchreg.io.frames import load_frames

    return load_frames(cloud_files(paths), scale=scale, nan_policy=nan_policy)


def _hulls(source: SilhouetteFrames, folder: Path, progress: Path | None, quiet: bool) -> list[TriangleMesh]:
    """Return the visual hulls of all frames, and draw each over its masks."""
    from tqdm import tqdm

    from torchreg.io.images import save_image
    from torchreg.viz.seen import hull_sheet

    meshes, drawing = [], OptionalOutput(folder)
    for number in tqdm(range(len(source)), unit="frame", desc="hulls", leave=False, disable=quiet):
        meshes.append(source.mesh(number, progress))
        with drawing:
            save_image(folder / f"hull_{number:04d}.png", hull_sheet(source.masks(number), source.cameras, meshes[-1]))
    return meshes


def _named(warning: str, names: tuple[str, ...]) -> str:
    """Return a warning with the name of its frame's file instead of the number."""
    frame, _, text = warning.removeprefix("frame ").partition(": ")
    return f"{names[int(frame)]}: {text}"


def _summary(found: SpineSequence, glb: Path) -> str:
    agreeing = sum(pair[0] == pair[1] for pair in zip(found.own_topologies, found.topologies, strict=True))
    parts = (found.num_tips, "tip"), (found.junctions.shape[1], "junction"), (len(found.graph), "limb")
    counts = ", ".join(counted(*part) for part in parts)
    return f"{counts}; {agreeing} of {counted(len(found.curves), 'frame')} with this tree by themselves -> {glb}"
