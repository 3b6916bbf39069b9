"""``torchreg calibrate``: where a robot's base is in a camera, or how large a hand is."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import NanPolicy, Scale, cloud_files, read_cloud
from torchreg.cli.cameras import DepthOptions, Seen, seen_folder
from torchreg.cli.outputs import Force, Quiet, check_outputs, check_used, with_ending, written_to
from torchreg.cli.reporting import ExitCode, OptionalOutput, reporting
from torchreg.cli.shape_argument import PackageDir, Shape, ShapeOptions
from torchreg.cli.writers import Source, write_optional
from torchreg.errors import FramesWarning, InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.alignment.results import BaseCalibration
    from torchreg.capture.depth_frame import DepthFrame
    from torchreg.shapes.articulated import ArticulatedShape


_CAMERA = "camera"  # the frame of the camera, whose axes are those of a picture


@reporting
def calibrate(
    shape: Shape,
    frames: Annotated[
        list[Path],
        typer.Argument(
            metavar="FRAMES",
            help="Clouds in camera coordinates, metres, folders or patterns of them, one for each row of --joints. "
            "With --depth depth pictures.",
        ),
    ],
    joints: Annotated[
        Path | None,
        typer.Option(
            metavar="TABLE.csv",
            help="Joints of a robot, a row for each of FRAMES: a line of names, then radians, metres.",
        ),
    ] = None,
    output: Annotated[Path, written_to("RESULT", "RESULT.safetensors and RESULT.json are written, and more.")] = Path(
        "calibration"
    ),
    *,
    views: DepthOptions,
    offsets: Annotated[bool, typer.Option("--offsets", help="Look for constant offsets of the joints, too.")] = False,
    camera_link: Annotated[
        str | None,
        typer.Option(
            metavar="LINK", help="Link that carries the camera (eye in hand); without it the camera stands still."
        ),
    ] = None,
    urdf_out: Annotated[
        Path | None, typer.Option(metavar="FILE.urdf", help="The robot with a link camera, axes right, down, forward.")
    ] = None,
    scale: Scale = 1.0,
    nan_policy: NanPolicy = "omit",
    package_dir: PackageDir = None,
    seen: Seen = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Find a robot's base in a camera from frames with known joints; or fit a hand's size and proportions to clouds.

    Of a robot RESULT_transform.json holds the base, what is known of it and ROS's static transform,
    RESULT_handeye.yaml the camera as easy_handeye and MoveIt read it, and RESULT_seen a picture of the robot over each
    frame. Joints whose names are those of the robot's file are read; offsets of joints
    that the frames do not determine stay zero.

    A hand is searched in every cloud. Clouds in which it is not surely found are named and left out.

    Exit codes: 0; 1 if no frame shows the robot, hardly any the hand, or an output beside the result could not be
    written; 2 for an error; 130 for Ctrl-C.
    """
    output = with_ending(output, (".safetensors",), add=True)
    is_hand = not Path(shape).suffix
    transform = None if is_hand else output.with_name(f"{output.stem}_transform.json")
    handeye = None if is_hand else output.with_name(f"{output.stem}_handeye.yaml")
    check_outputs([output, output.with_suffix(".json"), transform, handeye, urdf_out], force)
    if is_hand:
        robot = {"--joints": joints, "--depth": views.depth or None, "--offsets": offsets or None, "--seen": seen}
        more = {"--camera-link": camera_link, "--urdf-out": urdf_out}
        camera = {"--intrinsics": views.intrinsics, "--mask": views.mask, "--depth-range": views.depth_range}
        check_used(False, "a robot", robot | more | camera)
    views.check()
    images = views.source(frames) if views.depth else None
    frames = cloud_files(frames) if images is None else [Path(name) for name in images.names]
    model = ShapeOptions(package_dir=package_dir).load(shape)
    if is_hand:
        _calibrate_hand(model, frames, [read_cloud(path, scale, nan_policy) for path in frames], output, quiet)
        return
    if joints is None:
        raise InputError("a robot takes --joints TABLE.csv with the joints of each frame")
    rows = _read_joints(joints, model, frames)
    given: Sequence[Any] = list(images or [read_cloud(path, scale, nan_policy) for path in frames])
    folder = seen_folder(seen, output, force)
    from torchreg.alignment.calibrate_base import calibrate_base

    found = calibrate_base(model, given, rows, offsets, camera_link=camera_link)
    found.save(output)
    write_optional([transform], Source([found], shape=model))
    _write_camera(handeye, urdf_out, shape, model, found)
    with OptionalOutput(folder):
        _draw_frames(folder, model, found, frames, given, rows)
    if not quiet:
        typer.echo(f"{_summary(model, found, frames)} -> {transform}")
    if not found.status.usable:
        raise typer.Exit(ExitCode.UNUSABLE)


def _write_camera(
    handeye: Path | None, urdf: Path | None, source: str, shape: ArticulatedShape, found: BaseCalibration
) -> None:
    """Write the camera's pose in its carrier, the base or a link, for easy_handeye, and into a robot's file."""
    from torchreg.geometry.rigid import invert_rigid
    from torchreg.geometry.rotation import so3_log
    from torchreg.geometry.rotation_representations import quaternion_from_rotation_vector
    from torchreg.io.atomic import write_atomic
    from torchreg.io.urdf_file.write import save_urdf_with_camera

    placed, base, link = invert_rigid(found.T_camera_base), shape.part_names[0], found.camera_link
    w, x, y, z = quaternion_from_rotation_vector(so3_log(placed[None, :3, :3])[0]).tolist()
    numbers = dict(zip("xyz", placed[:3, 3].tolist(), strict=True)) | {"qx": x, "qy": y, "qz": z, "qw": w}
    lines = ["parameters:", f"  eye_on_hand: {str(link is not None).lower()}"]
    frames = {"robot_base_frame": base, "robot_effector_frame": link or "", "tracking_base_frame": _CAMERA}
    lines += [f"  {name}: {json.dumps(value)}" for name, value in frames.items()]
    lines += ["transformation:", *(f"  {name}: {value!r}" for name, value in numbers.items())]
    if handeye is not None:
        with OptionalOutput(handeye):
            write_atomic(handeye, ("\n".join(lines) + "\n").encode())
    if urdf is not None:
        with OptionalOutput(urdf):
            save_urdf_with_camera(urdf, source, link or base, _CAMERA, placed)


def _read_joints(path: Path, shape: ArticulatedShape, frames: Sequence[Path]) -> list[dict[str, float]]:
    """Return the joints by name of each frame."""
    from torchreg.io.pose_table import load_pose_table

    names = shape.dof_names[6:]
    rows = load_pose_table(path, names)
    lacking = [name for name in names if name not in rows[0]]
    if lacking:
        raise InputError(f"{path} has no column {', '.join(lacking[:4])}; the robot's joints are {', '.join(names)}")
    if len(rows) != len(frames):
        raise InputError(f"{path} must hold a row for every frame, {len(frames)}, got {len(rows)}")
    return rows


def _calibrate_hand(
    shape: ArticulatedShape, paths: Sequence[Path], clouds: Sequence[Tensor], output: Path, quiet: bool
) -> None:
    """Fit a hand to clouds and write it."""
    from torchreg.alignment.calibrate import calibrate as fit

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FramesWarning)  # reported below, by the names of files
        found = fit(shape, clouds)
    found.save(output)
    if found.outliers:
        names = ", ".join(paths[number].name for number in found.outliers)
        warnings.warn(f"not surely found in {names}, left out of {len(paths)} frames", FramesWarning, stacklevel=2)
    if not quiet:
        length = float(found.log_length_scales.exp().mean())
        typer.echo(f"{found.status.value}: lengths {length:.3f} times those of the shape on average -> {output}")
    if not found.status.usable:
        raise typer.Exit(ExitCode.UNUSABLE)


def _draw_frames(
    folder: Path,
    shape: ArticulatedShape,
    found: BaseCalibration,
    paths: Sequence[Path],
    frames: Sequence[Any],
    rows: Sequence[Mapping[str, float]],
) -> None:
    """Draw the robot over each frame."""
    import torch

    from torchreg.geometry.rigid import invert_rigid
    from torchreg.geometry.rotation import so3_log
    from torchreg.viz.figures import save_scene
    from torchreg.viz.posed_scenes import posed_scene

    part = None if found.camera_link is None else shape.part_names.index(found.camera_link)
    skin = shape.file_skin() if shape.surface is not None else None
    for number, (path, frame, row) in enumerate(zip(paths, frames, rows, strict=True)):
        joints = torch.tensor([row[name] for name in shape.dof_names[6:]], dtype=torch.float64) + found.offsets
        base = found.T_camera_base
        if part is not None:
            still = torch.cat([torch.zeros(6, dtype=torch.float64), joints]).to(shape.rest)
            base = base @ invert_rigid(shape.part_transforms(still)[part].cpu().double())
        pose = torch.cat([base[:3, 3], so3_log(base[None, :3, :3])[0], joints]).to(shape.rest)
        picture = folder / f"{number:02d}_{path.stem}.png"
        if hasattr(frame, "camera") and skin is not None and skin.faces is not None:
            _draw_over(picture, frame, skin(pose), skin.faces)
        else:
            points = frame.points if hasattr(frame, "points") else frame
            save_scene(picture, posed_scene(shape, pose[None], [points.to(pose)], skin=skin))


def _draw_over(picture: Path, frame: DepthFrame, vertices: Tensor, faces: Tensor) -> None:
    """Draw the outline of a mesh in camera coordinates over a depth image, its points blue."""
    import torch

    from torchreg.geometry.camera import Camera
    from torchreg.geometry.mesh import TriangleMesh
    from torchreg.io.images import save_image
    from torchreg.viz.seen import cut_picture, mask_outline, model_mask, picture_with_points

    given = frame.camera
    camera = Camera(given.width, given.height, given.intrinsics, distortion=given.distortion)
    outline = mask_outline(model_mask(TriangleMesh(vertices.double(), faces), camera))
    kept = frame.depth > 0 if frame.mask is None else frame.mask
    everything = torch.ones(len(frame.pixels), dtype=torch.bool)
    drawn = picture_with_points(
        cut_picture(frame.depth, kept), frame.pixels.double(), everything, outline, radius=0
    )  # fmt: skip
    save_image(picture, drawn)


def _summary(shape: ArticulatedShape, found: BaseCalibration, paths: Sequence[Path]) -> str:
    """Return what was found in one line: its uncertainty, outlier frames, offsets."""
    std = found.covariance.diagonal().sqrt()
    words = [
        f"{found.status}: {found.camera_link or 'base'} within {1e3 * float(std[:3].max()):.1f} mm and "
        f"{math.degrees(float(std[3:].max())):.2f} degrees (one standard deviation)",
        f"data {1e3 * float(found.residuals.median()):.1f} mm from the robot",
    ]
    if found.outliers:
        words.append(
            "does not show the robot there, or in other joints: " + ", ".join(paths[k].name for k in found.outliers)
        )
    moved = [
        f"{name} {math.degrees(value):+.2f} degrees"
        for name, value in zip(shape.dof_names[6:], found.offsets.tolist(), strict=True)
        if value
    ]
    return "; ".join([*words, *(["offsets " + ", ".join(moved)] if moved else [])])
