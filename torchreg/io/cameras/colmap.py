"""COLMAP's text models: cameras.txt with the lenses and images.txt with the poses."""

from __future__ import annotations

import math
import os
from pathlib import Path

import torch

from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation_representations import quaternion_from_rotation, rotation_from_quaternion
from torchreg.io.atomic import write_atomic
from torchreg.io.limits import DEFAULT_LIMITS, FILE_BUDGET, FileLimits, local_path, read_bytes

# Per model the indices of fx, fy, cx, cy, and then k1, k2, p1, p2, k3, k4, k5, k6 among its parameters; None is zero.
_MODELS: dict[str, tuple[int | None, ...]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2), "PINHOLE": (0, 1, 2, 3), "SIMPLE_RADIAL": (0, 0, 1, 2, 3, None, None, None),
    "RADIAL": (0, 0, 1, 2, 3, 4, None, None), "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
}  # fmt: skip
# COLMAP's pixel coordinates start at the corner of the picture, ours at the middle of the first pixel.
_CORNER = 0.5


def load_colmap(folder: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> CameraRig:
    """Return the cameras of a COLMAP text model, one per image in the order of ``images.txt``, in COLMAP's unit."""
    directory = local_path(folder)
    lenses = _lenses(directory / "cameras.txt", limits)
    path = directory / "images.txt"
    # Every image has a second line, of its points, which may be empty or missing.
    lines = [(number, line) for number, line in _lines(path, limits) if line and not line.startswith("#")]
    if len(lines) > 2 * FILE_BUDGET.cameras:
        raise FormatError(f"{path}: holds {len(lines) // 2} images, at most {FILE_BUDGET.cameras} are read")
    cameras = tuple(_placed(line, lenses, f"{path}, line {number}") for number, line in _images(lines))
    try:
        return CameraRig(cameras)
    except InputError as error:
        raise FormatError(f"{path}: {error}") from error


def save_colmap(folder: str | os.PathLike[str], cameras: CameraRig) -> None:
    """Write ``cameras.txt`` and ``images.txt``: a lens per camera and an image of its name, which holds no blanks."""
    directory = local_path(folder)
    lenses = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as (X Y POINT3D_ID)"]
    for number, camera in enumerate(cameras, start=1):
        if camera.name.split() != [camera.name]:
            raise InputError(f"names must not hold blanks in COLMAP's files, got {camera.name!r}")
        fx, fy, cx, cy = camera.intrinsics.double().tolist()
        lens = camera.distortion.double().tolist()
        model = "FULL_OPENCV" if any(lens[4:]) else "OPENCV" if any(lens) else "PINHOLE"
        values = [fx, fy, cx + _CORNER, cy + _CORNER, *lens][: {"PINHOLE": 4, "OPENCV": 8}.get(model, 12)]
        motion = camera.world_to_camera.detach().double().cpu()
        pose = torch.cat((quaternion_from_rotation(motion[:3, :3]), motion[:3, 3])).tolist()
        lenses.append(f"{number} {model} {camera.width} {camera.height} {_joined(values)}")
        images += [f"{number} {_joined(pose)} {number} {camera.name}", ""]
    write_atomic(directory / "cameras.txt", ("\n".join(lenses) + "\n").encode())
    write_atomic(directory / "images.txt", ("\n".join(images) + "\n").encode())


def _joined(values: list[float]) -> str:
    return " ".join(repr(value) for value in values)


def _lines(path: Path, limits: FileLimits) -> list[tuple[int, str]]:
    try:
        text = read_bytes(path, limits).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: is no text ({error})") from error
    return [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]


def _lenses(path: Path, limits: FileLimits) -> dict[str, tuple[int, int, list[float]]]:
    """Return width, height and fx, fy, cx, cy, k1, ... of every camera by its number."""
    found: dict[str, tuple[int, int, list[float]]] = {}
    for number, line in _lines(path, limits):
        where = f"{path}, line {number}"
        if not line or line.startswith("#"):
            continue
        words = line.split()
        if len(words) < 4 or not all(word.isascii() and word.isdecimal() and len(word) < 10 for word in words[2:4]):
            raise FormatError(f"{where}: must be CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line[:80]!r}")
        model, values = words[1], _values(words[4:], where)
        if model not in _MODELS:
            raise FormatError(f"{where}: lenses must be one of {', '.join(_MODELS)}; got {model}")
        which = _MODELS[model]
        needed = 1 + max(number for number in which if number is not None)
        if len(values) != needed:
            raise FormatError(f"{where}: {model} has {needed} parameters, got {len(values)}: it is cut off or damaged")
        if words[0] in found:
            raise FormatError(f"{where}: camera {words[0]} is listed twice")
        found[words[0]] = int(words[2]), int(words[3]), [0.0 if k is None else values[k] for k in which]
    return found


def _placed(line: str, lenses: dict[str, tuple[int, int, list[float]]], where: str) -> Camera:
    words = line.split(maxsplit=9)
    if len(words) != 10:
        raise FormatError(f"{where}: must be IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:80]!r}")
    pose = _values(words[1:8], where)
    if words[8] not in lenses:
        raise FormatError(f"{where}: names camera {words[8]}, cameras.txt holds {', '.join(lenses) or 'none'}")
    width, height, values = lenses[words[8]]
    if not abs(math.hypot(*pose[:4]) - 1) < 1e-2:
        raise FormatError(f"{where}: QW QX QY QZ must be a unit quaternion, got length {math.hypot(*pose[:4]):.3g}")
    quaternion, position = torch.tensor(pose, dtype=torch.float64).split((4, 3))
    motion = rigid_matrix(rotation_from_quaternion(quaternion), position)
    numbers = torch.tensor(values, dtype=torch.float64)
    numbers[2:4] -= _CORNER
    try:
        return Camera(width, height, numbers[:4], motion, numbers[4:], words[9])
    except InputError as error:
        raise FormatError(f"{where}: {error}") from error


def _images(lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Return the lines of images among the lines that are not empty, which may be those of points."""
    found, after_image = list[tuple[int, str]](), False
    for number, line in lines:
        after_image = after_image and not _is_image(line)
        if not after_image:
            found.append((number, line))
        after_image = not after_image
    return found


def _is_image(line: str) -> bool:
    """Return whether a line describes an image: two whole numbers at their places, and not points in triples."""
    words = line.split()
    if len(words) < 10 or not (words[0].isdecimal() and words[8].isdecimal()):
        return False
    return len(words) % 3 != 0 or not all(_is_number(word) for word in words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _values(words: list[str], where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise FormatError(f"{where}: must hold numbers ({error})") from error
    if not all(math.isfinite(value) for value in values):
        raise FormatError(f"{where}: numbers must be finite, got {' '.join(words)[:80]}")
    return values
