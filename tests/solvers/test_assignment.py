"""Assignments against trying all of them."""

from itertools import permutations

import pytest
import torch

from torchreg.solvers.assignment import assign, assign_within


def random(*size, seed=0):
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(("rows", "columns"), [(4, 4), (3, 5), (1, 1)])
def test_no_assignment_is_cheaper(rows, columns):
    costs = random(rows, columns, seed=rows)
    found = assign(costs)
    best = min(sum(float(costs[r, c]) for r, c in enumerate(way)) for way in permutations(range(columns), rows))
    assert float(costs[torch.arange(rows), found].sum()) == pytest.approx(best)
    assert len(set(found.tolist())) == rows


def test_rows_stay_alone_where_columns_are_few_or_dear():
    costs = torch.tensor([[0.1, 0.9], [0.2, 0.95], [0.3, 0.99]])
    assert assign(costs).tolist().count(-1) == 1
    assert assign(costs, 0.5).tolist() == [0, -1, -1]
    assert assign(costs, torch.tensor([0.05, 2.0, 2.0])).tolist() == [-1, 0, 1]
    assert assign(torch.zeros(2, 0)).tolist() == [-1, -1]
    assert assign(torch.zeros(0, 3)).tolist() == []


def test_permuting_rows_and_columns_permutes_the_answer():
    costs, rows, columns = random(5, 6), torch.tensor([3, 1, 4, 0, 2]), torch.tensor([5, 2, 0, 1, 4, 3])
    found, moved = assign(costs, 0.4), assign(costs[rows][:, columns], 0.4)
    there = torch.where(moved >= 0, columns[moved], -1)
    assert torch.equal(there, found[rows])


def test_no_assignment_within_a_limit_is_cheaper():
    costs = random(5, 4, seed=3)
    found = assign_within(costs, 0.3)
    paid = sum(float(costs[row, column]) if column >= 0 else 0.3 for row, column in enumerate(found.tolist()))
    table = torch.cat((costs.clamp(max=0.3), torch.full((5, 1), 0.3, dtype=torch.float64)), dim=1)
    best = min(sum(float(table[row, column]) for row, column in enumerate(way)) for way in permutations(range(5)))
    assert paid == pytest.approx(best)
    assert bool((costs[found >= 0, found[found >= 0]] < 0.3).all())


def test_nothing_within_the_limit_or_no_rows_leave_no_pairs():
    assert assign_within(random(3, 2), 1e-9).tolist() == [-1, -1, -1]
    assert assign_within(torch.zeros(0, 2), 1.0).tolist() == []
