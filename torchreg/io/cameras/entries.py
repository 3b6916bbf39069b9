"""Cameras as other programs write them, in the entries of torchreg's own JSON; and a look at their numbers."""

from __future__ import annotations

import difflib
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from torchreg.errors import FileWarning, FormatError
from torchreg.geometry.camera import Camera
from torchreg.geometry.rigid import invert_rigid
from torchreg.io.cameras.lenses import LENS_MODELS, check_lens
from torchreg.io.clouds.raw_cloud import Array

# Other names of our entries: RealSense, Record3D, instant-ngp, ROS, OpenCV, NICE-SLAM.
_ALIASES = {
    "width": ("w", "W", "image_width", "imageWidth", "img_width"),
    "height": ("h", "H", "image_height", "imageHeight", "img_height"),
    "fx": ("fl_x", "focal_x"),
    "fy": ("fl_y", "focal_y"),
    "cx": ("ppx", "c_x", "principal_x"),
    "cy": ("ppy", "c_y", "principal_y"),
    "name": ("camera_name",),
    "distortion": (
        "distortion_coefficients", "distCoeffs", "dist_coeffs", "dist_coef", "distortion_coeffs", "coeffs", "dist",
        "D", "d",
    ),
}  # fmt: skip
_SIZES = ("image_size", "imageSize", "img_size", "size", "resolution")
MATRICES = ("intrinsic_matrix", "camera_matrix", "cameraMatrix", "K", "k", "M", "mtx", "intrinsics", "intrinsic")
_LENS_NUMBERS = ("data", "coefficients", "coeffs", "values", "params")
# Objects within an object that describe its camera: Open3D, Replica, NICE-SLAM, RealSense.
_NESTED = ("intrinsic", "intrinsics", "camera", "cam", "camera_intrinsics", "depth_intrinsics", "depth_camera", "depth")
# ORB-SLAM's names begin with it.
_PREFIX = re.compile(r"^(Camera1?|RGBD)\.")
# Names of the unit of depths: True for units per metre (TUM, Open3D, NICE-SLAM, ORB-SLAM), False for metres per unit.
_DEPTHS = {
    "depth_scale": False, "depth_units": False, "depth_unit": False, "depthScale": False, "depthUnits": False,
    "depthUnit": False, "depth_factor": True, "depthFactor": True, "depth_map_factor": True, "DepthMapFactor": True,
    "depth_scale_factor": True, "depth_scaling_factor": True, "png_depth_scale": True, "scale": True,
}  # fmt: skip
_UNIT_WORDS = {
    "m": 1.0, "meter": 1.0, "metre": 1.0, "cm": 0.01, "centimeter": 0.01, "centimetre": 0.01, "mm": 0.001,
    "millimeter": 0.001, "millimetre": 0.001, "um": 1e-6, "micrometer": 1e-6, "micrometre": 1e-6,
}  # fmt: skip
# ROS's matrices of the rectified picture, and of the turn to it.
_PROJECTIONS = ("P", "p", "projection_matrix")
_RECTIFICATIONS = ("R", "r", "rectification_matrix")
OWN = (
    "name", "width", "height", "fx", "fy", "cx", "cy", "distortion", "world_to_camera", "camera_to_world",
    "depth_scale",
)  # fmt: skip
NUMBERS = ("fx", "fy", "cx", "cy")
# From a camera that looks along -z, y up (OpenGL, ARKit) to one that looks along z, y down.
_TURNED = np.diag([1.0, -1.0, -1.0, 1.0])


def own_entry(given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the entries of a camera under torchreg's names; what no camera needs is left out.

    Known are Open3D's intrinsics and parameters (also those of its Azure Kinect and RealSense recorders), RealSense's
    own, Polycam's, Record3D's, instant-ngp's, Replica's and ORB-SLAM's, ROS's camera_info, and K and D as lists.
    """
    given = _flat(given)
    entry = {name: given[name] for name in OWN if name in given}
    for name, others in _ALIASES.items():
        found = [given[other] for other in others if other in given]
        if found and name not in entry:
            entry[name] = found[0]
    for name in _SIZES:
        if "width" not in entry and isinstance(given.get(name), Sequence) and len(given[name]) == 2:
            entry["width"], entry["height"] = given[name]
    for side in ("width", "height"):
        if isinstance(entry.get(side), float) and entry[side].is_integer():
            entry[side] = int(entry[side])
    _add_matrix(entry, given, where)
    _add_lens(entry, given, where)
    _add_pose(entry, given, where)
    _add_projection(entry, given, where)
    _refuse_misspelled(entry, given, where)
    return entry


def _flat(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of an object and of those within it that describe the camera."""
    flat = dict(given)
    for _ in range(2):
        for name in _NESTED:
            if isinstance(flat.get(name), Mapping):
                flat |= flat.pop(name)
    return {_PREFIX.sub("", name): value for name, value in flat.items()}


def depth_unit(given: Mapping[str, Any], where: str) -> float | None:
    """Return the metres per unit of depth images that a camera's object states, under any name; None if it does not."""
    given = _flat(given)
    units = {name: _metres(given, name, where) for name in _DEPTHS if name in given}
    # Beside depths a scale is one of the picture.
    known = {name: unit for name, unit in units.items() if name != "scale" or unit <= 0.01}
    if known and max(known.values()) > 1.01 * min(known.values()):
        listed = ", ".join(f"{name} {given[name]}" for name in known)
        raise FormatError(f"{where}: holds {listed}, which are not the same unit of depth; keep one")
    return next(iter(known.values()), None)


def _metres(given: Mapping[str, Any], name: str, where: str) -> float:
    """Return the metres per unit of an entry: a number, its inverse or a word."""
    word = str(given[name]).strip().lower()
    if word.removesuffix("s") in _UNIT_WORDS:
        return _UNIT_WORDS[word.removesuffix("s")]
    value = _numbers(given[name], name, where)
    if value.ndim:
        raise FormatError(f"{where}: {name} must be a number, got {str(given[name])[:80]}")
    number = float(value)
    if not 0 < number < np.inf:
        raise FormatError(f"{where}: {name} must be positive, got {number:g}")
    # Open3D's recorders write units per metre; depth images decide what depth_scale means elsewhere.
    if name == "depth_scale" and "intrinsic_matrix" not in given:
        return number
    if number != 1 and (number > 1) != _DEPTHS[name] and name not in ("scale", "depth_scale"):
        meaning = "units per metre" if number > 1 else "metres per unit"
        warnings.warn(
            f"{where}: {name} {number:g} is taken for {meaning}: depth images count in no unit above a metre",
            FileWarning,
            stacklevel=4,
        )
    return 1 / number if number > 1 else number


def _add_matrix(entry: dict[str, Any], given: Mapping[str, Any], where: str) -> None:
    """Add fx, fy, cx and cy of a matrix, stored rows first or columns first."""
    name = next((name for name in MATRICES if name in given and not isinstance(given[name], Mapping)), None)
    matrix = next((given[n] for n in MATRICES if isinstance(given.get(n), Mapping) and "data" in given[n]), None)
    values = given[name] if name is not None else None if matrix is None else matrix["data"]
    if values is None or "fx" in entry:
        return
    numbers = _numbers(values, name or "the matrix", where).reshape(-1)
    if numbers.size == 4:
        entry |= dict(zip(("fx", "fy", "cx", "cy"), numbers.tolist(), strict=True))
        return
    if numbers.size != 9:
        raise FormatError(f"{where}: {name} must hold 3 x 3 numbers (or fx, fy, cx, cy), got {numbers.size}")
    square = numbers.reshape(3, 3)
    square = square.T if square[2, :2].any() and not square[:2, 2].any() else square
    if square[0, 1] or square[1, 0] or square[2].tolist() != [0.0, 0.0, 1.0]:
        raise FormatError(f"{where}: {name} must be fx 0 cx, 0 fy cy, 0 0 1, got {square.tolist()}")
    entry |= {"fx": square[0, 0], "fy": square[1, 1], "cx": square[0, 2], "cy": square[1, 2]}


def _add_lens(entry: dict[str, Any], given: Mapping[str, Any], where: str) -> None:
    """Add the distortion of a pinhole camera's lens; refuse others, whose numbers mean something else."""
    lens = entry.pop("distortion", None)
    named: Mapping[str, Any] = given
    if isinstance(lens, Mapping):
        named, held = {**given, **lens}, lens
        lens = next((held[name] for name in _LENS_NUMBERS if name in held), None)
        is_told = lens is not None or any(f"k{k}" in named for k in (1, 2, 3, 4))
        if not is_told and any(not isinstance(value, str) for value in held.values()):
            raise FormatError(f"{where}: distortion must hold numbers as {_LENS_NUMBERS[0]}, or k1, k2, p1, p2")
    if lens is None and any(f"k{k}" in named for k in (1, 2, 3, 4)):
        lens = [named.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
        if lens[5] and not {"k5", "k6"} & set(named):
            named = {**named, "model": "k1 k2 k3 k4"}
    if isinstance(lens, str):
        named, lens = {**named, "distortion_type": lens}, None
    numbers = _numbers([] if lens is None else lens, "distortion", where).reshape(-1)
    sides = [value if isinstance(value := entry.get(name), (int, float)) else 1.0 for name in ("fx", "width")]
    fx, width = _numbers(sides, "fx and width", where).tolist()
    focal = fx / width if width > 0 else 1.0
    # Our own format says what its four numbers are.
    check_lens(named, numbers, where, None if "distortion" in given else focal)
    if lens is None:
        return
    numbers = numbers[:0] if not numbers.any() else numbers
    entry["distortion"] = (numbers[:8] if not numbers[8:].any() else numbers).tolist()


def _add_pose(entry: dict[str, Any], given: Mapping[str, Any], where: str) -> None:
    """Add the pose of Polycam's and Open3D's cameras."""
    rows = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
    if all(name in given for row in rows for name in row):
        motion = np.eye(4)
        motion[:3] = _numbers([[given[name] for name in row] for row in rows], "t_00 to t_23", where)
        entry["camera_to_world"] = (motion @ _TURNED).tolist()
    if isinstance(given.get("extrinsic"), Sequence) and len(given["extrinsic"]) == 16:
        entry["world_to_camera"] = _numbers(given["extrinsic"], "extrinsic", where).reshape(4, 4).T.tolist()


def _add_projection(entry: dict[str, Any], given: Mapping[str, Any], where: str) -> None:
    """Add what ROS's P and R hold: the place of a camera of a stereo pair, and the numbers of a rectified picture.

    As in ROS's image_geometry, K and D are those of the raw picture, which R turns to the rectified one of P; a picture
    whose D is zero is rectified. P[0, 3] is -fx times the distance to the right of the left camera, metres.
    """
    projection, turn = (_matrix(given, names, where) for names in (_PROJECTIONS, _RECTIFICATIONS))
    if projection is None or projection.size != 12:
        return
    rows = projection.reshape(3, 4)
    if rows[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]].tolist() != [0, 0, 0, 0, 1] or not rows[0, 0] > 0 or not rows[1, 1] > 0:
        return  # as of a camera that is not calibrated
    numbers = dict(zip(("fx", "fy", "cx", "cy"), rows[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True))
    motion = np.eye(4)
    motion[:2, 3] = rows[:2, 3] / rows[[0, 1], [0, 1]]
    if np.any(entry.get("distortion", 0.0)):
        back = np.eye(4)
        back[:3, :3] = np.eye(3) if turn is None or turn.size != 9 else turn.reshape(3, 3).T
        motion = back @ motion
    else:
        known = [entry.get(name, value) for name, value in numbers.items()]
        if not np.allclose(known, list(numbers.values()), rtol=1e-4):
            warnings.warn(
                f"{where}: fx, fy, cx, cy are those of P, {[*numbers.values()]}, not of K: the distortion is zero, so "
                f"that the picture is the rectified one",
                FileWarning,
                stacklevel=4,
            )
        entry |= numbers
    if not {"world_to_camera", "camera_to_world"} & set(entry) and not np.allclose(motion, np.eye(4), atol=1e-12):
        entry["world_to_camera"] = motion.tolist()


def _matrix(given: Mapping[str, Any], names: Sequence[str], where: str) -> Array | None:
    """Return the numbers of the first matrix that is there under one of the names."""
    for name in names:
        if name in given:
            value = given[name]
            data = value.get("data", []) if isinstance(value, Mapping) else value
            return _numbers([] if isinstance(data, str) else data, name, where).reshape(-1)
    return None


def cameras_of(document: Mapping[str, Any], where: str) -> list[Camera]:
    """Return the camera of an object, or those of Kalibr's chain of cameras, the first at the origin."""
    chain = sorted(
        (name for name in document if re.fullmatch(r"cam\d+", name) and isinstance(document[name], Mapping)),
        key=lambda name: int(name[3:]),
    )
    if not chain:
        return [camera_of(own_entry(document, where), where)]
    cameras, motion = list[Camera](), np.eye(4)
    for number, name in enumerate(chain):
        given, place = document[name], f"{where}: {name}"
        if number > 0:
            step = _matrix(given, ("T_cn_cnm1",), place)
            if step is None or step.size != 16:
                raise FormatError(f"{place} lacks T_cn_cnm1, the 4 x 4 motion from the camera before it")
            motion = step.reshape(4, 4) @ motion
        cameras.append(camera_of({"name": name, **own_entry(given, place), "world_to_camera": motion.tolist()}, place))
    return cameras


def camera_of(entry: Mapping[str, Any], where: str) -> Camera:
    """Return the camera of an object's entries under torchreg's names."""
    missing = [key for key in ("width", "height", *NUMBERS) if key not in entry]
    if missing:
        raise FormatError(f"{where} lacks {', '.join(missing)}")
    if "world_to_camera" in entry and "camera_to_world" in entry:
        raise FormatError(f"{where} holds both world_to_camera and camera_to_world; keep one")
    name = entry.get("name", "")
    if not isinstance(name, str):
        raise FormatError(f"{where}: name must be text, got {name!r}")
    key = "camera_to_world" if "camera_to_world" in entry else "world_to_camera"
    motion = _finite(entry.get(key, np.eye(4)), key, where)
    lens = _finite(entry.get("distortion", []), "distortion", where)
    intrinsics = [_finite(entry[number], number, where) for number in NUMBERS]
    if any(value.ndim for value in intrinsics):
        raise FormatError(f"{where}: {', '.join(NUMBERS)} must be a number each")
    try:
        camera = Camera(entry["width"], entry["height"], torch.stack(intrinsics), motion, lens, name)
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(f"{where}: {str(error).replace('world_to_camera', key)}") from error
    return replace(camera, world_to_camera=invert_rigid(motion)) if key == "camera_to_world" else camera


def _finite(value: Any, name: str, where: str) -> torch.Tensor:
    numbers = torch.from_numpy(_numbers(value, name, where))
    if not bool(numbers.isfinite().all()):
        raise FormatError(f"{where}: {name} must be finite, got {value!r:.80}")
    return numbers


def _numbers(values: Any, name: str, where: str) -> Array:
    try:
        numbers = np.array(values)
        if numbers.dtype.kind not in "biuf":  # nor words that look like numbers
            raise TypeError(f"got {numbers.dtype}")
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            f"{where}: {name} must hold numbers, got {str(values)[:80]}; all rows equally many"
        ) from error
    return numbers.astype(np.float64)


def _refuse_misspelled(entry: Mapping[str, Any], given: Mapping[str, Any], where: str) -> None:
    others = (name for names in _ALIASES.values() for name in names)
    known = {*OWN, *_SIZES, *MATRICES, *LENS_MODELS, *_DEPTHS, *others}
    for name in sorted(set(given) - known):
        near = [word for word in difflib.get_close_matches(name, OWN, cutoff=0.8) if word not in entry]
        if near:
            raise FormatError(f"{where} holds {name}, which no camera has; is it {near[0]}?")


@dataclass(frozen=True)
class _Plausible:
    """What cameras are like."""

    off_center: float = 0.35  # of the middle of the picture from the principal point, shares of the side
    baseline: float = 3.0  # metres between the cameras of a pair


_PLAUSIBLE = _Plausible()


def check_principal_point(camera: Camera, where: str) -> None:
    """Warn if the principal point is far from the middle of the picture: the numbers are of another picture size."""
    _, _, cx, cy = camera.intrinsics.tolist()
    off = max(abs((cx + 0.5) / camera.width - 0.5), abs((cy + 0.5) / camera.height - 0.5))
    if off > _PLAUSIBLE.off_center:
        place = "lies outside" if off > 0.5 else "is far from the middle of"
        warnings.warn(
            f"{where}: the principal point {cx:g}, {cy:g} {place} a picture of {camera.width} x {camera.height}: the "
            f"numbers seem to be those of a picture of about {2 * cx + 1:.0f} x {2 * cy + 1:.0f}; scale fx, fy, cx and "
            f"cy to the size of yours",
            FileWarning,
            stacklevel=3,
        )


def check_baseline(distance: float, where: str) -> None:
    """Warn if the cameras of a pair are so far apart that lengths seem to be in millimeters."""
    if distance > _PLAUSIBLE.baseline:
        warnings.warn(
            f"{where}: the cameras of the pair are {distance:.4g} m apart: T seems to be in millimeters; give its unit "
            f"in metres, scale=0.001",
            FileWarning,
            stacklevel=3,
        )
