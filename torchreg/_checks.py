"""Argument checks; every message names the argument, the expected value, the given one and a remedy."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchreg.errors import InputError, InputTypeError, PrecisionWarning

# Share of the size of what is measured up to which rounding is no worse than the noise of good sensors.
_ROUNDING_SHARE = 1e-3


def as_tensor(value: Any, name: str, content: str) -> Tensor:
    """Return ``value`` as a tensor of its dtype; ``content`` names the expected entries, such as "integers"."""
    if isinstance(value, Tensor):
        return value
    try:
        return torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputTypeError(f"{name} must be a tensor or an array of {content}, got {type(value).__name__}") from error


def as_float_tensor(value: Any, name: str, *, like: Tensor | None = None) -> Tensor:
    """Return ``value`` as a floating-point tensor, on the dtype and device of ``like`` when it is given."""
    given, value = value, as_tensor(value, name, "numbers")
    if value.is_complex() or value.dtype == torch.bool:
        raise InputTypeError(f"{name} must hold real numbers, got dtype {value.dtype}")
    if like is not None:
        if value.is_floating_point() and not hasattr(given, "dtype"):
            value = torch.as_tensor(given, dtype=torch.float64)  # Python's numbers have that many digits
        return value.to(dtype=like.dtype, device=like.device)
    return value if value.is_floating_point() else value.to(torch.get_default_dtype())


def check_shape(value: Tensor, name: str, expected: Sequence[int | str | None], *, batch: bool = False) -> None:
    """Raise InputError unless the trailing sizes of ``value`` are ``expected``; None or a str is any size."""
    got = tuple(value.shape)
    trailing = got[len(got) - len(expected) :] if len(got) >= len(expected) else ()
    fits = len(trailing) == len(expected) and (batch or len(got) == len(expected))
    if not fits or any(isinstance(want, int) and want != have for want, have in zip(expected, trailing, strict=True)):
        sizes = ", ".join("*" if want is None else str(want) for want in expected)
        lead = "..., " if batch else ""
        raise InputError(f"{name} must have shape ({lead}{sizes}), got {got}")


def check_finite(value: Tensor, name: str, hint: str = "") -> None:
    """Raise InputError with their number if ``value`` holds NaN or infinity."""
    if all_finite(value):
        return
    bad = int((~torch.isfinite(value)).sum())
    if bad:
        raise InputError(
            f"{name} must be finite, got {bad} non-finite of {value.numel()} numbers{'; ' + hint if hint else ''}"
        )


def all_finite(value: Tensor) -> bool:
    """Return whether no number is NaN or infinite: their sum is, where one is, and takes one pass over memory."""
    return bool(torch.isfinite(value.detach().sum())) or bool(torch.isfinite(value).all())


def check_points(value: Tensor, name: str, *, min_count: int = 1, batch: bool = True) -> None:
    """Raise InputError unless ``value`` is a finite ``(..., N, 3)`` tensor with at least ``min_count`` points."""
    check_shape(value, name, ("N", 3), batch=batch)
    if value.shape[-2] < min_count:
        raise InputError(f"{name} must hold at least {min_count} point(s), got {value.shape[-2]}")
    check_finite(value, name)


def check_positive(value: float, name: str, *, allow_zero: bool = False) -> None:
    """Raise InputError unless the number ``value`` is finite and positive (or zero, when allowed)."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputTypeError(f"{name} must be a number, got {type(value).__name__}")
    if not math.isfinite(value) or value < 0 or (value == 0 and not allow_zero):
        raise InputError(f"{name} must be {'zero or ' if allow_zero else ''}positive and finite, got {value}")


def check_count(value: int, name: str, least: int) -> None:
    """Raise InputTypeError unless ``value`` is an integer, InputError if it is below ``least``."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputTypeError(f"{name} must be an integer, got {type(value).__name__}")
    if value < least:
        raise InputError(f"{name} must be at least {least}, got {value}")


def check_direction(value: Sequence[float] | Tensor, name: str) -> tuple[float, float, float]:
    """Return three numbers, finite and not all zero, of a direction in space."""
    direction = as_float_tensor(value, name)
    check_shape(direction, name, (3,))
    check_finite(direction, name)
    if not bool(direction.any()):
        raise InputError(f"{name} must be a direction, got zeros")
    x, y, z = direction.tolist()
    return x, y, z


def check_choice(value: str, name: str, choices: Sequence[str]) -> None:
    """Raise InputError unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise InputError(f"{name} must be one of {', '.join(choices)}; got {value!r}")


def check_same_kind(value: Tensor, name: str, like: Tensor, like_name: str) -> None:
    """Raise InputTypeError unless the two tensors share dtype and device."""
    if value.dtype != like.dtype or value.device != like.device:
        raise InputTypeError(
            f"{name} is {value.dtype} on {value.device} but {like_name} is {like.dtype} on {like.device}; "
            f"convert one with .to()"
        )


def warn_about_rounding(points: Tensor, name: str, size: float, *, stacklevel: int) -> None:
    """Warn if the dtype rounds points (..., 3) of something of a ``size`` coarsely, so far from the origin."""
    distance = float(points.detach().abs().max()) if points.numel() else 0.0
    rounding = distance * torch.finfo(points.dtype).eps
    if rounding > _ROUNDING_SHARE * size:
        warnings.warn(
            f"{name} lie {distance:.3g} from the origin, where {str(points.dtype).removeprefix('torch.')} rounds to "
            f"{rounding:.2g}, of a size of {size:.3g}: subtract an offset in float64 first, or compute in float64",
            PrecisionWarning,
            stacklevel=stacklevel + 1,
        )
