"""``torchreg track``: a shape through a sequence of clouds."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import NanPolicy, Scale, cloud_files, person_summary
from torchreg.cli.cameras import (
    Calibration,
    Depth,
    DepthRange,
    Intrinsics,
    Mask,
    Matcher,
    Reach,
    Seen,
    Volume,
    check_used,
    depth_job,
    depth_source,
    seen_folder,
    stereo_job,
    stereo_source,
)
from torchreg.cli.initializer_option import Initializer, read_initializer
from torchreg.cli.keypoint_options import Keypoints, KeypointStd, read_keypoints
from torchreg.cli.known_options import Joints, JointStd, Locked, read_known
from torchreg.cli.outputs import Force, Quiet, check_outputs, claimed, shifted_to, tell_origin, with_ending
from torchreg.cli.reporting import ExitCode, OptionalOutput, interruption, reporting
from torchreg.cli.shape_argument import FreeBase, PackageDir, Parents, Shape, Skin, load_shape
from torchreg.cli.track_run import Clouds, Report, TrackFiles, TrackRun, summary, track_job
from torchreg.cli.upright import Up, Upright, known_up
from torchreg.cli.view import Browser, Port, tell_url
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.capture.depth_frames import DepthFrames
    from torchreg.capture.stereo_frames import StereoFrames
    from torchreg.geometry.upright import Direction
    from torchreg.shapes.articulated import ArticulatedShape
    from torchreg.shapes.skin import LinearBlendSkin
    from torchreg.tracking.results import FrameResult, TrackResult

    OnFrame = Callable[[Tensor, FrameResult], object]

MOVIES = ("gif", "mp4", "none")


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
    initializer: Initializer = None,
    fit_shape: Annotated[
        bool,
        typer.Option(
            "--fit-shape",
            help="Also fit the shape's coefficients, as of a body to a person, or of a rig without any the lengths and "
            "radii of its parts: the first frame tells them, and every other one more.",
        ),
    ] = False,
    stereo: Annotated[
        bool, typer.Option("--stereo", help="FRAMES are the pictures of a calibrated pair of cameras.")
    ] = False,
    calibration: Calibration = None,
    depth: Depth = False,
    intrinsics: Intrinsics = None,
    mask: Mask = None,
    depth_range: DepthRange = None,
    volume: Volume = None,
    matcher: Matcher = None,
    reach: Reach = None,
    seen: Seen = None,
    locked: Locked = None,
    joints: Joints = None,
    joint_std: JointStd = None,
    keypoints: Keypoints = None,
    keypoint_std: KeypointStd = None,
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 20.0,
    scale: Scale = 1.0,
    nan_policy: NanPolicy = "omit",
    prediction: Annotated[str, typer.Option(help="Prediction of the motion: velocity, or none.")] = "velocity",
    points: Annotated[int, typer.Option(help="Number of model points.")] = 500,
    model_points: Annotated[
        str, typer.Option(help="What is aligned: points of the shape seen last, data of the frame before, or shape.")
    ] = "seen",
    recovery: Annotated[
        str, typer.Option(help="What finding a lost shape may cost: full, starts (milliseconds), or none.")
    ] = "full",
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    parents: Parents = None,
    package_dir: PackageDir = None,
    free_base: FreeBase = None,
    skin: Skin = None,
    pictures: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Also draw each frame as soon as it is done (frame_0000.png).")
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show each frame in the browser as soon as it is done (extra viewer).")
    ] = False,
    port: Port = 8080,
    browser: Browser = True,
    poses: Annotated[
        Path | None,
        typer.Option(metavar="OUT.csv", help="Also write a table: frame, time, status, and the pose by name."),
    ] = None,
    bvh: Annotated[
        Path | None, typer.Option(metavar="OUT.bvh", help="Also write the motion for animation programs (BVH).")
    ] = None,
    movie: Annotated[
        str | None,
        typer.Option(
            metavar="OUT.gif",
            help="The moving picture, .gif or .mp4 (needs ffmpeg); by default RESULT.gif; none for none.",
        ),
    ] = None,
    gltf: Annotated[
        Path | None, typer.Option(metavar="OUT.glb", help="The moving shape; by default RESULT.glb.")
    ] = None,
    no_gltf: Annotated[bool, typer.Option("--no-gltf", help="Do not write the moving shape.")] = False,
    upright: Upright = False,
    up: Up = None,
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

    With --depth --intrinsics FILE frames are depth pictures, and what they say of free space counts too. Keypoints that
    a detector saw, --keypoints, count beside any frames.

    Exit codes: 0; 1 if in any frame the shape was lost or is doubtful, or there were no data, or an output beside the
    result could not be written; 2 for an error; 130 for Ctrl-C.
    """
    files, resumed = _files(output, movie, gltf, no_gltf, pictures, resume, force)
    poses, bvh = with_ending(poses, (".csv",)), with_ending(bvh, (".bvh",))
    check_outputs([poses, bvh], force or resumed)
    _check_rates(fps, scale)
    views = {"--volume": volume, "--matcher": matcher, "--reach": reach, "--seen": seen}
    check_used(stereo, "--stereo", {"--calibration": calibration, **views})
    check_used(depth, "--depth", {"--intrinsics": intrinsics, "--mask": mask})
    check_used(stereo or depth, "--stereo or --depth", {"--depth-range": depth_range})
    options = parents, package_dir, free_base, skin
    videos = images = folder = None
    if stereo:
        model = load_shape(shape, *options)
        videos = stereo_source(frames, calibration, model, depth_range, volume, matcher, reach, scale)
        clouds, folder = Clouds(videos, floating=False), seen_folder(seen, files.result, force or resumed)
    elif depth:
        images = depth_source(frames, intrinsics, mask, depth_range)
        clouds, model = Clouds(images), load_shape(shape, *options)
    else:
        clouds, model = _clouds(frames, scale, nan_policy), load_shape(shape, *options)

    from torchreg.geometry.upright import guess_up
    from torchreg.storage import load_pose
    from torchreg.tracking.tracker import TrackConfig, Tracker

    known_direction = known_up(up, frames, camera=stereo or depth)
    config = TrackConfig(
        model_points=model_points,
        num_model_points=points,
        prediction=prediction,
        recovery=recovery,
        seed=seed,
        upright=(known_direction or guess_up([clouds[0]])) if upright else None,
    )
    first = None if start is None else shifted_to(clouds.origin, load_pose(start, model))
    network = read_initializer(initializer, model)
    known = read_known(model, locked, joints, joint_std, len(clouds))
    measured = read_keypoints(keypoints, keypoint_std, clouds, model, images)
    job = track_job(shape, options, first, config, fps, scale, nan_policy, clouds) | known.job() | measured.job()
    job |= {} if initializer is None else {"--initializer": str(initializer)}
    job |= {"--fit-shape": True} if fit_shape else {}
    if fit_shape and not model.coefficient_names:
        model = model.with_bone_coefficients()
    with claimed(files.result), ExitStack() as pages, _progress_bar(len(clouds), quiet) as bar:
        tracker = Tracker(
            model, first, config=config, locked=known.locked, initializer=network, fit_shape=fit_shape
        )  # fmt: skip
        run = TrackRun(
            tracker=tracker, clouds=clouds, fps=fps, job=job, files=files, report=Report(bar, clouds, quiet),
            save_every=save_every, known=known, measured=measured, up=known_direction,
        )  # fmt: skip
        _add_pictures(run, videos, folder, images)
        if view:
            run.live = _live_page(pages, port, browser, quiet, run.up)
        complete = _run(run, bar, resumed)
    if poses is not None:
        with OptionalOutput(poses):
            _write_poses(poses, model, run.located)
    if bvh is not None:
        with OptionalOutput(bvh):
            _write_motion(bvh, run)
    _report_end(run, model, complete, quiet)


def _check_rates(fps: float, scale: float) -> None:
    from torchreg._checks import check_positive

    check_positive(fps, "--fps")
    check_positive(scale, "--scale")


def _add_pictures(
    run: TrackRun, pictures: StereoFrames | None, folder: Path | None, images: DepthFrames | None
) -> None:
    """Tell a run which pictures its clouds come from: progress belongs to them, and what two cameras see is drawn."""
    if pictures is not None and folder is not None:
        run.job |= stereo_job(pictures)
        run.seen = _drawn_pictures(pictures, folder)
    if images is not None:
        run.job |= depth_job(images)


def _write_poses(path: Path, shape: ArticulatedShape, result: TrackResult) -> None:
    """Write one row per frame; frames without a pose have no numbers."""
    from torchreg.io.pose_table import save_pose_table

    rows = [
        [frame, time, status.value, *(value if value == value else "" for value in pose)]  # NaN is not equal to itself
        for frame, (time, status, pose) in enumerate(
            zip(result.times.tolist(), result.statuses, result.poses.tolist(), strict=True)
        )
    ]
    save_pose_table(path, ["frame", "time", "status", *shape.dof_names], rows)


def _write_motion(path: Path, run: TrackRun) -> None:
    """Write the motion of the shape, unless it was never found."""
    from torchreg.geometry.upright import guess_up
    from torchreg.viz.track_bvh import save_track_bvh

    if bool(run.result.poses.isfinite().all(-1).any()):
        save_track_bvh(path, run.tracker.shape, run.result, up=run.up or guess_up(list(run.result.keypoints)))
        tell_origin(path, run.clouds.origin)


def _files(
    output: Path, movie: str | None, gltf: Path | None, no_gltf: bool, pictures: Path | None, resume: bool, force: bool
) -> tuple[TrackFiles, bool]:
    """Return the outputs, after a check that they are writable, and whether an earlier run is resumed."""
    from torchreg._checks import check_choice

    if movie is not None and Path(movie).suffix.lower() not in (".gif", ".mp4"):
        check_choice(movie, "--movie", MOVIES)
    if gltf is not None and no_gltf:
        raise InputError("--gltf and --no-gltf cannot be used together; leave out either")
    result = with_ending(output, (".safetensors",), add=True)
    scene = None if no_gltf else with_ending(gltf, (".glb",)) or result.with_suffix(".glb")
    files = TrackFiles.at(result, movie or "gif", scene, pictures)
    resumed = resume and files.progress.exists()
    files.check(force or resumed)
    return files, resumed


def _clouds(frames: list[Path], scale: float, nan_policy: str) -> Clouds:
    from torchreg.io.frames import load_frames

    sequence = load_frames(cloud_files(frames), scale=scale, nan_policy=nan_policy)
    return Clouds(sequence)


def _progress_bar(count: int, quiet: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=count, unit="frame", desc="tracking", leave=False, disable=quiet)


def _drawn_pictures(frames: StereoFrames, folder: Path) -> Callable[[LinearBlendSkin], OnFrame]:
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
    """Print the summary of a run; raise its exit unless it is complete and usable."""
    statuses = run.result.statuses
    if not quiet:
        told = "; ".join(filter(None, (summary(run.result), person_summary(model, run.result))))
        typer.echo(f"{told} -> {run.files.result}")
    if not complete:
        raise interruption(f"{len(statuses)} of {len(run.clouds)} frames are done; --resume goes on from there")
    if not all(status.usable for status in statuses):
        raise typer.Exit(ExitCode.UNUSABLE)


def _run(run: TrackRun, bar: Any, resumed: bool) -> bool:
    """Track all frames, write what belongs to a complete run, and return whether it is complete."""
    from torchreg.cli.track_checkpoint import load_progress

    if resumed:
        run.go_on(load_progress(run.files.progress))
    complete = run.run()
    if complete:
        bar.reset(len(run.clouds))
        bar.set_description("drawing")
        run.write(on_frame=lambda done, planned: bar.update())
    return complete
