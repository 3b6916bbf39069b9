"""Coordinates far from the origin, as those of maps, which single precision rounds to decimetres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

Value = TypeVar("Value")


@dataclass(frozen=True)
class _Far:
    """When points are far from the origin."""

    ratio: float = 200.0  # distance over spread from which float32 rounds by more than 1e-5 of the spread
    sample: int = 10_000  # points that decide


_FAR = _Far()


def far_origin(points: Tensor | Sequence[Tensor]) -> Tensor | None:
    """Return an origin (3,) of whole numbers near far double-precision points, None where float32 is good enough."""
    tensors = [points] if isinstance(points, Tensor) else list(points)
    if not tensors or any(tensor.dtype != torch.float64 for tensor in tensors):
        return None
    rows = [tensor.detach().reshape(-1, tensor.shape[-1]) for tensor in tensors]
    middle, spread = _middle(rows[0] if len(rows) == 1 else torch.cat(rows))
    return middle.round() if middle is not None and float(middle.abs().max()) > _FAR.ratio * spread > 0 else None


def to_local(value: Value, origin: Tensor | None) -> Value:
    """Return points, poses (..., D), a scan or an observation in float64 from an origin (3,); the same without one."""
    if value is None or origin is None:
        return value
    given: Any = value
    if isinstance(given, Tensor):
        given = given.double()
        return cast(Value, torch.cat([given[..., :3] - origin.to(given.device), given[..., 3:]], dim=-1))
    return given.near(origin) if hasattr(given, "near") else given.shifted(-origin)


def to_world(value: Value, origin: Tensor | None) -> Value:
    """Return poses, or a result, whose coordinates begin at an origin (3,), in those in which the origin is given."""
    if origin is None:
        return value
    given: Any = value
    return to_local(value, -origin) if isinstance(value, Tensor) else given.moved(origin)


def _middle(points: Tensor) -> tuple[Tensor | None, float]:
    """Return the median (3,) of points (N, 3) and their spread, neither of which a few outliers change much."""
    sample = points[:: max(1, len(points) // _FAR.sample)].cpu()
    sample = sample[torch.isfinite(sample).all(-1)]
    if not len(sample):
        return None, 0.0
    middle = sample.median(0).values
    spread = float((sample - middle).abs().median(0).values.norm())
    return middle, spread or float((sample.amax(0) - sample.amin(0)).norm())
