"""Fitting a solid to points on a surface: closed forms in the principal frame, then the least mean distance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.primitives import PRIMITIVE_KINDS, Candidate
from torchreg.geometry.rigid import rigid_matrix

# Second principal spread, as a share of the first, up to which points lie on a line.
_LINE_SHARE = 1e-6


@dataclass(frozen=True)
class FittedPrimitive:
    """A solid fitted to points: its pose (4, 4) and the mean absolute distance of the points, metres."""

    kind: str
    sizes: tuple[float, ...]
    pose: Tensor
    error: float


def fit_primitive(points: Tensor, kind: str = "auto") -> FittedPrimitive:
    """Return the solid of least mean distance to surface points, metres, each principal axis tried as the long one."""
    points = points.detach().double()
    kinds = (kind,) if kind != "auto" else ("ellipsoid",) if _has_no_shape(points) else tuple(PRIMITIVE_KINDS)
    fits = [
        _with_error(points, name, candidate)
        for name in kinds
        for frame in _principal_frames(points)
        for candidate in PRIMITIVE_KINDS[name].candidates(points, frame)
    ]
    return min(fits, key=lambda fit: fit.error)


def _has_no_shape(points: Tensor) -> bool:
    """Return whether the points are too few or on a line."""
    if len(points) < 4:
        return True
    spreads = torch.linalg.svdvals(points - points.mean(0))
    return bool(spreads[1] <= _LINE_SHARE * spreads[0])


def _with_error(points: Tensor, kind: str, candidate: Candidate) -> FittedPrimitive:
    sizes, frame = candidate
    local = (points - frame[:3, 3]) @ frame[:3, :3]
    row = torch.tensor(sizes, dtype=points.dtype)
    error = float(PRIMITIVE_KINDS[kind].distance(local, row).abs().mean())
    return FittedPrimitive(kind, tuple(row.tolist()), frame, error)


def _principal_frames(points: Tensor) -> list[Tensor]:
    """Return three frames at the center of the points' bounding box, each principal axis once as z."""
    centered = points - points.mean(0)
    _, vectors = torch.linalg.eigh(centered.mT @ centered)
    frames = []
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        rotation = vectors[:, order]
        rotation = rotation * torch.det(rotation).sign()
        local = points @ rotation
        frames.append(rigid_matrix(rotation, rotation @ ((local.amin(0) + local.amax(0)) / 2)))
    return frames
