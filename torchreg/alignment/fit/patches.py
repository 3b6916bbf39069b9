"""Effective sample size under patch-correlated errors, as of a mesh, a joint or a depth."""

from __future__ import annotations

import torch
from torch import Tensor

# Edge of the patches within which data err together, as a share of the size: about a link of an arm.
_PATCH = 0.15


def independent_share(points: Tensor, size: float) -> float:
    """Return the share of points (M, 3) on a thing of some size, metres, that are independent: one for each patch."""
    return max(1, len((points / (_PATCH * size)).floor().unique(dim=0))) / max(1, len(points))


def errors_per_patch(data: Tensor, valid: Tensor, size: float) -> Tensor:
    """Return the mean number (B,) of data in a patch, which err as one, of a model of some size."""
    shares = [independent_share(points[chosen], size) for points, chosen in zip(data, valid, strict=True)]
    return torch.tensor([1 / share for share in shares]).to(data)
