"""``torchreg track``: a shape through a sequence of clouds."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import (
    Clothed,
    FitShape,
    NanPolicy,
    Scale,
    fitted_shape,
    person_summary,
    read_clothed,
)
from torchreg.cli.cameras import DepthOptions, Seen, StereoOptions, seen_folder
from torchreg.cli.export import Old, OldWord, check_old
from torchreg.cli.known_options import Initializer, KnownOptions, read_initializer
from torchreg.cli.outputs import Force, Quiet, claimed, shifted_to, with_ending, written_to
from torchreg.cli.reporting import ExitCode, interruption, reporting
from torchreg.cli.shape_argument import Shape, ShapeOptions
from torchreg.cli.track_run import Clouds, Report, TrackFiles, TrackRun, summary
from torchreg.cli.upright import Up, Upright, known_up
from torchreg.cli.view import Browser, Port, tell_url
from torchreg.cli.writers import MOVIES
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.geometry.upright import Direction
    from torchreg.shapes.articulated import ArticulatedShape
    from torchreg.shapes.skin import LinearBlendSkin
    from torchreg.tracking.config import TrackConfig
    from torchreg.tracking.results import FrameResult

    OnFrame = Callable[[Tensor, FrameResult], object]


@dataclass(frozen=True)
class TrackerOptions:
    """The settings of a tracker."""

    prediction: Annotated[str, typer.Option(help="Prediction of the motion: velocity, or none.")] = "velocity"
    points: Annotated[int, typer.Option(help="Number of model points.")] = 500
    model_points: Annotated[
        str, typer.Option(help="What is aligned: points of the shape seen last, data of the frame before, or shape.")
    ] = "seen"
    recovery: Annotated[
        str, typer.Option(help="What finding a lost shape may cost: full, starts (milliseconds), or none.")
    ] = "full"
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0
    upright: Upright = False

    def config(self, direction: Direction | None, clouds: Clouds) -> TrackConfig:
        """Return the settings; what is upright is guessed from the first cloud where it is not known."""
        from torchreg.geometry.upright import guess_up
        from torchreg.tracking.tracker import TrackConfig

        return TrackConfig(
            model_points=self.model_points, num_model_points=self.points, prediction=self.prediction,
            recovery=self.recovery, seed=self.seed,
            upright=(direction or guess_up([clouds[0]])) if self.upright else None,
        )  # fmt: skip

    def job(self, config: TrackConfig) -> dict[str, Any]:
        """Return the settings as plain data: what JSON gives back is equal to it."""
        return {"configuration": asdict(config) | {"upright": config.upright and list(config.upright)}}


@reporting
def track(
    shape: Shape,
    frames: Annotated[
        list[Path],
        typer.Argument(
            metavar="FRAMES",
            help="The clouds, metres: files, which are put in the order of the numbers in their names, one folder of "
            "them, or one .npz of frames. With --stereo two folders: the left pictures and the right ones; with "
            "--depth depth pictures, folders or patterns of them.",
        ),
    ],
    output: Annotated[
        Path, written_to("RESULT", "RESULT.safetensors, .json, .glb, .gif and .progress are written.")
    ] = Path("track"),
    *,
    start: Annotated[
        Path | None,
        typer.Option(
            help="Pose near the first frame: a result, or .json with numbers or {degree of freedom: number}, or .npz; "
            "without one the shape is searched for."
        ),
    ] = None,
    initializer: Initializer = None,
    fit_shape: FitShape = False,
    clothed: Clothed = "auto",
    cameras: StereoOptions,
    views: DepthOptions,
    seen: Seen = None,
    known: KnownOptions,
    smooth: Annotated[
        bool,
        typer.Option("--smooth", help="At the end estimate all poses anew, each from the frames before and after it."),
    ] = False,
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 20.0,
    scale: Scale = 1.0,
    nan_policy: NanPolicy = "omit",
    settings: TrackerOptions,
    options: ShapeOptions,
    pictures: Old = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show each frame in the browser as soon as it is done (extra viewer).")
    ] = False,
    port: Port = 8080,
    browser: Browser = True,
    poses: Old = None,
    bvh: Old = None,
    movie: OldWord = None,
    gltf: Old = None,
    no_gltf: Annotated[bool, typer.Option("--no-gltf", hidden=True, help="Do not write RESULT.glb.")] = False,
    up: Up = None,
    save_every: Annotated[int, typer.Option(min=1, help="Frames after which RESULT.progress is written anew.")] = 50,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where RESULT.progress ends, if it is there; else begin.")
    ] = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Follow a shape through a sequence of clouds, and find it where it is not known or was lost.

    A frame that cannot be read, or with points that are not finite under --nan-policy raise, is reported and dropped:
    its pose is predicted. After Ctrl-C the results so far are on disk, and the same command with --resume goes on to
    the same end, also with more frames than before. `torchreg export` writes poses, BVH, movies and pictures of frames.

    With --smooth a second pass follows: the poses in the result are least squares of all frames. What is shown while
    the frames come, and RESULT.progress, are of the first; --smooth with --resume smooths a run that is complete.

    With --stereo LEFT RIGHT --calibration FILE clouds are the corners that both cameras see. For every frame two
    pictures go to RESULT_seen: the disparity, and the left picture with its points, blue where they are inliers, and
    the outline of the shape.

    With --depth --intrinsics FILE frames are depth pictures, and their free space counts too. Keypoints that a detector
    found, --keypoints, count with any frames.

    Exit codes: 0; 1 if in any frame the shape was lost, not found or is doubtful, or there were no data, or an output
    other than the result could not be written; 2 for an error; 130 for Ctrl-C.
    """
    result = with_ending(output, (".safetensors",), add=True)
    from torchreg._checks import check_positive
    from torchreg.storage import load_pose
    from torchreg.tracking.tracker import Tracker

    files = _files(result, movie, gltf, no_gltf, pictures, poses, bvh, f" --data {frames[0]}")
    resumed = files.check(force, resume)
    check_positive(fps, "--fps")
    check_positive(scale, "--scale")
    cameras.check(seen, views)
    worn = read_clothed(clothed, fit_shape)
    model = options.load(shape)
    source = _source(frames, model, cameras, views, scale, nan_policy)
    folder = seen_folder(seen, result, force or resumed) if cameras.stereo else None
    clouds = Clouds(source, floating=not cameras.stereo)
    direction = known_up(up, frames, camera=cameras.stereo or views.depth)
    config = settings.config(direction, clouds)
    first = None if start is None else shifted_to(clouds.origin, load_pose(start, model))
    network = read_initializer(initializer, model)
    given = known.read(model, clouds, source if views.depth else None)
    job = {
        "shape": shape, "shape options": [None if value is None else str(value) for value in astuple(options)],
        "--start": None if first is None else first.tolist(), **settings.job(config), "--fps": fps, "--scale": scale,
        "--nan-policy": nan_policy, "frames": list(clouds.names), **given.job(), **cameras.job(source),
        **views.job(source), **({} if initializer is None else {"--initializer": str(initializer)}),
        **({"--fit-shape": True, "--clothed": clothed} if fit_shape else {}),
    }  # fmt: skip
    model = fitted_shape(model, fit_shape)
    with claimed(result), ExitStack() as pages, _progress_bar(len(clouds), quiet) as bar:
        tracker = Tracker(
            model, first, config=config, locked=given.locked, initializer=network, fit_shape=fit_shape, clothed=worn
        )  # fmt: skip
        run = TrackRun(
            tracker, clouds, fps, job, files, report=Report(bar, clouds, quiet), save_every=save_every, known=given,
            up=direction, smooth=smooth,
        )  # fmt: skip
        run.seen = None if folder is None else _drawn_pictures(source, folder)
        run.live = _live_page(pages, port, browser, quiet, direction) if view else None
        complete = run.run(resumed)
    _report_end(run, model, complete, quiet)


def _files(
    result: Path, movie: str | None, gltf: Path | None, no_gltf: bool, pictures: Path | None, poses: Path | None,
    bvh: Path | None, measured: str,
) -> TrackFiles:  # fmt: skip
    """Return where the outputs go; the moving picture and the moving shape by default to the name of the result."""
    from torchreg._checks import check_choice

    if gltf is not None and no_gltf:
        raise InputError("--gltf and --no-gltf cannot be used together; leave out either")
    moving = Path(movie or "")
    if moving.suffix.lower() not in MOVIES:
        check_choice(movie or "gif", "--movie", ("gif", "mp4", "none"))
        moving = result.with_suffix(f".{movie or 'gif'}")
    drawn = None if movie == "none" else moving
    check_old({"--poses": (poses, ".csv"), "--bvh": (bvh, ".bvh"), "--gltf": (gltf, ".glb")}, result)
    check_old({"--movie": (movie and drawn, ""), "--pictures": (pictures, "")}, result, measured)
    scene = None if no_gltf else gltf or result.with_suffix(".glb")
    return TrackFiles(result, drawn, scene, pictures, poses, bvh)


def _source(
    frames: list[Path], model: ArticulatedShape, cameras: StereoOptions, views: DepthOptions, scale: float, policy: str
) -> Any:
    """Return the frames that the files hold: stereo or depth pictures, or clouds."""
    if cameras.stereo:
        return cameras.source(frames, model, views.depth_range, scale)
    return views.frames(frames, scale, policy)


def _progress_bar(count: int, quiet: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=count, unit="frame", desc="tracking", leave=False, disable=quiet)


def _drawn_pictures(frames: Any, folder: Path) -> Callable[[LinearBlendSkin], OnFrame]:
    """Return the function that draws the frames of stereo pictures into a folder, with a skin's outline."""
    from torchreg.viz.seen import StereoPictures

    return lambda skin: StereoPictures(frames, skin, folder)


def _live_page(
    pages: ExitStack, port: int, browser: bool, quiet: bool, up: Direction | None
) -> Callable[[LinearBlendSkin], OnFrame]:
    """Return the function that opens a page for a skin, on which each frame is shown; it closes with ``pages``."""
    from torchreg.viz.live_track import LiveTrack
    from torchreg.viz.viser_server import import_viser

    import_viser()  # a missing extra is reported before the first frame

    def begin(skin: LinearBlendSkin) -> OnFrame:
        page = pages.enter_context(LiveTrack(skin, port=port, up=up))
        tell_url(page.url, browser, quiet)
        return page.show

    return begin


def _report_end(run: TrackRun, model: ArticulatedShape, complete: bool, quiet: bool) -> None:
    """Write tables and print the summary of a run; raise its exit unless it is complete and usable."""
    run.write([run.files.poses, run.files.bvh])
    statuses = run.result.statuses
    if not quiet:
        words = filter(None, (summary(run.result), person_summary(model, run.result)))
        typer.echo(f"{'; '.join(words)} -> {run.files.result}")
    if not complete:
        raise interruption(f"{len(statuses)} of {len(run.clouds)} frames are done; --resume goes on from there")
    if not all(status.usable for status in statuses):
        raise typer.Exit(ExitCode.UNUSABLE)
