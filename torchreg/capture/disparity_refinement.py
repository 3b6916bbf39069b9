"""Disparities to a fraction of a pixel: windows fitted by least squares, with the uncertainty of the fit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# Pictures are smoothed by this binomial first, along rows and columns: noise is then the same at fractional positions.
_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


@dataclass(frozen=True)
class _WindowFit:
    """Fit of the window of a pixel; lengths in pixels."""

    radius: int = 5  # half of the window's side: 11 x 11 pixels
    spread: float = 2.0  # standard deviation of the Gaussian weights in the picture
    num_steps: int = 9  # of Gauss-Newton
    same_surface: float = 1.5  # pixels farther in dense disparity from the middle lie on another surface
    slope_std: float = 0.3  # of the prior on the slopes of disparity, pixels per pixel
    min_noise: float = 1e-3  # of pictures from 0 to 1; without noise a flat window would have no uncertainty
    max_move: float = 1.5  # a fit that leaves the dense disparity by more is refused
    min_correlation: float = 0.8  # windows that correlate less are refused
    uneven_share: float = 0.5  # of the window's deviation from a plane, by which the middle may be off
    min_std: float = 0.05  # no fit is more certain


_FIT = _WindowFit()


@dataclass(frozen=True, eq=False)
class RefinedDisparity:
    """Disparities (N,) and standard deviations, pixels; good: near the dense disparity, windows that correlate."""

    disparity: Tensor
    std: Tensor
    good: Tensor


@dataclass(frozen=True, eq=False)
class _Windows:
    """The K pixels around each of N pixels, with Gaussian weights, zero on other surfaces; float64.

    ``basis`` (K, 3): one, the step along the row, the step down.
    """

    column: Tensor
    row: Tensor
    basis: Tensor
    disparity: Tensor
    weights: Tensor

    @classmethod
    def from_dense(cls, dense: Tensor, pixels: Tensor) -> _Windows:
        """Return the windows around pixels (N, 2) of a dense disparity (H, W)."""
        step = torch.arange(-_FIT.radius, _FIT.radius + 1, device=dense.device)
        down, along = (part.reshape(-1) for part in torch.meshgrid(step, step, indexing="ij"))
        column = (pixels[:, :1] + along).clamp(0, dense.shape[1] - 1)
        row = (pixels[:, 1:] + down).clamp(0, dense.shape[0] - 1)
        disparity, middle = dense[row, column], dense[pixels[:, 1], pixels[:, 0]].double()
        same = ((disparity - middle[:, None]).abs() <= _FIT.same_surface).double()
        # Smoothing spreads another surface over its edge by a pixel and more.
        square = (1 - same).reshape(-1, 1, len(step), len(step))
        same = 1 - torch.nn.functional.max_pool2d(square, 3, 1, 1).reshape(same.shape)
        weights = same * torch.exp(-0.5 * (along**2 + down**2) / _FIT.spread**2).double()
        basis = torch.stack((torch.ones_like(along), along, down), dim=-1).double()
        return cls(column=column, row=row, basis=basis, disparity=disparity.double(), weights=weights)

    def mean(self, values: Tensor) -> Tensor:
        """Return the weighted means (N,) of values (N, K)."""
        return (self.weights * values).sum(-1) / self.weights.sum(-1).clamp(min=1e-9)


def refine_disparity(left: Tensor, right: Tensor, dense: Tensor, pixels: Tensor) -> RefinedDisparity:
    """Return disparities of N pixels (column, row) to a fraction of a pixel, from 11 x 11 (Lucas and Kanade 1981).

    Gauss-Newton minimizes ``sum_q w_q (I_L(q) - g I_R(q - d - s . (q - p)) - b)^2`` over disparity d and slopes s, with
    gain g and offset b from the windows' means and deviations; w is a Gaussian, zero on other surfaces. Both pictures
    are smoothed first; without it, noise biases fractions towards a half.
    """
    windows = _Windows.from_dense(dense, pixels)
    start = dense[pixels[:, 1], pixels[:, 0]].double()
    first, second = _smoothed(torch.stack((left, right)).double())
    plane, variance, correlation = _fit_planes(first, second, windows, start)
    # Where the dense disparity is no plane, fit and noise do not cover the error of the plane.
    unevenness = windows.mean((windows.disparity - (plane.unsqueeze(1) * windows.basis).sum(-1)).nan_to_num(0.0) ** 2)
    std = (variance + _FIT.uneven_share**2 * unevenness + _FIT.min_std**2).sqrt()
    found = plane[:, 0]
    near = (found - start).abs() <= _FIT.max_move
    good = near & (correlation >= _FIT.min_correlation) & std.isfinite() & found.isfinite()
    return RefinedDisparity(found.to(left), std.to(left), good)


def _fit_planes(first: Tensor, second: Tensor, windows: _Windows, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return disparity and slopes (N, 3), variances of the disparities and correlations (N,), by Gauss-Newton."""
    target = first[windows.row, windows.column]
    plane = torch.stack((start, torch.zeros_like(start), torch.zeros_like(start)), dim=-1)
    prior = torch.diag(plane.new_tensor([1e-9, 1.0, 1.0])) / _FIT.slope_std**2
    for _ in range(_FIT.num_steps):
        values, derivative = _interpolated(second, windows.column - plane @ windows.basis.mT, windows.row)
        wanted, seen, scale = _normalized(target, values, windows.weights)
        residual = wanted - seen
        # d I_R(x - d) / dd = -I_R', in units of the window's deviation.
        jacobian = -(derivative / scale).unsqueeze(-1) * windows.basis
        noise = windows.mean(residual**2) + (_FIT.min_noise / scale[:, 0]) ** 2
        weighted = jacobian * windows.weights.unsqueeze(-1)
        ridge = prior * noise[:, None, None]
        normal = weighted.mT @ jacobian + ridge
        gradient = (weighted.mT @ residual.unsqueeze(-1))[..., 0] - (ridge @ _slopes(plane).unsqueeze(-1))[..., 0]
        plane = plane + torch.linalg.solve(normal, gradient).clamp(-0.5, 0.5)
    # Smoothed noise: raw noise of a variance so much larger, seen through the smoothed weights of the fit.
    rows, side = weighted.mT, 2 * _FIT.radius + 1
    rows = _smoothed(rows.reshape(-1, side, side)).reshape(rows.shape)
    inverse = torch.linalg.inv(normal)
    spread = inverse @ (rows @ rows.mT / sum(tap**2 for tap in _BINOMIAL) ** 2 + ridge) @ inverse
    return plane, spread[:, 0, 0] * noise, windows.mean(wanted * seen)


def _smoothed(images: Tensor) -> Tensor:
    """Return images (N, H, W) smoothed along rows and columns."""
    kernel = images.new_tensor(_BINOMIAL)
    padded = torch.nn.functional.pad(images.unsqueeze(1), (2, 2, 2, 2), mode="replicate")
    down = torch.nn.functional.conv2d(padded, kernel.reshape(1, 1, -1, 1))
    return torch.nn.functional.conv2d(down, kernel.reshape(1, 1, 1, -1))[:, 0]


def _slopes(plane: Tensor) -> Tensor:
    """Return planes (N, 3) with zero for the disparity, on which there is no prior."""
    return plane * plane.new_tensor([0.0, 1.0, 1.0])


def _interpolated(image: Tensor, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """Return values and slopes along the rows at (N, K) fractional columns: cubic convolution (Keys 1981)."""
    floor = column.floor()
    t = column - floor
    taps = [image[row, (floor.long() + k).clamp(0, image.shape[1] - 1)] for k in (-1, 0, 1, 2)]
    a, b, c, d = taps
    rise, bend, twist = 0.5 * (c - a), a - 2.5 * b + 2 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c)
    return b + t * (rise + t * (bend + t * twist)), rise + t * (2 * bend + 3 * t * twist)


def _normalized(target: Tensor, seen: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return both windows (N, K) with weighted mean zero and deviation one, and the deviation (N, 1) of the second."""
    share = weights / weights.sum(-1, keepdim=True).clamp(min=1e-9)
    centered = [window - (share * window).sum(-1, keepdim=True) for window in (target, seen)]
    scales = [(share * window**2).sum(-1, keepdim=True).sqrt().clamp(min=1e-6) for window in centered]
    return centered[0] / scales[0], centered[1] / scales[1], scales[1]
