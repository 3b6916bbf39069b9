"""What is written from a result: a table from its kind and the ending of the file to the function that writes it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchreg.cli.outputs import numbered, shifted_to, tell_origin
from torchreg.cli.reporting import OptionalOutput
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.geometry.upright import Direction
    from torchreg.shapes.articulated import ArticulatedShape
    from torchreg.shapes.skin import LinearBlendSkin

PICTURES, MOVIES = (".png", ".pdf", ".svg"), (".gif", ".mp4")


@dataclass
class Source:
    """What a file is written from."""

    results: Sequence[Any]  # one, or the alignments of a motion
    data: Sequence[Any] = ()  # clouds (M, 3), meshes or depth pictures, one per frame, in the coordinates of the files
    shape: ArticulatedShape | None = None  # of the results, with their coefficients; the one that they keep by default
    rig: tuple[str | Path, str | int | None] | None = None  # file of the rigged character that was fitted, and its skin
    up: Direction | None = None
    fps: float = 20.0
    color: str = "bones"
    names: Sequence[str] = ()
    local: Any = None  # the result in coordinates that begin at its origin, where it is at hand
    coarse: Callable[[], LinearBlendSkin] | None = None  # makes the surface of moving pictures
    on_frame: Callable[[int, int], None] | None = None

    @property
    def result(self) -> Any:
        """The last result, of which most files hold one."""
        return self.results[-1]

    @property
    def direction(self) -> Direction | None:
        """What is upright, where that is known."""
        return self.up or getattr(self.result, "up", None)

    @property
    def posed(self) -> ArticulatedShape:
        """The shape of the results, with the coefficients found."""
        found: ArticulatedShape | None = self.shape or getattr(self.result, "shape", None)
        if found is None:
            raise InputError("the result holds no shape; pass --shape with what was aligned")
        return found

    @cached_property
    def near(self) -> Any:
        """A sequence in coordinates that begin at its origin, which single precision can hold."""
        origin = self.result.origin
        if self.local is not None or origin is None:
            return self.result if self.local is None else self.local
        return self.result.local() if hasattr(self.result, "local") else self.result.moved(-origin)

    def about_origin(self, mesh: Any) -> Any:
        """Return a mesh in coordinates that begin at the result's origin."""
        from torchreg.geometry.mesh import TriangleMesh

        origin = self.result.origin
        return mesh if origin is None else TriangleMesh(mesh.vertices - origin, mesh.faces)


@lru_cache(maxsize=1)
def _surface(shape: ArticulatedShape, as_read: bool) -> LinearBlendSkin:
    """Return the surface of a shape, meshed once for all files; the file's own mesh of a fitted one."""
    from torchreg.datasets.hand import surface_skin

    return shape.file_skin() if as_read else surface_skin(shape)


def _align_surface(source: Source) -> LinearBlendSkin:
    return _surface(source.posed, source.result.coefficients is not None)


def _align_json(path: Path, source: Source) -> None:
    _write_json(path, dict(zip(source.posed.dof_names, source.result.pose.tolist(), strict=True)), 2)


def _align_csv(path: Path, source: Source) -> None:
    from torchreg.io.pose_table import save_pose_table

    save_pose_table(path, source.posed.dof_names, [result.pose.tolist() for result in source.results])


def _align_ply(path: Path, source: Source) -> None:
    from torchreg.io.points import save_points

    save_points(path, source.result.registered)


def _align_glb(path: Path, source: Source) -> None:
    """Write the poses of all results as a motion; or the rig's own file with the bones found."""
    import torch

    from torchreg.geometry.upright import guess_up
    from torchreg.viz.gltf import save_shape_animation

    if source.rig is not None:
        source.result.to_gltf(path, source.rig[0], skin=source.rig[1])
        return
    origin, shape = source.results[0].origin, source.posed
    poses = torch.stack([shifted_to(origin, result.pose) for result in source.results])
    up = source.direction or guess_up(list(shape.keypoints(poses.to(shape.rest)).detach()))
    save_shape_animation(path, shape, poses, skin=_align_surface(source), up=up)
    tell_origin(path, origin)


def _align_picture(path: Path, source: Source) -> None:
    from torchreg.viz.figures import save_scene
    from torchreg.viz.posed_scenes import posed_scene

    result, shape = source.result, source.posed
    points = result.points_of(source.data[-1])
    pose = result.local(shape.rest).pose
    near = points if result.origin is None else (points - result.origin).to(shape.rest)
    skin = _align_surface(source)
    save_scene(path, posed_scene(shape, pose[None], [near], [result.inliers], skin=skin, up=source.direction))


def _track_json(path: Path, source: Source) -> None:
    """Write times, statuses and a list of numbers, null where there is none, by name of degree of freedom."""
    track = source.result
    columns = {
        name: [value if value == value else None for value in column]
        for name, column in zip(source.posed.dof_names, track.poses.T.tolist(), strict=True)
    }
    units = "metres and radians; times in the unit of the sequence"
    statuses = [status.value for status in track.statuses]
    _write_json(path, {"units": units, "times": track.times.tolist(), "statuses": statuses, "poses": columns}, 1)


def _track_csv(path: Path, source: Source) -> None:
    """Write one row per frame; frames without a pose have no numbers."""
    from torchreg.io.pose_table import save_pose_table

    track = source.result
    rows = [
        [frame, time, status.value, *(value if value == value else "" for value in pose)]  # NaN is not equal to itself
        for frame, (time, status, pose) in enumerate(
            zip(track.times.tolist(), track.statuses, track.poses.tolist(), strict=True)
        )
    ]
    save_pose_table(path, ["frame", "time", "status", *source.posed.dof_names], rows)


def _track_motion(path: Path, source: Source) -> None:
    """Write the moving shape as glTF or BVH."""
    from torchreg.geometry.upright import guess_up
    from torchreg.viz.track_bvh import save_track_bvh
    from torchreg.viz.tracking import save_track_gltf

    save = save_track_gltf if path.suffix.lower() == ".glb" else save_track_bvh
    save(path, source.posed, source.near, up=source.direction or guess_up(list(source.near.keypoints)))
    tell_origin(path, source.result.origin)


def _track_movie(path: Path, source: Source) -> None:
    from torchreg.viz.tracking import animate_track

    skin = None if source.coarse is None else source.coarse()
    animate_track(
        path, source.posed, source.near, source.data, fps=source.fps, skin=skin, up=source.direction,
        on_frame=source.on_frame,
    )  # fmt: skip


def _track_pictures(path: Path, source: Source) -> None:
    """Draw each frame in one view, data near the surface blue."""
    from torchreg.viz.figures import save_scene, scene_view
    from torchreg.viz.posed_scenes import frame_labels, near_surface, posed_scene

    track, shape = source.near, source.posed
    scene = posed_scene(
        shape, track.poses, source.data, near_surface(shape, track.poses), captions=frame_labels(track),
        usable=[status.usable for status in track.statuses], up=source.direction,
    )  # fmt: skip
    view = scene_view(scene, margin=0.1)
    for number, picture in enumerate(_frames_of(path, source)):
        save_scene(picture, scene, number, view=view)


def _spine_glb(path: Path, source: Source) -> None:
    from torchreg.viz.spine_gltf import save_spine_animation

    frame = source.result.reference
    mesh = source.about_origin(source.data[frame])
    save_spine_animation(path, source.near.model, mesh, frame, fps=source.fps, up=source.direction)
    tell_origin(path, source.result.origin)


def _spine_swc(path: Path, source: Source) -> None:
    from torchreg.io.swc import save_swc

    for frame, name in enumerate(_numbered_frames(path, source)):
        save_swc(name, source.result.skeleton(frame), f"frame {frame}")


def _spine_npz(path: Path, source: Source) -> None:
    from torchreg.io.clouds.npz import save_arrays

    names = ["tips", "junctions", "graph", "curves", "radii", "frames", "times", "found", "own", "confidence"]
    names += ["births", "ends"] if source.result.births is not None else []
    save_arrays(path, {name: getattr(source.result, name) for name in names})


def _spine_csv(path: Path, source: Source) -> None:
    source.result.measurements().save_csv(path)


def _spine_plot(path: Path, source: Source) -> None:
    from torchreg.viz.figures import save_picture
    from torchreg.viz.spines import draw_measurements

    save_picture(draw_measurements(source.result.measurements()), path)


def _spine_pictures(path: Path, source: Source) -> None:
    from torchreg.viz.spines import save_spine_pictures

    save_spine_pictures(path, source.result, source.data)


def _spine_movie(path: Path, source: Source) -> None:
    from torchreg.viz.spines import save_spine_movie

    save_spine_movie(path, source.result, source.data, fps=source.fps)


def _rig_motion(path: Path, source: Source) -> None:
    """Write the rig and its clip as glTF, or its motion as BVH."""
    rig = source.result
    (rig.to_gltf if path.suffix.lower() == ".glb" else rig.to_bvh)(path, fps=source.fps, up=source.direction)


def _scan_ply(path: Path, source: Source) -> None:
    """Write the moved source, colored by bones, or by its distance from the target."""
    from torchreg.viz.bone_colors import save_error_ply, save_weight_ply

    scan = source.result
    if source.color == "distance":
        save_error_ply(path, scan.deformed, scan.distances, scan.faces)
    else:
        save_weight_ply(path, scan.model, scan.points, scan.faces, moved=True)


def _scan_glb(path: Path, source: Source) -> None:
    """Write the moving, skinned source."""
    from torchreg.geometry.upright import guess_up
    from torchreg.viz.scan_gltf import save_grid_animation

    scan, near = source.result, source.near
    if scan.faces is None:
        raise InputError("the source scan has no triangles, which a .glb needs; name an output that ends in .ply")
    up = source.direction or guess_up([scan.points])
    save_grid_animation(path, near.model, near.points, scan.faces, up=up)
    tell_origin(path, scan.origin)


def save_robot(path: Path, source: Source) -> Any:
    """Write a robot with the meshes of its links, a table of its joint values in all scans, and return it."""
    from torchreg.io.pose_table import save_pose_table

    robot = source.result.to_urdf(path)
    values = robot.joint_values.tolist()
    names = source.names or [str(number) for number in range(len(values))]
    with OptionalOutput(joint_table(path)):
        rows = [[name, *row] for name, row in zip(names, values, strict=True)]
        save_pose_table(joint_table(path), ["scan", *(joint.name for joint in robot.tree.joints[1:])], rows)
    return robot


def joint_table(path: Path) -> Path:
    """Return where the joint values of a robot go."""
    return path.with_name(f"{path.stem}_joints.csv")


def _base_json(path: Path, source: Source) -> None:
    _write_json(path, base_record(source.posed, source.result), 2)


def base_record(shape: ArticulatedShape, found: Any) -> Mapping[str, Any]:
    """Return the calibration of a base as plain numbers, with the command by which ROS 2 publishes it."""
    from torchreg.geometry.rotation import so3_log
    from torchreg.geometry.rotation_representations import quaternion_from_rotation_vector

    base = found.T_camera_base
    w, x, y, z = quaternion_from_rotation_vector(so3_log(base[None, :3, :3])[0]).tolist()
    place = dict(zip("xyz", base[:3, 3].tolist(), strict=True))
    turn = {"qx": x, "qy": y, "qz": z, "qw": w}
    options = " ".join(f"--{name} {value:.9g}" for name, value in (place | turn).items())
    publish = f"ros2 run tf2_ros static_transform_publisher {options} --frame-id camera --child-frame-id"
    carrier = found.camera_link or shape.part_names[0]
    std = found.covariance.diagonal().sqrt().tolist()
    return {
        "T_camera_base": base.tolist(), "translation": place, "rotation": turn, "std_translation_m": std[:3],
        "std_rotation_rad": std[3:], "offsets": dict(zip(shape.dof_names[6:], found.offsets.tolist(), strict=True)),
        "residuals_m": found.residuals.tolist(), "outliers": list(found.outliers), "status": found.status.value,
        "camera_link": found.camera_link, "ros2": f"{publish} {carrier}",
    }  # fmt: skip


def _calibrated_glb(path: Path, source: Source) -> None:
    from torchreg.viz.gltf import save_shape_animation

    save_shape_animation(path, source.posed, source.result.poses, fps=source.fps, up=source.up)


def _any_npz(path: Path, source: Source) -> None:
    """Write all tensors of a result, those of records inside as record.tensor."""
    from torchreg.io.clouds.npz import save_arrays

    save_arrays(path, dict(_tensors(vars(source.result), "")))


def _tensors(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Tensor]]:
    import torch

    for name, value in values.items():
        if isinstance(value, torch.nn.Module):
            yield from _tensors(value.state_dict(), f"{prefix}{name}.")
        elif isinstance(value, torch.Tensor):
            yield prefix + name, value


def _scene_of(source: Source) -> Any:
    from torchreg.cli.upright import remembering
    from torchreg.viz.result_scenes import result_scene

    return remembering(result_scene(source.result, shape=source.shape, data=source.data), source.up)


def _any_picture(path: Path, source: Source) -> None:
    """Draw the last frame."""
    from torchreg.viz.figures import save_scene

    scene = _scene_of(source)
    save_scene(path, scene, scene.num_frames - 1)


def _any_movie(path: Path, source: Source) -> None:
    from torchreg.viz.animation import animate_scene

    animate_scene(path, _scene_of(source), source.fps)


def _write_json(path: Path, content: Any, indent: int) -> None:
    from torchreg.io.atomic import write_atomic

    write_atomic(path, (json.dumps(content, indent=indent) + "\n").encode())


def _itself(path: Path, source: Source) -> list[Path]:
    return [path]


def _numbered_frames(path: Path, source: Source) -> list[Path]:
    count = len(source.result.curves)
    return [numbered(path, frame, count) for frame in range(count)]


def _frames_of(path: Path, source: Source) -> list[Path]:
    return [path / f"frame_{number:04d}.png" for number in range(len(source.data))]


def _robot_files(path: Path, source: Source) -> list[Path]:
    return [path, joint_table(path)]


@dataclass(frozen=True)
class Writer:
    """A row of the table: which results become which files, and what else that takes."""

    kind: str  # of the result, the name of its class; empty for all
    endings: tuple[str, ...]  # of the file; an empty one for a folder
    holds: str
    write: Callable[[Path, Source], Any]
    needs: tuple[str, ...] = ()  # fields of `Source` without which it cannot be written
    several: bool = False  # whether one file holds several results
    files: Callable[[Path, Source], list[Path]] = _itself  # the files that a path becomes


WRITERS = (
    Writer("AlignResult", (".json",), "the pose by name", _align_json),
    Writer("AlignResult", (".csv",), "the pose by name, a row for each result", _align_csv, several=True),
    Writer("AlignResult", (".ply",), "the registered model points", _align_ply),
    Writer("AlignResult", (".glb",), "the shape in the poses of all results; with --rig the rig's file with the bones "
           "found", _align_glb, several=True),
    Writer("AlignResult", PICTURES, "shape and data", _align_picture, ("data",)),
    Writer("TrackResult", (".json",), "times, statuses, and the poses by name", _track_json),
    Writer("TrackResult", (".csv",), "a table: frame, time, status, and the pose by name", _track_csv),
    Writer("TrackResult", (".glb",), "the moving shape", _track_motion),
    Writer("TrackResult", (".bvh",), "the motion for animation programs", _track_motion),
    Writer("TrackResult", MOVIES, "shape and data", _track_movie, ("data",)),
    Writer("TrackResult", ("",), "a picture of each frame", _track_pictures, ("data",), files=_frames_of),
    Writer("SpineSequence", (".glb",), "the curves in the surface of one frame", _spine_glb, ("data",)),
    Writer("SpineSequence", (".swc",), "the curves, a numbered file per frame", _spine_swc, files=_numbered_frames),
    Writer("SpineSequence", (".npz",), "tips, graph, curves and radii", _spine_npz),
    Writer("SpineSequence", (".csv",), "lengths, radii and angles of limbs, a line per frame", _spine_csv),
    Writer("SpineSequence", PICTURES, "lengths, radii and angles of limbs over time", _spine_plot),
    Writer("SpineSequence", MOVIES, "all frames", _spine_movie, ("data",)),
    Writer("SpineSequence", ("",), "a picture of each frame", _spine_pictures, ("data",), files=_frames_of),
    Writer("SequenceRig", (".glb",), "the skinned mesh with its clip", _rig_motion),
    Writer("SequenceRig", (".bvh",), "the motion for animation programs", _rig_motion),
    Writer("ScanRegistration", (".ply",), "the moved source, see --color", _scan_ply),
    Writer("ScanRegistration", (".glb",), "the moving, skinned source", _scan_glb),
    Writer("SequenceRegistration", (".urdf",), "the robot, its meshes, and FILE_joints.csv", save_robot,
           files=_robot_files),
    Writer("Calibration", (".glb",), "the shape in the poses of all frames", _calibrated_glb),
    Writer("BaseCalibration", (".json",), "the base, what is known of it, and ROS's static transform", _base_json,
           ("shape",)),
    Writer("", PICTURES, "the result in its last frame", _any_picture),
    Writer("", MOVIES, "the result in all frames", _any_movie),
    Writer("", (".npz",), "all tensors", _any_npz),
)  # fmt: skip
_ORIGINS = {
    "AlignResult": "align", "TrackResult": "track", "SpineSequence": "spine", "SequenceRig": "rig",
    "ScanRegistration": "register",
    "SequenceRegistration": "register --urdf", "Calibration": "calibrate hand",
    "BaseCalibration": "calibrate ROBOT.urdf", "": "any result",
}  # fmt: skip


def writers_of(kind: str) -> dict[str, Writer]:
    """Return the rows for a kind of result, by ending."""
    rows = [row for row in WRITERS if not row.kind] + [row for row in WRITERS if row.kind == kind]
    return {ending: row for row in rows for ending in row.endings}


def writer_of(path: Path, result: Any) -> Writer:
    """Return the row for a file; InputError, which lists the endings that go, if there is none."""
    kind = type(result).__name__
    known = writers_of(kind)
    if path.suffix.lower() not in known:
        endings = ", ".join(ending or "FOLDER" for ending in sorted(known))
        raise InputError(f"{path}: a {kind} is not written as {path.suffix or 'FOLDER'}, but as {endings}")
    return known[path.suffix.lower()]


def write(path: Path, source: Source) -> None:
    """Write a file."""
    writer_of(path, source.result).write(path, source)


def write_optional(paths: Iterable[Path | None], source: Source) -> None:
    """Write the files that are asked for; where one fails, a warning, and the others are written."""
    for path in paths:
        if path is not None:
            with OptionalOutput(path):
                write(path, source)


def endings_help() -> str:
    """Return the table in lines, by the commands that write the results."""
    lines = []
    for kind, command in _ORIGINS.items():
        lines.append(f"  {command}:")
        for row in WRITERS:
            if row.kind == kind:
                needs = "".join(f", needs --{name}" for name in row.needs)
                lines.append(f"    {' '.join(ending or 'FOLDER' for ending in row.endings)}: {row.holds}{needs}")
    return "\n".join(lines)
