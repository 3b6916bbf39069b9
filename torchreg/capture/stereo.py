"""Stereo pairs to points: rectification, Harris corners in both pictures, and 3-D points with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_count, check_finite, check_positive, check_shape
from torchreg.capture.color import brightness
from torchreg.capture.disparity import METHODS, match_disparity
from torchreg.capture.disparity_refinement import refine_disparity
from torchreg.errors import InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import StereoPair
from torchreg.geometry.rigid import rigid_matrix


@dataclass(frozen=True)
class _CornerSearch:
    """Which pixels are taken for corners; lengths in pixels."""

    min_response: float = 1e-4  # Harris response of a corner, as a share of the strongest
    reach: int = 2  # a corner of the right picture this near to the match is the same one
    border: int = 8  # a window needs that much room
    outline_reach: int = 2  # this near to an outline, dense disparity may belong to the other side of it
    max_slope: float = 1.25  # of the disparity within one surface, pixels per pixel
    fill_rounds: int = 4  # in which textured pixels are added where corners are few
    surplus: float = 1.1  # added pixels over missing ones: some will not match well


@dataclass(frozen=True)
class _OrderCheck:
    """Test for swapped pictures."""

    shrink: int = 4  # pictures are compared at that part of their size
    min_ratio: float = 1.5  # of pixels that match as given to those that match swapped


_CORNERS = _CornerSearch()
_ORDER = _OrderCheck()


@dataclass(frozen=True, eq=False)
class StereoPoints:
    """Corners that both cameras of a pair see."""

    points: Tensor  # (N, 3) in world coordinates, metres
    depth_std: Tensor  # (N,) standard deviation of the depth before the left camera, metres
    covariance: Tensor  # (N, 3, 3) of the points, along the rays of the left camera and, by a tenth of a pixel, across
    pixels: Tensor  # (N, 2) in the left picture, as (column, row)
    disparity: Tensor  # (N,) pixels
    disparity_std: Tensor  # (N,) pixels
    dense: Tensor  # (H, W) disparity of all pixels, NaN where it is not known

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, kept: Tensor) -> StereoPoints:
        """Return the points chosen by a mask (N,) bool or by indices."""
        parts = ("points", "depth_std", "covariance", "pixels", "disparity", "disparity_std")
        return replace(self, **{name: getattr(self, name)[kept] for name in parts})


@dataclass(frozen=True)
class StereoConfig:
    """Settings of `stereo_points`.

    Args:
        nearest: smallest depth of interest, metres; it limits the disparities that are searched.
        farthest: largest depth of interest, metres; surfaces beyond are background.
        num_corners: most that are kept, the strongest first.
        method: see `match_disparity`.
        max_disparity_std: corners whose disparity is less certain are dropped, pixels.
        both: whether a corner must be one in both pictures, to two pixels.
        least: where there are fewer corners, textured pixels between them are added, the most distinct first and no
            nearer to each other than three pixels.

    Raises:
        InputError: if a number is out of range.
    """

    nearest: float = 0.4
    farthest: float = 1.0
    num_corners: int = 1000
    method: str = "semi-global"
    max_disparity_std: float = 0.5
    both: bool = True
    least: int = 0

    def __post_init__(self) -> None:
        check_positive(self.nearest, "nearest")
        check_choice(self.method, "method", METHODS)
        check_positive(self.max_disparity_std, "max_disparity_std")
        check_count(self.num_corners, "num_corners", 1)
        check_count(self.least, "least", 0)
        if self.least > self.num_corners:
            raise InputError(f"least must be at most num_corners, got {self.least} and {self.num_corners}")
        if not self.farthest > self.nearest:
            raise InputError(f"farthest must be beyond nearest, got {self.farthest} and {self.nearest}")


def stereo_points(
    left: Tensor,
    right: Tensor,
    pair: StereoPair,
    *,
    config: StereoConfig | None = None,
    box: Tensor | None = None,
    check_order: bool = True,
) -> StereoPoints:
    """Return the Harris corners that both cameras of a rectified pair see, as points with their uncertainty.

    Dense disparity gives the rough position of a corner in the right picture; a least-squares fit of a window, slanted
    as the surface is, refines it to a fraction of a pixel, with the uncertainty from the fit's covariance and
    residuals. Corners that an outline may make, beside unknown disparities or a jump of them, are left out.

    Args:
        left: (H, W) or (H, W, 3) from 0 to 1.
        right: likewise.
        pair: the cameras, rectified; see `rectify`.
        config: depths, numbers and method.
        box: (2, 3) lower and upper corner of the volume of interest in world coordinates, or None.
        check_order: whether to test for swapped pictures; once per sequence is enough.

    Returns:
        The points, in the dtype of the pictures; there may be none.

    Raises:
        InputError: if the pair is not rectified, sizes do not fit, the pictures are swapped, or they hardly match.
        MissingExtraError: as `match_disparity`.

    Differentiable: no.

    Cost: that of `match_disparity`.

    References: Harris and Stephens 1988 (corners); Lucas and Kanade 1981 (the fit).
    """
    config = StereoConfig() if config is None else config
    pair.check_rectified()
    if box is not None:
        box = as_float_tensor(box, "box")
        check_shape(box, "box", (2, 3))
    first, second = as_gray(left, pair.left, "left"), as_gray(right, pair.right, "right")
    with torch.no_grad():
        highest = int(pair.disparity(torch.tensor(config.nearest, dtype=torch.float64))) + 2
        if highest >= pair.left.width:
            raise InputError(
                f"nearest must keep disparities within the picture, {config.nearest} m takes {highest} pixels"
            )
        if check_order:
            _check_order(first, second, highest)
        # From infinity on: a background whose disparity is not searched would be matched at a nearer depth.
        dense = match_disparity(first, second, highest, method=config.method)
        depth = pair.depth(dense)
        wanted = (depth >= config.nearest) & (depth <= config.farthest)
        # A corner made by an outline is no point of either surface.
        wanted &= ~_on_outline(dense)
        corners = _corners(first) & wanted
        if config.both:
            corners &= _is_corner_at_match(_corners(second), dense)
        corners |= _textured(first, wanted, corners, config.least)
        row, column = corners.nonzero().unbind(-1)
        fit = refine_disparity(first, second, dense, torch.stack((column, row), dim=-1))
        kept = fit.good & (fit.std <= config.max_disparity_std)
        strength = torch.where(kept, _corner_response(first)[row, column], -torch.inf)
        order = strength.argsort(descending=True)[: min(config.num_corners, int(kept.sum()))]
        pixels = torch.stack((column, row), dim=-1)[order].to(first)
        points = _triangulated(pair, pixels, fit.disparity[order], fit.std[order], dense)
        return points.subset(_of_interest(points, pair.depth(points.disparity), config, box))


def rectify(left: Tensor, right: Tensor, pair: StereoPair) -> tuple[Tensor, Tensor, StereoPair]:
    """Return both pictures with rows along the baseline, zero beyond the given ones, and their pair (Fusiello 2000)."""
    for image, camera, name in ((left, pair.left, "left"), (right, pair.right, "right")):
        _check_size(as_float_tensor(image, name), camera, name)
    first, second = pair.left.to(torch.float64), pair.right.to(torch.float64)
    along = torch.nn.functional.normalize(second.position - first.position, dim=0)
    forward = first.world_to_camera[2, :3] + second.world_to_camera[2, :3]
    down = torch.nn.functional.normalize(torch.linalg.cross(forward, along), dim=0)
    turn = torch.stack((along, down, torch.linalg.cross(along, down)))
    focal = min(float(first.intrinsics[:2].min()), float(second.intrinsics[:2].min()))
    size = first.intrinsics.new_tensor([first.width - 1, first.height - 1])
    # The middles of both pictures come to lie, on average, in the middle.
    tangents = []
    for camera in (first, second):
        middle = camera.intrinsics.new_tensor([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]])
        local = camera.directions(middle)[0] @ turn.mT
        tangents.append(local[:2] / local[2])
    center = 0.5 * size - focal * 0.5 * (tangents[0] + tangents[1])
    intrinsics = torch.cat((size.new_tensor([focal, focal]), center))
    cameras, pictures = [], []
    for camera, image in ((first, left), (second, right)):
        motion = rigid_matrix(turn, -(turn @ camera.position))
        straight = Camera(first.width, first.height, intrinsics, motion, name=camera.name)
        rays = straight.directions(straight.pixel_grid())
        source, _ = camera.project(camera.position + rays)
        pictures.append(_sampled(as_float_tensor(image, "image"), source.nan_to_num(-1e6)))
        cameras.append(straight)
    return pictures[0], pictures[1], StereoPair(*cameras)


def _sampled(image: Tensor, source: Tensor) -> Tensor:
    """Return a picture (H, W) or (H, W, 3) looked up at pixels (H, W, 2) of it."""
    planes = image.unsqueeze(-1) if image.ndim == 2 else image
    maps = source.to(image)[None]
    from kornia.geometry.transform import remap

    warped = remap(planes.movedim(-1, 0)[None], maps[..., 0], maps[..., 1], align_corners=True)[0].movedim(0, -1)
    return warped[..., 0] if image.ndim == 2 else warped


def _check_size(image: Tensor, camera: Camera, name: str) -> None:
    if image.ndim == 3:
        check_shape(image, name, (camera.height, camera.width, 3))
    else:
        check_shape(image, name, (camera.height, camera.width))
    check_finite(image, name)


def as_gray(image: Tensor, camera: Camera, name: str) -> Tensor:
    """Return a camera's picture (H, W) or (H, W, 3) as gray (H, W); InputError if it has another size."""
    image = as_float_tensor(image, name).detach()
    _check_size(image, camera, name)
    return brightness(image) if image.ndim == 3 else image


def _check_order(left: Tensor, right: Tensor, highest: int) -> None:
    """Raise InputError if the pictures match well when swapped, or match neither way."""
    first, second = (torch.nn.functional.avg_pool2d(part[None, None], _ORDER.shrink)[0, 0] for part in (left, right))
    reach = min(max(highest // _ORDER.shrink + 2, 4), first.shape[-1] - 1)
    found = [match_disparity(*pair, reach, method="block").isfinite() for pair in ((first, second), (second, first))]
    given, swapped = (float(known.float().mean()) for known in found)
    if swapped > _ORDER.min_ratio * given:
        raise InputError(
            f"left and right pictures are swapped: {100 * swapped:.0f} % of the pixels match the other way round, "
            f"{100 * given:.0f} % as given"
        )
    if given <= _ORDER.min_ratio * swapped:
        raise InputError(
            f"left and right hardly match, {100 * given:.0f} % of the pixels do, {100 * swapped:.0f} % by chance; "
            f"check that they were taken at the same time, are rectified, and that config.nearest is near enough"
        )


def _corners(gray: Tensor) -> Tensor:
    """Return the mask (H, W) of local maxima of the Harris response, away from the border."""
    response = _corner_response(gray)
    highest = torch.nn.functional.max_pool2d(response[None, None], 3, 1, 1)[0, 0]
    return (response >= highest) & (response > _CORNERS.min_response * response.max()) & _inner(gray)


def _inner(gray: Tensor) -> Tensor:
    """Return the mask (H, W) of pixels with room for a window."""
    inner = torch.zeros(gray.shape, dtype=torch.bool, device=gray.device)
    inner[_CORNERS.border : -_CORNERS.border, _CORNERS.border : -_CORNERS.border] = True
    return inner


def _textured(gray: Tensor, wanted: Tensor, corners: Tensor, least: int) -> Tensor:
    """Return a mask (H, W) of more pixels, of strong Harris response apart from corners, until there are ``least``."""
    response = torch.where(wanted & _inner(gray), _corner_response(gray), 0.0)
    response = torch.where(response > _CORNERS.min_response * response.max(), response, 0.0)
    more = torch.zeros_like(corners)
    for _ in range(_CORNERS.fill_rounds):
        missing = int(_CORNERS.surplus * least) - int(corners.sum() + more.sum())
        if missing <= 0:
            break
        taken = torch.nn.functional.max_pool2d((corners | more)[None, None].float(), 5, 1, 2)[0, 0] > 0
        free = torch.where(taken, 0.0, response)
        peaks = (free > 0) & (free >= torch.nn.functional.max_pool2d(free[None, None], 5, 1, 2)[0, 0])
        if not bool(peaks.any()):
            break
        weakest = free[peaks].sort(descending=True).values[:missing][-1]
        more |= peaks & (free >= weakest)
    return more


def _on_outline(disparity: Tensor) -> Tensor:
    """Return the mask of pixels (H, W) that have unknown disparities or another surface near by."""
    unknown, reach = disparity.isnan(), _CORNERS.outline_reach
    planes = torch.stack((unknown.to(disparity), disparity.nan_to_num(-torch.inf), -disparity.nan_to_num(torch.inf)))
    beside, most, least = torch.nn.functional.max_pool2d(planes[None], 2 * reach + 1, 1, reach)[0]
    return (beside > 0) | (most + least > 2 * reach * _CORNERS.max_slope)


def _is_corner_at_match(corners: Tensor, disparity: Tensor) -> Tensor:
    """Return the mask (H, W) of left pixels whose match is near one of the right picture's corners (H, W)."""
    reach = _CORNERS.reach
    near = torch.nn.functional.max_pool2d(corners[None, None].float(), 2 * reach + 1, 1, reach)[0, 0] > 0
    column = (torch.arange(corners.shape[1], device=corners.device) - disparity).round().nan_to_num(-1).long()
    return (column >= 0) & near.gather(1, column.clamp(0, corners.shape[1] - 1))


def _triangulated(pair: StereoPair, pixels: Tensor, disparity: Tensor, std: Tensor, dense: Tensor) -> StereoPoints:
    """Return the points of pixels (N, 2) with disparities (N,) and their standard deviations (N,)."""
    depth = pair.depth(disparity)
    depth_std, rays = pair.depth_std(depth, std), pair.left.directions(pixels)
    across = (0.1 * depth / float(pair.left.intrinsics[0])) ** 2
    along = rays.unsqueeze(-1) * rays.unsqueeze(-2) * (depth_std**2)[:, None, None]
    return StereoPoints(
        points=pair.left.unproject(pixels, depth),
        depth_std=depth_std,
        covariance=along + across[:, None, None] * torch.eye(3).to(rays),
        pixels=pixels,
        disparity=disparity,
        disparity_std=std,
        dense=dense,
    )


def _of_interest(points: StereoPoints, depth: Tensor, config: StereoConfig, box: Tensor | None) -> Tensor:
    """Return the mask (N,) of points within the depths of interest (N,) and a box (2, 3)."""
    kept = (depth >= config.nearest) & (depth <= config.farthest)
    if box is not None:
        lower, upper = box.to(points.points)
        kept &= ((points.points >= lower) & (points.points <= upper)).all(-1)
    return kept


def _corner_response(image: Tensor) -> Tensor:
    """Return Harris' response (H, W) of a gray picture (H, W)."""
    from kornia.feature import harris_response

    return harris_response(image[None, None])[0, 0]
