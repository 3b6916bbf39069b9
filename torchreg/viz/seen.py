"""Pictures of what cameras saw: disparity, inliers over the picture, outlines of the model, what filters cut."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import check_shape
from torchreg.capture.stereo_frames import StereoFrames
from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import rasterize
from torchreg.io.images import save_image
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.results import FrameResult

# From far to near.
_RAMP = ((0.19, 0.07, 0.23), (0.15, 0.43, 0.84), (0.11, 0.79, 0.62), (0.86, 0.89, 0.21), (0.98, 0.42, 0.13))
_INLIER, _OUTLIER, _OUTLINE = (0.10, 0.65, 1.0), (1.0, 0.25, 0.15), (0.2, 1.0, 0.3)
_FADED = 0.6


def ramp_colors(values: Tensor, lowest: float, highest: float) -> Tensor:
    """Return colors (..., 3) of values (...,), dark blue at the lowest, orange at the highest, black where NaN."""
    if not highest > lowest:
        raise InputError(f"highest must be above lowest, got {highest} and {lowest}")
    ramp = torch.tensor(_RAMP, device=values.device)
    place = ((values.float() - lowest) / (highest - lowest)).clamp(0, 1).nan_to_num(0.0) * (len(ramp) - 1)
    below = place.floor().long().clamp(max=len(ramp) - 2)
    share = (place - below).unsqueeze(-1)
    colors = ramp[below] * (1 - share) + ramp[below + 1] * share
    return torch.where(values.isnan().unsqueeze(-1), torch.zeros_like(colors), colors)


def picture_with_points(
    image: Tensor, pixels: Tensor, inliers: Tensor, outline: Tensor | None = None, *, radius: int = 1
) -> Tensor:
    """Return a faded picture (H, W, 3) with points on it, blue inliers and red others, and an outline in green.

    Args:
        image: (H, W) or (H, W, 3) from 0 to 1.
        pixels: (N, 2) as (column, row); those beside the picture and NaN are left out.
        inliers: (N,) bool.
        outline: (H, W) bool, see `model_outline`.
        radius: of a point, pixels.

    Raises:
        InputError: if sizes do not fit.
    """
    drawn = image.unsqueeze(-1).expand(*image.shape, 3) if image.ndim == 2 else image
    check_shape(drawn, "image", ("H", "W", 3))
    check_shape(pixels, "pixels", ("N", 2))
    check_shape(inliers, "inliers", (len(pixels),))
    drawn = 1 - _FADED * (1 - drawn.float())
    if outline is not None:
        check_shape(outline, "outline", tuple(drawn.shape[:2]))
        drawn = torch.where(outline.unsqueeze(-1), drawn.new_tensor(_OUTLINE), drawn)
    step = torch.arange(-radius, radius + 1, device=pixels.device)
    square = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1).reshape(-1, 2)
    known = pixels.isfinite().all(-1)
    # Inliers last, so that nothing hides them.
    order = inliers[known].int().argsort()
    places = pixels[known][order].round().long()[:, None] + square
    colors = torch.where(inliers[known][order, None], drawn.new_tensor(_INLIER), drawn.new_tensor(_OUTLIER))
    column, row = places.reshape(-1, 2).unbind(-1)
    inside = (column >= 0) & (column < drawn.shape[1]) & (row >= 0) & (row < drawn.shape[0])
    drawn = drawn.clone()
    drawn[row[inside], column[inside]] = colors.repeat_interleave(len(square), 0)[inside]
    return drawn


def model_mask(mesh: TriangleMesh, camera: Camera) -> Tensor:
    """Return which pixels (H, W) of a camera show a mesh; none if a part of it lies beside or behind the camera.

    What a lens bends into the picture from beyond the border of a plain one is left out.
    """
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
    there = mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return there & plain.contains(pixels)


def mask_outline(mask: Tensor) -> Tensor:
    """Return the pixels (H, W) of a mask with a neighbor that is none of its."""
    check_shape(mask, "mask", ("H", "W"))
    grown = torch.nn.functional.max_pool2d((~mask)[None, None].float(), 3, 1, 1)[0, 0] > 0
    return mask & grown


def cut_picture(depth: Tensor, kept: Tensor) -> Tensor:
    """Return a depth image in color (H, W, 3): by depth where it was kept, red where it was cut, black where unknown.

    Args:
        depth: (H, W) metres, zero where nothing was measured.
        kept: (H, W) bool.

    Raises:
        InputError: if sizes differ.
    """
    check_shape(depth, "depth", ("H", "W"))
    check_shape(kept, "kept", tuple(depth.shape))
    known = depth > 0
    seen = torch.where(kept & known, -depth, torch.nan)
    values = seen[kept & known]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    colors = ramp_colors(seen, low, max(high, low + 1e-6))
    return torch.where((known & ~kept).unsqueeze(-1), colors.new_tensor(_OUTLIER), colors)


def hull_picture(mask: Tensor, hull: Tensor) -> Tensor:
    """Return how a hull covers a mask (H, W, 3): white where both are, red where it misses the mask, blue beyond it.

    Args:
        mask: (H, W) bool.
        hull: (H, W) bool, see `model_mask`.

    Raises:
        InputError: if sizes differ.
    """
    check_shape(mask, "mask", ("H", "W"))
    check_shape(hull, "hull", tuple(mask.shape))
    colors = torch.zeros(*mask.shape, 3)
    for where, color in ((mask & hull, (0.9, 0.9, 0.9)), (mask & ~hull, _OUTLIER), (hull & ~mask, _INLIER)):
        colors[where] = colors.new_tensor(color)
    return colors


def hull_sheet(masks: Sequence[Tensor], cameras: CameraRig, mesh: TriangleMesh, width: int = 240) -> Tensor:
    """Return the `hull_picture` of every camera side by side in rows, each about so many pixels wide, (H, W, 3).

    Args:
        masks: one (H, W) bool per camera.
        cameras: calibrated.
        mesh: the surface of the hull.
        width: of each picture, pixels.

    Raises:
        InputError: if there are not as many masks as cameras.
    """
    if len(masks) != len(cameras):
        raise InputError(f"masks must be one per camera, got {len(masks)} and {len(cameras)} cameras")
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
        top, left = high * (number // across), wide * (number % across)
        sheet[:, top : top + picture.shape[1], left : left + picture.shape[2]] = picture
    return sheet.movedim(0, -1)


class StereoPictures:
    """Writes two pictures of every frame that is tracked: disparity_0000.png, and frame_0000.png with the points.

    In the second, points are blue where they are inliers, and the outline of the shape in its pose is green.

    Args:
        frames: what the tracker reads.
        skin: the surface of the shape, with faces.
        folder: where pictures go.

    Raises:
        InputError: if the skin has no faces.
    """

    def __init__(self, frames: StereoFrames, skin: LinearBlendSkin, folder: Path) -> None:
        if skin.faces is None:
            raise InputError("skin must have faces to draw; make it with surface_skin(shape)")
        self._frames, self._skin, self._faces, self._folder = frames, skin, skin.faces, folder

    def __call__(self, points: Tensor, frame: FrameResult) -> None:
        """Draw a frame; one that could not be read has no pictures."""
        try:
            sight = self._frames.sight(frame.frame)
        except (FormatError, OSError):
            return
        config, pair, found = self._frames.config, sight.pair, sight.points
        near = float(pair.disparity(torch.tensor(config.nearest)))
        save_image(self._folder / f"disparity_{frame.frame:04d}.png", ramp_colors(found.dense, 0.0, near))
        outline = None
        if frame.statuses[0].usable and bool(frame.pose.isfinite().all()):
            with torch.no_grad():
                mesh = TriangleMesh(self._skin(frame.pose), self._faces)
            outline = mask_outline(model_mask(mesh, pair.left))
        drawn = picture_with_points(sight.left, found.pixels, frame.inliers.cpu(), outline)
        save_image(self._folder / f"frame_{frame.frame:04d}.png", drawn)
