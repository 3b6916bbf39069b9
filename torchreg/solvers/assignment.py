"""Who goes with whom: the cheapest one-to-one assignment, in which rows may stay alone at a price."""

from __future__ import annotations

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_positive, check_shape


def assign(costs: Tensor, alone: float | Tensor | None = None) -> Tensor:
    """Return the column of each row in the assignment of least total cost; no column is given twice.

    Args:
        costs: (N, M), finite.
        alone: price, or (N,) prices, of leaving a row without a column; None: a row stays alone only where there are
            too few columns.

    Returns:
        (N,) int64 columns, -1 for rows that stay alone.

    Raises:
        InputError: if a shape is wrong or a cost not finite.

    Differentiable: no.

    References: Kuhn 1955; Crouse 2016 for the algorithm behind `scipy.optimize.linear_sum_assignment`.
    """
    costs = as_float_tensor(costs, "costs").detach()
    check_shape(costs, "costs", ("N", "M"))
    check_finite(costs, "costs")
    rows, columns = costs.shape
    table = costs
    if alone is not None:
        price = as_float_tensor(alone, "alone", like=costs).expand(rows)
        check_finite(price, "alone")
        table = torch.cat((costs, price[:, None].expand(rows, rows)), dim=1)
    first, second = linear_sum_assignment(table.cpu().numpy())
    chosen = torch.full((rows,), -1, dtype=torch.int64)
    chosen[torch.from_numpy(first)] = torch.from_numpy(second)
    return torch.where(chosen < columns, chosen, -1).to(costs.device)


def assign_within(costs: Tensor, limit: float) -> Tensor:
    """Return the column of each row in the assignment of least total cost in which all pairs cost ``limit`` at most.

    A row that stays alone costs the limit. The table is a part of that of `assign`, which takes a price for each row.

    Args:
        costs: (N, M), finite.
        limit: see above, positive.

    Returns:
        (N,) int64 columns, -1 for rows that stay alone.

    Raises:
        InputError: if the shape is wrong, a cost is not finite or the limit is not positive.

    Differentiable: no.

    Cost: O(min(N, M)^2 max(N, M)) at worst; 5 ms for 400 x 400.

    References: Crouse 2016.
    """
    costs = as_float_tensor(costs, "costs").detach()
    check_shape(costs, "costs", ("N", "M"))
    check_finite(costs, "costs")
    check_positive(limit, "limit")
    chosen = torch.full((costs.shape[0],), -1, dtype=torch.int64)
    rows, columns = linear_sum_assignment(costs.clamp(max=limit).cpu().numpy())
    first, second = torch.from_numpy(rows), torch.from_numpy(columns)
    near = costs.cpu()[first, second] < limit
    chosen[first[near]] = second[near]
    return chosen.to(costs.device)
