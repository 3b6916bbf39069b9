"""Dense disparity of rectified pictures: census cost, semi-global aggregation, sub-pixel minima, left-right check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchreg.errors import MissingExtraError

METHODS = ("semi-global", "block", "opencv")


@dataclass(frozen=True)
class _Matching:
    """Costs and checks of matching."""

    half_rows: int = 3  # of the census window, 7 x 9 pixels:
    half_columns: int = 4  # its comparisons fit into an int64 with the sign bit unused
    num_bits: int = 62  # comparisons with the middle, and so the largest cost
    small_step: int = 6  # P1, the cost of a change of disparity by one pixel
    large_step: int = 60  # P2, the cost of a larger change; sums below 4 (62 + P2) need 16 bits
    max_difference: float = 1.0  # between the disparities of both directions, pixels


_MATCHING = _Matching()


def match_disparity(left: Tensor, right: Tensor, max_disparity: int, *, method: str = "semi-global") -> Tensor:
    """Return the disparity (..., H, W) of every left pixel, ``x_left - x_right``, NaN where it is not known.

    Costs are differing bits of census transforms (7 x 9; Zabih and Woodfill 1994). Semi-global matching (Hirschmueller
    2008) sums along four directions r the costs of the cheapest paths,
    ``L(p, d) = C(p, d) + min(L(p - r, d), L(p - r, d +- 1) + P1, min_k L(p - r, k) + P2) - min_k L(p - r, k)``; block
    matching averages over 9 x 9 pixels. Minima are refined by a parabola, and kept where the right picture agrees.
    """
    with torch.no_grad():
        pairs = left.reshape(-1, *left.shape[-2:]), right.reshape(-1, *left.shape[-2:])
        if method == "opencv":
            found = torch.stack([_opencv(*pair, max_disparity) for pair in zip(*pairs, strict=True)])
            return found.to(left).reshape(left.shape)
        volume = _cost_volume(census(pairs[0]), census(pairs[1]), max_disparity)
        volume = _block_mean(volume) if method == "block" else _semi_global(volume)
        found = _agreeing(_minima(volume), _minima(_seen_from_right(volume)))
        return found.to(left).reshape(left.shape)


def census(image: Tensor) -> Tensor:
    """Return the census (..., H, W) int64 of pictures: a bit per neighbor in a window of 7 x 9, set if it is darker."""
    rows, columns = _MATCHING.half_rows, _MATCHING.half_columns
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
    """Return the number of set bits among the 62 low ones, summing pairs, fours and eights of bits side by side."""
    code = code - ((code >> 1) & 0x5555555555555555)
    code = (code & 0x3333333333333333) + ((code >> 2) & 0x3333333333333333)
    code = (code + (code >> 4)) & 0x0F0F0F0F0F0F0F0F
    code = code + (code >> 8)
    code = code + (code >> 16)
    return (code + (code >> 32)) & 0x7F


def _cost_volume(left: Tensor, right: Tensor, highest: int) -> Tensor:
    """Return (B, H, W, D) int16 costs; the largest where the right pixel lies outside of the picture."""
    width = left.shape[-1]
    shape = (*left.shape, highest + 1)
    volume = torch.full(shape, _MATCHING.num_bits, dtype=torch.int16, device=left.device)
    for disparity in range(highest + 1):
        differing = _set_bits(left[..., disparity:] ^ right[..., : width - disparity])
        volume[..., disparity:, disparity] = differing.to(torch.int16)
    return volume


def _block_mean(volume: Tensor) -> Tensor:
    planes = volume.float().movedim(-1, 1)
    return torch.nn.functional.avg_pool2d(planes, 9, stride=1, padding=4, count_include_pad=False).movedim(1, -1)


def _semi_global(volume: Tensor) -> Tensor:
    """Return the sums of the costs of the cheapest paths to every pixel from the left, the right, above and below."""
    total = torch.zeros_like(volume)
    for axis in (1, 2):
        steps, sums = volume.unbind(axis), total.unbind(axis)
        for order in (range(len(steps)), range(len(steps) - 1, -1, -1)):
            path = None
            for line in order:
                path = steps[line] if path is None else steps[line] + _cheapest_step(path)
                sums[line].add_(path)
    return total


def _cheapest_step(path: Tensor) -> Tensor:
    """Return the cost of the best step from the previous pixel to each disparity, less the least path cost there."""
    level = path - path.amin(-1, keepdim=True)
    best = level.clamp(max=_MATCHING.large_step)
    best[..., 1:] = torch.minimum(best[..., 1:], level[..., :-1] + _MATCHING.small_step)
    best[..., :-1] = torch.minimum(best[..., :-1], level[..., 1:] + _MATCHING.small_step)
    return best


def _minima(volume: Tensor) -> Tensor:
    """Return the indices (...,) of least cost along the last axis, to a fraction by a parabola; NaN at the ends."""
    index = volume.argmin(-1, keepdim=True)
    last = volume.shape[-1] - 1
    middle = index.clamp(1, last - 1)
    before, cost, after = (volume.gather(-1, middle + step)[..., 0].float() for step in (-1, 0, 1))
    bend = before - 2 * cost + after
    shift = torch.where(bend > 0, 0.5 * (before - after) / torch.where(bend > 0, bend, 1.0), 0.0).clamp(-0.5, 0.5)
    index = index[..., 0]
    return torch.where((index > 0) & (index < last), index + shift, torch.nan)


def _seen_from_right(volume: Tensor) -> Tensor:
    """Return the cost volume of the right picture, a view: column x is x + d on the left; largest beyond it."""
    batch, height, width, count = volume.shape
    padded = volume.new_full((batch, height, width + count, count), volume.max().item())
    padded[:, :, :width] = volume
    strides = padded.stride()
    # One column and one disparity further at once.
    return padded.as_strided((batch, height, width, count), (*strides[:3], strides[2] + strides[3]))


def _agreeing(found: Tensor, reverse: Tensor) -> Tensor:
    """Return disparities, NaN where the right picture's disparity of the matched pixel differs too much."""
    column = torch.arange(found.shape[-1], device=found.device)
    matched = (column - found).round().nan_to_num(-1).long()
    back = reverse.gather(-1, matched.clamp(0, found.shape[-1] - 1))
    return torch.where((matched >= 0) & ((back - found).abs() <= _MATCHING.max_difference), found, torch.nan)


def _opencv(left: Tensor, right: Tensor, highest: int) -> Tensor:
    """Return the disparities (H, W) of OpenCV's semi-global matcher, which has a left-right check of its own."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(
            "method 'opencv' takes the extra stereo: pip install 'torchreg-articulated[stereo]'"
        ) from error
    count = 16 * -(-(highest + 1) // 16)
    # Blocks of 5 x 5 pixels; P1 and P2 are 8 and 32 times their area, as OpenCV advises.
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=count, blockSize=5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=5,
        speckleWindowSize=50, speckleRange=2,
    )  # fmt: skip
    scale = 255 / max(float(left.max()), float(right.max()), 1e-9)
    gray = [(part.cpu().clamp(min=0) * scale).round().numpy().astype(np.uint8) for part in (left, right)]
    # OpenCV leaves out columns for which not all disparities lie in the picture; its border repeated, none does.
    wide = [np.pad(part, ((0, 0), (count, 0)), mode="edge") for part in gray]
    found = torch.from_numpy(matcher.compute(*wide))[:, count:].double() / 16
    inside = torch.arange(found.shape[1]) >= found
    return torch.where((found >= 0) & inside, found, torch.nan)
