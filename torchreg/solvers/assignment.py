"""Minimum-cost one-to-one assignments in which rows may stay unmatched at a cost."""

from __future__ import annotations

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor


def assign(costs: Tensor, unmatched_cost: Tensor | float | None = None) -> Tensor:
    """Return the column of each row in the assignment of least total cost; no column is given twice.

    Args:
        costs: (N, M), finite.
        unmatched_cost: cost of leaving a row without a column, or (N,) costs; None: rows stay unmatched only if there
            are too few columns.

    Returns:
        Columns (N,) int64, -1 for unmatched rows.

    Differentiable: no.

    References: Kuhn 1955; Crouse 2016 for the algorithm behind `scipy.optimize.linear_sum_assignment`.
    """
    rows, columns = costs.shape
    table = costs.detach()
    if unmatched_cost is not None:
        unmatched = torch.as_tensor(unmatched_cost, dtype=costs.dtype, device=costs.device).expand(rows)
        table = torch.cat((table, unmatched[:, None].expand(rows, rows)), dim=1)
    first, second = linear_sum_assignment(table.cpu().numpy())
    chosen = torch.full((rows,), -1, dtype=torch.int64)
    chosen[torch.from_numpy(first)] = torch.from_numpy(second)
    return torch.where(chosen < columns, chosen, -1).to(costs.device)
