"""The errors of real depth cameras: noise, steps, flying pixels and holes, with presets."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.errors import InputError


@dataclass(frozen=True)
class DepthNoise:
    """Error model of a depth camera, with ``std(z) = sqrt(constant^2 + (quadratic z^2)^2)``, metres.

    Args:
        constant: deviation from errors of timing, metres.
        quadratic: deviation from errors of disparity, 1 / metre.
        step: depths are rounded to multiples of it in ``1 / z``, 1 / metre; zero does not round.
        jitter: deviation of the position at which a pixel measures, pixels: it ruffles edges.
        flying: share of pixels at a jump in depth that mix both sides.
        dropout: share of pixels that measure nothing, everywhere.

    References: Khoshelham and Elberink 2012 (structured light); Foix et al. 2011 (time of flight).
    """

    constant: float = 0.0
    quadratic: float = 0.0
    step: float = 0.0
    jitter: float = 0.0
    flying: float = 0.0
    dropout: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            check_positive(getattr(self, field.name), field.name, allow_zero=True)
        for name in ("flying", "dropout"):
            if getattr(self, name) > 1:
                raise InputError(f"{name} is a share of the pixels, at most one, got {getattr(self, name)}")

    @classmethod
    def structured_light(cls) -> DepthNoise:
        """Return the noise of a camera that projects a pattern: 1.4 mm at one metre, in steps of 2.9 mm there."""
        return cls(quadratic=1.4e-3, step=2.9e-3, jitter=0.5, dropout=0.01)

    @classmethod
    def time_of_flight(cls) -> DepthNoise:
        """Return the noise of a camera that times light: 3 mm near by, 3.6 mm at one metre, with flying pixels."""
        return cls(constant=3e-3, quadratic=2e-3, flying=0.7, dropout=0.002)

    def depth_std(self, depth: Tensor) -> Tensor:
        """Return the standard deviations (...,) of depths (...,), rounding included, metres."""
        rounding = self.step / math.sqrt(12)
        return torch.sqrt(self.constant**2 + (self.quadratic**2 + rounding**2) * depth**4)

    def measured(self, depth: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return true depth images (..., H, W), metres, with the camera's errors; zero where nothing is measured."""
        check_shape(depth, "depth", ("H", "W"), batch=True)
        generator = torch.Generator().manual_seed(0) if generator is None else generator

        def drawn(kind: str) -> Tensor:
            source = torch.randn if kind == "normal" else torch.rand
            return source(depth.shape, generator=generator, dtype=torch.float64).to(depth)

        seen = torch.where(depth.isfinite() & (depth > 0), depth, 0.0)
        if self.jitter:
            seen = _jittered(seen, self.jitter * drawn("normal"), self.jitter * drawn("normal"))
        if self.flying:
            seen = _with_flying_pixels(seen, drawn("uniform") < self.flying, drawn("uniform"))
        valid = seen > 0
        spread = torch.sqrt(self.constant**2 + (self.quadratic * seen**2) ** 2)
        noisy = torch.where(valid, seen + spread * drawn("normal"), 0.0)
        valid = valid & (noisy > 0)
        if self.step:
            nearness = 1 / torch.where(valid, noisy, 1.0)
            noisy = 1 / (self.step * (nearness / self.step).round().clamp(min=1))
        if self.dropout:
            valid = valid & (drawn("uniform") >= self.dropout)
        return torch.where(valid, noisy, 0.0)


def _jittered(depth: Tensor, right: Tensor, down: Tensor) -> Tensor:
    """Return depths (..., H, W) looked up at pixels shifted by steps (..., H, W) to the right and down."""
    height, width = depth.shape[-2:]
    row = torch.arange(height, device=depth.device)[:, None] + down.round().long()
    column = torch.arange(width, device=depth.device) + right.round().long()
    pixel = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    return depth.flatten(-2).gather(-1, pixel.flatten(-2)).reshape(depth.shape)


def _with_flying_pixels(depth: Tensor, chosen: Tensor, share: Tensor) -> Tensor:
    """Return depths whose chosen pixels mix with the farthest of four neighbors, where that is 3 % farther or more."""
    padded = torch.nn.functional.pad(depth, (1, 1, 1, 1))
    sides = (padded[..., :-2, 1:-1], padded[..., 2:, 1:-1], padded[..., 1:-1, :-2], padded[..., 1:-1, 2:])
    behind = torch.stack(sides).amax(0)
    jump = (depth > 0) & (behind > 1.03 * depth)
    return torch.where(jump & chosen, depth + share * (behind - depth), depth)
