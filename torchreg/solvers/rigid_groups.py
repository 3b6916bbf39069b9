"""Rigid parts made of pieces that moved alike."""

from __future__ import annotations

import torch
from torch import Tensor


def merge_alike(residuals: Tensor, counts: Tensor, adjacent: Tensor, tolerance: float) -> Tensor:
    """Return the part of each piece after the two adjacent pieces of most similar motion are merged repeatedly.

    A merged piece moves as its larger member, so that chains of pieces, each of which moves much like the next, do not
    merge into one part. It ends when, of any two adjacent pieces, the motion of neither explains the points of the
    other within the tolerance, on average.

    Args:
        residuals: (T, B, B) sum of the distances of the points of piece b from their observed positions under the
            motion of piece a, ``[t, a, b]``, in each of T frames.
        counts: (B,) points of each piece; pieces without points are not merged.
        adjacent: (B, B) bool, symmetric.
        tolerance: of the mean residual over the points in the worst frame, in the unit of ``residuals``.

    Returns:
        Parts (B,) int64, each the index of one of its pieces.
    """
    residuals, counts, adjacent = residuals.clone(), counts.clone(), adjacent.clone().fill_diagonal_(False)
    part = torch.arange(len(counts), device=counts.device)
    adjacent &= (counts > 0) & (counts > 0).unsqueeze(1)
    while bool(adjacent.any()):
        mean = residuals / counts.clamp_min(1)
        difference = torch.minimum(mean, mean.mT).amax(0).masked_fill(~adjacent, torch.inf)
        kept, merged = divmod(int(difference.argmin()), len(counts))
        if float(difference[kept, merged]) > tolerance:
            break
        if counts[merged] > counts[kept]:
            kept, merged = merged, kept
        residuals[..., kept] += residuals[..., merged]
        counts[kept] += counts[merged]
        adjacent[kept] |= adjacent[merged]
        adjacent[:, kept] |= adjacent[:, merged]
        adjacent[merged], adjacent[:, merged], adjacent[kept, kept] = False, False, False
        part[part == merged] = kept
    return part
