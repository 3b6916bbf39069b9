"""``torchreg spine``: one graph of curves for a sequence of meshes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.align_options import NanPolicy, Scale, cloud_files
from torchreg.cli.cameras import Calibration, Seen, check_used, load_calibration, seen_folder
from torchreg.cli.outputs import (
    PICTURE_ENDINGS,
    Force,
    Quiet,
    check_outputs,
    claimed,
    counted,
    numbered,
    tell_origin,
    with_ending,
)
from torchreg.cli.reporting import OptionalOutput, interruption, reporting
from torchreg.cli.support_option import Support
from torchreg.cli.upright import Up, known_up, remembering

if TYPE_CHECKING:
    from torchreg.capture.silhouette_frames import SilhouetteFrames
    from torchreg.geometry.mesh import TriangleMesh
    from torchreg.geometry.skeleton import Skeleton
    from torchreg.spines.extract_spine import SpineConfig
    from torchreg.spines.results import SpineSequence


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
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="OUT.glb", help="OUT.glb, OUT.safetensors and OUT.json are written."),
    ] = Path("spine.glb"),
    silhouettes: Annotated[
        bool, typer.Option("--silhouettes", help="FRAMES are folders of masks, or with --screen of pictures.")
    ] = False,
    calibration: Calibration = None,
    screen: Annotated[
        bool | None, typer.Option("--screen", help="Pictures before a screen of one color stand for masks.")
    ] = None,
    resolution: Annotated[
        int | None, typer.Option(min=8, help="Voxels along the longest side of a hull; 128 by default.")
    ] = None,
    seen: Seen = None,
    scale: Scale = 1.0,
    nan_policy: NanPolicy = "raise",
    support: Support = "auto",
    swc: Annotated[
        Path | None, typer.Option(metavar="OUT.swc", help="Also write the curves as SWC, one numbered file per frame.")
    ] = None,
    npz: Annotated[
        Path | None, typer.Option(metavar="OUT.npz", help="Also write tips, graph, curves, radii as arrays.")
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(metavar="OUT.csv", help="Also write lengths, radii and angles of limbs, one line per frame."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="OUT.png", help="Also draw lengths, radii and angles of limbs over time."),
    ] = None,
    movie: Annotated[
        Path | None, typer.Option(metavar="OUT.gif", help="Also draw all frames as a moving picture, .gif or .mp4.")
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Also draw each frame (frame_0000.png).")
    ] = None,
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
        bool,
        typer.Option("--growing", help="Tips may appear and end, as those of a plant; names live as long."),
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
    .safetensors file, which `torchreg.load` reads.

    With --silhouettes CAMERA... --calibration FILE the meshes are visual hulls; a folder belongs to the camera of its
    name, or all are in the order of the cameras. How hulls cover masks goes to OUT_seen: white, red where a hull misses
    its mask, blue beyond it.

    Exit codes: 0; 1 if an output beside the result could not be written; 2 for an error; 130 for Ctrl-C.
    """
    from torchreg._checks import check_positive

    check_positive(fps, "--fps")
    glb = with_ending(output, (".glb",), add=True)
    result = glb.with_suffix(".safetensors")
    swc, npz, table = with_ending(swc, (".swc",)), with_ending(npz, (".npz",)), with_ending(table, (".csv",))
    plot = with_ending(plot, PICTURE_ENDINGS)
    hulls = {"--calibration": calibration, "--screen": screen, "--resolution": resolution, "--seen": seen}
    check_used(silhouettes, "--silhouettes", hulls)
    if growing:
        _check_free(prior, tips)
    known, upright = _read_prior(prior), known_up(up, [] if silhouettes else frames)
    if silhouettes:
        source = _silhouettes(frames, calibration, bool(screen), resolution, scale)
        count, names = len(source), source.names
    else:
        from torchreg.io.frames import load_frames

        files = load_frames(cloud_files(frames), scale=scale, nan_policy=nan_policy)
        count, names = len(files), files.names
    curves = [numbered(swc, frame, count) for frame in range(count)] if swc is not None else []
    check_outputs([glb, result, result.with_suffix(".json"), npz, table, plot, movie, *curves], force)
    if movie is not None:
        from torchreg.viz.animation import check_animation_path

        check_animation_path(movie)

    from torchreg.spines.extract_spine import SpineConfig
    from torchreg.spines.frames.frame_surfaces import FrameSurfaces

    config = SpineConfig.growing(num_samples=samples) if growing else SpineConfig(num_tips=tips, num_samples=samples)
    with claimed(glb), _kept(progress):
        if silhouettes:
            meshes: Sequence[TriangleMesh] = _hulls(source, seen_folder(seen, glb, force), progress, quiet)
        else:
            clouds = files.clouds()
            meshes = FrameSurfaces.of_frames(clouds, names, workers=workers, progress=progress, support=support)
        found = _extracted(meshes, known, config, workers, progress, quiet, growing=growing, support=support)
        found = remembering(found, upright)
        found.save(result)
        _write(found, meshes, glb, curves, npz, fps)
        if table is not None:
            with OptionalOutput(table):
                found.measurements().save_csv(table)
        if plot is not None:
            from torchreg.viz.figures import save_picture
            from torchreg.viz.spines import draw_measurements

            with OptionalOutput(plot):
                save_picture(draw_measurements(found.measurements()), plot)
        _draw(found, meshes, movie, pictures, fps)
    if not quiet:
        for warning in found.warnings:
            typer.echo(f"torchreg: warning: {_named(warning, names)}", err=True)
        typer.echo(_summary(found, glb))


def _check_free(prior: Path | None, tips: int | None) -> None:
    """Raise InputError if the number of limbs is given of what grows."""
    from torchreg.errors import InputError

    for name, value in (("--prior", prior), ("--tips", tips)):
        if value is not None:
            raise InputError(f"--growing cannot be used with {name}, which fixes the number of limbs; leave out either")


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


def _extracted(
    meshes: Sequence[TriangleMesh],
    known: Skeleton | SpineSequence | None,
    config: SpineConfig,
    workers: int | None,
    progress: Path | None,
    quiet: bool,
    *,
    growing: bool,
    support: str,
) -> SpineSequence:
    from tqdm import tqdm

    from torchreg.spines.extract_spine import extract_spine

    with tqdm(total=len(meshes), unit="frame", desc="skeletons", leave=False, disable=quiet) as bar:
        return extract_spine(
            meshes, prior=known, growing=growing, config=config, workers=workers, on_step=lambda _: bar.update(),
            progress=progress, support=support,
        )  # fmt: skip


def _read_prior(path: Path | None) -> Skeleton | SpineSequence | None:
    """Return the skeleton of a file, whose ends are numbered in the order of its lines, or the spine of a result."""
    from torchreg.errors import InputError
    from torchreg.io.swc import load_swc
    from torchreg.spines.results import SpineSequence
    from torchreg.storage import load

    if path is None:
        return None
    if path.suffix.lower() == ".swc":
        return load_swc(path)
    spine = load(path) if path.suffix.lower() == ".safetensors" else None
    if not isinstance(spine, SpineSequence):
        raise InputError(f"--prior must be a spine (.safetensors) or a skeleton (.swc), got {path}")
    return spine


def _silhouettes(
    folders: list[Path], calibration: Path | None, screen: bool, resolution: int | None, scale: float
) -> SilhouetteFrames:
    from torchreg.capture.silhouette_frames import SilhouetteFrames

    rig = load_calibration(calibration, "--silhouettes", scale)
    return SilhouetteFrames(folders, rig, screen=screen, resolution=resolution or 128)


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


def _write(
    found: SpineSequence, meshes: Sequence[TriangleMesh], glb: Path, swc: Sequence[Path | None], npz: Path | None,
    fps: float,
) -> None:  # fmt: skip
    from torchreg.geometry.mesh import TriangleMesh
    from torchreg.io.npz import save_arrays
    from torchreg.io.swc import save_swc
    from torchreg.viz.spine_gltf import save_spine_animation

    with OptionalOutput(glb):
        near, mesh = found.local(), meshes[found.reference]
        if found.origin is not None:
            mesh = TriangleMesh(mesh.vertices - found.origin, mesh.faces)
        save_spine_animation(glb, near.model, mesh, found.reference, fps=fps, up=found.up)
        tell_origin(glb, found.origin)
    for frame, path in enumerate(swc):
        if path is not None:
            with OptionalOutput(path):
                save_swc(path, found.skeleton(frame), f"frame {frame}")
    if npz is not None:
        names = ["tips", "junctions", "graph", "curves", "radii", "frames", "times", "found", "own", "confidence"]
        names += ["births", "ends"] if found.births is not None else []
        with OptionalOutput(npz):
            save_arrays(npz, {name: getattr(found, name) for name in names})


def _draw(
    found: SpineSequence, meshes: Sequence[TriangleMesh], movie: Path | None, pictures: Path | None, fps: float
) -> None:
    from torchreg.viz.spines import save_spine_movie, save_spine_pictures

    if pictures is not None:
        with OptionalOutput(pictures):
            save_spine_pictures(pictures, found, meshes)
    if movie is not None:
        with OptionalOutput(movie):
            save_spine_movie(movie, found, meshes, fps=fps)


def _named(warning: str, names: tuple[str, ...]) -> str:
    """Return a warning with the name of its frame's file instead of the number."""
    frame, _, text = warning.removeprefix("frame ").partition(": ")
    return f"{names[int(frame)]}: {text}"


def _summary(found: SpineSequence, glb: Path) -> str:
    agreeing = sum(pair[0] == pair[1] for pair in zip(found.own_topologies, found.topologies, strict=True))
    parts = (found.num_tips, "tip"), (found.junctions.shape[1], "junction"), (len(found.graph), "limb")
    counts = ", ".join(counted(*part) for part in parts)
    return f"{counts}; {agreeing} of {counted(len(found.curves), 'frame')} with this tree by themselves -> {glb}"
