"""``torchreg align``: a shape to point clouds, one after another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import (
    Clothed,
    FitShape,
    Frame,
    NanPolicy,
    Outlier,
    Scale,
    Search,
    Sigma,
    Support,
    Time,
    alignment_summary,
    cloud_files,
    fitted_shape,
    person_summary,
    read_clothed,
    read_cloud,
    read_schedule,
)
from torchreg.cli.cameras import DepthOptions
from torchreg.cli.export import Old, check_old
from torchreg.cli.hand_side import Side, better_hand, shape_of_side
from torchreg.cli.known_options import Initializer, Known, KnownOptions, observability, read_initializer
from torchreg.cli.outputs import (
    PICTURE_ENDINGS,
    Force,
    Quiet,
    check_outputs,
    check_used,
    numbered,
    with_ending,
    written_to,
)
from torchreg.cli.reporting import ExitCode, interruption, reporting
from torchreg.cli.shape_argument import Shape, ShapeOptions, chosen_skin
from torchreg.cli.upright import Up, Upright, known_up, remembering
from torchreg.cli.writers import Source, write_optional
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor
    from tqdm import tqdm

    from torchreg.alignment.config import AlignConfig
    from torchreg.alignment.results import AlignResult
    from torchreg.alignment.search.pose_proposer import PoseProposer
    from torchreg.alignment.shape.person_proposer import PersonProposer
    from torchreg.geometry.upright import Direction
    from torchreg.shapes.articulated import ArticulatedShape
    from torchreg.shapes.skin import LinearBlendSkin


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
    output: Annotated[Path, written_to("RESULT", "RESULT.safetensors and RESULT.json are written.")] = Path("result"),
    *,
    start: Annotated[
        Path | None,
        typer.Option(
            help="Pose to start from: a result, or .json with numbers or {degree of freedom: number}, .csv or .npz; "
            "without one the shape is searched for."
        ),
    ] = None,
    initializer: Initializer = None,
    fit_shape: FitShape = False,
    clothed: Clothed = "auto",
    views: DepthOptions,
    known: KnownOptions,
    sigma: Sigma = None,
    outlier: Outlier = "limit",
    search: Search = "auto",
    nan_policy: NanPolicy = "raise",
    support: Support = "auto",
    scale: Scale = 1.0,
    time: Time = None,
    frame: Frame = None,
    options: ShapeOptions,
    side: Side = None,
    picture: Annotated[Path | None, typer.Option(help="Also draw shape and data (.png, .pdf, .svg).")] = None,
    pose: Old = None,
    ply: Old = None,
    gltf: Old = None,
    rig: Old = None,
    upright: Upright = False,
    up: Up = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Align a shape to point clouds.

    With several clouds, the names of the outputs are numbered: RESULT_1, RESULT_2, ... Ctrl-C leaves those of the
    finished clouds on disk. `torchreg export` writes poses, points and the moving shape from the results.

    Coordinates far from the origin, as in maps, keep their digits; pictures begin at an origin near the clouds, which
    is in the result.

    With --depth --intrinsics FILE the free space of the pictures counts too: nothing is in front of what was measured,
    nor outside the --mask.

    With --fit-shape the result holds the coefficients, and every cloud starts from --start, or is searched, by itself.

    What is known of the pose, --joints, counts with its --joint-std against data of which neighbors err together.
    So do keypoints that a detector found, --keypoints, of which some may be wrong.

    Exit codes: 0; 1 if an alignment is doubtful, found too few inliers to mean anything, or did not find the shape in a
    whole picture, or an output other than the results could not be written; 2 for an error; 130 for Ctrl-C.
    """
    views.check()
    check_used(fit_shape, "--fit-shape", {"--rig": rig})
    worn = read_clothed(clothed, fit_shape)
    _check_together(shape, rig, searched_upright=upright and start is not None, in_picture=views.depth, support=support)
    pictures = views.source(clouds) if views.depth else None
    direction = known_up(up, clouds, camera=views.depth)
    clouds = cloud_files(clouds) if pictures is None else [Path(name) for name in pictures.names]
    output = with_ending(output, (".safetensors",), add=True)
    first = numbered(output, 0, len(clouds))
    check_old({"--pose": (pose, ".json .csv"), "--ply": (ply, ".ply")}, first)
    check_old({"--gltf": (gltf, ".glb")}, output if first == output else output.with_stem(f"{output.stem}_*"))
    check_old({"--rig": (rig, ".glb")}, first, f" --rig {shape}")
    files = _Files(output, [with_ending(picture, PICTURE_ENDINGS), pose, ply, rig], gltf, len(clouds))
    files.check(force)
    for path in clouds:
        path.stat()  # a missing file is reported before the first is aligned
    from tqdm import tqdm

    with tqdm(total=len(clouds), unit="cloud", desc="reading", leave=False, disable=quiet) as bar:
        from torchreg.alignment.config import AlignConfig

        config = AlignConfig(schedule=read_schedule(sigma), outlier=outlier, search=search, nan_policy=nan_policy)
        run = _AlignRun(
            options.load(shape_of_side(shape, side)), config,
            pictures.__getitem__ if pictures else lambda k: read_cloud(clouds[k], scale, nan_policy, time, frame),
            clouds, files, bar, fit_shape=fit_shape, rig=(shape, chosen_skin(options.skin)), up=direction,
            support=support, clothed=worn,
        )  # fmt: skip
        run.prepare(start, initializer, side, upright)
        run.known = known.read(run.shape, clouds, pictures, any_side=side == "either")
        if side == "either":
            run.choose_hand()
        complete = run.align_all()
    if not complete:
        raise interruption(f"{len(run.results)} of {len(clouds)} clouds are done")
    if not all(result.statuses[0].usable for result in run.results):
        raise typer.Exit(ExitCode.UNUSABLE)


def _check_together(shape: str, rig: Path | None, *, searched_upright: bool, in_picture: bool, support: str) -> None:
    """Raise InputError where options contradict each other."""
    if rig is not None and Path(shape).suffix.lower() not in (".glb", ".gltf"):
        raise InputError(f"--rig has no meaning for {shape}, which is no rigged character; leave it out")
    if searched_upright:
        raise InputError("--upright is of a search, which --start leaves out; give one of them")
    if in_picture and support != "auto":
        raise InputError("--support is of clouds, and has no meaning with --depth; leave it out")


@dataclass(frozen=True)
class _Files:
    """The outputs: results, others of each cloud, and a motion of all."""

    result: Path
    others: list[Path | None]
    motion: Path | None
    count: int

    def of(self, number: int) -> tuple[Path, list[Path | None]]:
        """Return where the result of a cloud goes, and what else is written of it."""
        others = [numbered(path, number, self.count) for path in self.others]
        return numbered(self.result, number, self.count), others

    def check(self, force: bool) -> None:
        """Raise an error if one cannot be written, or exists and may not be overwritten."""
        wanted: list[Path | None] = []
        for result, others in map(self.of, range(self.count)):
            wanted += [result, result.with_suffix(".json"), *others]
        check_outputs([*wanted, self.motion], force)


@dataclass
class _AlignRun:
    """Aligns clouds one after another and writes the requested files."""

    shape: ArticulatedShape
    config: AlignConfig
    read: Callable[[int], Any]
    clouds: list[Path]
    files: _Files
    bar: tqdm
    fit_shape: bool
    rig: tuple[str, str | int | None]
    up: Direction | None
    support: str
    clothed: bool | str
    known: Known = field(default_factory=Known)
    initializer: PoseProposer | PersonProposer | None = None
    start: Tensor | None = None
    results: list[AlignResult] = field(default_factory=list)

    def prepare(self, start: Path | None, initializer: Path | None, side: str | None, upright: bool) -> None:
        """Read where to start from, and decide in which poses to search."""
        from torchreg.alignment.shape.person_proposer import PersonProposer, is_body
        from torchreg.geometry.loaded import as_points
        from torchreg.geometry.upright import guess_up
        from torchreg.storage import load_pose

        self.start = None if start is None else load_pose(start, self.shape)
        if self.fit_shape and initializer is not None and is_body(self.shape):
            self.initializer = PersonProposer.load(initializer)
        else:
            self.initializer = read_initializer(initializer, self.shape, side)
        self.shape = fitted_shape(self.shape, self.fit_shape)
        if upright:  # where neither --up nor the file say what that is, the first cloud does
            self.config = replace(self.config, upright=self.up or guess_up([as_points(self.read(0))]))
        self.skin = self._skin()

    def _skin(self) -> LinearBlendSkin:
        from torchreg.shapes.skin import sample_skin

        return sample_skin(self.shape, self.config.num_model_points, sharpness=self.config.sharpness)

    def choose_hand(self) -> None:
        """Go on with the hand, right or left, that the first cloud or picture shows."""
        from torchreg.alignment.align import align

        data = self.read(0)
        hand = better_hand(lambda hand: align(
            hand, data, self.start, support=self.support, config=self.config, **self.known.of(0)
        ))  # fmt: skip
        self.shape = hand
        self.skin = self._skin()
        if not self.bar.disable:
            self.bar.write(f"{self.clouds[0]}: a {hand.side} hand")

    def align_all(self) -> bool:
        """Align to all clouds, and return whether all are done; what is done is on disk."""
        complete = True
        try:
            for number, path in enumerate(self.clouds):
                self.bar.set_description(path.name)
                result, written = self._align(number), self.files.of(number)[0]
                self.bar.update()
                if not self.bar.disable:
                    loose = observability(self.shape, result) if self.known.rows else ""
                    words = alignment_summary(result), person_summary(self.shape, result), loose
                    self.bar.write(f"{path}: {'; '.join(filter(None, words))} -> {written}")
        except KeyboardInterrupt:
            complete = False
        if self.results:
            write_optional([self.files.motion], Source(self.results, up=self.up))
        return complete

    def _align(self, number: int) -> AlignResult:
        """Return the alignment to one cloud or picture, after writing it."""
        from torchreg.alignment.align import align

        data = self.read(number)
        result = align(
            self.shape, data, self.start, model_points=None if self.fit_shape else self.skin, fit_shape=self.fit_shape,
            clothed=self.clothed, initializer=self.initializer, support=self.support, config=self.config,
            on_step=self._show, **self.known.of(number),
        )  # fmt: skip
        result = remembering(result, self.up)
        path, (picture, pose, ply, rig) = self.files.of(number)
        result.save(path)
        self.results.append(result)
        write_optional([pose, ply, picture], Source([result], [data], up=self.up))
        write_optional([rig], Source([result], rig=self.rig))
        if result.statuses[0].usable and not self.fit_shape:
            self.start = result.pose
        return result

    def _show(self, record: Any) -> None:
        if not self.bar.disable and self.bar.postfix != record.stage:
            self.bar.set_postfix_str(record.stage)
