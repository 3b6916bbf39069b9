"""The numerical rank of a point set: zero for one position, one for a line, two for a plane."""

from __future__ import annotations

import torch
from torch import Tensor

# A cloud thinner than this share of its longest side is flat: no limb is, and hardly a sensor measures, so thin.
_FLAT_SHARE = 1e-3
# Points within this share of the size of what they are measured on are one: no two units differ so much.
SAME_SHARE = 1e-6
SPREADS = ("at one place", "on a line", "on a plane")


def spread_dimensions(points: Tensor, size: float | Tensor, valid: Tensor | None = None) -> Tensor:
    """Return the rank (...), 0 to 3, of points (..., N, 3), whose position is precise to a millionth of ``size``."""
    points = points.detach().double()
    weights = torch.ones_like(points[..., 0]) if valid is None else valid.to(points)
    total = weights.sum(-1).clamp_min(1)[..., None, None]
    centered = points - (weights.unsqueeze(-1) * points).sum(-2, keepdim=True) / total
    covariance = (weights.unsqueeze(-1) * centered).mT @ centered / total
    deviations = torch.linalg.eigvalsh(covariance).clamp_min(0).sqrt()
    least = SAME_SHARE * torch.as_tensor(size).to(deviations)
    return (deviations > torch.maximum(_FLAT_SHARE * deviations[..., -1:], least)).sum(-1)
