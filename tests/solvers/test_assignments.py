"""Assignments and combinations of rows against trying them all."""

from itertools import permutations, product

import pytest
import torch

from tests.geometry.draws import D, rand, seeded
from torchreg.solvers.assignment import assign
from torchreg.solvers.cover import best_covers


@pytest.mark.parametrize(("rows", "columns"), [(4, 4), (3, 5), (1, 1)])
def test_no_assignment_is_cheaper(rows, columns):
    costs = rand(rows, columns, seed=rows)
    found = assign(costs)
    best = min(sum(float(costs[r, c]) for r, c in enumerate(order)) for order in permutations(range(columns), rows))
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
    costs, rows, columns = rand(5, 6), torch.tensor([3, 1, 4, 0, 2]), torch.tensor([5, 2, 0, 1, 4, 3])
    moved = assign(costs[rows][:, columns], 0.4)
    assert torch.equal(torch.where(moved >= 0, columns[moved], -1), assign(costs, 0.4)[rows])


def problem(seed, rows=(4, 5, 3), columns=12, batch=2):
    tables = [rand(batch, count, columns, seed=seed + k) for k, count in enumerate(rows)]
    return rand(batch, columns, seed=seed), tables, [rand(batch, count, seed=seed + 9) for count in rows]


def all_totals(uncovered, tables, costs, row):
    """Every choice with its cost, from the definition."""
    found = {}
    for choice in product(*[range(table.shape[1]) for table in tables]):
        chosen = [table[row, k] for table, k in zip(tables, choice, strict=True)]
        covered = torch.stack([uncovered[row], *chosen]).amin(0).sum()
        found[choice] = float(covered + sum(c[row, k] for c, k in zip(costs, choice, strict=True)))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_a_wide_beam_finds_the_best_choices_in_order(seed):
    uncovered, tables, costs = problem(seed)
    index, total = best_covers(uncovered, tables, costs, count=6, beam=60, num_exchanged=0)
    for row in range(2):
        expected = all_totals(uncovered, tables, costs, row)
        ranked = sorted(expected, key=expected.get)[:6]
        assert [tuple(choice) for choice in index[row].tolist()] == ranked
        torch.testing.assert_close(total[row], torch.tensor([expected[c] for c in ranked], dtype=D))


@pytest.mark.parametrize("seed", range(4))
def test_exchanges_mend_what_a_beam_of_one_misses(seed):
    uncovered, tables, costs = problem(seed, rows=(4, 4, 4))
    greedy = best_covers(uncovered, tables, costs, count=1, beam=1, num_exchanged=0)[1]
    index, total = best_covers(uncovered, tables, costs, count=1, beam=1, num_exchanged=1, sweeps=3)
    assert (total <= greedy).all()
    for row in range(2):
        expected = all_totals(uncovered, tables, costs, row)
        torch.testing.assert_close(float(total[row, 0]), expected[tuple(index[row, 0].tolist())])
        # No exchange of two rows is left that would help.
        best = tuple(index[row, 0].tolist())
        near = [choice for choice in expected if sum(a != b for a, b in zip(choice, best, strict=True)) <= 2]
        assert expected[best] <= min(expected[choice] for choice in near) + 1e-12


def test_two_rows_that_must_change_together_are_found():
    # Each limb alone prefers the columns of the other.
    uncovered = torch.ones(1, 4)
    first = torch.tensor([[[0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]]])
    second = torch.tensor([[[1.0, 1.0, 1.0, 0.0], [0.0, 1.0, 1.0, 1.0]]])
    index, total = best_covers(uncovered, [first, second], [torch.zeros(1, 2)] * 2, count=1, beam=1)
    assert float(total) == 0.0
    assert index.tolist() in ([[[0, 0]]], [[[1, 1]]])


def test_batches_equal_single_problems_and_columns_may_be_permuted():
    uncovered, tables, costs = problem(7, batch=3)
    index, total = best_covers(uncovered, tables, costs)
    order = torch.randperm(uncovered.shape[1], generator=seeded())
    for row in range(3):
        one = slice(row, row + 1)
        permuted = (uncovered[one][:, order], [t[one][..., order] for t in tables], [c[one] for c in costs])
        alone = best_covers(*permuted)
        torch.testing.assert_close(alone[1][0], total[row])
        assert alone[0][0].tolist() == index[row].tolist()
