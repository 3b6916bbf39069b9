"""``torchreg align``: a shape to point clouds, one after another."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import (
    Frame,
    NanPolicy,
    Outlier,
    Scale,
    Search,
    Sigma,
    Time,
    alignment_summary,
    cloud_files,
    person_summary,
    read_cloud,
    read_schedule,
    write_pose,
)
from torchreg.cli.cameras import Depth, DepthRange, Intrinsics, Mask, check_used, depth_source
from torchreg.cli.hand_side import Side, better_hand, shape_of_side
from torchreg.cli.initializer_option import Initializer, read_initializer
from torchreg.cli.keypoint_options import Keypoints, KeypointStd, MeasuredFrames, read_keypoints
from torchreg.cli.known_options import Joints, JointStd, Known, Locked, observability, read_known
from torchreg.cli.outputs import PICTURE_ENDINGS, Force, Quiet, check_outputs, numbered, with_ending
from torchreg.cli.reporting import ExitCode, OptionalOutput, interruption, reporting
from torchreg.cli.shape_argument import FreeBase, PackageDir, Parents, Shape, Skin, chosen_skin, load_shape
from torchreg.cli.upright import Up, Upright, known_up, remembering
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.alignment.config import AlignConfig
    from torchreg.alignment.pose_proposer import PoseProposer
    from torchreg.alignment.results import AlignResult
    from torchreg.capture.depth_frames import DepthFrames
    from torchreg.geometry.upright import Direction
    from torchreg.shapes.articulated import ArticulatedShape
    from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class _Files:
    """The outputs of one cloud."""

    result: Path
    pose: Path | None
    ply: Path | None
    picture: Path | None
    rig: Path | None

    def all(self) -> Iterable[Path | None]:
        """Yield the paths of all outputs."""
        yield from (self.result, self.result.with_suffix(".json"), self.pose, self.ply, self.picture, self.rig)


@reporting
def align(
    shape: Shape,
    clouds: Annotated[
        list[Path],
        typer.Argument(
            metavar="CLOUD",
            help="Point clouds, metres, of any format that `torchreg formats` shows, or a folder of them; several are "
            "taken for the frames of a motion, and each starts from the pose before. With --depth depth pictures.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="RESULT", help="RESULT.safetensors and RESULT.json are written.")
    ] = Path("result"),
    start: Annotated[
        Path | None,
        typer.Option(
            help="Pose to start from: a result, or .json with numbers or {degree of freedom: number}, .csv or .npz; "
            "without one the shape is searched for."
        ),
    ] = None,
    initializer: Initializer = None,
    fit_shape: Annotated[
        bool,
        typer.Option(
            "--fit-shape",
            help="Also fit the shape's coefficients, as of a body to a person; of a rig without any the lengths and "
            "radii of its parts.",
        ),
    ] = False,
    depth: Depth = False,
    intrinsics: Intrinsics = None,
    mask: Mask = None,
    depth_range: DepthRange = None,
    locked: Locked = None,
    joints: Joints = None,
    joint_std: JointStd = None,
    keypoints: Keypoints = None,
    keypoint_std: KeypointStd = None,
    sigma: Sigma = None,
    outlier: Outlier = "limit",
    search: Search = "auto",
    nan_policy: NanPolicy = "raise",
    scale: Scale = 1.0,
    time: Time = None,
    frame: Frame = None,
    parents: Parents = None,
    package_dir: PackageDir = None,
    free_base: FreeBase = None,
    skin: Skin = None,
    side: Side = None,
    pose: Annotated[
        Path | None, typer.Option(help="Also write the pose by name of degree of freedom (.json or .csv).")
    ] = None,
    ply: Annotated[Path | None, typer.Option(help="Also write the registered model points (.ply).")] = None,
    picture: Annotated[Path | None, typer.Option(help="Also draw shape and data (.png, .pdf, .svg).")] = None,
    gltf: Annotated[
        Path | None, typer.Option(help="Also write the moving shape, all clouds in one file (.glb).")
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            help="Also write the file of SHAPE with the bones found and its clips (.glb); of a rigged character with "
            "--fit-shape."
        ),
    ] = None,
    upright: Upright = False,
    up: Up = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Align a shape to point clouds.

    With several clouds, the names of the outputs are numbered: RESULT_1, RESULT_2, ... Ctrl-C leaves those of the
    finished clouds on disk.

    Coordinates far from the origin, as in maps, keep their digits; pictures and the .glb file, which has single
    precision, begin at an origin near the clouds that the result tells.

    With --depth --intrinsics FILE what the pictures say of free space counts too: nothing is in front of what was
    measured, nor beside the --mask.

    With --fit-shape the result holds the coefficients, and every cloud starts from --start, or is searched, by itself.

    What is known of the pose, --joints, counts with its --joint-std against data of which neighbors err together.
    So do keypoints that a detector saw, --keypoints, of which some may be wrong.

    Exit codes: 0; 1 if an alignment is doubtful, or found too few inliers to mean anything, or an output beside the
    results could not be written; 2 for an error; 130 for Ctrl-C.
    """
    check_used(depth, "--depth", {"--intrinsics": intrinsics, "--mask": mask, "--depth-range": depth_range})
    check_used(fit_shape, "--fit-shape", {"--rig": rig})
    if rig is not None and Path(shape).suffix.lower() not in (".glb", ".gltf"):
        raise InputError(f"--rig has no meaning for {shape}, which is no rigged character; leave it out")
    if upright and start is not None:
        raise InputError("--upright is of a search, which --start leaves out; give one of them")
    pictures = depth_source(clouds, intrinsics, mask, depth_range) if depth else None
    known_direction = known_up(up, clouds, camera=depth)
    clouds = cloud_files(clouds) if pictures is None else [Path(name) for name in pictures.names]
    output = with_ending(output, (".safetensors",), add=True)
    optional = (
        with_ending(pose, (".json", ".csv")), with_ending(ply, (".ply",)), with_ending(picture, PICTURE_ENDINGS),
        with_ending(rig, (".glb",)),
    )  # fmt: skip
    files = _output_files(output, optional, len(clouds))
    check_outputs([*(path for entry in files for path in entry.all()), with_ending(gltf, (".glb",))], force)
    for path in clouds:
        path.stat()  # a missing file is reported before the first is aligned

    from tqdm import tqdm

    with tqdm(total=len(clouds), unit="cloud", desc="reading", leave=False, disable=quiet) as bar:
        model = load_shape(shape_of_side(shape, side), parents, package_dir, free_base, skin)
        from torchreg.alignment.config import AlignConfig
        from torchreg.shapes.skin import sample_skin
        from torchreg.storage import load_pose

        config = AlignConfig(schedule=read_schedule(sigma), outlier=outlier, search=search, nan_policy=nan_policy)
        first = None if start is None else load_pose(start, model)
        points = sample_skin(model, config.num_model_points, sharpness=config.sharpness)
        network = read_initializer(initializer, model, side)
        known = read_known(model, locked, joints, joint_std, len(clouds))
        measured = read_keypoints(keypoints, keypoint_std, clouds, None if side == "either" else model, pictures)
        run = _AlignRun(
            model, config, points, scale, time, frame, first, known, measured, network, pictures=pictures,
            fit_shape=fit_shape, source=(shape, chosen_skin(skin)), up=known_direction,
        )  # fmt: skip
        if upright:
            run.search_upright(clouds[0])
        if side == "either":
            side = run.choose_hand(clouds[0])
            if not quiet:
                bar.write(f"{clouds[0]}: a {side} hand")
        try:
            run.align_all(clouds, files, bar, quiet)
            interrupted = False
        except KeyboardInterrupt:
            interrupted = True
        if gltf is not None and run.results:
            with OptionalOutput(gltf):
                run.save_motion(gltf)
    if interrupted:
        raise interruption(f"{len(run.results)} of {len(clouds)} clouds are done")
    if not all(result.statuses[0].usable for result in run.results):
        raise typer.Exit(ExitCode.UNUSABLE)


def _output_files(output: Path, optional: Iterable[Path | None], count: int) -> list[_Files]:
    """Return the outputs of each cloud, numbered if there are several."""
    return [
        _Files(numbered(output, number, count), *(numbered(name, number, count) for name in optional))
        for number in range(count)
    ]


def _show_stage(bar: Any, stage: str) -> None:
    if not bar.disable and bar.postfix != stage:
        bar.set_postfix_str(stage)


@dataclass
class _AlignRun:
    """Aligns clouds one after another and writes the requested files."""

    shape: ArticulatedShape
    config: AlignConfig
    skin: LinearBlendSkin
    scale: float
    time: float | None
    frame: int | None
    start: Tensor | None
    known: Known
    measured: MeasuredFrames
    initializer: PoseProposer | None = None
    pictures: DepthFrames | None = None
    fit_shape: bool = False
    source: tuple[str, str | int | None] = ("", None)
    up: Direction | None = None
    results: list[AlignResult] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.fit_shape and not self.shape.coefficient_names:
            self.shape = self.shape.with_bone_coefficients()

    @functools.cached_property
    def surface(self) -> LinearBlendSkin:
        """The surface of pictures, meshed once."""
        from torchreg.datasets.hand import surface_skin

        return surface_skin(self.shape)

    def fitted(self, result: AlignResult) -> tuple[ArticulatedShape, LinearBlendSkin]:
        """Return the shape of a result, and its surface: with --fit-shape those of the person found."""
        if result.coefficients is None:
            return self.shape, self.surface
        person = self.shape.with_coefficients(result.coefficients)
        return person, person.file_skin()

    def align_all(self, clouds: list[Path], files: list[_Files], bar: Any, quiet: bool) -> None:
        """Align to all clouds, and tell of each."""
        for number, (path, entry) in enumerate(zip(clouds, files, strict=True)):
            bar.set_description(path.name)
            result = self.align(number, path, entry, on_step=lambda record: _show_stage(bar, record.stage))
            bar.update()
            if not quiet:
                loose = observability(self.shape, result) if self.known.rows else ""
                told = "; ".join(filter(None, (alignment_summary(result), person_summary(self.shape, result), loose)))
                bar.write(f"{path}: {told} -> {entry.result}")

    def align(self, number: int, path: Path, files: _Files, on_step: Callable[[Any], None]) -> AlignResult:
        """Return the alignment to one cloud or picture, after writing it."""
        from torchreg.alignment.align import align

        data = self._data(number, path)
        result = align(
            self.shape, data, self.start, model_points=None if self.fit_shape else self.skin, locked=self.known.locked,
            prior=self.known.prior(number), fit_shape=self.fit_shape, initializer=self.initializer, config=self.config,
            on_step=on_step, **self.measured.of(number),
        )  # fmt: skip
        result = remembering(result, self.up)
        result.save(files.result)
        self.results.append(result)
        self._write_others(result, data, files)
        if result.statuses[0].usable and not self.fit_shape:
            self.start = result.pose
        return result

    def _data(self, number: int, path: Path) -> Any:
        if self.pictures is not None:
            return self.pictures[number]
        return read_cloud(path, self.scale, self.config.nan_policy, self.time, self.frame)

    def search_upright(self, path: Path) -> None:
        """Search upright shapes alone; where neither --up nor the file say what that is, the first cloud does."""
        from torchreg.geometry.loaded import as_points
        from torchreg.geometry.upright import guess_up

        self.config = replace(self.config, upright=self.up or guess_up([as_points(self._data(0, path))]))

    def choose_hand(self, path: Path) -> str:
        """Go on with the hand that the first cloud or picture shows, and return its side."""
        from torchreg.alignment.align import align
        from torchreg.shapes.skin import sample_skin

        data = self._data(0, path)
        found = better_hand(
            lambda hand: align(
                hand, data, self.start, locked=self.known.locked, prior=self.known.prior(0), config=self.config,
                **self.measured.of(0),
            )
        )  # fmt: skip
        self.shape = found
        self.skin = sample_skin(found, self.config.num_model_points, sharpness=self.config.sharpness)
        return found.side

    def _write_others(self, result: AlignResult, data: Any, files: _Files) -> None:
        """Write what is asked for beside the result, which is saved: none of it keeps the others from being written."""
        if files.pose is not None:
            with OptionalOutput(files.pose):
                write_pose(files.pose, self.shape, result.pose)
        if files.ply is not None:
            from torchreg.io.points import save_points

            with OptionalOutput(files.ply):
                save_points(files.ply, result.registered)
        if files.picture is not None:
            with OptionalOutput(files.picture):
                self._draw(result, result.points_of(data), files.picture)
        if files.rig is not None:
            with OptionalOutput(files.rig):
                result.to_gltf(files.rig, self.source[0], skin=self.source[1])

    def _draw(self, result: AlignResult, data: Tensor, path: Path) -> None:
        """Draw the shape over the points (M, 3) that it was aligned to."""
        from torchreg.viz.figures import save_scene
        from torchreg.viz.posed_scenes import posed_scene

        shown = result.local(self.shape.rest)
        near = data if result.origin is None else (data - result.origin).to(self.shape.rest)
        shape, surface = self.fitted(result)
        save_scene(path, posed_scene(shape, shown.pose[None], [near], [result.inliers], skin=surface, up=self.up))

    def save_motion(self, path: Path) -> None:
        """Write all poses found as an animation."""
        import torch

        from torchreg.cli.outputs import shifted_to, tell_origin
        from torchreg.geometry.upright import guess_up
        from torchreg.viz.gltf import save_shape_animation

        origin = self.results[0].origin
        poses = torch.stack([shifted_to(origin, result.pose) for result in self.results])
        shape, surface = self.fitted(self.results[-1])
        near = list(shape.keypoints(poses.to(shape.rest)).detach())
        save_shape_animation(path, shape, poses, skin=surface, up=self.up or guess_up(near))
        tell_origin(path, origin)
