"""Depth images as surfaces: pixels become points, and neighbors on one surface become triangles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.errors import InputError, InputTypeError

# A surface this many times steeper than the jump that is allowed is cut in any case.
_STEEPEST = 4.0


def unproject(depth: Tensor, intrinsics: Sequence[float], max_jump: float) -> tuple[Tensor, Tensor]:
    """Return the points (N, 3) and triangles (F, 3) of a depth image in camera coordinates: right, down, forward.

    Triangles are wound towards the camera; pixels without one are left out. For the rule that joins pixels see
    `RangeScan.from_depth`.

    Args:
        depth: (H, W) along the axis of the camera; zero, negative or not finite where nothing was measured.
        intrinsics: fx, fy, cx, cy in pixels.
        max_jump: allowed difference from a continued surface, in pixel widths.

    Raises:
        InputError: if a size or number does not fit, or no three pixels join.
    """
    check_shape(depth, "depth", ("H", "W"))
    focal_x, focal_y, center_x, center_y = _check_intrinsics(intrinsics)
    depth = torch.where(depth.isfinite() & (depth > 0), depth, torch.nan)
    across = _joined(depth, focal_x, max_jump)
    down = _joined(depth.mT, focal_y, max_jump).mT
    faces = _triangles(depth, across, down)
    if len(faces) == 0:
        valid = int(depth.isfinite().sum())
        raise InputError(
            f"depth must hold neighboring pixels of one surface, got {valid} of {depth.numel()} pixels measured and "
            f"none joined; check the unit of the intrinsics (pixels), or pass a larger max_jump"
        )
    row = torch.arange(depth.shape[0], device=depth.device, dtype=depth.dtype)[:, None]
    column = torch.arange(depth.shape[1], device=depth.device, dtype=depth.dtype)
    points = torch.stack(((column - center_x) * depth / focal_x, (row - center_y) * depth / focal_y, depth), dim=-1)
    used, faces = faces.unique(return_inverse=True)
    return points.reshape(-1, 3)[used], faces


def _check_intrinsics(intrinsics: Sequence[float]) -> tuple[float, float, float, float]:
    try:
        focal_x, focal_y, center_x, center_y = (float(value) for value in intrinsics)
    except (TypeError, ValueError) as error:
        raise InputTypeError(f"intrinsics must be the four numbers fx, fy, cx, cy, got {intrinsics!r}") from error
    check_positive(focal_x, "intrinsics[0] (fx)")
    check_positive(focal_y, "intrinsics[1] (fy)")
    if not math.isfinite(center_x) or not math.isfinite(center_y):
        raise InputError(f"intrinsics must be finite, got cx {center_x} and cy {center_y}")
    return focal_x, focal_y, center_x, center_y


def _joined(depth: Tensor, focal: float, max_jump: float) -> Tensor:
    """Return which pixels are on one surface with the next in their row, (H, W - 1) bool; NaN depths never are."""
    step = depth[:, 1:] - depth[:, :-1]
    gap = torch.full_like(depth[:, :1], torch.nan)
    bend = (step[:, 1:] - step[:, :-1]).abs()
    width = torch.minimum(depth[:, 1:], depth[:, :-1]) / focal
    relative = (bend / width[:, 1:]).reshape(-1)
    relative = relative[relative.isfinite()]
    noise = float(relative.median()) if len(relative) else 0.0
    unit = width * max(1.0, noise)
    # The surface on either side, continued; or a level one, which is all there is to go by at its rim.
    before, after = torch.cat((gap, step), dim=1)[:, : step.shape[1]], torch.cat((step, gap), dim=1)[:, 1:]
    misses = torch.stack((step, step - before, step - after)).abs().nan_to_num(torch.inf).amin(dim=0)
    return (misses <= max_jump * unit) & (step.abs() <= _STEEPEST * max_jump * unit)


def _triangles(depth: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Return (F, 3) flat pixel indices; of two ways to split four pixels the one with more triangles, or flatter."""
    height, width = depth.shape
    top, bottom, left, right = across[:-1], across[1:], down[:, :-1], down[:, 1:]
    upper_left, upper_right = depth[:-1, :-1], depth[:-1, 1:]
    lower_left, lower_right = depth[1:, :-1], depth[1:, 1:]
    falling = (left & bottom).int() + (top & right).int()
    rising = (left & top).int() + (bottom & right).int()
    flatter = (upper_left - lower_right).abs() <= (upper_right - lower_left).abs()
    falls = (falling > rising) | ((falling == rising) & (flatter | upper_right.isnan() | lower_left.isnan()))
    number = torch.arange(height * width, device=depth.device).reshape(height, width)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    parts = (
        (falls & left & bottom, (a, c, d)),
        (falls & top & right, (a, d, b)),
        (~falls & left & top, (a, c, b)),
        (~falls & bottom & right, (b, c, d)),
    )
    return torch.cat([torch.stack([corner[mask] for corner in corners], dim=-1) for mask, corners in parts])
