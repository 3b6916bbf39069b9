"""The nearest point of the unit simplex: weights that are not negative and add up to one."""

from __future__ import annotations

import torch
from torch import Tensor


def nearest_on_simplex(rows: Tensor) -> Tensor:
    """Return ``argmin_x |x - v|^2`` subject to ``x >= 0, sum_j x_j = 1`` for every row v of rows (..., B)."""
    # An amount added to a whole row changes nothing, and entries more than one below the largest end at zero: so
    # large rows keep their digits.
    exact = rows.double()
    exact = (exact - exact.amax(-1, keepdim=True)).clamp_min(-1.0)
    descending = exact.sort(dim=-1, descending=True).values
    count = torch.arange(1, rows.shape[-1] + 1, dtype=exact.dtype, device=exact.device)
    thetas = (descending.cumsum(-1) - 1) / count
    num_positive = (descending > thetas).sum(-1, keepdim=True)
    return (exact - thetas.gather(-1, num_positive - 1)).clamp_min(0).to(rows.dtype)
