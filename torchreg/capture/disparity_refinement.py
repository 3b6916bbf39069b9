"""Disparities to a fraction of a pixel: windows fitted by least squares, with the uncertainty of the fit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_shape

_RADIUS, _SPREAD = 5, 2.0
_STEPS = 8
# Pixels of the window further in disparity from its middle belong to something else.
_SAME_SURFACE = 1.5
# The fit may not leave the dense disparity by more, must correlate so well, and is never surer than that (pixels).
_MAX_MOVE, _MIN_CORRELATION, _FLOOR = 1.5, 0.8, 0.05
# Share of how far the surface in a window is from a plane by which the middle may be off.
_UNEVEN = 0.5
# Pictures are smoothed by this before, along rows and columns: noise is then the same at fractional places.
_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
# A prior on the slopes of disparity: standard deviation, pixels per pixel; and the least noise of a picture.
_SLOPE, _LEAST_NOISE = 0.3, 1e-3


@dataclass(frozen=True, eq=False)
class RefinedDisparity:
    """Disparities of N pixels.

    Args:
        disparity: (N,) pixels.
        std: (N,) standard deviation, pixels.
        good: (N,) bool, whether the fit stayed near and the windows look alike.
    """

    disparity: Tensor
    std: Tensor
    good: Tensor


def refine_disparity(left: Tensor, right: Tensor, dense: Tensor, pixels: Tensor) -> RefinedDisparity:
    """Return the disparities of some pixels to a fraction of a pixel, from windows of 11 x 11.

    Minimizes ``sum_q w_q (I_L(q) - g I_R(q - d - s . (q - p)) - b)^2`` over disparity d and slopes s by Gauss-Newton,
    the gain g and offset b taken from the windows' means and deviations. The weights are a Gaussian, zero where the
    dense disparity says another surface. The variance of d is that of weighted least squares, the noise from the
    residuals. Both pictures are smoothed first; without it, noise draws fractions towards a half.

    Args:
        left: (H, W) gray, rectified.
        right: (H, W).
        dense: (H, W) disparity, NaN where it is not known.
        pixels: (N, 2) int64 as (column, row), where ``dense`` is known.

    Returns:
        one entry per pixel.

    Raises:
        InputError: if sizes differ.

    Differentiable: no.

    References: Lucas and Kanade 1981.
    """
    check_shape(right, "right", tuple(left.shape))
    check_shape(dense, "dense", tuple(left.shape))
    check_shape(pixels, "pixels", ("N", 2))
    step = torch.arange(-_RADIUS, _RADIUS + 1, device=left.device)
    down, along = (part.reshape(-1) for part in torch.meshgrid(step, step, indexing="ij"))
    column = (pixels[:, :1] + along).clamp(0, left.shape[1] - 1)
    row = (pixels[:, 1:] + down).clamp(0, left.shape[0] - 1)
    start = dense[pixels[:, 1], pixels[:, 0]].double()
    same = ((dense[row, column] - start[:, None]).abs() <= _SAME_SURFACE).double()
    # Smoothing carries what is beside a surface over its edge.
    side = 2 * _RADIUS + 1
    same = 1 - torch.nn.functional.max_pool2d((1 - same).reshape(-1, 1, side, side), 3, 1, 1).reshape(same.shape)
    weights = same * torch.exp(-0.5 * (along**2 + down**2) / _SPREAD**2).double()
    first, second = _smoothed(torch.stack((left, right)).double())
    target = first[row, column]
    shape = torch.stack((torch.ones_like(along), along, down), dim=-1).double()
    unknowns = torch.stack((start, torch.zeros_like(start), torch.zeros_like(start)), dim=-1)
    prior = torch.diag(shape.new_tensor([1e-9, 1.0, 1.0])) / _SLOPE**2
    for _ in range(_STEPS + 1):
        place = column - unknowns @ shape.mT
        seen, slope = _interpolated(second, place, row)
        wanted, seen, scale = _normalized(target, seen, weights)
        residual = wanted - seen
        # d I_R(x - d) / dd = -I_R', in units of the window's deviation.
        jacobian = -(slope / scale).unsqueeze(-1) * shape
        noise = (weights * residual**2).sum(-1) / weights.sum(-1).clamp(min=1e-9)
        noise = noise + (_LEAST_NOISE / scale[:, 0]) ** 2
        weighted = jacobian * weights.unsqueeze(-1)
        ridge = prior * noise[:, None, None]
        normal = weighted.mT @ jacobian + ridge
        right_side = (weighted.mT @ residual.unsqueeze(-1))[..., 0] - (ridge @ _slopes(unknowns).unsqueeze(-1))[..., 0]
        unknowns = unknowns + torch.linalg.solve(normal, right_side).clamp(-0.5, 0.5)
    inverse = torch.linalg.inv(normal)
    # Smoothed noise: raw noise of a variance so much larger, seen through the smoothed weights of the fit.
    pull = _smoothed(weighted.mT.reshape(-1, side, side)).reshape(weighted.mT.shape)
    spread = inverse @ (pull @ pull.mT / sum(tap**2 for tap in _BINOMIAL) ** 2 + ridge) @ inverse
    # Where the dense disparity is no plane, neither fit nor noise tell how far off the plane is.
    plane = (unknowns.unsqueeze(1) * shape).sum(-1)
    bumps = (weights * (dense[row, column].double() - plane).nan_to_num(0.0) ** 2).sum(-1)
    bumps = bumps / weights.sum(-1).clamp(min=1e-9)
    std = (spread[:, 0, 0] * noise + _UNEVEN**2 * bumps + _FLOOR**2).sqrt()
    alike = (weights * wanted * seen).sum(-1) / weights.sum(-1).clamp(min=1e-9)
    found = unknowns[:, 0]
    good = ((found - start).abs() <= _MAX_MOVE) & (alike >= _MIN_CORRELATION) & std.isfinite() & found.isfinite()
    return RefinedDisparity(found.to(left), std.to(left), good)


def _smoothed(images: Tensor) -> Tensor:
    """Return images (N, H, W) smoothed along rows and columns."""
    kernel = images.new_tensor(_BINOMIAL)
    padded = torch.nn.functional.pad(images.unsqueeze(1), (2, 2, 2, 2), mode="replicate")
    down = torch.nn.functional.conv2d(padded, kernel.reshape(1, 1, -1, 1))
    return torch.nn.functional.conv2d(down, kernel.reshape(1, 1, 1, -1))[:, 0]


def _slopes(unknowns: Tensor) -> Tensor:
    """Return the unknowns with zero for the disparity, on which there is no prior."""
    return unknowns * unknowns.new_tensor([0.0, 1.0, 1.0])


def _interpolated(image: Tensor, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """Return values and slopes along the rows at (N, K) fractional columns: cubic convolution (Keys 1981)."""
    whole = column.floor()
    t = column - whole
    taps = [image[row, (whole.long() + k).clamp(0, image.shape[1] - 1)] for k in (-1, 0, 1, 2)]
    a, b, c, d = taps
    rise, bend, twist = 0.5 * (c - a), a - 2.5 * b + 2 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c)
    return b + t * (rise + t * (bend + t * twist)), rise + t * (2 * bend + 3 * t * twist)


def _normalized(target: Tensor, seen: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return both windows (N, K) with weighted mean zero and deviation one, and the deviation (N, 1) of the second."""
    share = weights / weights.sum(-1, keepdim=True).clamp(min=1e-9)
    both = []
    for window in (target, seen):
        window = window - (share * window).sum(-1, keepdim=True)
        scale = (share * window**2).sum(-1, keepdim=True).sqrt().clamp(min=1e-6)
        both.append((window / scale, scale))
    return both[0][0], both[1][0], both[1][1]
