"""``torchreg register``: one range scan onto another, or scans of a robot to its description."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import NanPolicy, Support, cloud_files
from torchreg.cli.cameras import Depth, DepthRange, Seen, seen_folder
from torchreg.cli.export import Old, check_old
from torchreg.cli.outputs import Force, Quiet, check_outputs, check_used, with_ending, written_to
from torchreg.cli.reporting import ExitCode, OptionalOutput, reporting
from torchreg.cli.upright import Up, known_up, remembering
from torchreg.cli.writers import Source, joint_table, save_robot, write_optional
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor
    from tqdm import tqdm

    from torchreg.geometry.camera import Camera
    from torchreg.geometry.range_scan import RangeScan
    from torchreg.registration.results import RegisterRecord, ScanRegistration, SequenceRegistration
    from torchreg.registration.robots.model import RobotModel

_DEFAULT = Path("registered.glb")


@reporting
def register(
    scans: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE TARGET",
            help="Scan to be moved (.ply, .obj, .npz, ...), in any unit, and scan to be reached, in the same unit and "
            "frame; or a folder or pattern of the two. With --urdf, any number of scans of one robot, in metres, in "
            "any order.",
        ),
    ],
    output: Annotated[
        Path,
        written_to(
            "OUT.glb",
            "The moving, skinned source; OUT.safetensors and OUT.json are written beside it. Ending in "
            ".safetensors: the result alone, as always of scans without triangles.",
        ),
    ] = _DEFAULT,
    bones: Annotated[int, typer.Option(help="Most bones.")] = 20,
    grid: Annotated[int, typer.Option(help="Cells of the grid along the longest side.")] = 50,
    depth: Depth = False,
    intrinsics: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="The camera of the depth pictures, .json; twice if they have two cameras."),
    ] = None,
    depth_range: DepthRange = None,
    smoothing: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Noise of depths at one metre, metres, by which they are smoothed; by default that of the background.",
        ),
    ] = None,
    seen: Seen = None,
    scale: Annotated[
        list[float] | None,
        typer.Option(help="Metres, or another unit, per unit of the scans; twice for source and target."),
    ] = None,
    nan_policy: NanPolicy = "raise",
    support: Support = "auto",
    time: Annotated[
        list[float] | None,
        typer.Option(help="Seconds of the animation of a .glb file at which a scan is read; twice for both."),
    ] = None,
    frame: Annotated[
        list[int] | None, typer.Option(help="Number of the keyframe of a .glb file's animation; twice for both.")
    ] = None,
    weights: Old = None,
    errors: Old = None,
    up: Up = None,
    urdf: Annotated[
        bool,
        typer.Option(
            "--urdf",
            help="Write what was scanned as a robot: OUT.urdf, a mesh of each link in OUT_meshes, the joint values of "
            "every scan in OUT_joints.csv and the registration in OUT.safetensors. The scan most like the others has "
            "joint values of zero.",
        ),
    ] = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Register two range scans of something that moves, without a template: bones, weights, the deformation.

    With --urdf scans of a robot become its description: torchreg register S0 S1 S2 ... -o robot --urdf.

    With --depth A B --intrinsics FILE the scans are depth pictures in metres, steps cut and flying pixels left out.
    The background, what did not move between them, is left out unless --support keep. What was kept of each goes to
    OUT_seen, red where it was cut, and the moved source over the picture of the target.

    OMP_NUM_THREADS=2 in the environment makes a second core help to find where the source goes.

    Exit codes: 0; 1 if the result is doubtful or too few points match, or an output beside it could not be written; 2
    for an error; 130 for Ctrl-C.
    """
    scans = cloud_files(scans) if not depth else scans
    views = {"--intrinsics": intrinsics, "--depth-range": depth_range, "--smoothing": smoothing, "--seen": seen}
    read = partial(_read, scans, (scale, time, frame), nan_policy)
    if urdf:
        others = {"--weights": weights, "--errors": errors, "--up": up, "--support": support != "auto"}
        _check_unused({"--depth": depth, **views, **others})
        _write_robot(read, scans, output, bones, grid, force, quiet)
        return
    if len(scans) != 2:
        raise InputError(f"register takes two scans, source and target, got {len(scans)}; more need --urdf")
    output = with_ending(output, (".glb", ".safetensors"), add=True)
    result = output.with_suffix(".safetensors")
    scene = output if output.suffix.lower() == ".glb" else None
    check_old({"--weights": (weights, ".ply")}, result)
    check_old({"--errors": (errors, ".ply")}, result, " --color distance")
    check_outputs([scene, result, result.with_suffix(".json"), weights, errors], force)
    check_used(depth, "--depth", views)
    if depth:
        folder = seen_folder(seen, output, force)
        images, pair = _depth_pair(scans, intrinsics, depth_range, smoothing, support, folder)
    else:
        pair = read(2)
    if scene is not None and pair[0].faces is None:
        if output.name != _DEFAULT.name:
            raise InputError(f"{scans[0]} has no triangles, which a .glb needs; name an output ending in .safetensors")
        scene = None
    found = remembering(_registered(pair, bones, grid, support, quiet), known_up(up, scans, camera=depth))
    found.save(result)
    write_optional([scene, weights], Source([found]))
    write_optional([errors], Source([found], color="distance"))
    if depth:
        with OptionalOutput(folder / "registered.png"):
            images[1].draw_over(found, folder / "registered.png")
    if not quiet:
        typer.echo(f"{_summary(found)} -> {scene or result}")
    if not found.status.usable:
        raise typer.Exit(ExitCode.UNUSABLE)


def _check_unused(options: dict[str, Any]) -> None:
    """Raise InputError if options are given that a robot has no use for."""
    for name, value in options.items():
        if value:
            raise InputError(f"{name} has no meaning with --urdf; leave it out")


def _depth_pair(
    paths: list[Path],
    intrinsics: list[Path] | None,
    depths: tuple[float, float] | None,
    smoothing: float | None,
    support: str,
    folder: Path,
) -> tuple[list[_DepthImage], Sequence[RangeScan]]:
    """Return depth images and their scans, and draw the depths that were kept."""
    from torchreg.capture.depth import load_depth_scan
    from torchreg.capture.depth_frame import DepthFrame
    from torchreg.capture.moved import moved_scans

    if intrinsics is None or len(intrinsics) > 2:
        raise InputError("--depth takes --intrinsics FILE once, or twice where source and target have two cameras")
    files = list(zip(paths, (intrinsics[0], intrinsics[-1]), strict=True))
    images = [_DepthImage.read(*pair) for pair in files]
    near, far = depths or (0.0, float("inf"))
    pair: Sequence[RangeScan]
    if support == "auto":
        first, second = (DepthFrame.load(*names, nearest=near, farthest=far) for names in files)
        pair = moved_scans(first, second, smoothing=smoothing)
    else:
        pair = [load_depth_scan(*names, smoothing=smoothing or 0.0, nearest=near, farthest=far) for names in files]
    for image, scan, name in zip(images, pair, ("source.png", "target.png"), strict=True):
        image.draw_kept(scan, folder / name)
    return images, pair


def _read(
    paths: list[Path], options: tuple[list[float] | None, list[float] | None, list[int] | None], policy: str, most: int
) -> list[RangeScan]:
    """Return scans; what is given once is said of all, twice of source and target."""
    from torchreg.io.scans import load_scan

    columns: list[list[Any]] = []
    for name, given, default in zip(("--scale", "--time", "--frame"), options, (1.0, None, None), strict=True):
        if given is not None and len(given) > most:
            often = "once for both scans, or twice" if most > 1 else "once for all scans with --urdf"
            raise InputError(f"{name} is given {often}, got {len(given)}")
        columns.append(given if given and len(given) == 2 else (given or [default]) * len(paths))
    return [
        load_scan(path, scale=scale, nan_policy=policy, time=time, frame=frame)
        for path, scale, time, frame in zip(paths, *columns, strict=True)
    ]


def _registered(pair: Sequence[RangeScan], bones: int, grid: int, support: str, quiet: bool) -> ScanRegistration:
    from tqdm import tqdm

    from torchreg.registration.register import register as run

    with tqdm(desc="initialize", unit="step", leave=False, disable=quiet) as bar:
        return run(pair[0], pair[1], bones, grid, on_step=partial(_show, bar), support=support)


def _write_robot(
    read: Callable[[int], list[RangeScan]], paths: list[Path], output: Path, bones: int, grid: int, force: bool,
    quiet: bool,
) -> None:  # fmt: skip
    """Register scans of a robot and write its description and its joint values in all of them."""
    from tqdm import tqdm

    from torchreg.registration.register_sequence import register_sequence

    urdf = with_ending(output, (".urdf",), add=True)
    result, table = urdf.with_suffix(".safetensors"), joint_table(urdf)
    check_outputs([urdf, result, result.with_suffix(".json"), table], force)
    scans = read(1)
    with tqdm(desc="initialize", unit="step", leave=False, disable=quiet) as bar:
        found = register_sequence(scans, bones, grid, on_step=partial(_show, bar), reference="auto")
    found.save(result)
    with OptionalOutput(urdf):
        robot = save_robot(urdf, Source([found], names=[path.name for path in paths]))
        if not quiet:
            typer.echo(f"{_robot_summary(found, robot)} -> {urdf}, {table}")
            for name in robot.loose:
                typer.echo(
                    f"torchreg: {name} does not explain how its two links move: a part between may be missing", err=True
                )
            for name in robot.undetermined:
                typer.echo(
                    f"torchreg: the axis of {name} is not determined: it hardly moved, or its link was not found",
                    err=True,
                )
    if not found.status.usable:
        raise typer.Exit(ExitCode.UNUSABLE)


def _show(bar: tqdm, record: RegisterRecord) -> None:
    """Show a step on a progress bar."""
    bar.set_description_str(record.stage)  # tqdm adds the colon where there is no total
    bar.update()


@dataclass(frozen=True, eq=False)
class _DepthImage:
    """A depth image (H, W) from a file, metres, and its camera."""

    camera: Camera
    depth: Tensor

    @classmethod
    def read(cls, path: Path, intrinsics: Path) -> _DepthImage:
        from torchreg.io.calibration import load_depth_camera
        from torchreg.io.images import load_depth

        camera, scale = load_depth_camera(intrinsics)
        return cls(camera, load_depth(path, scale, camera=camera))

    def draw_kept(self, scan: RangeScan, picture: Path) -> None:
        """Draw the depths that a scan has kept."""
        import torch

        from torchreg.io.images import save_image
        from torchreg.viz.seen import cut_picture

        column, row = self.camera.project(scan.points.double())[0].round().long().unbind(-1)
        kept = torch.zeros(self.depth.shape, dtype=torch.bool)
        kept[row.clamp(0, self.camera.height - 1), column.clamp(0, self.camera.width - 1)] = True
        with OptionalOutput(picture):
            save_image(picture, cut_picture(self.depth, kept))

    def draw_over(self, found: ScanRegistration, picture: Path) -> None:
        """Draw the moved source over this image, the target."""
        from torchreg.io.images import save_image
        from torchreg.viz.seen import cut_picture, picture_with_points

        pixels = self.camera.project(found.deformed.detach().double())[0]
        drawn = picture_with_points(cut_picture(self.depth, self.depth > 0), pixels, found.matched, radius=0)
        save_image(picture, drawn)


def _summary(found: ScanRegistration) -> str:
    seconds = ", ".join(
        f"{name} {value:.1f} s"
        for name, value in zip(("setup", "initialization", "align", "refine"), found.seconds.tolist(), strict=True)
    )
    share = float(found.matched.float().mean())
    sure = "" if found.confidence is None else f", confidence {found.confidence:.0%}"
    return f"{found.status}{sure}: {found.model.num_bones} bones, {share:.0%} of the points match; {seconds}"


def _robot_summary(found: SequenceRegistration, robot: RobotModel) -> str:
    kinds = [joint.kind for joint in robot.tree.joints[1:]]
    size = float((found.points.amax(0) - found.points.amin(0)).norm())
    sure = "" if found.confidence is None else f", confidence {float(found.confidence.min()):.0%} in the worst scan"
    return (
        f"{found.status}{sure}: {len(robot.tree)} links, {kinds.count('revolute')} hinges and "
        f"{kinds.count('prismatic')} sliders; the joints leave the scans a median of "
        f"{100 * float(robot.residuals.max()) / size:.2g} % of the size apart in the worst scan"
    )
