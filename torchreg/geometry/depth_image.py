"""Depth images as surfaces: pixels become points, and neighboring pixels of a surface are joined by triangles."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.errors import InputError

# Largest difference in depth of joined pixels, in allowed jumps: steeper surfaces are cut even where they continue.
_STEEPEST = 4.0


def unproject(depth: Tensor, intrinsics: tuple[float, float, float, float], max_jump: float) -> tuple[Tensor, Tensor]:
    """Return the points (N, 3) and triangles (F, 3) of a depth image (H, W), in camera coordinates.

    Axes are right, down, forward; triangles are wound towards the camera. `RangeScan.from_depth` says which pixels
    join: ``max_jump`` is the allowed difference from a continued surface, in pixel widths.
    """
    focal_x, focal_y, center_x, center_y = intrinsics
    depth = torch.where(depth.isfinite() & (depth > 0), depth, torch.nan)
    across = _continues(depth, focal_x, max_jump)
    down = _continues(depth.mT, focal_y, max_jump).mT
    faces = _pixel_triangles(depth, across, down)
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


def _continues(depth: Tensor, focal: float, max_jump: float) -> Tensor:
    """Return a mask (H, W - 1) of the pixels whose surface continues to the next in their row; NaN depths never do."""
    step = depth[:, 1:] - depth[:, :-1]
    unknown = torch.full_like(depth[:, :1], torch.nan)
    curvature = (step[:, 1:] - step[:, :-1]).abs()
    width = torch.minimum(depth[:, 1:], depth[:, :-1]) / focal
    relative = (curvature / width[:, 1:]).reshape(-1)
    relative = relative[relative.isfinite()]
    noise = float(relative.median()) if len(relative) else 0.0
    unit = width * max(1.0, noise)
    # Predictions: the surface on either side, continued, or a level one, the only prediction at its rim.
    before, after = torch.cat((unknown, step), dim=1)[:, : step.shape[1]], torch.cat((step, unknown), dim=1)[:, 1:]
    residuals = torch.stack((step, step - before, step - after)).abs().nan_to_num(torch.inf).amin(dim=0)
    return (residuals <= max_jump * unit) & (step.abs() <= _STEEPEST * max_jump * unit)


def _pixel_triangles(depth: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Return triangles (F, 3) of flat pixel indices; four pixels are split along the diagonal with more, or flatter."""
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
