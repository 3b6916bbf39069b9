"""Rigid parts made of pieces that moved alike."""

from __future__ import annotations

import torch
from torch import Tensor


def merge_alike(residuals: Tensor, counts: Tensor, adjacent: Tensor, tolerance: float) -> Tensor:
    """Return the part (B,) of each piece, the index of one of its pieces: adjacent pieces of like motion are merged.

    ``residuals[t, a, b]`` sums the distances of the points of piece b from their observed positions under the motion of
    piece a in frame t. A merged piece moves as its larger member, so that chains of pieces do not merge into one part;
    merging ends at a mean residual of ``tolerance`` in the worst frame.
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
