"""Fitting a solid to points on a surface: closed forms in the principal frame, then a choice by mean distance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_points
from torchreg.geometry.primitives import PRIMITIVE_KINDS
from torchreg.geometry.rigid import rigid_matrix

# Below this share of the largest spread, the second principal spread says that the points lie on a line.
_LINE_SHARE = 1e-6
# A tube open at both ends says little about its length: an ellipsoid may reach this far beyond the points.
_MAX_OVERSHOOT = 1.4


@dataclass(frozen=True)
class FittedPrimitive:
    """A solid fitted to points.

    Args:
        kind: name of the kind.
        sizes: its sizes, metres.
        pose: (4, 4) frame of the solid in the points' coordinates.
        error: mean absolute distance of the points, metres.
    """

    kind: str
    sizes: tuple[float, ...]
    pose: Tensor
    error: float


def fit_primitive(points: Tensor, kind: str = "auto") -> FittedPrimitive:
    """Return the solid that lies nearest to surface points.

    The solid's axes are the principal axes of the points; each axis is tried as the long one.

    Args:
        points: (N, 3), metres; at least one.
        kind: a kind's name, or "auto" for the kind with the smallest mean distance.

    Returns:
        the best `FittedPrimitive`, in float64. With "auto", fewer than four points, or points on a line, say nothing
        about the kind and give a thin ellipsoid around them.

    Raises:
        InputError: if ``points`` is empty or not finite, or ``kind`` is unknown.

    Differentiable: no.
    """
    check_choice(kind, "kind", ("auto", *PRIMITIVE_KINDS))
    check_points(points, "points", batch=False)
    points = points.detach().double()
    kinds = (kind,) if kind != "auto" else ("ellipsoid",) if _shapeless(points) else tuple(PRIMITIVE_KINDS)
    candidates = [
        (name, sizes, moved)
        for name in kinds
        for frame in _principal_frames(points)
        for sizes, moved in _SIZES[name](points, frame)
    ]
    fits = [_evaluate(points, name, frame, sizes) for name, sizes, frame in candidates]
    return min(fits, key=lambda fit: fit.error)


def _shapeless(points: Tensor) -> bool:
    """Return whether the points are too few or on a line."""
    if len(points) < 4:
        return True
    spreads = torch.linalg.svdvals(points - points.mean(0))
    return bool(spreads[1] <= _LINE_SHARE * spreads[0])


def _evaluate(points: Tensor, kind: str, frame: Tensor, sizes: Sequence[float]) -> FittedPrimitive:
    local = (points - frame[:3, 3]) @ frame[:3, :3]
    row = torch.tensor(list(sizes), dtype=points.dtype)
    error = float(PRIMITIVE_KINDS[kind].distance(local, row).abs().mean())
    return FittedPrimitive(kind, tuple(float(size) for size in row), frame, error)


def _principal_frames(points: Tensor) -> list[Tensor]:
    """Return three frames at the middle of the points' bounding box, each principal axis once as z."""
    centered = points - points.mean(0)
    _, vectors = torch.linalg.eigh(centered.mT @ centered)
    frames = []
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        rotation = vectors[:, order]
        rotation = rotation * torch.det(rotation).sign()
        local = points @ rotation
        middle = rotation @ ((local.amin(0) + local.amax(0)) / 2)
        frames.append(rigid_matrix(rotation, middle))
    return frames


def _half_extents(points: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
    local = (points - frame[:3, 3]) @ frame[:3, :3]
    half = (local.amax(0) - local.amin(0)) / 2
    return local, half.clamp_min(float(half.max()) * 1e-2).clamp_min(1e-6)


def _moved(frame: Tensor, center: Tensor) -> Tensor:
    return rigid_matrix(frame[:3, :3], frame[:3, 3] + frame[:3, :3] @ center)


def _ellipsoid_sizes(points: Tensor, frame: Tensor) -> list[tuple[list[float], Tensor]]:
    """Return the box's ellipsoid and the algebraic least-squares ellipsoid with the frame's axes."""
    local, half = _half_extents(points, frame)
    candidates = [(half.tolist(), frame)]
    if len(points) < 10:
        return candidates
    scaled = local / half
    design = torch.cat([scaled.square(), scaled], dim=-1)
    solution = torch.linalg.lstsq(design, torch.ones(len(points), 1, dtype=points.dtype), driver="gelsd").solution[:, 0]
    curvature = solution[:3].clamp_min(_MAX_OVERSHOOT**-2)
    center = (-0.5 * solution[3:] / curvature).clamp(-0.5, 0.5)
    level = 1 + (curvature * center.square()).sum()
    radii = (level / curvature).sqrt().clamp(0.5, _MAX_OVERSHOOT)
    candidates.append(((radii * half).tolist(), _moved(frame, center * half)))
    return candidates


def _capsule_sizes(points: Tensor, frame: Tensor) -> list[tuple[list[float], Tensor]]:
    local, half = _half_extents(points, frame)
    radius = float(local[:, :2].norm(dim=-1).quantile(0.7).clamp_min(1e-6))
    return [([max(float(half[2]) - radius, 1e-3 * radius), radius], frame)]


def _cone_sizes(points: Tensor, frame: Tensor) -> list[tuple[list[float], Tensor]]:
    """Return cones whose mantle is the regression of the radius on the height, over the points off the ends."""
    local, half = _half_extents(points, frame)
    side = local[:, 2].abs() < 0.95 * half[2]
    side = side if int(side.sum()) >= 4 else torch.ones_like(side)
    height, radial = local[side, 2], local[side, :2].norm(dim=-1)
    spread = (height - height.mean()).square().mean()
    slope = ((height - height.mean()) * radial).mean() / spread.clamp_min(1e-12)
    middle = radial.mean() - slope * height.mean()
    ends = torch.stack([middle - slope * half[2], middle + slope * half[2]]).clamp_min(1e-2 * float(half[:2].max()))
    return [([float(half[2]), *ends.tolist()], frame)]


def _superquadric_sizes(points: Tensor, frame: Tensor) -> list[tuple[list[float], Tensor]]:
    _, half = _half_extents(points, frame)
    return [([*half.tolist(), e1, e2], frame) for e1 in (0.2, 0.5, 1.0) for e2 in (0.2, 0.5, 1.0)]


_SIZES: dict[str, Callable[[Tensor, Tensor], list[tuple[list[float], Tensor]]]] = {
    "ellipsoid": _ellipsoid_sizes,
    "capsule": _capsule_sizes,
    "cone": _cone_sizes,
    "superquadric": _superquadric_sizes,
}
