"""Settings that run from a first to a last value in even ratios."""

from __future__ import annotations

from torchreg._checks import check_positive
from torchreg.errors import InputError, InputTypeError


def geometric_at(ends: tuple[float, float], progress: float) -> float:
    """Return the value at a progress from 0 to 1 between the first and the last, and the last one after."""
    first, last = ends
    return float(first * (last / first) ** min(progress, 1.0))


def check_ends(ends: tuple[float, float], name: str, *, allow_zero: bool = False) -> None:
    """Raise unless there are two positive numbers."""
    if not isinstance(ends, (tuple, list)):
        raise InputTypeError(f"{name} must be two numbers, first and last, got {type(ends).__name__}")
    if len(ends) != 2:
        raise InputError(f"{name} must be two numbers, first and last, got {len(ends)}")
    for value in ends:
        check_positive(value, name, allow_zero=allow_zero)
