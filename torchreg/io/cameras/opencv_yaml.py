"""OpenCV's calibration files, for one camera or a stereo pair, and ROS's, which are alike."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.io.atomic import write_atomic
from torchreg.io.cameras.entries import MATRICES, cameras_of
from torchreg.io.cameras.lenses import check_lens
from torchreg.io.file_format import plain_text
from torchreg.io.limits import FileLimits, local_path

_KEY = re.compile(r"^([A-Za-z_][\w.]*):[ \t]*(.*)$", re.MULTILINE)
# Names of the same entries in calibrations of different origin.
_SINGLE = (
    ("camera_matrix", "distortion_coefficients"), ("camera_matrix", "dist_coeffs"), ("cameraMatrix", "distCoeffs"),
    ("K", "D"), ("k", "d"), ("M", "D"), ("mtx", "dist"),
)  # fmt: skip
PAIRS = (
    ("M1", "D1", "M2", "D2"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
    ("K1", "D1", "K2", "D2"),
)
_WIDTHS, _HEIGHTS, _SIZES = ("image_width", "width"), ("image_height", "height"), ("image_size", "imageSize", "size")

Values = dict[str, "Tensor | str | Values"]


def read_opencv(content: bytes, file: Path, _: FileLimits) -> CameraRig:
    """Return the camera, or the stereo pair left and right, in the bytes of an OpenCV YAML file, float64.

    A pair has ``M1 D1 M2 D2 R T``, whose R and T map coordinates of the left camera, at the origin, to the right one;
    one camera has ``camera_matrix`` and ``distortion_coefficients``, and maybe R and T from the world. ROS's files have
    ``K D R P``; Kalibr's chains and ORB-SLAM's settings are read as well.
    """
    values = _parsed(_text(content, file), file)
    if _is_opencvs(values):
        return read_opencv_values(values, file)
    try:
        return CameraRig(tuple(cameras_of(_as_object(values), str(file))))
    except InputError as error:
        raise FormatError(f"{file}: {error}") from error


def yaml_object(content: bytes, file: Path) -> dict[str, Any]:
    """Return what a YAML file holds as its JSON would."""
    return _as_object(_parsed(_text(content, file), file))


def _text(content: bytes, file: Path) -> str:
    try:
        text = plain_text(content).decode("utf-8")
    except UnicodeDecodeError as error:
        raise FormatError(f"{file}: is no text ({error})") from error
    if not text.startswith("%YAML") and not _KEY.search(text):
        raise FormatError(
            f"{file}: must begin with %YAML, as OpenCV's FileStorage writes it, or hold `name: value` lines"
        )
    return text


def _is_opencvs(values: Values) -> bool:
    """Return whether the matrices are named as OpenCV's programs name them, or nothing in them is a camera's."""
    if any(names[0] in values for names in PAIRS) or "T" in values:
        return True
    if any(name in values for name in ("P", "p", "projection_matrix")):
        return False
    if any(names[0] in values for names in _SINGLE):
        return True
    cameras = (isinstance(value, dict) or name in MATRICES or name.endswith("x") for name, value in values.items())
    return not any(cameras)


def _as_object(values: Values) -> dict[str, Any]:
    """Return matrices, words and what is nested in them as JSON would hold them."""
    found = dict[str, Any]()
    for name, value in values.items():
        if isinstance(value, dict):
            found[name] = _as_object(value)
        else:
            found[name] = value.tolist() if isinstance(value, Tensor) else _number(value)
    return found


def _number(word: str) -> str | int | float:
    """Return a word as a number where it is one."""
    if _is_count(word):
        return int(word)
    try:
        return float(word)
    except ValueError:
        return word


def read_opencv_values(values: Values, file: Path) -> CameraRig:
    """Return the cameras of named matrices."""
    width, height = _picture_size(values, file)
    try:
        return CameraRig(tuple(_cameras(values, width, height, file)))
    except InputError as error:
        raise FormatError(f"{file}: {error}") from error


def values_of(document: Mapping[str, Any]) -> Values:
    """Return the matrices, lists of numbers and words of a JSON object."""
    values: Values = {}
    for name, value in document.items():
        data = value.get("data") if isinstance(value, Mapping) else value
        if isinstance(data, list):
            numbers = np.array(data, dtype=np.float64)
            shaped = isinstance(value, Mapping) and numbers.size == value.get("rows", 0) * value.get("cols", 0)
            numbers = numbers.reshape(value["rows"], value["cols"]) if shaped else numbers
            values[name] = torch.from_numpy(numbers.reshape(3, 3) if numbers.size == 9 else numbers)
        elif isinstance(data, str | int | float):
            values[name] = str(data)
    return values


def save_opencv(path: str | os.PathLike[str], cameras: CameraRig) -> None:
    """Write one camera, or two as a pair, for OpenCV to read; metres, the left camera of a pair at the origin."""
    if len(cameras) > 2 or len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise InputError(f"OpenCV files hold one or two cameras with pictures of one size, got {len(cameras)}")
    first, last = cameras[0], cameras[len(cameras) - 1]
    names = PAIRS[0] if len(cameras) == 2 else _SINGLE[0]
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


class _Loader(yaml.BaseLoader):
    """Reads words, lists and mappings, as no number of YAML 1.1 is one of FileStorage; no entry is used twice."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not supported")
        return super().compose_node(parent, index)


def _parsed(text: str, path: Path) -> Values:
    """Return the matrices, lists of numbers, other words and what is nested in a file by their names."""
    try:
        # FileStorage's first line is not valid YAML; anything after the first document is not a camera's.
        document = next(yaml.load_all(re.sub(r"\A%YAML.*", "", text), _Loader), None)
    except (yaml.YAMLError, RecursionError) as error:
        raise FormatError(f"{path}: is cut off or no YAML ({' '.join(str(error).split())})") from error
    if not isinstance(document, dict):
        raise FormatError(f"{path}: must hold `name: value` lines")
    return _values(document, str(path))


def _values(document: Mapping[Any, Any], where: str) -> Values:
    values: Values = {}
    for name, value in document.items():
        if isinstance(value, dict):
            values[name] = (
                _matrix(value, f"{where}: {name}") if {"data", "rows"} & value.keys() else _values(value, where)
            )
        elif isinstance(value, list):
            numbers = _listed(value, f"{where}: {name}")
            values[name] = numbers.reshape(3, 3) if numbers.numel() == 9 else numbers
        else:
            values[name] = str(value)
    return values


def _matrix(fields: Mapping[str, Any], where: str) -> Tensor:
    rows, columns = (str(fields.get(side, "")) for side in ("rows", "cols"))
    if not _is_count(rows) or not _is_count(columns) or "data" not in fields:
        raise FormatError(f"{where} lacks rows, cols or data: the file is cut off or damaged")
    data = _listed(fields["data"], where)
    if len(data) != int(rows) * int(columns):
        raise FormatError(f"{where} must hold {rows} x {columns} numbers, got {len(data)}")
    return data.reshape(int(rows), int(columns))


def _is_count(word: str) -> bool:
    """Return whether a word is a whole number that a picture's or matrix's side can be."""
    return word.isascii() and word.isdecimal() and len(word) < 10


def _listed(entries: Any, where: str) -> Tensor:
    """Return the numbers (N,) of a list, which may hold lists."""
    words = [entries]
    while any(isinstance(word, list) for word in words):
        words = [inner for word in words for inner in (word if isinstance(word, list) else [word])]
    try:
        # FileStorage writes .Nan and .Inf.
        numbers = [float(word.replace(".N", "n").replace(".I", "i")) for word in words]
    except (AttributeError, ValueError) as error:
        raise FormatError(f"{where} must hold numbers ({error})") from error
    values = torch.tensor(numbers, dtype=torch.float64)
    if not bool(values.isfinite().all()):
        raise FormatError(f"{where} must be finite")
    return values


def _picture_size(values: Values, path: Path) -> tuple[int, int]:
    pair = next((values[name] for name in _SIZES if name in values), None)
    if isinstance(pair, Tensor) and pair.numel() == 2:
        return int(pair.flatten()[0]), int(pair.flatten()[1])
    sides = [next((values[name] for name in names if name in values), None) for names in (_WIDTHS, _HEIGHTS)]
    if all(isinstance(side, str) and _is_count(side) for side in sides):
        return int(str(sides[0])), int(str(sides[1]))
    raise FormatError(
        f"{path}: lacks image_width and image_height; write them into the file, as in `image_width: 640` and "
        f"`image_height: 480`, below its first lines"
    )


def _cameras(values: Values, width: int, height: int, path: Path) -> list[Camera]:
    motion = _motion(values, path)
    for names in PAIRS:
        if names[0] in values:
            if motion is None:
                raise FormatError(f"{path}: lacks R and T of the stereo pair, which OpenCV keeps in extrinsics.yml")
            first, second = _lens(values, names[:2], width, path), _lens(values, names[2:], width, path)
            left = Camera(width, height, first[0], distortion=first[1], name="left")
            rig = CameraRig((left, Camera(width, height, second[0], motion, second[1], "right")))
            rig.stereo()  # refuses swapped cameras
            return list(rig)
    for single in sorted(_SINGLE, key=lambda names: names[1] not in values):
        if single[0] in values:
            intrinsics, lens = _lens(values, single, width, path)
            name = values.get("camera_name", "")
            pose = torch.eye(4) if motion is None else motion
            return [Camera(width, height, intrinsics, pose, lens, name if isinstance(name, str) else "")]
    raise FormatError(f"{path}: holds neither camera_matrix nor M1 and M2, but {', '.join(values) or 'nothing'}")


def _lens(values: Values, names: tuple[str, ...], width: int, path: Path) -> tuple[Tensor, Tensor]:
    """Return fx, fy, cx, cy and the distortion."""
    matrix, lens = values.get(names[0]), values.get(names[1], torch.zeros(0, dtype=torch.float64))
    if not isinstance(matrix, Tensor) or matrix.shape != (3, 3):
        raise FormatError(f"{path}: {names[0]} must be a 3 x 3 matrix")
    if isinstance(lens, Tensor) and not bool(lens.any()):
        lens = lens[:0]  # no distortion, however many zeros
    if isinstance(lens, Tensor):
        check_lens(values, lens.numpy().reshape(-1), str(path), float(matrix[0, 0]) / width)
    if not isinstance(lens, Tensor) or lens.numel() not in (0, 1, 4, 5, 8, 12, 14) or bool(lens.flatten()[8:].any()):
        raise FormatError(
            f"{path}: {names[1]} must hold 4, 5 or 8 numbers; prisms and tilted sensors are not supported"
        )
    if bool(matrix[0, 1] != 0) or matrix[1, 0] != 0 or matrix[2].tolist() != [0.0, 0.0, 1.0]:
        raise FormatError(f"{path}: {names[0]} must be fx 0 cx, 0 fy cy, 0 0 1, got {matrix.tolist()}")
    flat = lens.flatten()[:8]
    return matrix[[0, 1, 0, 1], [0, 1, 2, 2]], flat if len(flat) > 1 else flat[:0]


def _motion(values: Values, path: Path) -> Tensor | None:
    if "T" not in values and "R" not in values:
        return None
    turn, step = values.get("R"), values.get("T")
    if not isinstance(turn, Tensor) or not isinstance(step, Tensor) or step.numel() != 3 or turn.numel() not in (3, 9):
        raise FormatError(f"{path}: R must be a 3 x 3 matrix or a rotation vector, and T a vector of 3")
    rotation = so3_exp(turn.flatten()) if turn.numel() == 3 else turn.reshape(3, 3)
    return rigid_matrix(rotation, step.flatten())
