"""Few points that stand for many: those farthest apart, or a random draw in which no crowded place outvotes others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class _Crowding:
    """When places hold so many points that fewer of them are drawn."""

    cells: float = 40.0  # cubes along the size of what is measured: its surface fills hundreds of them
    places: int = 200  # that points are drawn from as if all of them held as many, at least
    share: float = 0.5  # the same, of the places that hold any where these are fewer


_CROWDING = _Crowding()


def draw_spread(points: Tensor, count: int, size: float, generator: torch.Generator) -> Tensor:
    """Return indices of points drawn at random, of which those in crowded places are drawn more rarely."""
    place, held = _places(points, size / _CROWDING.cells)
    weight = (_crowded_from(held) / held).clamp_max(1).float()[place]
    waiting = torch.empty(len(points), dtype=torch.float32).exponential_(generator=generator).to(points.device)
    return waiting.div_(weight).topk(count, largest=False).indices.sort().values


def _places(points: Tensor, cell: float) -> tuple[Tensor, Tensor]:
    """Return the number (M,) of the cube that each of points (M, 3) lies in, and how many each cube holds."""
    # 21 bits for each axis; what lies farther away than these reach shares a number with others.
    code = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for axis, values in enumerate(points.unbind(-1)):
        code += (values / cell).floor_().clamp_(-(2.0**62), 2.0**62).long() << (21 * axis)
    return torch.unique(code, return_inverse=True, return_counts=True)[1:]


def _crowded_from(held: Tensor) -> Tensor:
    """Return the number () of points from which on places that hold some numbers (K,) are crowded."""
    held = held.double().sort(descending=True).values
    # Of places as full as each one that hold all points if fuller ones are thinned to its number.
    effective = torch.arange(len(held)).to(held) + held.flip(0).cumsum(0).flip(0) / held
    wanted = min(float(_CROWDING.places), _CROWDING.share * len(held))
    return held[(effective >= wanted).nonzero()[0, 0]]


def farthest_points(points: Tensor, count: int, start: int = 0) -> Tensor:
    """Return the indices (count,) of points, each next one the farthest from those chosen (Gonzalez 1985)."""
    chosen = torch.empty(count, dtype=torch.long, device=points.device)
    chosen[0] = start
    nearest = torch.full_like(points[:, 0], torch.inf)
    for index in range(1, count):
        nearest = torch.minimum(nearest, (points - points[chosen[index - 1]]).square().sum(-1))
        # Below every distance, so that no point is chosen twice among duplicates.
        nearest[chosen[index - 1]] = -1
        chosen[index] = nearest.argmax()
    return chosen


def even_order(points: Tensor, count: int | None = None) -> Tensor:
    """Return the indices (count,) in an order of which every beginning covers the cloud evenly (Gonzalez 1985)."""
    centered = points.detach().cpu().double().numpy()
    centered = centered - centered.mean(axis=0)
    squares = (centered**2).sum(axis=1)
    order = np.empty(len(centered) if count is None else count, dtype=np.int64)
    order[0], nearest = squares.argmax(), np.full(len(centered), np.inf)
    for index in range(1, len(order)):
        last = order[index - 1]
        np.minimum(nearest, squares - centered @ (2 * centered[last]) + squares[last], out=nearest)
        # Below every distance, rounding included, so that no point is chosen twice among duplicates.
        nearest[last] = -np.inf
        order[index] = nearest.argmax()
    return torch.from_numpy(order).to(points.device)
