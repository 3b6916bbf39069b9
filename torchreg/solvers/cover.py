"""Combinations of one row from each of several tables that together cover all columns at least cost."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import torch
from torch import Tensor


def best_covers(
    uncovered: Tensor,
    tables: Sequence[Tensor],
    costs: Sequence[Tensor],
    *,
    count: int = 8,
    beam: int = 64,
    num_exchanged: int = 3,
    sweeps: int = 2,
) -> tuple[Tensor, Tensor]:
    """Return the best combinations of one row per table, ``min sum_j min(u_j, min_f T_f[k_f, j]) + sum_f c_f[k_f]``.

    From u (B, M), F tables (B, K_f, M) and their row costs (B, K_f): indices (B, C, F) int64 and total costs (B, C),
    best first, repeated ones last. A beam search over the tables, in their order, then, for the best ``num_exchanged``,
    exchanges of pairs of rows, which find two rows that must change at once.
    """
    index, total = _beam(uncovered, tables, costs, max(beam, count))
    if num_exchanged > 0 and len(tables) > 1:
        chosen = index[:, :num_exchanged]
        for _ in range(sweeps):
            for pair in combinations(range(len(tables)), 2):
                chosen = _exchanged(uncovered, tables, costs, chosen, *pair)
        index = torch.cat([chosen, index], dim=1)
        total = torch.cat([_total(uncovered, tables, costs, chosen), total], dim=1)
    order = total.argsort(dim=1, stable=True)
    index, total = _take(index, order), total.gather(1, order)
    order = _repeats(index).to(torch.uint8).argsort(dim=1, stable=True)[:, :count]
    return _take(index, order), total.gather(1, order)


def _repeats(index: Tensor) -> Tensor:
    """Return a mask (B, C) of the combinations that equal an earlier one."""
    same = (index.unsqueeze(2) == index.unsqueeze(1)).all(-1)
    return same.tril(-1).any(-1)


def _beam(uncovered: Tensor, tables: Sequence[Tensor], costs: Sequence[Tensor], width: int) -> tuple[Tensor, Tensor]:
    """Return the combinations (B, C, F) that survive a beam search over the tables, and their costs (B, C)."""
    covered, paid = uncovered.unsqueeze(1), torch.zeros_like(uncovered[:, :1])
    index = torch.zeros(len(uncovered), 1, 0, dtype=torch.long, device=uncovered.device)
    for table, cost in zip(tables, costs, strict=True):
        grown = torch.minimum(covered.unsqueeze(2), table.unsqueeze(1)).flatten(1, 2)
        spent = (paid.unsqueeze(2) + cost.unsqueeze(1)).flatten(1)
        best = (grown.sum(-1) + spent).topk(min(width, spent.shape[1]), largest=False).indices
        covered, paid = _take(grown, best), spent.gather(1, best)
        rows = cost.shape[1]
        index = torch.cat([_take(index, best // rows), (best % rows).unsqueeze(-1)], dim=-1)
    return index, covered.sum(-1) + paid


def _exchanged(
    uncovered: Tensor, tables: Sequence[Tensor], costs: Sequence[Tensor], index: Tensor, first: int, second: int
) -> Tensor:
    """Return the combinations with the rows of two tables replaced by the best pair, given all other rows."""
    covered = uncovered.unsqueeze(1).expand(-1, index.shape[1], -1)
    for number in range(len(tables)):
        if number not in (first, second):
            covered = torch.minimum(covered, _take(tables[number], index[..., number]))
    with_first = torch.minimum(covered.unsqueeze(2), tables[first].unsqueeze(1))
    # One row of the second table at a time keeps the table of pairs and columns small.
    totals = torch.stack(
        [torch.minimum(with_first, row[:, None, None]).sum(-1) for row in tables[second].unbind(1)], dim=-1
    )
    totals = totals + costs[first][:, None, :, None] + costs[second][:, None, None, :]
    best = totals.flatten(2).argmin(-1)
    index = index.clone()
    index[..., first], index[..., second] = best // totals.shape[-1], best % totals.shape[-1]
    return index


def _total(uncovered: Tensor, tables: Sequence[Tensor], costs: Sequence[Tensor], index: Tensor) -> Tensor:
    covered, paid = uncovered.unsqueeze(1), torch.zeros_like(uncovered[:, :1])
    for number, (table, cost) in enumerate(zip(tables, costs, strict=True)):
        covered = torch.minimum(covered, _take(table, index[..., number]))
        paid = paid + cost.gather(1, index[..., number])
    return covered.sum(-1) + paid


def _take(table: Tensor, index: Tensor) -> Tensor:
    """Return rows ``index`` (B, C) of a table (B, K, M)."""
    return table.gather(1, index.unsqueeze(-1).expand(*index.shape, table.shape[-1]))
