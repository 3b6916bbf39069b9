"""Cameras as other programs write them, in the entries of torchreg's own JSON; and a look at their numbers."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchreg.errors import FileWarning, FormatError
from torchreg.geometry.camera import Camera
from torchreg.io.raw_cloud import Array

# Other names of our entries: RealSense, Record3D, instant-ngp, ROS, OpenCV.
_ALIASES = {
    "width": ("w", "image_width", "imageWidth", "img_width"),
    "height": ("h", "image_height", "imageHeight", "img_height"),
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
_MATRICES = ("intrinsic_matrix", "camera_matrix", "cameraMatrix", "K", "k", "M", "mtx", "intrinsics", "intrinsic")
_MODELS = ("distortion_model", "model", "camera_model")
_PINHOLE = (
    "", "none", "pinhole", "plumb_bob", "rational_polynomial", "brown_conrady", "modified_brown_conrady", "radtan",
    "opencv", "opencv_pinhole", "simple_pinhole",
)  # fmt: skip
OWN = (
    "name", "width", "height", "fx", "fy", "cx", "cy", "distortion", "world_to_camera", "camera_to_world",
    "depth_scale",
)  # fmt: skip
# From a camera that looks along -z, y up (OpenGL, ARKit) to one that looks along z, y down.
_TURNED = np.diag([1.0, -1.0, -1.0, 1.0])


def own_entry(given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the entries of a camera under torchreg's names; what no camera needs is left out.

    Known are Open3D's intrinsics and parameters (also those of its Azure Kinect and RealSense recorders), RealSense's
    own, Polycam's, Record3D's and instant-ngp's, ROS's camera_info, and K and D as lists.

    Args:
        given: a JSON or YAML object.
        where: it is from, for messages.

    Raises:
        FormatError: if a lens is of another kind, a matrix is none, or an entry seems to be misspelled.
    """
    given = dict(given)
    inner = given.get("intrinsic", given.get("intrinsics"))
    if isinstance(inner, Mapping):
        given |= inner
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
    if "intrinsic_matrix" in given and isinstance(entry.get("depth_scale"), (int, float)) and entry["depth_scale"] > 1:
        entry["depth_scale"] = 1 / entry["depth_scale"]  # Open3D's recorders write units per metre
    _refuse_misspelled(entry, given, where)
    return entry


def _add_matrix(entry: dict[str, Any], given: Mapping[str, Any], where: str) -> None:
    """Add fx, fy, cx and cy of a matrix, stored rows first or columns first."""
    name = next((name for name in _MATRICES if name in given and not isinstance(given[name], Mapping)), None)
    matrix = next((given[n] for n in _MATRICES if isinstance(given.get(n), Mapping) and "data" in given[n]), None)
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
    lens = entry.get("distortion")
    if isinstance(lens, Mapping):
        lens = lens.get("data", [])
    if lens is None and any(f"k{k}" in given for k in (1, 2, 3)):
        lens = [given.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    if lens is None or isinstance(lens, str):
        return
    numbers = _numbers(lens, "distortion", where).reshape(-1)
    model = next((str(given[name]) for name in _MODELS if isinstance(given.get(name), str)), "")
    check_lens_model(model, numbers, where)
    numbers = numbers[:0] if not numbers.any() else numbers
    entry["distortion"] = (numbers[:8] if not numbers[8:].any() else numbers).tolist()


def check_lens_model(model: str, numbers: Any, where: str) -> None:
    """Raise FormatError if a lens's model gives its numbers, where any is not zero, another meaning than OpenCV's."""
    plain = (
        model.lower().removeprefix("distortion.").removeprefix("rs2_distortion_").replace(" ", "_").replace("-", "_")
    )
    if plain not in _PINHOLE and bool(np.any(np.asarray(numbers))):
        raise FormatError(
            f"{where}: the lens model {model!r} is not a pinhole camera's (plumb_bob, rational_polynomial), so its "
            f"numbers mean something else; undistort the pictures first, and give the camera of those"
        )


def _add_pose(entry: dict[str, Any], given: Mapping[str, Any], where: str) -> None:
    """Add the pose of Polycam's and Open3D's cameras."""
    rows = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
    if all(name in given for row in rows for name in row):
        motion = np.eye(4)
        motion[:3] = _numbers([[given[name] for name in row] for row in rows], "t_00 to t_23", where)
        entry["camera_to_world"] = (motion @ _TURNED).tolist()
    if isinstance(given.get("extrinsic"), Sequence) and len(given["extrinsic"]) == 16:
        entry["world_to_camera"] = _numbers(given["extrinsic"], "extrinsic", where).reshape(4, 4).T.tolist()


def _numbers(values: Any, name: str, where: str) -> Array:
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FormatError(f"{where}: {name} must hold numbers, got {str(values)[:80]}") from error


def _refuse_misspelled(entry: Mapping[str, Any], given: Mapping[str, Any], where: str) -> None:
    known = {*OWN, *_SIZES, *_MATRICES, *_MODELS, *(name for names in _ALIASES.values() for name in names)}
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
