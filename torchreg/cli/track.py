"""``torchreg track``: a shape through a sequence of clouds."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.align_options import NanPolicy, Scale
from torchreg.cli.cameras import (
    Calibration,
    DepthRange,
    Matcher,
    Reach,
    Seen,
    Volume,
    check_used,
    seen_folder,
    stereo_job,
    stereo_source,
)
from torchreg.cli.outputs import Force, Quiet, with_ending
from torchreg.cli.reporting import UNUSABLE, interruption, reporting
from torchreg.cli.shape_argument import FreeBase, PackageDir, Parents, Shape, load_shape
from torchreg.cli.track_run import Clouds, Report, TrackFiles, TrackRun, summary, track_job
from torchreg.cli.view import Browser, Port, tell_url
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.shapes.skin import LinearBlendSkin
    from torchreg.tracking.results import FrameResult

MOVIES = ("gif", "mp4", "none")


@reporting
def track(
    shape: Shape,
    frames: Annotated[
        list[Path],
        typer.Argument(
            metavar="FRAMES",
            help="The clouds, metres: files, which are put in the order of the numbers in their names, one folder of "
            "them, or one .npz of frames. With --stereo two folders: the left pictures and the right ones.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="RESULT",
            help="RESULT.safetensors, .json, .glb, .gif and .progress are written.",
        ),
    ] = Path("track"),
    start: Annotated[
        Path | None,
        typer.Option(
            help="Pose near the first frame: a result, or .json with numbers or {degree of freedom: number}, or .npz; "
            "without one the shape is searched for."
        ),
    ] = None,
    stereo: Annotated[
        bool, typer.Option("--stereo", help="FRAMES are the pictures of a calibrated pair of cameras.")
    ] = False,
    calibration: Calibration = None,
    depth_range: DepthRange = None,
    volume: Volume = None,
    matcher: Matcher = None,
    reach: Reach = None,
    seen: Seen = None,
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 20.0,
    scale: Scale = 1.0,
    nan_policy: NanPolicy = "omit",
    prediction: Annotated[str, typer.Option(help="How the shape goes on: velocity, or none.")] = "velocity",
    points: Annotated[int, typer.Option(help="Number of model points.")] = 500,
    model_points: Annotated[
        str, typer.Option(help="What is aligned: points of the shape seen last, data of the frame before, or shape.")
    ] = "seen",
    recovery: Annotated[
        str, typer.Option(help="What finding a lost shape may cost: full, starts (milliseconds), or none.")
    ] = "full",
    seed: Annotated[int, typer.Option(help="Of all that is drawn.")] = 0,
    parents: Parents = None,
    package_dir: PackageDir = None,
    free_base: FreeBase = None,
    overlay: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Also draw each frame as soon as it is done (frame_0000.png).")
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show each frame in the browser as soon as it is done (extra viewer).")
    ] = False,
    port: Port = 8080,
    browser: Browser = True,
    movie: Annotated[str, typer.Option(help="The moving picture: gif, mp4 (needs ffmpeg), or none.")] = "gif",
    gltf: Annotated[bool, typer.Option("--gltf/--no-gltf", help="Whether to write the moving shape.")] = True,
    save_every: Annotated[int, typer.Option(min=1, help="Frames after which RESULT.progress is written anew.")] = 50,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where RESULT.progress ends, if it is there; else begin.")
    ] = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Follow a shape through a sequence of clouds, and find it where it is not known or was lost.

    A frame that cannot be read, or with points that are not finite under --nan-policy raise, is told and dropped: its
    pose is predicted. After Ctrl-C the results so far are on disk, and the same command with --resume goes on to the
    same end, also with more frames than before.

    With --stereo LEFT RIGHT --calibration FILE clouds are the corners that both cameras see. For every frame two
    pictures go to RESULT_seen: the disparity, and the left picture with its points, blue where they are inliers, and
    the outline of the shape.

    Exit codes: 0; 1 if in any frame the shape was lost or there were no data; 2 for an error; 130 for Ctrl-C.
    """
    from torchreg._checks import check_choice, check_positive
    from torchreg.io.frames import load_frames

    check_choice(movie, "--movie", MOVIES)
    check_positive(fps, "--fps")
    check_positive(scale, "--scale")
    files = TrackFiles.at(with_ending(output, (".safetensors",), add=True), movie, gltf, overlay)
    resumed = resume and files.progress.exists()
    files.check(force or resumed)
    views = {"--depth-range": depth_range, "--volume": volume, "--matcher": matcher, "--reach": reach, "--seen": seen}
    check_used(stereo, "--stereo", {"--calibration": calibration, **views})
    if stereo:
        if scale != 1:
            raise InputError("--scale has no meaning with --stereo: calibrations are in metres; leave it out")
        model = load_shape(shape, parents, package_dir, free_base)
        source = stereo_source(frames, calibration, model, depth_range, volume, matcher, reach)
        clouds = Clouds(source, 1.0)
        pictures = seen_folder(seen, files.result, force or resumed)
    else:
        clouds = Clouds(load_frames(frames[0] if len(frames) == 1 else frames, nan_policy=nan_policy), scale)

    from tqdm import tqdm

    with (
        ExitStack() as pages,
        tqdm(total=len(clouds), unit="frame", desc="tracking", leave=False, disable=quiet) as bar,
    ):
        model = model if stereo else load_shape(shape, parents, package_dir, free_base)
        from torchreg.cli.track_checkpoint import load_progress
        from torchreg.storage import load_pose
        from torchreg.tracking.tracker import TrackConfig, Tracker

        config = TrackConfig(
            model_points=model_points, num_model_points=points, prediction=prediction, recovery=recovery, seed=seed
        )
        first = None if start is None else load_pose(start, model)
        job = track_job(shape, (parents, package_dir, free_base), first, config, fps, scale, nan_policy, clouds)
        tracker = Tracker(model, first, config=config)
        run = TrackRun(tracker, clouds, fps, job, files, Report(bar, clouds, quiet), save_every)
        if stereo:
            from torchreg.viz.seen import StereoPictures

            run.job |= stereo_job(source)
            run.seen = lambda skin: StereoPictures(source, skin, pictures)
        if view:
            from torchreg.viz.live_track import LiveTrack
            from torchreg.viz.viser_server import import_viser

            import_viser()  # a missing extra is told before the first frame

            def begin(skin: LinearBlendSkin) -> Callable[[Tensor, FrameResult], None]:
                page = pages.enter_context(LiveTrack(skin, port=port))
                tell_url(page.url, browser, quiet)
                return page.show

            run.live = begin
        if resumed:
            run.go_on(load_progress(files.progress))
        complete = run.run()
        if complete:
            bar.reset(len(clouds))
            bar.set_description("drawing")
            run.write(on_frame=lambda done, planned: bar.update())
    result = run.result
    if not quiet:
        typer.echo(f"{summary(result)} -> {files.result}")
    if not complete:
        raise interruption(f"{len(result.statuses)} of {len(clouds)} frames are done; --resume goes on from there")
    if not all(status.usable for status in result.statuses):
        raise typer.Exit(UNUSABLE)
