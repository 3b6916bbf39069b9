"""Rotation representations for networks: six numbers or a quaternion of any length, and rotation vectors.

Three numbers cannot parametrize all rotations continuously; six, or four up to a sign, can. Rotation vectors from them
change sign at a half turn, but their rotation is smooth at every angle.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.rotation import SMALL_SQUARED_ANGLE, so3_exp

# Length below which a column or quaternion has no direction.
_LEAST_LENGTH = 1e-12
# Sine of the angle between two columns below which they are collinear.
_LEAST_SINE = 1e-6


def rotation_from_6d(columns: Tensor) -> Tensor:
    """Return the rotation (..., 3, 3) of two columns (..., 6) made orthonormal (Zhou et al. 2019, eq. 15).

    A first column of zero length becomes x, a second one of zero length or along the first the coordinate axis nearest
    to perpendicular; the replaced numbers get no gradient.
    """
    axes = torch.eye(3, dtype=columns.dtype, device=columns.device)
    first, second = columns[..., :3], columns[..., 3:]
    first = _to_unit(torch.where(_length(first) < _LEAST_LENGTH, axes[0], first))
    length = _length(second)
    direction = second / length.clamp_min(_LEAST_LENGTH)
    across = direction - (first * direction).sum(-1, keepdim=True) * first
    undetermined = (length < _LEAST_LENGTH) | (_length(across) < _LEAST_SINE)
    substitute = axes[first.detach().abs().argmin(-1)]
    substitute = substitute - (first * substitute).sum(-1, keepdim=True) * first
    second = _to_unit(torch.where(undetermined, substitute, across))
    # A second time: the difference of nearly collinear columns is mostly rounding.
    second = _to_unit(second - (first * second).sum(-1, keepdim=True) * first)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def rotation_to_6d(rotation: Tensor) -> Tensor:
    """Return the first two columns (..., 6) of rotation matrices (..., 3, 3), see `rotation_from_6d`."""
    return rotation[..., :2].mT.flatten(-2)


def rotation_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return the rotation matrix of a quaternion (w, x, y, z) of any length; zero gives identity and no gradient."""
    w, x, y, z = _normalized_quaternion(quaternion).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def quaternion_from_rotation(rotation: Tensor) -> Tensor:
    """Return the unit quaternion (w, x, y, z), w not negative, of a rotation matrix (Shepperd 1978)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotation.unbind(-2))
    outer = (
        (1 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1 + xx - yy - zz, yx + xy, xz + zx),
        (xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz),
        (yx - xy, xz + zx, zy + yz, 1 - xx - yy + zz),
    )
    table = torch.stack([torch.stack(row, dim=-1) for row in outer], dim=-2)
    largest = table.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    return _positive_scalar(_to_unit(table.gather(-2, index).squeeze(-2)))


def rotation_vector_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return the rotation vector, of an angle of at most pi, of a quaternion (w, x, y, z); zero gives no rotation."""
    unit = _positive_scalar(_normalized_quaternion(quaternion))
    scalar, vector = unit[..., :1], unit[..., 1:]
    square = (vector * vector).sum(-1, keepdim=True)
    small = square < SMALL_SQUARED_ANGLE / 4
    sine = square.masked_fill(small, 1.0).sqrt()
    # Each branch depends on the scalar as atan2 does; atan(t) / t with t = sine / scalar where that is small.
    ratio = (square / scalar.masked_fill(~small, 1.0).square()).masked_fill(~small, 0.0)
    series = (1 - ratio / 3 + ratio * ratio / 5) / scalar.masked_fill(~small, 1.0)
    return 2 * torch.where(small, series, torch.atan2(sine, scalar) / sine) * vector


def quaternion_from_rotation_vector(rotation_vector: Tensor) -> Tensor:
    """Return the unit quaternion (w, x, y, z), w not negative, of rotation vectors (..., 3), radians."""
    return quaternion_from_rotation(so3_exp(rotation_vector))


def rotation_vector_from_rotation(rotation: Tensor) -> Tensor:
    """Return the rotation vector, of an angle of at most pi, of a matrix; unlike `so3_log` smooth at half turns too."""
    return rotation_vector_from_quaternion(quaternion_from_rotation(rotation))


def rotation_vector_from_6d(columns: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3), radians, of six numbers (..., 6), see `rotation_from_6d`."""
    return rotation_vector_from_rotation(rotation_from_6d(columns))


def rotation_vector_to_6d(rotation_vector: Tensor) -> Tensor:
    """Return the six numbers (..., 6) of rotation vectors (..., 3), radians, see `rotation_to_6d`."""
    return rotation_to_6d(so3_exp(rotation_vector))


def _normalized_quaternion(quaternion: Tensor) -> Tensor:
    identity = quaternion.new_tensor([1.0, 0.0, 0.0, 0.0])
    return _to_unit(torch.where(_length(quaternion) < _LEAST_LENGTH, identity, quaternion))


def _positive_scalar(quaternion: Tensor) -> Tensor:
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def _length(vector: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vector.detach(), dim=-1, keepdim=True)


def _to_unit(vector: Tensor) -> Tensor:
    # By the largest entry first, so that the squares of short vectors do not vanish.
    scaled = vector / vector.detach().abs().amax(-1, keepdim=True)
    return scaled * (scaled * scaled).sum(-1, keepdim=True).rsqrt()
