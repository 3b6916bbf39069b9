"""What a depth camera saw at one time: points, normals and free space of one picture."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, as_tensor, check_count, check_shape
from torchreg.capture.depth import without_flying_pixels
from torchreg.capture.free_space import FreeSpace
from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.geometry.camera import Camera
from torchreg.geometry.normals import estimate_normals
from torchreg.io.calibration import load_depth_camera
from torchreg.io.images import load_depth, load_mask
from torchreg.io.points import needed_dtype


@dataclass(frozen=True)
class _Picture:
    """Numbers of a depth picture."""

    farthest: float = 100.0  # median depth that no depth camera reaches, metres: the numbers are in another unit
    min_points: int = 3  # fewer are no surface
    least_rim: int = 2  # pixels up to which the rim of a mask is not exact
    steepest: float = 6.0  # tangent of the steepest slope of one surface, 80 degrees


_PICTURE = _Picture()


@dataclass(frozen=True, eq=False, repr=False, init=False)
class DepthFrame:
    """A depth picture, the camera that took it, and the pixels that count.

    Where a cloud or a scan is taken, so is a frame: its `points`. `align`, `find_pose` and `Tracker` look at its
    `free_space` beside: nothing is in front of what was measured.

    Neighboring pixels err together, so a regular grid of pixels stands for all of them where they are many.

    Args:
        depth: (H, W) metres along the camera's axis; zero, negative or not finite where nothing was measured.
        camera: its picture has that size.
        mask: (H, W) bool, True for pixels that may show the shape; None for all. The shape is not beside the mask but
            where something nearer hides it.
        max_points: points taken, at most.

    Attributes:
        depth: (H, W), zero where nothing was measured.
        camera: the camera.
        mask: (H, W) bool, or None.
        max_points: as given.

    Raises:
        InputError: if sizes do not fit, no pixel that counts was measured, or depths are in another unit than metres.
        InputTypeError: if the depth is not numbers, or the mask not bool.

    Differentiable: no.
    """

    depth: Tensor
    camera: Camera
    mask: Tensor | None
    max_points: int

    def __init__(self, depth: Any, camera: Camera, mask: Any = None, *, max_points: int = 4000) -> None:
        if not isinstance(camera, Camera):
            raise InputTypeError(f"camera must be a Camera, got {type(camera).__name__}; load one with load_cameras")
        check_count(max_points, "max_points", _PICTURE.min_points)
        depth = as_float_tensor(depth, "depth").detach()
        depth = depth if depth.dtype == torch.float64 else depth.float()
        check_shape(depth, "depth", (camera.height, camera.width))
        depth = torch.where(depth.isfinite() & (depth > 0), depth, 0.0)
        mask = None if mask is None else _as_mask(mask, depth)
        _check_depths(depth, mask)
        values = {"depth": depth, "camera": camera, "mask": mask, "max_points": max_points}
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        intrinsics: str | os.PathLike[str],
        mask: str | os.PathLike[str] | None = None,
        *,
        nearest: float = 0.0,
        farthest: float = float("inf"),
    ) -> DepthFrame:
        """Return the frame of files.

        Args:
            path: the depth picture, see `load_depth`.
            intrinsics: the camera's file, see `load_depth_camera`.
            mask: a picture, see `load_mask`; None for all pixels.
            nearest: nearer pixels are left out, metres.
            farthest: pixels beyond are left out, metres.

        Raises:
            FormatError: if a file is damaged or sizes differ, or no pixel that counts was measured; names the file.
            FileNotFoundError: if a file is missing.
        """
        camera, scale = load_depth_camera(intrinsics)
        depth = load_depth(path, scale, camera=camera)
        depth = torch.where((depth >= nearest) & (depth <= farthest), depth, 0.0)
        kept = None if mask is None else load_mask(mask)
        try:
            return cls(depth, camera, kept)
        except InputError as error:
            name = mask if mask is not None and str(error).startswith("mask") else path
            raise FormatError(f"{os.fspath(name)}: {error}") from error

    def __repr__(self) -> str:
        height, width = self.depth.shape
        return f"DepthFrame({width} x {height} pixels, {int(self.measured.sum())} of them count)"

    @cached_property
    def measured(self) -> Tensor:
        """Mask (H, W) of the pixels that count and show a surface: depths between two surfaces at an edge do not."""
        clean = self._clean if self.mask is None else self._clean & self.mask
        # Of pictures too coarse to tell, all depths are kept.
        if int(clean.sum()) < _PICTURE.min_points:
            clean = self.depth > 0 if self.mask is None else (self.depth > 0) & self.mask
        return clean

    @cached_property
    def _clean(self) -> Tensor:
        """Mask (H, W) of the depths that are of one surface."""
        fx, fy = self.camera.intrinsics[:2].tolist()
        return without_flying_pixels(self.depth, (fx, fy)) > 0

    @cached_property
    def stride(self) -> int:
        """Pixels from one point to the next, in rows and columns."""
        stride = 1
        while int(self.measured[::stride, ::stride].sum()) > self.max_points:
            stride += 1
        return stride

    @cached_property
    def pixels(self) -> Tensor:
        """The pixels (M, 2) of the points as (column, row), int64."""
        pixels = self.stride * self.measured[:: self.stride, :: self.stride].nonzero().flip(-1)
        if self.camera.is_distorted:
            pixels = pixels[self.camera.directions(pixels.double()).isfinite().all(-1)]
        return pixels

    @cached_property
    def points(self) -> Tensor:
        """The points (M, 3) in world coordinates, metres; float64 where these are far from their origin."""
        column, row = self.pixels.unbind(-1)
        camera = self.camera.to(device=self.depth.device)
        points = camera.unproject(self.pixels.double(), self.depth[row, column].double())
        return points.to(torch.promote_types(self.depth.dtype, needed_dtype(points)))

    @cached_property
    def normals(self) -> Tensor:
        """Unit normals (M, 3) of the points, towards the camera."""
        return estimate_normals(self.points, viewpoint=self.camera.position.double())

    @cached_property
    def free_space(self) -> FreeSpace:
        """What the picture says of where nothing is."""
        return FreeSpace.of_picture(self.depth, self.camera, self.mask, self.stride)

    @cached_property
    def links(self) -> Tensor:
        """Pairs (E, 2) of points that are neighbors on the grid and on one surface."""
        stride, number = self.stride, torch.full_like(self.depth, -1, dtype=torch.int64)
        column, row = self.pixels.unbind(-1)
        number[row, column] = torch.arange(len(row), device=row.device)
        number, depth = number[::stride, ::stride], self.depth[::stride, ::stride]
        pairs = []
        for axis in (0, 1):
            size = number.shape[axis] - 1
            first, second = number.narrow(axis, 0, size), number.narrow(axis, 1, size)
            joined = self.is_continuous(depth, axis) & (first >= 0) & (second >= 0)
            pairs.append(torch.stack((first[joined], second[joined]), dim=-1))
        return torch.cat(pairs)

    def is_continuous(self, depth: Tensor, axis: int) -> Tensor:
        """Return where the depths (H', W') of every stride-th pixel go on along an axis as those of one surface do."""
        step = _PICTURE.steepest * self.stride * depth / float(self.camera.intrinsics[:2].min())
        return depth.diff(dim=axis).abs() <= step.narrow(axis, 0, depth.shape[axis] - 1)

    @cached_property
    def without_mask(self) -> DepthFrame:
        """The frame in which all pixels count."""
        return DepthFrame(self.depth, self.camera, max_points=self.max_points)

    @cached_property
    def cut(self) -> Tensor:
        """Mask (M,) of the points beside which their surface goes on where no pixel counts, or leaves the picture."""
        radius = max(_PICTURE.least_rim, self.stride)
        outside = torch.zeros_like(self.measured) if self.mask is None else ~self.mask & self._clean
        # What is thinner than the radius is the rim of a mask that is not exact.
        outside = grown(~grown(~outside, radius), radius)
        low = -pooled(torch.where(outside, -self.depth, -torch.inf), radius + 1)
        high = pooled(torch.where(outside, self.depth, -torch.inf), radius + 1)
        step = _PICTURE.steepest * radius * self.depth / float(self.camera.intrinsics[:2].min())
        goes_on = (self.depth >= low - step) & (self.depth <= high + step)
        goes_on[[0, -1]], goes_on[:, [0, -1]] = True, True
        near = grown(goes_on & self.measured, self.stride)
        column, row = self.pixels.unbind(-1)
        return near[row, column]

    def near(self, origin: Tensor) -> DepthFrame:
        """Return the frame in coordinates that begin at an origin (3,)."""
        shift = torch.eye(4, dtype=torch.float64)
        shift[:3, 3] = -origin.double().cpu()
        return DepthFrame(self.depth, self.camera.moved(shift), self.mask, max_points=self.max_points)

    def cropped(self, mask: Any) -> DepthFrame:
        """Return the frame with those pixels alone that are in a mask (H, W) too."""
        mask = _as_mask(mask, self.depth)
        both = mask if self.mask is None else mask & self.mask
        return DepthFrame(self.depth, self.camera, both, max_points=self.max_points)


def pooled(picture: Tensor, radius: int) -> Tensor:
    """Return the largest number of a picture (H, W) within a radius, pixels, of each pixel."""
    found = torch.nn.functional.pad(picture, (radius,) * 4, value=-torch.inf)
    # Rows after columns, and the window doubled in each step: a square at once costs its whole area for each pixel.
    for axis in (0, 1):
        width = 1
        while width < 2 * radius + 1:
            step = min(width, 2 * radius + 1 - width)
            size = found.shape[axis] - step
            found = torch.maximum(found.narrow(axis, 0, size), found.narrow(axis, step, size))
            width += step
    return found


def grown(mask: Tensor, radius: int) -> Tensor:
    """Return a mask (H, W) grown by some pixels."""
    return pooled(mask.float(), radius) > 0


def _as_mask(mask: Any, depth: Tensor) -> Tensor:
    mask = as_tensor(mask, "mask", "bool")
    if mask.dtype != torch.bool:
        raise InputTypeError(f"mask must hold bool, True for pixels that count, got dtype {mask.dtype}")
    check_shape(mask, "mask", tuple(depth.shape))
    return mask.to(depth.device)


def _check_depths(depth: Tensor, mask: Tensor | None) -> None:
    """Raise InputError unless a depth picture (H, W) shows something, in metres."""
    measured = depth > 0
    counted = int(measured.sum()) if mask is None else int((measured & mask).sum())
    if counted < _PICTURE.min_points:
        where = f"{depth.numel()} pixels" if mask is None else f"{int(mask.sum())} pixels of the mask"
        raise InputError(
            f"depth must be positive where the shape may be, got {counted} of {where} measured; check that it is a "
            f"depth picture, and that the mask belongs to it"
        )
    middle = float(depth[measured].median())
    if middle > _PICTURE.farthest:
        raise InputError(f"depth must be in metres, got {middle:.4g} in the middle; multiply millimeters by 0.001")
