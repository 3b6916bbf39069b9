"""Options of commands that read pictures, and the folder of the pictures that they write."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import cloud_files
from torchreg.cli.outputs import check_used
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torchreg.capture.depth_frames import DepthFrames
    from torchreg.capture.stereo_frames import StereoFrames
    from torchreg.geometry.camera_rig import CameraRig
    from torchreg.shapes.articulated import ArticulatedShape

Calibration = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="The cameras: .json, OpenCV's .yml, a folder of COLMAP's text files or of ROS's left.yaml and right.yaml.",
    ),
]
DepthRange = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="NEAR FAR", help="Depths of interest, metres; what lies beyond is background."),
]
Depth = Annotated[
    bool,
    typer.Option(
        "--depth", help="The files are depth pictures (16-bit .png or .tif, .exr, .npy), folders or patterns of them."
    ),
]
Intrinsics = Annotated[Path | None, typer.Option(metavar="FILE", help="The camera of the depth pictures, .json.")]
Mask = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Picture whose bright pixels may show the shape; or a folder, one per picture."),
]
Seen = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="Where pictures of what was seen go; by default RESULT_seen.")
]


def seen_folder(seen: Path | None, result: Path, force: bool) -> Path:
    """Return the folder for pictures, made if need be; InputError if it holds some that may not be overwritten."""
    folder = seen or result.with_name(f"{result.stem}_seen")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} must be a folder, it is a file; name another with --seen")
    if folder.is_dir() and not force and any(folder.glob("*.png")):
        raise InputError(f"{folder} holds pictures; pass --force to overwrite them, or name another folder with --seen")
    folder.mkdir(exist_ok=True)
    return folder


def load_calibration(calibration: Path | None, flag: str, scale: float = 1.0) -> CameraRig:
    """Return the cameras of a calibration in some unit in metres, which a flag requires."""
    from torchreg.io.calibration import load_cameras

    if calibration is None:
        raise InputError(f"{flag} takes --calibration FILE with the cameras")
    return load_cameras(calibration, scale=scale)


@dataclass(frozen=True)
class DepthOptions:
    """What depth pictures are read with."""

    depth: Depth = False
    intrinsics: Intrinsics = None
    mask: Mask = None
    depth_range: DepthRange = None

    def check(self, *, stereo: bool | None = None) -> None:
        """Raise InputError if options are given that have no meaning."""
        check_used(self.depth, "--depth", {"--intrinsics": self.intrinsics, "--mask": self.mask})
        flag = "--depth" if stereo is None else "--stereo or --depth"
        check_used(self.depth or bool(stereo), flag, {"--depth-range": self.depth_range})

    def source(self, paths: list[Path]) -> DepthFrames:
        """Return the frames of depth pictures."""
        from torchreg.capture.depth_frames import DepthFrames

        if self.intrinsics is None:
            raise InputError("--depth takes --intrinsics FILE with the camera")
        nearest, farthest = self.depth_range or (0.0, float("inf"))
        return DepthFrames(paths, self.intrinsics, self.mask, nearest=nearest, farthest=farthest)

    def job(self, frames: Any) -> dict[str, Any]:
        """Return all settings that determine the frames of depth pictures, as plain data."""
        if not self.depth:
            return {}
        return {"--depth": True, "--depth-range": [str(limit) for limit in frames.depths], "--mask": list(frames.masks)}

    def frames(self, paths: list[Path], scale: float, nan_policy: str) -> Any:
        """Return the frames of depth pictures, or of clouds."""
        from torchreg.io.frames import load_frames

        if self.depth:
            return self.source(paths)
        return load_frames(cloud_files(paths), scale=scale, nan_policy=nan_policy)


@dataclass(frozen=True)
class StereoOptions:
    """What stereo pictures are read with."""

    stereo: Annotated[
        bool, typer.Option("--stereo", help="FRAMES are the pictures of a calibrated pair of cameras.")
    ] = False
    calibration: Calibration = None
    volume: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X Y Z X Y Z", help="Lower and upper corner of the volume of interest, metres."),
    ] = None
    matcher: Annotated[
        str | None,
        typer.Option(
            help="How pictures are matched: semi-global, block, or opencv, the default where it is installed."
        ),
    ] = None
    reach: Annotated[
        float | None,
        typer.Option(
            help="Crop what crosses the border of the picture, as a forearm, at this distance from its far end, "
            "metres; 0 keeps it. By default the length of a hand; other shapes keep all."
        ),
    ] = None

    def check(self, seen: Path | None, views: DepthOptions) -> None:
        """Raise InputError if options are given that have no meaning, of stereo or of depth pictures."""
        given = {"--calibration": self.calibration, "--volume": self.volume, "--matcher": self.matcher}
        check_used(self.stereo, "--stereo", given | {"--reach": self.reach, "--seen": seen})
        views.check(stereo=self.stereo)

    def source(
        self, folders: list[Path], shape: ArticulatedShape, depths: tuple[float, float] | None, scale: float
    ) -> StereoFrames:
        """Return the clouds of stereo pictures, after a check of the first pair for swapped cameras."""
        from importlib.util import find_spec

        import torch

        from torchreg.capture.stereo import StereoConfig
        from torchreg.capture.stereo_frames import StereoFrames
        from torchreg.shapes.hand import Hand

        if len(folders) != 2:
            raise InputError(
                f"--stereo takes two folders as FRAMES, the left pictures and the right ones; got {len(folders)}"
            )
        rig = load_calibration(self.calibration, "--stereo", scale)
        if len(rig) != 2:
            raise InputError(f"--calibration must hold the left and the right camera, in this order; got {len(rig)}")
        method = self.matcher or ("opencv" if find_spec("cv2") else "semi-global")
        near, far = depths or (StereoConfig.nearest, StereoConfig.farthest)
        reach = shape.length if self.reach is None and isinstance(shape, Hand) else self.reach
        # Corners alone may be too few where fingers point at the camera.
        config = StereoConfig(nearest=near, farthest=far, method=method, least=500)
        box = None if self.volume is None else torch.tensor(self.volume).reshape(2, 3)
        frames = StereoFrames(folders[0], folders[1], rig.stereo(), config=config, box=box, reach=reach or None)
        frames.sight(0)
        return frames

    def job(self, frames: Any) -> dict[str, Any]:
        """Return all settings that determine the clouds of stereo pictures, as plain data."""
        if not self.stereo:
            return {}
        cameras = [
            [camera.intrinsics.tolist(), camera.world_to_camera.tolist(), camera.distortion.tolist()]
            for camera in (frames.pair.left, frames.pair.right)
        ]
        box = None if frames.box is None else frames.box.tolist()
        return {"cameras": cameras, "configuration": asdict(frames.config), "--volume": box, "--reach": frames.reach}
