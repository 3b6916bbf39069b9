"""Dense disparity of rectified pictures: census cost, semi-global aggregation, sub-pixel minima, left-right check."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_count, check_positive, check_shape
from torchreg.errors import InputError, MissingExtraError

# Bits per whole number: the window of 7 x 9 has 62 comparisons, which fit into one int64 with its sign bit unused.
_HALF_ROWS, _HALF_COLUMNS = 3, 4
_LARGEST_COST = (2 * _HALF_ROWS + 1) * (2 * _HALF_COLUMNS + 1) - 1
_OPENCV_BLOCK = 5
# Penalties up to this keep sums of 16 bits from overflowing.
_LARGEST_WHOLE = 8000


def match_disparity(
    left: Tensor,
    right: Tensor,
    max_disparity: int,
    *,
    min_disparity: int = 0,
    method: str = "semi-global",
    small_step: float = 6.0,
    large_step: float = 60.0,
    max_difference: float | None = 1.0,
) -> Tensor:
    """Return the disparity of every left pixel, ``x_left - x_right``, NaN where it is not known.

    The cost of a disparity is the number of differing bits of the two census transforms (7 x 9). Semi-global matching
    sums along four directions r the cheapest ways to a pixel,
    ``L(p, d) = C(p, d) + min(L(p - r, d), L(p - r, d +- 1) + P1, min_k L(p - r, k) + P2) - min_k L(p - r, k)``;
    block matching averages costs over 9 x 9 pixels instead. Minima are refined to fractions by a parabola, and kept
    where the right picture, matched with the left one, agrees.

    Args:
        left: (..., H, W) gray pictures of one scale, rectified.
        right: (..., H, W).
        max_disparity: the largest disparity, pixels.
        min_disparity: the smallest disparity, pixels.
        method: "semi-global", "block", or "opencv" for OpenCV's own semi-global matcher (extra ``stereo``).
        small_step: P1, what a change by one pixel costs.
        large_step: P2, what a larger one costs.
        max_difference: between both directions, pixels; None keeps all.

    Returns:
        (..., H, W), in the dtype of ``left``.

    Raises:
        InputError: if sizes or numbers do not fit.
        MissingExtraError: if OpenCV is asked for and not installed.

    Differentiable: no.

    Cost: about 60 operations per pixel and disparity, and three numbers of 16 bits: 2 s for 640 x 480 pixels and 128
        disparities on one CPU core, twice that with penalties that are no whole numbers. Batches and GPUs run the same
        code.

    References: Zabih and Woodfill 1994 (census); Hirschmueller 2008 (semi-global matching).
    """
    left = as_float_tensor(left, "left")
    right = as_float_tensor(right, "right", like=left)
    check_shape(left, "left", ("H", "W"), batch=True)
    check_shape(right, "right", tuple(left.shape))
    check_choice(method, "method", ("semi-global", "block", "opencv"))
    check_count(min_disparity, "min_disparity", 0)
    check_count(max_disparity, "max_disparity", min_disparity + 2)
    check_positive(small_step, "small_step")
    if not large_step >= small_step:
        raise InputError(f"large_step must be no less than small_step, got {large_step} and {small_step}")
    if max_disparity >= left.shape[-1]:
        raise InputError(f"max_disparity must be below the width {left.shape[-1]}, got {max_disparity}")
    with torch.no_grad():
        pairs = left.reshape(-1, *left.shape[-2:]), right.reshape(-1, *left.shape[-2:])
        if method == "opencv":
            found = torch.stack([_opencv(*pair, min_disparity, max_disparity) for pair in zip(*pairs, strict=True)])
            return found.to(left).reshape(left.shape)
        volume = _cost_volume(census(pairs[0]), census(pairs[1]), min_disparity, max_disparity)
        volume = _block_mean(volume) if method == "block" else _semi_global(volume, small_step, large_step)
        found = min_disparity + _minima(volume)
        if max_difference is not None:
            other = min_disparity + _minima(_seen_from_right(volume)).roll(-min_disparity, dims=-1)
            found = _agreeing(found, other, max_difference)
        return found.to(left).reshape(left.shape)


def census(image: Tensor) -> Tensor:
    """Return for pixels of pictures (..., H, W) which of the 62 neighbors in a window of 7 x 9 are darker, as bits."""
    check_shape(image, "image", ("H", "W"), batch=True)
    rows, columns = _HALF_ROWS, _HALF_COLUMNS
    flat = image.reshape(-1, 1, *image.shape[-2:])
    padded = torch.nn.functional.pad(flat, (columns, columns, rows, rows), mode="replicate").reshape(
        *image.shape[:-2], image.shape[-2] + 2 * rows, image.shape[-1] + 2 * columns
    )
    height, width = image.shape[-2:]
    code = torch.zeros(image.shape, dtype=torch.int64, device=image.device)
    for row in range(2 * rows + 1):
        for column in range(2 * columns + 1):
            if (row, column) != (rows, columns):
                darker = padded[..., row : row + height, column : column + width] < image
                code = (code << 1) | darker
    return code


def _set_bits(code: Tensor) -> Tensor:
    """Return how many of the 62 low bits are set, summing pairs, fours and eights of bits side by side."""
    code = code - ((code >> 1) & 0x5555555555555555)
    code = (code & 0x3333333333333333) + ((code >> 2) & 0x3333333333333333)
    code = (code + (code >> 4)) & 0x0F0F0F0F0F0F0F0F
    code = code + (code >> 8)
    code = code + (code >> 16)
    return (code + (code >> 32)) & 0x7F


def _cost_volume(left: Tensor, right: Tensor, lowest: int, highest: int) -> Tensor:
    """Return (B, H, W, D) int16 costs; the largest where the other pixel lies beside the picture."""
    width = left.shape[-1]
    shape = (*left.shape, highest - lowest + 1)
    volume = torch.full(shape, _LARGEST_COST, dtype=torch.int16, device=left.device)
    for disparity in range(lowest, highest + 1):
        differing = _set_bits(left[..., disparity:] ^ right[..., : width - disparity])
        volume[..., disparity:, disparity - lowest] = differing.to(torch.int16)
    return volume


def _block_mean(volume: Tensor) -> Tensor:
    planes = volume.float().movedim(-1, 1)
    return torch.nn.functional.avg_pool2d(planes, 9, stride=1, padding=4, count_include_pad=False).movedim(1, -1)


def _semi_global(volume: Tensor, small: float, large: float) -> Tensor:
    """Return the sum of the cheapest ways to every pixel from the left, the right, above and below."""
    # Whole numbers of 16 bits take half the time of floats; the sums stay below 4 (62 + P2).
    whole = float(small).is_integer() and float(large).is_integer() and large <= _LARGEST_WHOLE
    if whole:
        small, large = int(small), int(large)
    else:
        volume = volume.float()
    total = torch.zeros_like(volume)
    for axis in (1, 2):
        steps, sums = volume.unbind(axis), total.unbind(axis)
        for order in (range(len(steps)), range(len(steps) - 1, -1, -1)):
            way = None
            for place in order:
                way = steps[place] if way is None else steps[place] + _cheapest_step(way, small, large)
                sums[place].add_(way)
    return total


def _cheapest_step(way: Tensor, small: float, large: float) -> Tensor:
    """Return what the best step from the pixel before adds to each disparity, less the least cost there."""
    level = way - way.amin(-1, keepdim=True)
    best = level.clamp(max=large)
    best[..., 1:] = torch.minimum(best[..., 1:], level[..., :-1] + small)
    best[..., :-1] = torch.minimum(best[..., :-1], level[..., 1:] + small)
    return best


def _minima(volume: Tensor) -> Tensor:
    """Return where along the last axis the cost is least (...,), to a fraction by a parabola; NaN at the ends."""
    place = volume.argmin(-1, keepdim=True)
    last = volume.shape[-1] - 1
    middle = place.clamp(1, last - 1)
    before, here, after = (volume.gather(-1, middle + step)[..., 0].float() for step in (-1, 0, 1))
    bend = before - 2 * here + after
    shift = torch.where(bend > 0, 0.5 * (before - after) / torch.where(bend > 0, bend, 1.0), 0.0).clamp(-0.5, 0.5)
    place = place[..., 0]
    return torch.where((place > 0) & (place < last), place + shift, torch.nan)


def _seen_from_right(volume: Tensor) -> Tensor:
    """Return the volume (B, H, W, D) of the right picture, as a view: its column x is x + step on the left.

    Columns are counted from the lowest disparity on; what lies beyond the left picture costs most.
    """
    batch, height, width, count = volume.shape
    padded = volume.new_full((batch, height, width + count, count), volume.max().item())
    padded[:, :, :width] = volume
    strides = padded.stride()
    # One column and one disparity further at once.
    return padded.as_strided((batch, height, width, count), (*strides[:3], strides[2] + strides[3]))


def _agreeing(found: Tensor, other: Tensor, slack: float) -> Tensor:
    column = torch.arange(found.shape[-1], device=found.device)
    there = (column - found).round().nan_to_num(-1).long()
    back = other.gather(-1, there.clamp(0, found.shape[-1] - 1))
    return torch.where((there >= 0) & ((back - found).abs() <= slack), found, torch.nan)


def _opencv(left: Tensor, right: Tensor, lowest: int, highest: int) -> Tensor:
    """Return what OpenCV's semi-global matcher finds, with its own left-right check."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("method 'opencv' takes the extra stereo: pip install 'torchreg[stereo]'") from error
    count = 16 * -(-(highest - lowest + 1) // 16)
    area = _OPENCV_BLOCK**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest, numDisparities=count, blockSize=_OPENCV_BLOCK, P1=8 * area, P2=32 * area,
        disp12MaxDiff=1, uniquenessRatio=5, speckleWindowSize=50, speckleRange=2,
    )  # fmt: skip
    scale = 255 / max(float(left.max()), float(right.max()), 1e-9)
    gray = [(part.cpu().clamp(min=0) * scale).round().numpy().astype(np.uint8) for part in (left, right)]
    # OpenCV leaves out columns for which not all disparities lie in the picture; its border repeated, none does.
    wide = [np.pad(part, ((0, 0), (lowest + count, 0)), mode="edge") for part in gray]
    found = torch.from_numpy(matcher.compute(*wide))[:, lowest + count :].double() / 16
    inside = torch.arange(found.shape[1]) >= found
    return torch.where((found >= lowest) & inside, found, torch.nan)
