r"""Calibrations from files: torchreg's own JSON, COLMAP's text folders and OpenCV's YAML.

The JSON is one object::

    {"format": "torchreg-cameras", "version": 1,
     "cameras": [{"name": "left", "width": 640, "height": 480,
                  "fx": 600.0, "fy": 600.0, "cx": 319.5, "cy": 239.5,
                  "distortion": [k1, k2, p1, p2, k3],
                  "world_to_camera": [[r, r, r, x], [r, r, r, y], [r, r, r, z], [0, 0, 0, 1]]}, ...]}

or one of those cameras alone. Pixels are OpenCV's: whole numbers are the middles of pixels. The motion is in metres and
maps world coordinates to camera coordinates (right, down, forward); ``camera_to_world`` may give its inverse instead,
and without either the camera is at the origin. Name and distortion (0, 4, 5 or 8 numbers, see `Camera`) may be missing.
The camera of a depth image also has ``depth_scale``, metres per unit of the file's numbers: 0.001 by default.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import torch

from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.rigid import invert_rigid
from torchreg.io.atomic import write_atomic
from torchreg.io.colmap import load_colmap
from torchreg.io.images import MILLIMETER
from torchreg.io.limits import DEFAULT_LIMITS, FILE_BUDGET, FileLimits, check_budget, local_path, read_bytes
from torchreg.io.opencv_yaml import load_opencv

FORMAT = "torchreg-cameras"
_VERSION = 1
_NUMBERS = ("fx", "fy", "cx", "cy")
_KNOWN = {"name", "width", "height", *_NUMBERS, "distortion", "world_to_camera", "camera_to_world", "depth_scale"}


def load_cameras(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> CameraRig:
    """Return the cameras of a calibration file, float64.

    Args:
        path: a ``.json`` file as above, a ``.yml`` or ``.yaml`` file of OpenCV's (see `load_opencv` for lengths in
            other units), or a folder with COLMAP's ``cameras.txt`` and ``images.txt``.
        limits: ``max_bytes`` applies.

    Raises:
        FormatError: if the file is cut off, lacks an entry, or does not describe a camera; names the file.
        FileNotFoundError: if there is no such file.
    """
    file = local_path(path)
    loader = _LOADERS.get(_FOLDER if file.is_dir() else file.suffix.lower())
    if loader is None:
        raise FormatError(f"{file}: calibrations are .json, .yml or .yaml files or a COLMAP folder")
    return loader(file, limits=limits)


def _load_json(file: Path, *, limits: FileLimits) -> CameraRig:
    document = _document(file, limits)
    entries = document.get("cameras", [document])
    if "cameras" in document and (document.get("format"), document.get("version")) != (FORMAT, _VERSION):
        raise FormatError(
            f'{file}: must hold "format": "{FORMAT}" and "version": {_VERSION}, got {document.get("format")!r} and '
            f"{document.get('version')!r}"
        )
    if not isinstance(entries, list) or not entries:
        raise FormatError(f"{file}: cameras must be a list of at least one camera")
    _check_number(len(entries), file)
    cameras = tuple(_camera(entry, f"{file}: camera {number}") for number, entry in enumerate(entries))
    try:
        return CameraRig(cameras)
    except InputError as error:
        raise FormatError(f"{file}: {error}") from error


def _check_number(count: int, file: Path) -> None:
    try:
        check_budget(count, FILE_BUDGET.cameras, "cameras")
    except FormatError as error:
        raise FormatError(f"{file}: {error}") from error


# Loaders by the ending of the file; a folder has a key that is no ending. A new format is one more row.
_FOLDER = "folder"
_LOADERS: dict[str, Callable[..., CameraRig]] = {
    _FOLDER: load_colmap,
    ".json": _load_json,
    ".yml": load_opencv,
    ".yaml": load_opencv,
}


def load_depth_camera(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> tuple[Camera, float]:
    """Return the camera of a depth image, float64, and its scale in metres per unit of the image.

    Args:
        path: a ``.json`` file with width, height, fx, fy, cx, cy and maybe depth_scale and camera_to_world, see above.
        limits: ``max_bytes`` applies.

    Raises:
        FormatError: as `load_cameras`, and if there are several cameras.
        FileNotFoundError: if there is no such file.
    """
    file = local_path(path)
    document = _document(file, limits)
    entries = document.get("cameras", [document])
    if not isinstance(entries, list) or len(entries) != 1:
        raise FormatError(f"{file}: must hold the one camera of the depth image")
    camera = _camera(entries[0], str(file))
    scale = _number(entries[0].get("depth_scale", MILLIMETER), "depth_scale", str(file))
    if scale <= 0:
        raise FormatError(f"{file}: depth_scale must be positive, got {scale}")
    return camera, scale


def save_cameras(path: str | os.PathLike[str], cameras: CameraRig) -> None:
    """Write cameras as JSON, in full precision.

    Args:
        path: a ``.json`` file; its folder must exist.
        cameras: at least one.

    Raises:
        FormatError: if the name has another ending.
        FileNotFoundError: if the folder does not exist.
    """
    entries = [_entry(camera) for camera in cameras]
    _write(path, {"format": FORMAT, "version": _VERSION, "cameras": entries})


def save_depth_camera(path: str | os.PathLike[str], camera: Camera, depth_scale: float = MILLIMETER) -> None:
    """Write the camera of a depth image as JSON, see `load_depth_camera`.

    Raises:
        FormatError: if the name does not end in ``.json``.
        FileNotFoundError: if the folder does not exist.
    """
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
    numbers = dict(zip(_NUMBERS, camera.intrinsics.tolist(), strict=True))
    distortion = {"distortion": lens[:length]} if length else {}
    return named | size | numbers | distortion | {"world_to_camera": camera.world_to_camera.tolist()}


def _document(file: os.PathLike[str], limits: FileLimits) -> dict[str, Any]:
    def refuse(constant: str) -> NoReturn:
        raise FormatError(f"{file}: numbers must be finite, got {constant}")

    content = read_bytes(file, limits)
    try:
        document = json.loads(content.decode("utf-8-sig"), parse_constant=refuse)
    except (ValueError, RecursionError) as error:  # also numbers of thousands of digits
        raise FormatError(f"{file}: is cut off or no JSON ({error})") from error
    if not isinstance(document, dict):
        raise FormatError(f"{file}: must hold a JSON object, got {type(document).__name__}")
    return document


def _camera(entry: Any, where: str) -> Camera:
    if not isinstance(entry, dict):
        raise FormatError(f"{where} must be a JSON object, got {type(entry).__name__}")
    missing = [key for key in ("width", "height", *_NUMBERS) if key not in entry]
    if missing:
        raise FormatError(f"{where} lacks {', '.join(missing)}")
    unknown = sorted(set(entry) - _KNOWN)
    if unknown:
        raise FormatError(f"{where} holds {', '.join(unknown)}, which no camera has")
    if "world_to_camera" in entry and "camera_to_world" in entry:
        raise FormatError(f"{where} holds both world_to_camera and camera_to_world; keep one")
    name = entry.get("name", "")
    if not isinstance(name, str):
        raise FormatError(f"{where}: name must be text, got {name!r}")
    key = "camera_to_world" if "camera_to_world" in entry else "world_to_camera"
    motion = _numbers(entry.get(key, torch.eye(4).tolist()), key, where)
    lens = _numbers(entry.get("distortion", []), "distortion", where)
    intrinsics = [_number(entry[number], number, where) for number in _NUMBERS]
    try:
        camera = Camera(
            entry["width"], entry["height"], torch.tensor(intrinsics, dtype=torch.float64), motion, lens, name
        )
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(f"{where}: {str(error).replace('world_to_camera', key)}") from error
    return replace(camera, world_to_camera=invert_rigid(motion)) if key == "camera_to_world" else camera


def _number(value: Any, name: str, where: str) -> float:
    numbers = _numbers([value], name, where)
    if numbers.shape != (1,):
        raise FormatError(f"{where}: {name} must be a number, got {value!r:.80}")
    return float(numbers)


def _numbers(value: Any, name: str, where: str) -> torch.Tensor:
    try:
        numbers = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise FormatError(f"{where}: {name} must hold numbers, all rows equally many, got {value!r:.80}") from error
    if not bool(numbers.isfinite().all()):
        raise FormatError(f"{where}: {name} must be finite, got {value!r:.80}")
    return numbers
