"""The upright direction of points, estimated from how things stand and move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Direction = tuple[float, float, float]

Y_UP: Direction = (0.0, 1.0, 0.0)
Z_UP: Direction = (0.0, 0.0, 1.0)

# Endings of formats whose y axis points up, by their specification or by use.
Y_UP_ENDINGS = (".glb", ".gltf", ".obj")


@dataclass(frozen=True)
class _UprightRule:
    """Evidence of the upright direction."""

    far_share: float = 0.75  # points were measured from the origin if their middle is farther, in diagonals
    tall: float = 1.2  # what stands on y is taller than it is wide and deep by this factor
    steadier: float = 1.5  # factor by which what moves on the ground y = 0 moves less along y than along z
    num_points: int = 2000  # of a frame that are looked at
    ground: float = 0.05  # what stands on the plane at zero ends there, to this share of its height
    sole: float = 0.05  # lowest share of the height of what stands, on which it rests
    more_often: float = 0.15  # share of the frames by which things stand on one axis more often than on another


_RULE = _UprightRule()


def is_before_camera(lower: Tensor, upper: Tensor) -> bool:
    """Return whether points with bounds (3,) lie away from the origin, as if measured by a camera there, along z."""
    middle = (lower + upper) / 2
    ahead = middle[2] > middle[:2].abs().amax()
    return bool(ahead & (middle.norm() > _RULE.far_share * (upper - lower).norm().clamp(min=1e-6)))


def guess_up(frames: Sequence[Tensor]) -> Direction:
    """Return the likely upright direction of points over time, clouds (N_t, 3): one of -y, y and z.

    Before a camera at the origin it is -y. Else that of y and z along which things end at zero, or rest stably, if only
    one does; else y where things are tallest, or move less, along y than along z; otherwise z.
    """
    found = [frame[:: max(1, len(frame) // _RULE.num_points)].detach().double().cpu() for frame in frames]
    found = [points for frame in found if len(points := frame[frame.isfinite().all(-1)])]
    if not found:
        return 0.0, 0.0, 1.0
    lower = torch.stack([points.amin(0) for points in found])
    upper = torch.stack([points.amax(0) for points in found])
    if is_before_camera(lower.amin(0), upper.amax(0)):
        return 0.0, -1.0, 0.0
    extent = (upper - lower).median(0).values
    on_ground = (lower.median(0).values.abs() < _RULE.ground * extent)[1:].tolist()
    if on_ground[0] != on_ground[1]:
        return (0.0, 1.0, 0.0) if on_ground[0] else (0.0, 0.0, 1.0)
    on_y, on_z = (sum(_stands(points, axis) for points in found) for axis in (1, 2))
    if abs(on_y - on_z) > _RULE.more_often * len(found):
        return (0.0, 1.0, 0.0) if on_y > on_z else (0.0, 0.0, 1.0)
    width, height, depth = extent.tolist()
    if height > _RULE.tall * max(width, depth) or _is_steadier(found, lower):
        return 0.0, 1.0, 0.0
    return 0.0, 0.0, 1.0


def to_y_up(up: Direction) -> Tensor:
    """Return the rotation (4, 4), float64, that takes an axis to +y, as glTF wants it, about x unless it is along x."""
    length = sum(value * value for value in up) ** 0.5
    x, y, z = (value / length for value in up)
    turn = torch.eye(4, dtype=torch.float64)
    if abs(x) > 0.5:
        sign = 1.0 if x > 0 else -1.0
        turn[:2, :2] = torch.tensor([[0.0, -sign], [sign, 0.0]])
    else:
        turn[1:3, 1:3] = torch.tensor([[y, z], [-z, y]])
    return turn


def _stands(points: Tensor, axis: int) -> bool:
    """Return whether points (N, 3) would not fall over: their middle is above their lowest ones along an axis."""
    height = points[:, axis] - points[:, axis].amin()
    sole = points[height <= _RULE.sole * height.amax()]
    aside = [other for other in range(3) if other != axis]
    middle = points.mean(0)[aside]
    return bool(((middle >= sole[:, aside].amin(0)) & (middle <= sole[:, aside].amax(0))).all())


def _is_steadier(frames: Sequence[Tensor], lower: Tensor) -> bool:
    """Return whether the lowest points (T, 3) and the middles of frames move less along y than along z."""
    if len(frames) < 3:
        return False
    middle = torch.stack([points.mean(0) for points in frames])
    motion = lower.std(0) * middle.std(0)
    return bool(_RULE.steadier * motion[1] < motion[2])


def from_front(up: Tensor, points: Tensor) -> Tensor:
    """Return the direction (3,) to a camera in front of upright points (N, 3), the higher the flatter they lie."""
    along_z = -1.0 if float(up[1]) < 0 else 1.0  # a camera's y points down, and it looks along z
    front = up.new_tensor([0.0, -1.0, 0.0] if abs(float(up[2])) > 0.5 else [0.0, 0.0, along_z])
    level = torch.nn.functional.normalize(0.6 * torch.linalg.cross(up, front) + front, dim=0)
    height, width = (float((points.to(up) @ axis).std(correction=0)) for axis in (up, torch.linalg.cross(up, level)))
    sine = min(max(0.4, 0.9 - height / max(width, 1e-9)), 0.8)  # of the elevation: 24 to 53 degrees
    return math.sqrt(1 - sine**2) * level + sine * up
