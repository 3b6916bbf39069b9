r"""Calibrations from files: JSON of torchreg and other programs, COLMAP's folders, OpenCV's and ROS's YAML.

The JSON is one object::

    {"format": "torchreg-cameras", "version": 1,
     "cameras": [{"name": "left", "width": 640, "height": 480,
                  "fx": 600.0, "fy": 600.0, "cx": 319.5, "cy": 239.5,
                  "distortion": [k1, k2, p1, p2, k3],
                  "world_to_camera": [[r, r, r, x], [r, r, r, y], [r, r, r, z], [0, 0, 0, 1]]}, ...]}

or one of those cameras alone. Pixels are OpenCV's: whole numbers are the middles of pixels. The motion is in metres and
maps world coordinates to camera coordinates (right, down, forward); ``camera_to_world`` may give its inverse instead,
and without either the camera is at the origin. Name and distortion (0, 4, 5 or 8 numbers, see `Camera`) may be missing.
The camera of a depth image may have ``depth_scale``, metres per unit of the file's numbers, or what other programs
write in its place (``depth_units``, ``depth_factor``, ...); see `load_depth` for those without. `own_entry` lists
the other programs whose files are read.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from torchreg._checks import check_positive
from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.io.atomic import write_atomic
from torchreg.io.cameras.colmap import load_colmap
from torchreg.io.cameras.entries import (
    NUMBERS,
    camera_of,
    cameras_of,
    check_baseline,
    check_principal_point,
    depth_unit,
    own_entry,
)
from torchreg.io.cameras.opencv_yaml import PAIRS, read_opencv, read_opencv_values, values_of, yaml_object
from torchreg.io.file_format import FileFormat, begins, check_stand_in, choose, naming, plain_text
from torchreg.io.images import MILLIMETER
from torchreg.io.limits import DEFAULT_LIMITS, FILE_BUDGET, FileLimits, check_budget, local_path, read_bytes

FORMAT = "torchreg-cameras"
_VERSION = 1
CAMERAS = "cameras"
_SIDES = ("left", "right")


def load_cameras(path: str | os.PathLike[str], *, scale: float = 1.0, limits: FileLimits = DEFAULT_LIMITS) -> CameraRig:
    """Return the cameras of a calibration file, float64.

    Args:
        path: a ``.json`` file as above or of another program, a ``.yml`` or ``.yaml`` file of OpenCV's, ROS's, Kalibr's
            or ORB-SLAM's, a folder with COLMAP's ``cameras.txt`` and ``images.txt``, or one with the files ``left`` and
            ``right`` of ROS's stereo calibration, whose P holds the distance of the cameras.
        scale: metres per unit of the lengths in the file, such as 0.001 where the board was measured in millimeters.
        limits: ``max_bytes`` applies.

    Raises:
        FormatError: if the file is cut off, lacks an entry, or does not describe a camera; names the file.
        FileNotFoundError: if there is no such file.
        InputError: if ``scale`` is not positive.

    Warns:
        FileWarning: if the numbers are unlikely: those of pictures of another size, or lengths in millimeters.
    """
    check_positive(scale, "scale")
    file = local_path(path)
    if file.is_dir():
        rig = _stereo_folder(file, limits) or load_colmap(file, limits=limits)
    else:
        content = read_bytes(file, limits)
        with naming(file):
            rig = choose(FORMATS, content, file).read(content, file, limits)
    rig = rig if scale == 1 else _scaled(rig, scale)
    for number, camera in enumerate(rig):
        check_principal_point(camera, f"{file}: camera {camera.name or number}")
    if len(rig) == 2 and {camera.name for camera in rig} == set(_SIDES):
        check_baseline(float((rig[0].camera_to_world[:3, 3] - rig[1].camera_to_world[:3, 3]).norm()), str(file))
    return rig


def _stereo_folder(folder: Path, limits: FileLimits) -> CameraRig | None:
    """Return the pair of the files left and right of a folder, as ROS's calibrator writes them; None without both."""
    endings = [ending for row in FORMATS for ending in row.endings]
    files = {side: [file for end in endings if (file := folder / f"{side}{end}").is_file()] for side in _SIDES}
    if not all(len(found) == 1 for found in files.values()):
        return None
    pair = [load_cameras(found[0], limits=limits)[0] for found in files.values()]
    return CameraRig(tuple(replace(camera, name=side) for camera, side in zip(pair, _SIDES, strict=True)))


def _scaled(rig: CameraRig, scale: float) -> CameraRig:
    """Return cameras with their positions in another unit."""
    motions = [camera.world_to_camera.clone() for camera in rig]
    for motion in motions:
        motion[:3, 3] *= scale
    return CameraRig(tuple(replace(camera, world_to_camera=m) for camera, m in zip(rig, motions, strict=True)))


def _read_json(content: bytes, file: Path, limits: FileLimits) -> CameraRig:
    document = json_object(content, file)
    if any(names[0] in document for names in PAIRS):
        return read_opencv_values(values_of(document), file)
    entries = document.get("cameras", document.get("parameters"))
    if "cameras" in document and (document.get("format"), document.get("version")) != (FORMAT, _VERSION):
        raise FormatError(
            f'{file}: must hold "format": "{FORMAT}" and "version": {_VERSION}, got {document.get("format")!r} and '
            f"{document.get('version')!r}"
        )
    try:
        if entries is None:
            return CameraRig(tuple(cameras_of(document, f"{file}: camera 0")))
        if not isinstance(entries, list) or not entries:
            raise FormatError(f"{file}: cameras must be a list of at least one camera")
        _check_number(len(entries), file)
        return CameraRig(tuple(_camera(entry, f"{file}: camera {number}") for number, entry in enumerate(entries)))
    except InputError as error:
        raise FormatError(f"{file}: {error}") from error


def _camera(given: Any, where: str) -> Camera:
    if not isinstance(given, dict):
        raise FormatError(f"{where} must be a JSON object, got {type(given).__name__}")
    return camera_of(own_entry(given, where), where)


def _check_number(count: int, file: Path) -> None:
    try:
        check_budget(count, FILE_BUDGET.cameras, "cameras")
    except FormatError as error:
        raise FormatError(f"{file}: {error}") from error


def _is_json(content: bytes) -> bool:
    return content.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] == b"{"


# Beside folders of COLMAP's. A new format is one more row.
FORMATS: tuple[FileFormat, ...] = (
    FileFormat(
        name="torchreg JSON",
        kind=CAMERAS,
        endings=(".json",),
        read=_read_json,
        holds="also of Open3D, RealSense, Azure Kinect, Polycam, Record3D, ROS camera_info, K and D as lists",
        loader="load_cameras",
        sniff=_is_json,
    ),
    FileFormat(
        name="OpenCV YAML",
        kind=CAMERAS,
        endings=(".yml", ".yaml"),
        read=read_opencv,
        holds="one camera or a pair; also of ROS's calibrator and camera_info, Kalibr, ORB-SLAM",
        loader="load_cameras",
        sniff=begins(b"%YAML"),
    ),
)


def load_depth_camera(
    path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS
) -> tuple[Camera, float | None]:
    """Return the camera of a depth image, float64, and its metres per unit of depth, None where the file has none."""
    file = local_path(path)
    content = read_bytes(file, limits)
    if file.suffix.lower() == ".json" or _is_json(content):
        document = json_object(content, file)
        entries = document.get("cameras", [document])
        if not isinstance(entries, list) or len(entries) != 1:
            raise FormatError(f"{file}: must hold the one camera of the depth image")
        rig, document = CameraRig((_camera(entries[0], str(file)),)), entries[0]
        check_principal_point(rig[0], str(file))
    else:
        rig, document = load_cameras(file, limits=limits), yaml_object(content, file)
    if len(rig) != 1:
        raise FormatError(f"{file}: must hold the one camera of the depth image, got {len(rig)}")
    return rig[0], depth_unit(document, str(file))


def save_cameras(path: str | os.PathLike[str], cameras: CameraRig) -> None:
    """Write cameras as JSON, in full precision."""
    entries = [_entry(camera) for camera in cameras]
    _write(path, {"format": FORMAT, "version": _VERSION, "cameras": entries})


def save_depth_camera(path: str | os.PathLike[str], camera: Camera, depth_scale: float = MILLIMETER) -> None:
    """Write the camera of a depth image as JSON, see `load_depth_camera`."""
    _write(path, _entry(camera) | {"depth_scale": depth_scale})


def _write(path: str | os.PathLike[str], document: dict[str, Any]) -> None:
    file = local_path(path)
    if file.suffix.lower() != ".json":
        raise FormatError(f"{file}: must end in .json")
    write_atomic(file, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def _entry(camera: Camera) -> dict[str, Any]:
    lens = camera.distortion.tolist()
    length = next(size for size in (0, 4, 5, 8) if not any(lens[size:]))
    named = {"name": camera.name} if camera.name else {}
    size = {"width": camera.width, "height": camera.height}
    numbers = dict(zip(NUMBERS, camera.intrinsics.tolist(), strict=True))
    distortion = {"distortion": lens[:length]} if length else {}
    return named | size | numbers | distortion | {"world_to_camera": camera.world_to_camera.tolist()}


def json_object(content: bytes, file: Path) -> dict[str, Any]:
    """Return the object in the bytes of a JSON file; FormatError, which names the file, if there is none."""

    def refuse(constant: str) -> NoReturn:
        raise FormatError(f"{file}: numbers must be finite, got {constant}")

    check_stand_in(content)
    try:
        document = json.loads(plain_text(content).decode("utf-8"), parse_constant=refuse)
    except (ValueError, RecursionError) as error:  # also numbers of thousands of digits
        raise FormatError(f"{file}: is cut off or no JSON ({error})") from error
    if not isinstance(document, dict):
        raise FormatError(f"{file}: must hold a JSON object, got {type(document).__name__}")
    return document
