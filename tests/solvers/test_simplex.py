"""Projections on the simplex: against trying every support, and scipy; what must not change them."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import torch

from tests.geometry.draws import D, randn
from torchreg.solvers.simplex import nearest_on_simplex


def best_of_all_supports(row):
    """The nearest of the points that are least squares for some entries and zero for the others, in exact numbers."""
    row, trials = [Fraction(entry) for entry in row.tolist()], []
    for count in range(1, len(row) + 1):
        for support in combinations(range(len(row)), count):
            shift = (1 - sum(row[k] for k in support)) / count
            trials.append([row[k] + shift if k in support else Fraction(0) for k in range(len(row))])
    inside = [trial for trial in trials if min(trial) >= 0]
    return [float(entry) for entry in min(inside, key=lambda t: sum((x - v) ** 2 for x, v in zip(t, row, strict=True)))]


ROWS = {
    "random": randn(20, 5),
    "near": 0.2 + 0.1 * randn(20, 5, seed=1),
    "zero": torch.zeros(1, 5, dtype=D),
    "negative": -randn(20, 5, seed=2).abs() - 0.1,
    "large": 1e6 * randn(20, 5, seed=3),
    "equal": torch.full((1, 5), 1e8, dtype=D),
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
    rows, order = randn(4, 6, 7), torch.tensor([3, 1, 6, 0, 2, 5, 4])
    found = nearest_on_simplex(rows)
    torch.testing.assert_close(nearest_on_simplex(found), found)
    torch.testing.assert_close(nearest_on_simplex(rows + 5.0), found)
    torch.testing.assert_close(nearest_on_simplex(rows[..., order]), found[..., order])
    torch.testing.assert_close(nearest_on_simplex(rows[2, 3]), found[2, 3])
    assert nearest_on_simplex(randn(3, 1)).tolist() == [[1.0]] * 3
