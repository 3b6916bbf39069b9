"""How the width of the correspondence kernel shrinks over an alignment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchreg._checks import check_positive
from torchreg.errors import InputError, InputTypeError


@dataclass(frozen=True)
class SigmaSchedule:
    """The sequence of sigmas of an annealed EM.

    Build one with `geometric`, `linear`, `constant` or `adaptive`.

    Args:
        values: sigma of every step, metres, largest first; for "adaptive" the first value and the floor.
        kind: "fixed" (the values are the schedule) or "adaptive" (sigma is estimated after each step).
        steps: number of steps.

    References: Dewaele et al. 2006, section 3.3.
    """

    values: tuple[float, ...]
    steps: int
    kind: Literal["fixed", "adaptive"] = "fixed"

    def __post_init__(self) -> None:
        if isinstance(self.steps, bool) or not isinstance(self.steps, int):
            raise InputTypeError(f"steps must be an integer, got {type(self.steps).__name__}")
        if self.steps < 1:
            raise InputError(f"steps must be at least 1, got {self.steps}")
        for value in self.values:
            check_positive(value, "sigma")

    @classmethod
    def geometric(cls, start: float, stop: float, steps: int = 5) -> SigmaSchedule:
        """Return ``sigma_{q+1} = kappa sigma_q`` from ``start`` down to ``stop``, as in the paper.

        Args:
            start: first sigma, metres: the largest motion that is to be found.
            stop: last sigma, metres: the noise of the data.
            steps: number of sigmas.
        """
        _check_range(start, stop, steps)
        ratio = (stop / start) ** (1 / max(steps - 1, 1))
        return cls(tuple(start * ratio**step for step in range(steps)), steps)

    @classmethod
    def linear(cls, start: float, stop: float, steps: int = 5) -> SigmaSchedule:
        """Return sigmas that fall by the same amount each step, from ``start`` to ``stop``, metres."""
        _check_range(start, stop, steps)
        fall = (start - stop) / max(steps - 1, 1)
        return cls(tuple(start - fall * step for step in range(steps)), steps)

    @classmethod
    def constant(cls, sigma: float, steps: int = 5) -> SigmaSchedule:
        """Return the same sigma for every step, metres."""
        _check_range(sigma, sigma, steps)
        return cls((sigma,) * steps, steps)

    @classmethod
    def adaptive(cls, start: float, stop: float, steps: int = 20) -> SigmaSchedule:
        """Return the conventional schedule: sigma is re-estimated from the residuals, never below ``stop``.

        The paper observes that it falls too quickly and gets trapped; it is here for comparison.
        """
        _check_range(start, stop, steps)
        return cls((start, stop), steps, "adaptive")


def _check_range(start: float, stop: float, steps: int) -> None:
    check_positive(start, "start")
    check_positive(stop, "stop")
    if stop > start:
        raise InputError(f"stop must not exceed start, got start {start} and stop {stop}")
    if steps < 1:
        raise InputError(f"steps must be at least 1, got {steps}")
