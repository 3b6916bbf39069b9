"""Least squares under x >= 0 against scipy, and projections on the simplex against trying every support."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.optimize import nnls as dense_nnls

import torchreg.solvers.nnls as module
from tests.geometry.draws import D, randn
from torchreg.solvers.nnls import nnls
from torchreg.solvers.simplex import nearest_on_simplex

SEEDS = st.integers(0, 10_000)


def dense_problem(seed, rows=30, columns=12):
    generator = np.random.default_rng(seed)
    return generator.normal(size=(rows, columns)), generator.normal(size=rows)


def solved(matrix, target, start=None, **options):
    matrix, target, start = (torch.from_numpy(a) if isinstance(a, np.ndarray) else a for a in (matrix, target, start))
    return nnls(matrix, target, start=start, **options)


def weight_problem(side=16, num_bones=6, rows=1200, seed=0):
    """A, b and a start like the weights of a skin: data rows, smoothness, rows that sum to one, closeness."""
    generator = np.random.default_rng(seed)
    count = side * side
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1).reshape(-1, 2)
    labels = ((cells[:, None] - generator.random((num_bones, 2)) * side) ** 2).sum(-1).argmin(1)
    cell = generator.integers(0, count, rows)
    residual = 2 * generator.normal(size=(rows, num_bones))
    residual[np.arange(rows), labels[cell]] *= 0.02
    columns = cell[:, None] * num_bones + np.arange(num_bones)
    entries = (residual.ravel(), (np.repeat(np.arange(rows), num_bones), columns.ravel()))
    data = sp.csr_matrix(entries, shape=(rows, count * num_bones))
    line, one = sp.diags([1.0, -1.0], [0, 1], shape=(side - 1, side)), sp.eye(side)
    difference = sp.vstack([sp.kron(line, one), sp.kron(one, line)])
    start = np.eye(num_bones)[labels].ravel()
    smooth, sums = sp.kron(difference, sp.eye(num_bones)), sp.kron(sp.eye(count), np.ones((1, num_bones)))
    matrix = sp.vstack([data, np.sqrt(0.5) * smooth, sums, np.sqrt(0.3) * sp.eye(count * num_bones)]).tocsr()
    return matrix, np.r_[np.zeros(rows + smooth.shape[0]), np.ones(count), np.sqrt(0.3) * start], start


@given(SEEDS, st.integers(1, 40), st.integers(1, 20), st.booleans())
@settings(max_examples=60, deadline=None)
def test_small_dense_problems_agree_with_scipy(seed, rows, columns, with_zeros):
    matrix, target = dense_problem(seed, rows, columns)
    matrix[:, :: 3 if with_zeros else columns + 1] *= 0
    result = solved(matrix, target)
    assert result.converged
    assert result.objective <= dense_nnls(matrix, target)[1] ** 2 + 1e-6 * (target @ target)
    assert result.objective == pytest.approx(((matrix @ result.x.numpy() - target) ** 2).sum(), rel=1e-9)
    assert (result.x >= 0).all()
    assert (result.x[torch.from_numpy((matrix == 0).all(0))] == 0).all()


def test_a_problem_of_weights_agrees_with_another_method():
    matrix, target, start = weight_problem()
    result = solved(matrix, target, start=start)
    assert (len(result.x), result.converged, result.ridge) == (1536, True, 0)

    def value_and_slope(x):
        residual = matrix @ x - target
        return residual @ residual, 2 * (matrix.T @ residual)

    options = {"maxiter": 2000, "maxfun": 5000, "ftol": 1e-14, "gtol": 1e-8}
    bounds = [(0, None)] * len(start)
    oracle = minimize(value_and_slope, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    assert result.objective == pytest.approx(oracle.fun, rel=1e-6)
    assert result.objective <= oracle.fun * (1 + 1e-9)


def test_every_form_of_matrix_gives_the_same():
    matrix, target = dense_problem(3)
    matrix[np.abs(matrix) < 0.7] = 0
    for form in (torch.from_numpy(matrix).to_sparse_coo(), sp.coo_matrix(matrix)):
        assert torch.equal(solved(form, target).x, solved(matrix, target).x)


@pytest.mark.parametrize("scale", [1e-8, 1e8])
def test_units_of_variables_and_of_the_target_change_nothing_but_units(scale):
    matrix, target = dense_problem(5)
    units = np.logspace(-6, 6, 12)
    plain, other = solved(matrix, target), solved(matrix * units, target * scale)
    torch.testing.assert_close(other.x * torch.from_numpy(units) / scale, plain.x, atol=1e-9, rtol=1e-7)
    assert other.kkt_residual <= 1e-7


def test_a_step_too_few_is_no_convergence_but_a_sound_point():
    matrix, target = dense_problem(4, 60, 40)
    result = solved(matrix, target, start=np.zeros(40), max_steps=1)
    assert not result.converged
    assert result.kkt_residual > 1e-7
    assert result.objective < target @ target
    assert (result.x >= 0).all()


@pytest.mark.parametrize("seed", range(6))
def test_steps_that_cannot_cycle_find_the_same_solution(seed, monkeypatch):
    matrix, target = dense_problem(seed, 40, 25)
    expected = solved(matrix, target)
    # An elimination that loses everything after the first one makes every round fall back.
    eliminate, calls = module._eliminate, []

    def useless(problem, free, start):
        calls.append(1)
        return eliminate(problem, free, start) if len(calls) == 1 else np.zeros_like(start)

    monkeypatch.setattr(module, "_eliminate", useless)
    result = solved(matrix, target, start=(np.arange(25) % 3 == 0).astype(float))
    assert len(calls) > 1
    assert result.converged
    torch.testing.assert_close(result.x, expected.x, atol=1e-7, rtol=1e-7)


@pytest.mark.parametrize("repeats", [2, 60])
def test_singular_problems_are_solved_with_a_visible_ridge_at_most(repeats):
    matrix, target = dense_problem(8)
    result = solved(np.tile(matrix, (1, repeats)), target)
    assert 0 <= result.ridge <= 1e-8
    assert result.objective == pytest.approx(dense_nnls(matrix, target)[1] ** 2, rel=1e-6)
    wide, x = dense_problem(repeats, 6, 20)[0], np.random.default_rng(0).random(20)
    result = solved(wide, wide @ x)
    assert 0 < result.ridge <= 1e-8
    assert result.objective < 1e-10


def test_when_nothing_helps_the_solution_is_zero():
    matrix = np.abs(dense_problem(1)[0])
    for a, b in ((matrix, -np.ones(30)), (matrix, np.zeros(30)), (sp.csr_matrix((3, 2)), np.ones(3))):
        result = solved(a, b)
        assert not result.x.any()
        assert (result.objective, result.converged) == (float(b @ b), True)


def test_a_long_chain_beyond_conjugate_gradients_is_factored():
    size = 3000
    first = sp.diags([1.0, -1.0], [0, 1], shape=(size - 1, size))
    ends = sp.csr_matrix(([1.0, 1.0], ([0, 1], [0, size - 1])), shape=(2, size))
    result = solved(sp.vstack([first, ends]), np.r_[np.zeros(size - 1), 1.0, 2.0])
    expected = torch.linspace(1 + 1 / (size + 1), 2 - 1 / (size + 1), size, dtype=torch.float64)
    torch.testing.assert_close(result.x, expected, atol=1e-5, rtol=0)
    assert result.ridge == 0


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
