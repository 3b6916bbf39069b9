"""What a calibration of a robot's base is given: clouds in camera coordinates, and the joints of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_shape
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.free_space import FreeSpace
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.camera import Camera
from torchreg.geometry.loaded import as_points
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import BASE_DOFS


@dataclass(frozen=True)
class _Given:
    """Numbers of the checks of frames and joints."""

    beyond: float = math.radians(3)  # limits: encoders and descriptions differ by so much
    beyond_shift: float = 0.01  # the same of joints that slide, metres
    turn: float = 2 * math.pi  # angles beyond which numbers may be degrees
    turns: float = 4 * math.pi  # of a joint without limits: larger angles seem to be degrees


_GIVEN = _Given()


@dataclass(frozen=True, eq=False)
class BaseFrame:
    """Points (M, 3) in camera coordinates, metres, joints (J,), and a depth picture and its free space, if any."""

    points: Tensor
    joints: Tensor
    free_space: FreeSpace | None = None
    picture: DepthFrame | None = None

    @classmethod
    def of_picture(cls, frame: DepthFrame, joints: Tensor) -> BaseFrame:
        """Return a frame with the points that count in a picture, and the free space outside of its mask, if any."""
        given, depth = frame.camera, frame.depth.cpu()
        camera = Camera(given.width, given.height, given.intrinsics, distortion=given.distortion)
        mask = None if frame.mask is None else frame.mask.cpu()
        picture = DepthFrame(depth, camera, mask, max_points=frame.max_points)
        found = cls(picture.points.double(), joints, picture=picture)
        return found if mask is None else found._with_space(picture, mask)

    @property
    def is_whole(self) -> bool:
        """Whether it is a picture all of whose pixels count."""
        return self.picture is not None and self.picture.mask is None

    def showing(self, picture: DepthFrame, pixels: Tensor) -> BaseFrame:
        """Return the frame with some pixels (H, W) of a picture alone, free beside them and pixels without depth."""
        shown = picture.cropped(pixels)
        return replace(self, points=shown.points.double())._with_space(shown, pixels | ~picture.measured)

    def _with_space(self, picture: DepthFrame, mask: Tensor) -> BaseFrame:
        """Return the frame with the space outside of a mask (H, W), before what was measured there.

        Inside data pull the surface already; their noise would push it away.
        """
        depth = torch.where(mask, 0.0, picture.depth)
        space = FreeSpace.of_picture(depth.double(), picture.camera, mask, picture.stride)
        return replace(self, picture=picture, free_space=space)

    def where(self, kept: Tensor) -> BaseFrame:
        """Return the frame with some of its points (M,) alone."""
        return replace(self, points=self.points[kept])

    def thinned(self, count: int) -> BaseFrame:
        """Return the frame with ``count`` of its points at most."""
        kept = _spread(self.points, count)
        space = self.free_space
        if space is not None:
            space = space.thinned(torch.tensor([len(self.points) / len(kept)]))
        return replace(self, points=kept, free_space=space)


def carrier(shape: Articulation, joints: Tensor, part: int | None) -> Tensor:
    """Return ``T_base_link`` (T, 4, 4), float64, of the part that carries the camera; None for a camera beside it."""
    if part is None:
        return torch.eye(4, dtype=torch.float64).expand(len(joints), 4, 4)
    pose = torch.nn.functional.pad(joints, (BASE_DOFS, 0)).to(shape.rest)
    return shape.part_transforms(pose)[:, part].cpu().double()


def _spread(points: Tensor, count: int) -> Tensor:
    """Return at most ``count`` of points (M, 3), evenly in their order."""
    if len(points) <= count:
        return points
    return points[torch.linspace(0, len(points) - 1, count, dtype=torch.float64).round().long()]


def read_frames(shape: Articulation, frames: Any, poses: Any) -> list[BaseFrame]:
    """Return the checked frames of a calibration from T clouds (M, 3) or depth frames and their joints."""
    given = list(frames) if isinstance(frames, (Sequence, Tensor)) else [frames]
    if not given:
        raise InputError("frames must hold at least one cloud or depth frame, got none")
    joints = read_joints(shape, poses, len(given))
    return [_read_frame(frame, row, number) for number, (frame, row) in enumerate(zip(given, joints, strict=True))]


def _read_frame(frame: Any, joints: Tensor, number: int) -> BaseFrame:
    name = f"frames[{number}]"
    if isinstance(frame, DepthFrame):
        return BaseFrame.of_picture(frame, joints)
    points = as_float_tensor(as_points(frame), name).detach().cpu().double()
    check_shape(points, name, ("M", 3))
    points = points[points.isfinite().all(-1)]
    if len(points) == 0:
        raise InputError(f"{name} must hold at least one finite point, got none; leave the frame out")
    # Clouds may be sorted by anything.
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    return BaseFrame(points[order], joints)


def read_joints(shape: Articulation, poses: Any, count: int) -> Tensor:
    """Return the joints (T, J), float64, within limits, of (T, J), (T, num_dofs) or T dictionaries by name."""
    names = shape.dof_names[BASE_DOFS:]
    if isinstance(poses, Sequence) and poses and isinstance(poses[0], Mapping):
        rows = torch.tensor([_by_name(row, names, number) for number, row in enumerate(poses)], dtype=torch.float64)
    else:
        rows = _stacked(poses)
    if rows.ndim != 2 or rows.shape[1] not in (len(names), shape.num_dofs):
        raise InputError(
            f"poses must have shape ({count}, {len(names)}), the joints {', '.join(names[:4])}, ... of each frame, or "
            f"({count}, {shape.num_dofs}) with the base before them; got {tuple(rows.shape)}"
        )
    if len(rows) != count:
        raise InputError(f"poses must hold one row per frame, {count}, got {len(rows)}")
    joints = rows[:, -len(names) :] if names else rows[:, :0]
    if not bool(joints.isfinite().all()):
        number, dof = (~joints.isfinite()).nonzero()[0].tolist()
        raise InputError(f"poses[{number}] holds no finite number for joint {names[dof]!r}")
    _check_limits(shape, joints)
    return joints


def _stacked(poses: Any) -> Tensor:
    """Return rows of numbers, of any floating-point or integer type, as one tensor in float64."""
    try:
        rows = poses if isinstance(poses, Tensor) else [torch.as_tensor(row) for row in poses]
        rows = rows if isinstance(rows, Tensor) else torch.stack([row.double() for row in rows])
        return rows.detach().cpu().double()
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputTypeError(
            f"poses must be numbers (T, joints), or a dictionary by name of joint for each frame; {error}"
        ) from error


def _by_name(row: Any, names: Sequence[str], number: int) -> list[float]:
    if not isinstance(row, Mapping):
        raise InputTypeError(f"poses[{number}] must be a dictionary by name of joint, as poses[0] is")
    lacking = [name for name in names if name not in row]
    if lacking:
        raise InputError(
            f"poses[{number}] lacks joint {lacking[0]!r}; the robot's joints are {', '.join(names)}, and the names "
            f"given {', '.join(list(map(str, row))[:8])}"
        )
    return [float(row[name]) for name in names]


def _check_limits(shape: Articulation, joints: Tensor) -> None:
    """Raise InputError if a joint lies beyond its limits, and say so where degrees fit."""
    lower, upper = (limit[BASE_DOFS:].cpu().double() for limit in (shape.lower, shape.upper))
    slides = shape.is_sliding[BASE_DOFS:].cpu()
    open_ended = ~slides & ~(lower.isfinite() & upper.isfinite())
    lower, upper = lower.clamp_min(-math.inf), upper.clamp_max(math.inf)
    lower = torch.where(open_ended, -_GIVEN.turns, lower)
    upper = torch.where(open_ended, _GIVEN.turns, upper)
    slack = torch.where(slides, _GIVEN.beyond_shift, _GIVEN.beyond)
    bad = (joints < lower - slack) | (joints > upper + slack)
    if not bool(bad.any()):
        return
    number, dof = bad.nonzero()[0].tolist()
    turned = torch.where(slides, joints, joints.deg2rad())
    large = (bad & ~slides & (joints.abs() > _GIVEN.turn)).any()
    degrees = bool(large) and not bool(((turned < lower - slack) | (turned > upper + slack)).any())
    hint = "as degrees all would fit: convert them with torch.deg2rad" if degrees else "check units and order of joints"
    raise InputError(
        f"poses[{number}] has joint {shape.dof_names[BASE_DOFS + dof]!r} at {float(joints[number, dof]):.4g}, beyond "
        f"its limits {float(lower[dof]):.4g} to {float(upper[dof]):.4g}; {hint}"
    )
