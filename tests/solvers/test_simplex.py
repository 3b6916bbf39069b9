"""Projections on the simplex: against trying every support, and scipy; what must not change them."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import torch

from torchreg.solvers.simplex import nearest_on_simplex


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def best_of_all_supports(row):
    """The nearest of the points that are least squares for some entries and zero for the others, in exact numbers."""
    row = [Fraction(entry) for entry in row.tolist()]
    best, nearest = None, None
    for count in range(1, len(row) + 1):
        for support in combinations(range(len(row)), count):
            shift = (1 - sum(row[k] for k in support)) / count
            trial = [row[k] + shift if k in support else Fraction(0) for k in range(len(row))]
            square = sum((x - v) ** 2 for x, v in zip(trial, row, strict=True))
            if min(trial) >= 0 and (best is None or square < best):
                best, nearest = square, trial
    return [float(entry) for entry in nearest]


ROWS = {
    "random": draw(20, 5),
    "near": 0.2 + 0.1 * draw(20, 5, seed=1),
    "zero": torch.zeros(1, 5, dtype=torch.float64),
    "negative": -draw(20, 5, seed=2).abs() - 0.1,
    "large": 1e6 * draw(20, 5, seed=3),
    "equal": torch.full((1, 5), 1e8, dtype=torch.float64),
}


@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_nearest_point_of_the_simplex_is_found(rows, dtype):
    rows = rows.to(dtype)
    found = nearest_on_simplex(rows)
    assert found.dtype == dtype
    expected = np.array([best_of_all_supports(row) for row in rows.double()])
    np.testing.assert_allclose(found.double().numpy(), expected, atol=1e-6, rtol=0)


def test_what_changes_nothing():
    rows = draw(4, 6, 7)
    found = nearest_on_simplex(rows)
    assert bool((found >= 0).all())
    torch.testing.assert_close(found.sum(-1), torch.ones(4, 6, dtype=torch.float64))
    torch.testing.assert_close(nearest_on_simplex(found), found)
    torch.testing.assert_close(nearest_on_simplex(rows + 5.0), found)
    order = torch.tensor([3, 1, 6, 0, 2, 5, 4])
    torch.testing.assert_close(nearest_on_simplex(rows[..., order]), found[..., order])
    torch.testing.assert_close(nearest_on_simplex(rows[2, 3]), found[2, 3])
    assert nearest_on_simplex(draw(3, 1)).tolist() == [[1.0]] * 3
