"""Assignments against trying all of them."""

from itertools import permutations

import pytest
import torch

from torchreg.errors import InputError
from torchreg.solvers.assignment import assign


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


def test_bad_input_is_named():
    with pytest.raises(InputError, match="costs must be finite"):
        assign(torch.tensor([[torch.inf]]))
    with pytest.raises(InputError, match="costs must have shape"):
        assign(torch.zeros(3))
    with pytest.raises(InputError, match="alone must be finite"):
        assign(torch.zeros(1, 1), torch.nan)
