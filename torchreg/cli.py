"""The command line: aligning files, the demonstration, pictures, and what a shape consists of."""

from __future__ import annotations

import functools
import json
import math
import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from torchreg import __version__
from torchreg.errors import FormatError, InputError, TorchregError, TorchregWarning

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.correspondence.sigma import SigmaSchedule
    from torchreg.models.articulated import ArticulatedShape
    from torchreg.models.skin import LinearBlendSkin
    from torchreg.pipelines.align import AlignConfig
    from torchreg.results import AlignResult

# Exit codes beside 0; 2 is also what wrong usage ends with.
_UNUSABLE, _ERROR, _INTERRUPTED = 1, 2, 130
_HANDS = {"hand": "right", "hand-left": "left"}
_PICTURE_ENDINGS = (".png", ".pdf", ".svg")

app = typer.Typer(
    name="torchreg",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
    no_args_is_help=True,
)

_SHAPE_HELP = "hand, hand-left, a robot (.urdf) or a rigged character (.glb, .gltf)."
_Shape = Annotated[str, typer.Argument(metavar="SHAPE", help=_SHAPE_HELP)]
_Parents = Annotated[
    Path | None,
    typer.Option(help="JSON file {joint: parent or null}, for glTF files whose hierarchy of nodes is flat."),
]
_PackageDir = Annotated[
    list[Path] | None, typer.Option(help="Folder in which a URDF's package:// names are looked up.")
]
_FreeBase = Annotated[
    bool | None, typer.Option("--free-base/--fixed-base", help="Whether the base of a URDF moves; by default it does.")
]
_Force = Annotated[bool, typer.Option("--force", help="Overwrite outputs that exist.")]
_Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]


def main() -> None:
    """Run the command line."""
    # Before torch is loaded. The problems are small: threads that wait for a busy core slow them down twentyfold.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    app(prog_name="torchreg")


def _reporting(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with errors and warnings of the library told in one line, and Ctrl-C as exit code 130."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("always", TorchregWarning)
            warnings.showwarning = _show_warning
            try:
                command(*arguments, **options)
            except KeyboardInterrupt:
                typer.echo("torchreg: interrupted", err=True)
                raise typer.Exit(_INTERRUPTED) from None
            except BrokenPipeError:
                raise
            except (TorchregError, OSError) as error:
                typer.echo(f"torchreg: {_one_line(error)}", err=True)
                raise typer.Exit(_ERROR) from None

    return run


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: TextIO | None = None,
    line: str | None = None,
) -> None:  # fmt: skip
    place = "" if issubclass(category, TorchregWarning) else f"{filename}:{lineno}: "
    typer.echo(f"torchreg: warning: {place}{' '.join(str(message).split())}", err=True)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"torchreg {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Register articulated, bending shapes to 3-D point data.

    Commands compute on one thread unless the environment variable OMP_NUM_THREADS asks for more, which pays for clouds
    of many thousands of points on idle cores.
    """


@dataclass(frozen=True)
class _Files:
    """Where the outputs of one cloud go."""

    result: Path
    pose: Path | None
    ply: Path | None
    picture: Path | None

    def all(self) -> Iterable[Path | None]:
        yield from (self.result, self.result.with_suffix(".json"), self.pose, self.ply, self.picture)


@app.command("align", short_help="Align a shape to point clouds.")
@_reporting
def align_command(
    shape: _Shape,
    clouds: Annotated[
        list[Path],
        typer.Argument(
            metavar="CLOUD",
            help="Point clouds (.ply, .pcd, .xyz, .txt, .obj, .stl, .glb, .npz), metres; several are taken for the "
            "frames of a motion, and each starts from the pose before.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="RESULT", help="RESULT.safetensors and RESULT.json are written.")
    ] = Path("result"),
    start: Annotated[
        Path | None,
        typer.Option(
            help="Pose to start from: a result, or .json with numbers or {degree of freedom: number}, or .npz. By "
            "default the rest pose is moved to the mean of the cloud and not turned: poses are not searched for yet."
        ),
    ] = None,
    sigma: Annotated[
        str | None, typer.Option(metavar="START:STOP:STEPS", help="Widths of the EM, metres, as in 0.02:0.005:5.")
    ] = None,
    outlier: Annotated[str, typer.Option(help="Outlier class: limit, or volume for eq. 18 of the paper.")] = "limit",
    search: Annotated[
        str, typer.Option(help="Look for better poses around the start: auto, always or never.")
    ] = "auto",
    nan_policy: Annotated[str, typer.Option(help="Non-finite points: raise, or omit.")] = "raise",
    scale: Annotated[float, typer.Option(help="Unit of the clouds in metres; 0.001 for millimeters.")] = 1.0,
    parents: _Parents = None,
    package_dir: _PackageDir = None,
    free_base: _FreeBase = None,
    pose: Annotated[Path | None, typer.Option(help="Also write the pose by name of degree of freedom (.json).")] = None,
    ply: Annotated[Path | None, typer.Option(help="Also write the registered model points (.ply).")] = None,
    picture: Annotated[Path | None, typer.Option(help="Also draw shape and data (.png, .pdf, .svg).")] = None,
    gltf: Annotated[
        Path | None, typer.Option(help="Also write the moving shape, all clouds in one file (.glb).")
    ] = None,
    force: _Force = False,
    quiet: _Quiet = False,
) -> None:
    """Align a shape to point clouds.

    With several clouds, the names of the outputs are numbered: RESULT_1, RESULT_2, ... Ctrl-C leaves those of the
    finished clouds on disk.

    Exit codes: 0; 1 if an alignment found too few inliers to mean anything; 2 for an error; 130 for Ctrl-C.
    """
    names = (_ending(output, (".safetensors",), add=True), _ending(pose, (".json",)), _ending(ply, (".ply",)))
    pictures = _ending(picture, _PICTURE_ENDINGS)
    files = [_Files(*(_numbered(name, k, len(clouds)) for name in (*names, pictures))) for k in range(len(clouds))]
    _check_outputs([*(path for entry in files for path in entry.all()), _ending(gltf, (".glb",))], force)
    for place in clouds:
        place.stat()  # a missing file is told before the first is aligned

    from tqdm import tqdm

    with tqdm(total=len(clouds), unit="cloud", desc="reading", leave=False, disable=quiet) as bar:
        model = _load_shape(shape, parents, package_dir, free_base)
        from torchreg._checks import check_positive
        from torchreg.models.skin import sample_skin
        from torchreg.pipelines.align import AlignConfig
        from torchreg.pipelines.storage import load_pose

        check_positive(scale, "--scale")
        config = AlignConfig(schedule=_schedule(sigma), outlier=outlier, search=search, nan_policy=nan_policy)
        first = None if start is None else load_pose(start, model)
        skin = sample_skin(model, config.num_model_points, sharpness=config.sharpness)
        run = _AlignRun(model, config, skin, scale, first)
        interrupted = False
        try:
            for place, entry in zip(clouds, files, strict=True):
                bar.set_description(place.name)
                result = run.align(place, entry, on_step=lambda record: _show_stage(bar, record.stage))
                bar.update()
                if not quiet:
                    bar.write(f"{place}: {_summary(result)} -> {entry.result}")
        except KeyboardInterrupt:
            interrupted = True
        if gltf is not None and run.results:
            run.save_motion(gltf)
    if interrupted:
        typer.echo(f"torchreg: interrupted; {len(run.results)} of {len(clouds)} clouds are done", err=True)
        raise typer.Exit(_INTERRUPTED)
    if not all(result.statuses[0].usable for result in run.results):
        raise typer.Exit(_UNUSABLE)


def _show_stage(bar: Any, stage: str) -> None:
    if not bar.disable and bar.postfix != stage:
        bar.set_postfix_str(stage)


@dataclass
class _AlignRun:
    """Aligns clouds one after another and writes what was asked for."""

    shape: ArticulatedShape
    config: AlignConfig
    skin: LinearBlendSkin
    scale: float
    start: Tensor | None
    results: list[AlignResult] = field(default_factory=list)

    @functools.cached_property
    def surface(self) -> LinearBlendSkin:
        """The surface that pictures show, meshed once."""
        from torchreg.datasets.hand import surface_skin

        return surface_skin(self.shape)

    def align(self, place: Path, files: _Files, on_step: Callable[[Any], None]) -> AlignResult:
        """Return the alignment to one cloud, which is on disk then."""
        from torchreg.io.points import load_points
        from torchreg.pipelines.align import align
        from torchreg.pipelines.demo import moved_to_mean

        data = load_points(place, nan_policy=self.config.nan_policy).points * self.scale
        start = moved_to_mean(self.skin, self.shape.rest_pose(), data) if self.start is None else self.start
        result = align(self.shape, data, start, model_points=self.skin, config=self.config, on_step=on_step)
        self._write(result, data, files)
        self.results.append(result)
        if result.statuses[0].usable:
            self.start = result.pose
        return result

    def _write(self, result: AlignResult, data: Tensor, files: _Files) -> None:
        if files.pose is not None:
            from torchreg.io.atomic import write_atomic

            named = dict(zip(self.shape.dof_names, result.pose.tolist(), strict=True))
            write_atomic(files.pose, (json.dumps(named, indent=2) + "\n").encode())
        if files.ply is not None:
            from torchreg.io.points import save_points

            save_points(files.ply, result.registered)
        if files.picture is not None:
            from torchreg.viz.figures import draw_alignment, save_picture

            ax = draw_alignment(None, self.shape, result.pose, data, result.inliers, skin=self.surface)
            save_picture(ax.get_figure(), files.picture)  # type: ignore[arg-type]
        # The result comes last: where it is, the others are.
        result.save(files.result)

    def save_motion(self, path: Path) -> None:
        """Write all poses found as an animation."""
        import torch

        from torchreg.viz.gltf import save_shape_animation

        poses = torch.stack([result.pose for result in self.results])
        save_shape_animation(path, self.shape, poses, skin=self.surface)


@app.command(short_help="Run the main job on built-in data.")
@_reporting
def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where to write; made if it does not exist.")
    ] = Path("torchreg_demo"),
    frames: Annotated[int, typer.Option(min=1, help="Number of frames, 20 per second.")] = 40,
    seed: Annotated[int, typer.Option(help="Of motion and measurements.")] = 0,
    picture: Annotated[bool, typer.Option("--picture/--no-picture", help="Whether to draw the animation.")] = True,
    force: _Force = False,
) -> None:
    """Run the main job on built-in data: follow a bending hand through noisy one-sided clouds with outliers.

    Writes poses.safetensors (read it with torchreg.load), hand.glb and alignment.gif. Ctrl-C ends the sequence early;
    what was done is written.
    """
    poses, scene, movie = output / "poses.safetensors", output / "hand.glb", output / "alignment.gif"
    wanted = [poses, poses.with_suffix(".json"), scene, *([movie] if picture else [])]
    _check_outputs([path for path in wanted if output.exists()], force)
    output.mkdir(parents=True, exist_ok=True)

    from tqdm import tqdm

    from torchreg.models.hand import Hand
    from torchreg.pipelines.demo import DEMO_FPS, run_demo
    from torchreg.viz.gltf import save_shape_animation

    with tqdm(total=frames, unit="frame", desc="aligning", leave=False) as bar:
        result = run_demo(frames, seed, on_frame=lambda done, planned: bar.update())
    count, hand = len(result.poses), Hand()
    result.save(poses)
    typer.echo(f"{count} frames of {result.clouds.shape[1]} points: {count / float(result.seconds.sum()):.1f} frames/s")
    _print_tip_errors("all", result.tip_errors.flatten())
    _print_tip_errors("seen by the camera", result.tip_errors[result.tips_seen])
    save_shape_animation(scene, hand, result.poses, fps=DEMO_FPS)
    if picture:
        from torchreg.viz.animation import animate_alignment

        with tqdm(total=count, unit="frame", desc="drawing", leave=False) as bar:
            animate_alignment(
                movie, hand, result.poses, list(result.clouds), inliers=list(result.inliers), fps=DEMO_FPS,
                on_frame=lambda done, planned: bar.update(),
            )  # fmt: skip
    typer.echo(f"wrote {', '.join(str(path) for path in wanted)}")
    if count < frames:
        typer.echo(f"torchreg: interrupted; {count} of {frames} frames are done", err=True)
        raise typer.Exit(_INTERRUPTED)


def _print_tip_errors(which: str, errors: Tensor) -> None:
    if len(errors):
        values = f"mean {1e3 * float(errors.mean()):.1f} mm, max {1e3 * float(errors.max()):.1f} mm"
        typer.echo(f"fingertip error, {which}: {values} ({len(errors)} fingertips)")


@app.command(short_help="Draw the bending skin, or the picture of the README.")
@_reporting
def figure(
    name: Annotated[str, typer.Argument(metavar="bending|readme", help="Which picture to draw.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Where to (.png, .pdf, .svg); by default NAME.png.")
    ] = None,
    force: _Force = False,
) -> None:
    """Draw a picture: bending (the paper's figure 2, the skin at a = 2 and a = 10) or readme (start and alignment)."""
    from torchreg._checks import check_choice

    check_choice(name, "NAME", ("bending", "readme"))
    path = _ending(output or Path(f"{name}.png"), _PICTURE_ENDINGS)
    _check_outputs([path], force)
    from torchreg.viz.figures import bending_figure, readme_picture

    typer.echo(f"wrote {bending_figure(path) if name == 'bending' else readme_picture(path)}")


@app.command(short_help="Show the degrees of freedom and the parts of a shape.")
@_reporting
def info(shape: _Shape, parents: _Parents = None, package_dir: _PackageDir = None, free_base: _FreeBase = None) -> None:
    """Show the degrees of freedom of a shape with their limits, and its parts."""
    model = _load_shape(shape, parents, package_dir, free_base)
    rest = model.surface.vertices if model.surface is not None else model.surface_mesh().vertices
    size = float((rest.amax(0) - rest.amin(0)).norm())
    surface = "the file's mesh" if model.surface is not None else "fused solids"
    typer.echo(f"{shape}: {model.num_parts} parts, {model.num_dofs} degrees of freedom, {surface}, {size:.3f} m across")
    sliding = {joint.name for joint in model.chain.tree.joints if joint.kind == "prismatic"}
    width = max(len(name) for name in (*model.dof_names, *model.part_names))
    typer.echo("\ndegrees of freedom")
    limits = zip(model.dof_names, model.lower.tolist(), model.upper.tolist(), strict=True)
    for index, (name, lower, upper) in enumerate(limits):
        unit, factor = ("m", 1.0) if index < 3 or name in sliding else ("deg", 180 / math.pi)
        bounds = "fixed" if lower == upper else f"{factor * lower:g} to {factor * upper:g} {unit}"
        typer.echo(f"  {name:{width}}  {'free' if math.isinf(lower) and math.isinf(upper) else bounds}")
    typer.echo("\nparts")
    for name, kind, parent in zip(model.part_names, model.primitives.part_kinds, model.part_parents, strict=True):
        typer.echo(f"  {name:{width}}  {kind}{f' on {model.part_names[parent]}' if parent >= 0 else ''}")


def _load_shape(
    name: str, parents: Path | None, package_dirs: Sequence[Path] | None, free_base: bool | None
) -> ArticulatedShape:
    """Return the shape of a name or file; options that its kind has no use for are refused."""
    ending = Path(name).suffix.lower()
    uses = {".urdf": {"--package-dir", "--free-base/--fixed-base"}, ".glb": {"--parents"}, ".gltf": {"--parents"}}
    given = {"--parents": parents, "--package-dir": package_dirs or None, "--free-base/--fixed-base": free_base}
    if name not in _HANDS and ending not in uses:
        raise InputError(f"SHAPE must be hand, hand-left or a file ending in .urdf, .glb or .gltf; got {name!r}")
    for option, value in given.items():
        if value is not None and option not in uses.get(ending, set()):
            raise InputError(f"{option} has no meaning for {name}; leave it out")
    if name in _HANDS:
        from torchreg.models.hand import Hand

        return Hand(_HANDS[name])
    from torchreg.models.articulated import ArticulatedShape

    if ending == ".urdf":
        return ArticulatedShape.from_urdf(name, package_dirs=package_dirs or (), free_base=free_base is not False)
    return ArticulatedShape.from_gltf(name, parents=None if parents is None else _read_parents(parents))


def _read_parents(path: Path) -> dict[str, str | None]:
    from torchreg.io.limits import read_bytes

    try:
        table = json.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: cannot be read as JSON ({error})") from error
    if not isinstance(table, dict) or not all(isinstance(parent, str | None) for parent in table.values()):
        raise FormatError(f"{path}: must hold {{joint: parent or null}}, all of them names")
    return table


def _schedule(text: str | None) -> SigmaSchedule | None:
    if text is None:
        return None
    from torchreg.correspondence.sigma import SigmaSchedule

    try:
        start, stop, steps = text.split(":")
        values = float(start), float(stop), int(steps)
    except ValueError:
        raise InputError(f"--sigma must be START:STOP:STEPS as in 0.02:0.005:5, got {text!r}") from None
    return SigmaSchedule.geometric(*values)


def _summary(result: AlignResult) -> str:
    near = result.distances[result.inliers]
    rms = f"rms {1e3 * float(near.square().mean().sqrt()):.2f} mm, " if len(near) else ""
    counts = f"{len(near)} of {len(result.distances)} points inliers"
    return f"{result.statuses[0].value}, {counts}, {rms}cost {float(result.cost):.4g}"


def _ending(path: Path | None, endings: Sequence[str], *, add: bool = False) -> Any:
    """Return the path, its ending added where asked for; InputError if the ending is none of those allowed."""
    if path is None or path.suffix.lower() in endings:
        return path
    if add:
        return path.with_name(path.name + endings[0])
    raise InputError(f"{path} must end in {', '.join(endings)}; rename the output")


def _numbered(path: Path | None, index: int, count: int) -> Any:
    if path is None or count == 1:
        return path
    return path.with_name(f"{path.stem}_{index + 1:0{len(str(count))}}{path.suffix}")


def _check_outputs(paths: Iterable[Path | None], force: bool) -> None:
    """Raise before any work is done if an output cannot be written, or exists and may not be overwritten."""
    wanted = [path for path in paths if path is not None]
    for path in wanted:
        if wanted.count(path) > 1:
            raise InputError(f"two outputs would be called {path}; rename one")
        if not path.parent.is_dir():
            raise FileNotFoundError(f"the folder {path.parent} does not exist; create it first")
        if path.exists() and not force:
            raise InputError(f"{path} exists; pass --force to overwrite it, or name another output with -o")
