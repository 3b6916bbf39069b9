"""OpenCV's calibration files: the YAML that its FileStorage writes, for one camera or a stereo pair."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

import torch
from torch import Tensor

from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.io.atomic import write_atomic
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes

_KEY = re.compile(r"^([A-Za-z_]\w*):[ \t]*(.*)$", re.MULTILINE)
_FIELD = re.compile(r"^[ \t]+(rows|cols|dt|data):[ \t]*", re.MULTILINE)
# Names of the same entries in calibrations of different origin.
_SINGLE = (("camera_matrix", "distortion_coefficients"), ("cameraMatrix", "distCoeffs"), ("K", "D"), ("M", "D"))
_PAIR = (
    ("M1", "D1", "M2", "D2"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
    ("K1", "D1", "K2", "D2"),
)
_WIDTHS, _HEIGHTS, _SIZES = ("image_width", "width"), ("image_height", "height"), ("image_size", "imageSize", "size")

Values = dict[str, "Tensor | str"]


def load_opencv(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    unit: float = 1.0,
    limits: FileLimits = DEFAULT_LIMITS,
) -> CameraRig:
    """Return the camera, or the stereo pair left and right, of an OpenCV YAML file.

    A pair has ``M1 D1 M2 D2 R T`` (or ``cameraMatrix1 distCoeffs1 ...``, ``K1 ...``), where R and T map coordinates of
    the left camera to the right one; the left one is at the origin. One camera has ``camera_matrix`` and
    ``distortion_coefficients`` (or ``cameraMatrix distCoeffs``, ``K D``), and maybe R and T from the world.

    Args:
        path: the file.
        size: (width, height) of the pictures, for files without ``image_width`` and ``image_height``.
        unit: metres per unit of T, which is that of the calibration board, often 0.001.
        limits: ``max_bytes`` applies.

    Returns:
        The cameras, float64.

    Raises:
        FormatError: if the file is cut off, a matrix has another size, a number is not finite, an entry is missing, or
            the cameras of a pair are swapped; names the file.
        FileNotFoundError: if there is no such file.
        InputError: if ``unit`` is not positive.
    """
    if not (math.isfinite(unit) and unit > 0):
        raise InputError(f"unit must be positive and finite, got {unit}")
    file = local_path(path)
    try:
        text = read_bytes(file, limits).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(f"{file}: is no text ({error})") from error
    if not text.startswith("%YAML"):
        raise FormatError(f"{file}: must begin with %YAML, as OpenCV's FileStorage writes it")
    values = _parsed(text, file)
    width, height = _picture_size(values, size, file)
    try:
        return CameraRig(tuple(_cameras(values, width, height, unit, file)))
    except InputError as error:
        raise FormatError(f"{file}: {error}") from error


def save_opencv(path: str | os.PathLike[str], cameras: CameraRig) -> None:
    """Write one camera, or two as a pair, for OpenCV to read; metres, the left camera of a pair at the origin.

    Args:
        path: a ``.yml`` or ``.yaml`` file; its folder must exist.
        cameras: one or two, with pictures of one size.

    Raises:
        InputError: if there are more, or sizes differ.
        FileNotFoundError: if the folder does not exist.
    """
    if len(cameras) > 2 or len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise InputError(f"OpenCV files hold one or two cameras with pictures of one size, got {len(cameras)}")
    first, last = cameras[0], cameras[len(cameras) - 1]
    names = _PAIR[0] if len(cameras) == 2 else _SINGLE[0]
    parts = [part for camera in cameras for part in (camera.matrix, camera.distortion.unsqueeze(0))]
    motion = last.world_to_camera.double()
    if len(cameras) == 2:
        motion = motion @ first.camera_to_world.double()
    parts += [motion[:3, :3], motion[:3, 3:]]
    lines = ["%YAML:1.0", "---", f"image_width: {first.width}", f"image_height: {first.height}"]
    lines += [_written(name, part) for name, part in zip((*names, "R", "T"), parts, strict=True)]
    write_atomic(local_path(path), ("\n".join(lines) + "\n").encode())


def _written(name: str, matrix: Tensor) -> str:
    data = ", ".join(repr(value) for value in matrix.detach().double().flatten().tolist())
    rows, columns = matrix.shape
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]"


def _parsed(text: str, path: Path) -> Values:
    """Return the matrices, lists of numbers and other words of a file by their names."""
    marks = list(_KEY.finditer(text))
    if not marks:
        raise FormatError(f"{path}: holds no entry NAME: VALUE")
    ends = [mark.start() for mark in marks[1:]] + [len(text)]
    values: Values = {}
    for mark, end in zip(marks, ends, strict=True):
        name, first = mark.group(1), mark.group(2).strip()
        body = text[mark.start(2) : end]
        if "opencv-matrix" in first:
            values[name] = _matrix(body, f"{path}: {name}")
        elif first.startswith("["):
            values[name] = _listed(body, f"{path}: {name}")
        else:
            values[name] = first.strip('"')
    return values


def _matrix(body: str, where: str) -> Tensor:
    marks = list(_FIELD.finditer(body))
    # Without any field, it lacks them all.
    ends = [mark.start() for mark in marks[1:]] + [len(body)] * bool(marks)
    fields = {mark.group(1): body[mark.end() : end] for mark, end in zip(marks, ends, strict=True)}
    rows, columns = (fields.get(side, "").strip() for side in ("rows", "cols"))
    if not _is_count(rows) or not _is_count(columns) or "data" not in fields:
        raise FormatError(f"{where} lacks rows, cols or data: the file is cut off or damaged")
    data = _listed(fields["data"], where)
    if len(data) != int(rows) * int(columns):
        raise FormatError(f"{where} must hold {rows} x {columns} numbers, got {len(data)}")
    return data.reshape(int(rows), int(columns))


def _is_count(word: str) -> bool:
    """Return whether a word is a whole number that a picture's or matrix's side can be."""
    return word.isascii() and word.isdecimal() and len(word) < 10


def _listed(body: str, where: str) -> Tensor:
    inner = re.match(r"\s*\[([^\]]*)\]", body)
    if inner is None:
        raise FormatError(f"{where} has no closing bracket: the file is cut off")
    words = [word for word in re.split(r"[,\s]+", inner.group(1)) if word]
    try:
        # FileStorage writes .Nan and .Inf.
        values = torch.tensor(
            [float(word.replace(".N", "n").replace(".I", "i")) for word in words], dtype=torch.float64
        )
    except ValueError as error:
        raise FormatError(f"{where} must hold numbers ({error})") from error
    if not bool(values.isfinite().all()):
        raise FormatError(f"{where} must be finite")
    return values


def _picture_size(values: Values, size: tuple[int, int] | None, path: Path) -> tuple[int, int]:
    pair = next((values[name] for name in _SIZES if name in values), None)
    if isinstance(pair, Tensor) and pair.numel() == 2:
        return int(pair.flatten()[0]), int(pair.flatten()[1])
    sides = [next((values[name] for name in names if name in values), None) for names in (_WIDTHS, _HEIGHTS)]
    if all(isinstance(side, str) and _is_count(side) for side in sides):
        return int(str(sides[0])), int(str(sides[1]))
    if size is None:
        raise FormatError(f"{path}: lacks image_width and image_height; pass size=(width, height) to load_opencv")
    return size


def _cameras(values: Values, width: int, height: int, unit: float, path: Path) -> list[Camera]:
    motion = _motion(values, unit, path)
    for names in _PAIR:
        if names[0] in values:
            if motion is None:
                raise FormatError(f"{path}: lacks R and T of the stereo pair, which OpenCV keeps in extrinsics.yml")
            first, second = _lens(values, names[:2], path), _lens(values, names[2:], path)
            left = Camera(width, height, first[0], distortion=first[1], name="left")
            rig = CameraRig((left, Camera(width, height, second[0], motion, second[1], "right")))
            rig.stereo()  # refuses swapped cameras
            return list(rig)
    for single in _SINGLE:
        if single[0] in values:
            intrinsics, lens = _lens(values, single, path)
            return [Camera(width, height, intrinsics, torch.eye(4) if motion is None else motion, lens)]
    raise FormatError(f"{path}: holds neither camera_matrix nor M1 and M2, but {', '.join(values) or 'nothing'}")


def _lens(values: Values, names: tuple[str, ...], path: Path) -> tuple[Tensor, Tensor]:
    """Return fx, fy, cx, cy and the distortion."""
    matrix, lens = values.get(names[0]), values.get(names[1], torch.zeros(0, dtype=torch.float64))
    if not isinstance(matrix, Tensor) or matrix.shape != (3, 3):
        raise FormatError(f"{path}: {names[0]} must be a 3 x 3 matrix")
    if not isinstance(lens, Tensor) or lens.numel() not in (0, 1, 4, 5, 8, 12, 14) or bool(lens.flatten()[8:].any()):
        raise FormatError(
            f"{path}: {names[1]} must hold 4, 5 or 8 numbers; prisms and tilted sensors are not supported"
        )
    if bool(matrix[0, 1] != 0) or matrix[1, 0] != 0 or matrix[2].tolist() != [0.0, 0.0, 1.0]:
        raise FormatError(f"{path}: {names[0]} must be fx 0 cx, 0 fy cy, 0 0 1, got {matrix.tolist()}")
    flat = lens.flatten()[:8]
    return matrix[[0, 1, 0, 1], [0, 1, 2, 2]], flat if len(flat) > 1 else flat[:0]


def _motion(values: Values, unit: float, path: Path) -> Tensor | None:
    if "R" not in values and "T" not in values:
        return None
    turn, step = values.get("R"), values.get("T")
    if not isinstance(turn, Tensor) or not isinstance(step, Tensor) or step.numel() != 3 or turn.numel() not in (3, 9):
        raise FormatError(f"{path}: R must be a 3 x 3 matrix or a rotation vector, and T a vector of 3")
    rotation = so3_exp(turn.flatten()) if turn.numel() == 3 else turn.reshape(3, 3)
    return rigid_matrix(rotation, unit * step.flatten())
