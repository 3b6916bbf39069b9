"""The width sigma of the correspondence kernel over an alignment: schedules, and the estimate of a conventional EM."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.errors import InputError
from torchreg.solvers.e_step import EStep


@dataclass(frozen=True)
class _Narrowing:
    """How fast the kernel of a fit narrows."""

    ratio: float = 0.62  # of successive widths, at most: a few steps at one reduce the error of a pose as much


_NARROWING = _Narrowing()


def narrowing(start: float, stop: float) -> tuple[float, ...]:
    """Return kernel widths from the error of a start down to the noise, or to what the next stage bridges."""
    count = math.ceil(math.log(stop / start) / math.log(_NARROWING.ratio))
    return tuple(start * (stop / start) ** (number / count) for number in range(count + 1))


@dataclass(frozen=True)
class SigmaSchedule:
    """The sequence of sigmas of an annealed EM.

    Build one with `geometric`, `linear`, `constant` or `adaptive`.

    Args:
        values: sigma of every step, metres, never rising; for "adaptive" the first value and the floor.
        steps: number of steps.
        kind: "fixed" (the values are the schedule) or "adaptive" (sigma is estimated after each step).

    Raises:
        InputError: if a value is not positive, the values rise, or their number does not fit ``steps`` and ``kind``.
        InputTypeError: if ``steps`` is not an integer.

    References: Dewaele et al. 2006, section 3.3.
    """

    values: tuple[float, ...]
    steps: int
    kind: Literal["fixed", "adaptive"] = "fixed"

    def __post_init__(self) -> None:
        check_choice(self.kind, "kind", ("fixed", "adaptive"))
        check_count(self.steps, "steps", 1)
        expected = self.steps if self.kind == "fixed" else 2
        if len(self.values) != expected:
            raise InputError(
                f"values must hold {expected} sigmas for {self.steps} {self.kind} steps, got {self.values}"
            )
        for index, value in enumerate(self.values):
            check_positive(value, f"values[{index}]")
        if any(later > earlier for earlier, later in pairwise(self.values)):
            raise InputError(f"values must not rise from one step to the next, got {self.values}")

    @classmethod
    def geometric(cls, start: float, stop: float, steps: int = 5) -> SigmaSchedule:
        """Return ``sigma_{q+1} = kappa sigma_q`` from ``start`` down to ``stop``, as in the paper.

        Args:
            start: first sigma, metres: the largest motion that is to be found.
            stop: last sigma, metres: the noise of the data.
            steps: number of sigmas; with one, ``start`` is the only sigma.

        Raises:
            InputError: if a sigma is not positive, ``stop`` exceeds ``start``, or ``steps`` is below one.
            InputTypeError: if a sigma is not a number, or ``steps`` not an integer.
        """
        _check_range(start, stop, steps)
        ratio = (stop / start) ** (1 / max(steps - 1, 1))
        return cls(_between(start, stop, [start * ratio**step for step in range(steps)]), steps)

    @classmethod
    def linear(cls, start: float, stop: float, steps: int = 5) -> SigmaSchedule:
        """Return sigmas that fall by the same amount each step, from ``start`` to ``stop``, metres.

        Arguments and errors are those of `geometric`.
        """
        _check_range(start, stop, steps)
        fall = (start - stop) / max(steps - 1, 1)
        return cls(_between(start, stop, [start - fall * step for step in range(steps)]), steps)

    @classmethod
    def constant(cls, sigma: float, steps: int = 5) -> SigmaSchedule:
        """Return the same sigma for every step, metres.

        Raises:
            InputError: if ``sigma`` is not positive, or ``steps`` is below one.
            InputTypeError: if ``sigma`` is not a number, or ``steps`` not an integer.
        """
        _check_range(sigma, sigma, steps)
        return cls((sigma,) * steps, steps)

    @classmethod
    def adaptive(cls, start: float, stop: float, steps: int = 20) -> SigmaSchedule:
        """Return the conventional schedule: sigma is re-estimated from the residuals, never below ``stop``.

        Each M-step ends with the sigma that maximizes eq. 19 (see `estimate_sigma`), between ``start`` and ``stop``.
        The paper observes that it falls too quickly and gets trapped; it serves for comparison. Arguments and errors
        are those of `geometric`.
        """
        _check_range(start, stop, steps)
        return cls((start, stop), steps, "adaptive")


def estimate_sigma(matches: EStep, before: Tensor, after: Tensor) -> Tensor:
    """Return the sigma (...) that the M-step of a conventional EM estimates from the points (..., N, 3) that it moved.

    ``sigma^2 = sum_ij alpha_ij |Y_j - T(X_i)|^2 / (3 sum_ij alpha_ij)``, zero without inliers. Dewaele et al. 2006,
    3.3.
    """
    decrease = (before - matches.targets).square().sum(-1) - (after - matches.targets).square().sum(-1)
    squares = matches.squared_error - (matches.weights * decrease).sum(-1)
    mass = matches.weights.sum(-1).clamp_min(torch.finfo(squares.dtype).tiny)
    return (squares.clamp_min(0) / (3 * mass)).sqrt()


def _check_range(start: float, stop: float, steps: int) -> None:
    check_positive(start, "start")
    check_positive(stop, "stop")
    if stop > start:
        raise InputError(f"stop must not exceed start, got start {start} and stop {stop}")
    check_count(steps, "steps", 1)


def _between(start: float, stop: float, values: list[float]) -> tuple[float, ...]:
    """Return the values with rounding beyond the two ends removed."""
    return tuple(min(max(value, stop), start) for value in values)
