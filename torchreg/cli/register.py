"""``torchreg register``: one range scan onto another, or scans of a robot to its description."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from torchreg.cli.align_options import NanPolicy, cloud_files
from torchreg.cli.cameras import Depth, DepthRange, Seen, check_used, seen_folder
from torchreg.cli.outputs import Force, Quiet, check_outputs, tell_origin, with_ending
from torchreg.cli.reporting import ExitCode, OptionalOutput, reporting
from torchreg.cli.robot import RobotFiles, check_alone, write_scanned_robot
from torchreg.cli.support_option import Support
from torchreg.cli.upright import Up, known_up, remembering
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor
    from tqdm import tqdm

    from torchreg.geometry.camera import Camera
    from torchreg.geometry.range_scan import RangeScan
    from torchreg.registration.results import RegisterRecord, ScanRegistration

_DEFAULT = Path("registered.glb")
# Pictures of the depth of source and target that was kept.
_KEPT = ("source.png", "target.png")


@reporting
def register(
    scans: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE TARGET",
            help="Scan to be moved (.ply, .obj, .npz, ...), in any unit, and scan to be reached, in the same unit and "
            "frame; or a folder or pattern of the two. With --urdf, any number of scans of one robot, in metres.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT.glb",
            help="The moving, skinned source; OUT.safetensors and OUT.json are written beside it. Ending in "
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
        float | None, typer.Option(min=0, help="Noise of depths at one metre, metres; depths are smoothed by it.")
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
    weights: Annotated[Path | None, typer.Option(help="Also write the moved source, colored by bones (.ply).")] = None,
    errors: Annotated[
        Path | None, typer.Option(help="Also write the moved source, colored by its distance from the target (.ply).")
    ] = None,
    up: Up = None,
    urdf: Annotated[
        bool,
        typer.Option(
            "--urdf",
            help="Write what was scanned as a robot: OUT.urdf, a mesh of each link in OUT_meshes, the joint values of "
            "every scan in OUT_joints.csv and the registration in OUT.safetensors.",
        ),
    ] = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Register two range scans of something that moves, without a template: bones, weights, the deformation.

    With --urdf scans of a robot become its description: torchreg register S0 S1 S2 ... -o robot --urdf.

    With --depth A B --intrinsics FILE the scans are depth pictures in metres, steps cut and flying pixels left out.
    What was kept of each goes to OUT_seen, red where it was cut, and the moved source over the picture of the target.

    OMP_NUM_THREADS=2 in the environment makes a second core help to find where the source goes.

    Exit codes: 0; 1 if the result is doubtful or too few points match, or an output beside it could not be written; 2
    for an error; 130 for Ctrl-C.
    """
    scans = cloud_files(scans) if not depth else scans
    if urdf:
        check_alone({"--depth": depth, "--intrinsics": intrinsics, "--depth-range": depth_range, "--seen": seen,
                     "--smoothing": smoothing, "--weights": weights, "--errors": errors, "--up": up,
                     "--support": support != "auto"})  # fmt: skip
        units = _common(scale, "--scale"), _common(time, "--time"), _common(frame, "--frame")
        _write_robot(scans, output, bones, grid, units, nan_policy, force=force, quiet=quiet)
        return
    source, target = _two(scans)
    output = with_ending(output, (".glb", ".safetensors"), add=True)
    result = output.with_suffix(".safetensors")
    scene = output if output.suffix.lower() == ".glb" else None
    weights, errors = with_ending(weights, (".ply",)), with_ending(errors, (".ply",))
    check_outputs([scene, result, result.with_suffix(".json"), weights, errors], force)
    from tqdm import tqdm

    from torchreg.io.scans import load_scan
    from torchreg.registration.register import register as run

    views = {"--intrinsics": intrinsics, "--depth-range": depth_range, "--smoothing": smoothing, "--seen": seen}
    check_used(depth, "--depth", views)
    if depth:
        folder = seen_folder(seen, output, force)
        images = [_DepthImage.read(*pair) for pair in zip((source, target), _cameras(intrinsics), strict=True)]
        kept = [folder / name for name in _KEPT]
        first, second = (
            image.scan(depth_range, smoothing or 0.0, path) for image, path in zip(images, kept, strict=True)
        )
    else:
        pairs = _pair(scale, 1.0, "--scale"), _pair(time, None, "--time"), _pair(frame, None, "--frame")
        first, second = (
            load_scan(path, scale=unit, nan_policy=nan_policy, time=seconds, frame=number)
            for path, unit, seconds, number in zip((source, target), *pairs, strict=True)
        )
    if scene is not None and first.faces is None:
        if output.name != _DEFAULT.name:
            raise InputError(f"{source} has no triangles, which a .glb needs; name an output that ends in .safetensors")
        scene = None
    with tqdm(desc="initialize", unit="step", leave=False, disable=quiet) as bar:
        found = run(first, second, bones, grid, on_step=partial(_show, bar), support=support)
    found = remembering(found, known_up(up, scans, camera=depth))
    found.save(result)
    _write(found, scene, weights, errors)
    if depth:
        with OptionalOutput(folder / "registered.png"):
            images[1].draw_over(found, folder / "registered.png")
    if not quiet:
        typer.echo(f"{_summary(found)} -> {scene or result}")
    if not found.status.usable:
        raise typer.Exit(ExitCode.UNUSABLE)


def _two(scans: list[Path]) -> tuple[Path, Path]:
    if len(scans) != 2:
        raise InputError(f"register takes two scans, source and target, got {len(scans)}; more need --urdf")
    return scans[0], scans[1]


def _write_robot(
    paths: list[Path], output: Path, bones: int, grid: int, units: tuple[Any, Any, Any], nan_policy: NanPolicy,
    *, force: bool, quiet: bool,
) -> None:  # fmt: skip
    """Read scans of a robot and write its description."""
    from tqdm import tqdm

    from torchreg.io.scans import load_scan

    files = RobotFiles.named(output, force)
    scale, time, frame = units
    scans = [
        load_scan(path, scale=1.0 if scale is None else scale, nan_policy=nan_policy, time=time, frame=frame)
        for path in paths
    ]
    with tqdm(desc="initialize", unit="step", leave=False, disable=quiet) as bar:
        usable = write_scanned_robot(scans, paths, bones, grid, files, partial(_show, bar), not quiet)
    if not usable:
        raise typer.Exit(ExitCode.UNUSABLE)


def _show(bar: tqdm, record: RegisterRecord) -> None:
    """Show a step on a progress bar."""
    bar.set_description_str(record.stage)  # tqdm adds the colon where there is no total
    bar.update()


@dataclass(frozen=True, eq=False)
class _DepthImage:
    """A depth image (H, W) from a file, metres, and its camera."""

    path: Path
    intrinsics: Path
    camera: Camera
    depth: Tensor

    @classmethod
    def read(cls, path: Path, intrinsics: Path) -> _DepthImage:
        from torchreg.io.calibration import load_depth_camera
        from torchreg.io.images import load_depth

        camera, scale = load_depth_camera(intrinsics)
        return cls(path, intrinsics, camera, load_depth(path, scale, camera=camera))

    def scan(self, depths: tuple[float, float] | None, smoothing: float, picture: Path) -> RangeScan:
        """Return the scan, and draw the depths that were kept."""
        import torch

        from torchreg.capture.depth import load_depth_scan
        from torchreg.io.images import save_image
        from torchreg.viz.seen import cut_picture

        near, far = depths or (0.0, float("inf"))
        found = load_depth_scan(self.path, self.intrinsics, smoothing=smoothing, nearest=near, farthest=far)
        column, row = self.camera.project(found.points.double())[0].round().long().unbind(-1)
        kept = torch.zeros(self.depth.shape, dtype=torch.bool)
        kept[row.clamp(0, self.camera.height - 1), column.clamp(0, self.camera.width - 1)] = True
        with OptionalOutput(picture):
            save_image(picture, cut_picture(self.depth, kept))
        return found

    def draw_over(self, found: ScanRegistration, picture: Path) -> None:
        """Draw the moved source over this image, the target."""
        from torchreg.io.images import save_image
        from torchreg.viz.seen import cut_picture, picture_with_points

        pixels = self.camera.project(found.deformed.detach().double())[0]
        drawn = picture_with_points(cut_picture(self.depth, self.depth > 0), pixels, found.matched, radius=0)
        save_image(picture, drawn)


def _cameras(intrinsics: list[Path] | None) -> tuple[Path, Path]:
    if intrinsics is None or len(intrinsics) > 2:
        raise InputError("--depth takes --intrinsics FILE once, or twice where source and target have two cameras")
    return intrinsics[0], intrinsics[-1]


Given = TypeVar("Given")


def _common(given: list[Given] | None, option: str) -> Given | None:
    """Return what an option says about all scans."""
    if given is not None and len(given) > 1:
        raise InputError(f"{option} is given once for all scans with --urdf, got {len(given)}")
    return given[0] if given else None


def _pair(given: list[Given] | None, default: Any, option: str) -> tuple[Any, Any]:
    """Return what an option that may be given once or twice says about source and target."""
    if given is not None and len(given) > 2:
        raise InputError(f"{option} is given once for both scans, or twice, got {len(given)}")
    return (given[0], given[-1]) if given else (default, default)


def _write(found: ScanRegistration, scene: Path | None, weights: Path | None, errors: Path | None) -> None:
    if scene is not None and found.faces is not None:
        from torchreg.geometry.upright import guess_up
        from torchreg.viz.scan_gltf import save_grid_animation

        near = found.local()
        with OptionalOutput(scene):
            save_grid_animation(scene, near.model, near.points, found.faces, up=found.up or guess_up([found.points]))
            tell_origin(scene, found.origin)
    if weights is not None or errors is not None:
        from torchreg.viz.bone_colors import save_error_ply, save_weight_ply

        if weights is not None:
            with OptionalOutput(weights):
                save_weight_ply(weights, found.model, found.points, found.faces, moved=True)
        if errors is not None:
            with OptionalOutput(errors):
                save_error_ply(errors, found.deformed, found.distances, found.faces)


def _summary(found: ScanRegistration) -> str:
    seconds = ", ".join(
        f"{name} {value:.1f} s"
        for name, value in zip(("setup", "initialization", "align", "refine"), found.seconds.tolist(), strict=True)
    )
    share = float(found.matched.float().mean())
    sure = "" if found.confidence is None else f", confidence {found.confidence:.0%}"
    return f"{found.status}{sure}: {found.model.num_bones} bones, {share:.0%} of the points match; {seconds}"
