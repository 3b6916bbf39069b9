"""Pictures of measurements: disparity, points and outlines over the picture, filtered depth, covered masks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchreg.capture.stereo_frames import StereoFrames
from torchreg.datasets.hand import faces_of
from torchreg.errors import FormatError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import rasterize
from torchreg.io.images import save_image
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.results import FrameResult
from torchreg.viz.bone_colors import scale_colors

# From far to near: dark blue, blue, green, yellow, orange.
_DEPTH_COLORS = ((0.19, 0.07, 0.23), (0.15, 0.43, 0.84), (0.11, 0.79, 0.62), (0.86, 0.89, 0.21), (0.98, 0.42, 0.13))


@dataclass(frozen=True)
class _OverlayStyle:
    """Colors drawn on pictures."""

    inlier: tuple[float, float, float] = (0.10, 0.65, 1.0)
    outlier: tuple[float, float, float] = (1.0, 0.25, 0.15)
    outline: tuple[float, float, float] = (0.2, 1.0, 0.3)
    covered: tuple[float, float, float] = (0.9, 0.9, 0.9)
    contrast: float = 0.6  # of the picture under it, the rest white


_OVERLAY = _OverlayStyle()


def depth_colors(values: Tensor, lowest: float, highest: float) -> Tensor:
    """Return colors (..., 3) of values (...), dark blue at the lowest, orange at the highest, black where NaN."""
    share = ((values.float() - lowest) / (highest - lowest)).clamp(0, 1).nan_to_num(0.0)
    colors = scale_colors(share, _DEPTH_COLORS)
    return torch.where(values.isnan().unsqueeze(-1), torch.zeros_like(colors), colors)


def picture_with_points(
    image: Tensor, pixels: Tensor, inliers: Tensor, outline: Tensor | None = None, *, radius: int = 1
) -> Tensor:
    """Return a faded picture (H, W, 3) with points at pixels (N, 2), inliers blue, others red; outline green."""
    drawn = image.unsqueeze(-1).expand(*image.shape, 3) if image.ndim == 2 else image
    drawn = 1 - _OVERLAY.contrast * (1 - drawn.float())
    if outline is not None:
        drawn = torch.where(outline.unsqueeze(-1), drawn.new_tensor(_OVERLAY.outline), drawn)
    step = torch.arange(-radius, radius + 1, device=pixels.device)
    square = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1).reshape(-1, 2)
    known = pixels.isfinite().all(-1)
    # Inliers are drawn last, over the others.
    order = inliers[known].int().argsort()
    covered = pixels[known][order].round().long()[:, None] + square
    inlier, outlier = drawn.new_tensor(_OVERLAY.inlier), drawn.new_tensor(_OVERLAY.outlier)
    colors = torch.where(inliers[known][order, None], inlier, outlier)
    column, row = covered.reshape(-1, 2).unbind(-1)
    inside = (column >= 0) & (column < drawn.shape[1]) & (row >= 0) & (row < drawn.shape[0])
    drawn = drawn.clone()
    drawn[row[inside], column[inside]] = colors.repeat_interleave(len(square), 0)[inside]
    return drawn


def model_mask(mesh: TriangleMesh, camera: Camera) -> Tensor:
    """Return the mask (H, W) of a mesh in a camera's picture; empty if a part of it is not in front of the camera."""
    if bool((camera.project(mesh.vertices)[1] <= 0).any()):
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    focal, center = camera.intrinsics.split(2)
    square = focal.mean().expand(2)
    plain = Camera(camera.width, camera.height, torch.cat((square, center)), camera.world_to_camera)
    mask = rasterize(mesh, plain.view()).face_index >= 0
    if not camera.is_distorted and bool((focal == square).all()):
        return mask
    plane = camera.undistorted((camera.pixel_grid() - center) / focal)
    pixels = plane * square + center
    column, row = pixels.nan_to_num(0.0).round().long().unbind(-1)
    return mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)] & plain.contains(pixels)


def mask_outline(mask: Tensor) -> Tensor:
    """Return the pixels (H, W) of a mask with a neighbor outside of it."""
    grown = torch.nn.functional.max_pool2d((~mask)[None, None].float(), 3, 1, 1)[0, 0] > 0
    return mask & grown


def cut_picture(depth: Tensor, kept: Tensor) -> Tensor:
    """Return a depth image in color (H, W, 3): by depth where kept, red where filtered, black where it is zero."""
    known = depth > 0
    seen = torch.where(kept & known, -depth, torch.nan)
    values = seen[kept & known]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    colors = depth_colors(seen, low, max(high, low + 1e-6))
    return torch.where((known & ~kept).unsqueeze(-1), colors.new_tensor(_OVERLAY.outlier), colors)


def hull_picture(mask: Tensor, hull: Tensor) -> Tensor:
    """Return a picture (H, W, 3) of a mask and its hull: white in both, red in the mask, blue in the hull alone."""
    colors, style = torch.zeros(*mask.shape, 3), _OVERLAY
    for region, color in ((mask & hull, style.covered), (mask & ~hull, style.outlier), (hull & ~mask, style.inlier)):
        colors[region] = colors.new_tensor(color)
    return colors


def hull_sheet(masks: Sequence[Tensor], cameras: CameraRig, mesh: TriangleMesh, width: int = 240) -> Tensor:
    """Return the `hull_picture` of every camera side by side in rows (H, W, 3), each about ``width`` pixels wide."""
    pictures = []
    for mask, camera in zip(masks, cameras, strict=True):
        step = max(1, camera.width // width)
        small = camera.scaled(1 / step)
        rows, columns = (torch.arange(side) * step + step // 2 for side in (small.height, small.width))
        kept = mask[rows.clamp(max=mask.shape[0] - 1)][:, columns.clamp(max=mask.shape[1] - 1)]
        picture = hull_picture(kept, model_mask(mesh, small))
        pictures.append(torch.nn.functional.pad(picture.movedim(-1, 0), (1, 1, 1, 1), value=0.3))
    across = math.ceil(len(pictures) ** 0.5)
    high, wide = (max(picture.shape[side] for picture in pictures) for side in (1, 2))
    sheet = torch.zeros(3, high * math.ceil(len(pictures) / across), wide * across)
    for number, picture in enumerate(pictures):
        row, column = high * (number // across), wide * (number % across)
        sheet[:, row : row + picture.shape[1], column : column + picture.shape[2]] = picture
    return sheet.movedim(0, -1)


class StereoPictures:
    """Writes two pictures of every tracked frame: disparity, and points, inliers blue, with the shape's outline."""

    def __init__(self, frames: StereoFrames, skin: LinearBlendSkin, folder: Path) -> None:
        self._frames, self._skin, self._faces, self._folder = frames, skin, faces_of(skin), folder

    def __call__(self, points: Tensor, frame: FrameResult) -> None:
        """Draw a frame, unless it could not be read."""
        try:
            sight = self._frames.sight(frame.frame)
        except (FormatError, OSError):
            return
        config, pair, found = self._frames.config, sight.pair, sight.points
        near = float(pair.disparity(torch.tensor(config.nearest)))
        save_image(self._folder / f"disparity_{frame.frame:04d}.png", depth_colors(found.dense, 0.0, near))
        outline = None
        if frame.statuses[0].usable and bool(frame.pose.isfinite().all()):
            with torch.no_grad():
                mesh = TriangleMesh(self._skin(frame.pose), self._faces)
            outline = mask_outline(model_mask(mesh, pair.left))
        drawn = picture_with_points(sight.left, found.pixels, frame.inliers.cpu(), outline)
        save_image(self._folder / f"frame_{frame.frame:04d}.png", drawn)
