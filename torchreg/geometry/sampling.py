"""Farthest-point sampling: few points that cover many."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


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
    """Return the indices (count,) in an order of which every beginning covers the cloud evenly (Gonzalez 1985).

    The first is the farthest from the centroid; the order of equally far points is not defined.
    """
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
