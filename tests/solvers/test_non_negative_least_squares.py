"""Least squares under x >= 0, by active sets, against scipy."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.optimize import nnls as dense_nnls

import torchreg.solvers.nnls as module
from torchreg.solvers.nnls import nnls

SEEDS = st.integers(0, 10_000)


def dense_problem(seed, rows=30, columns=12):
    generator = np.random.default_rng(seed)
    return generator.normal(size=(rows, columns)), generator.normal(size=rows)


def solved(matrix, target, start=None, **options):
    """Return the solution for arrays or tensors."""
    matrix, target, start = (torch.from_numpy(a) if isinstance(a, np.ndarray) else a for a in (matrix, target, start))
    return nnls(matrix, target, start=start, **options)


def weight_problem(side=16, num_bones=6, rows=1200, seed=0):
    """Return A, b and labels like the weights of a skin: data rows, smoothness, rows that sum to one, closeness."""
    generator = np.random.default_rng(seed)
    count = side * side
    places = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1).reshape(-1, 2)
    labels = ((places[:, None] - generator.random((num_bones, 2)) * side) ** 2).sum(-1).argmin(1)
    cell = generator.integers(0, count, rows)
    residual = 2 * generator.normal(size=(rows, num_bones))
    residual[np.arange(rows), labels[cell]] *= 0.02
    columns = cell[:, None] * num_bones + np.arange(num_bones)
    data = sp.csr_matrix(
        (residual.ravel(), (np.repeat(np.arange(rows), num_bones), columns.ravel())), shape=(rows, count * num_bones)
    )
    index = np.arange(count).reshape(side, side)
    pairs = np.concatenate(
        [np.stack([a.ravel(), b.ravel()], 1) for a, b in [(index[1:], index[:-1]), (index[:, 1:], index[:, :-1])]]
    )
    number = np.arange(len(pairs))
    ones = np.ones(len(pairs))
    difference = sp.csr_matrix(
        (np.r_[ones, -ones], (np.r_[number, number], np.r_[pairs[:, 0], pairs[:, 1]])), shape=(len(pairs), count)
    )
    bones = sp.eye(num_bones)
    sums = sp.kron(sp.eye(count), np.ones((1, num_bones)))
    near = np.sqrt(0.3) * sp.eye(count * num_bones)
    start = np.eye(num_bones)[labels].ravel()
    matrix = sp.vstack([data, np.sqrt(0.5) * sp.kron(difference, bones), sums, near]).tocsr()
    target = np.r_[np.zeros(rows + len(pairs) * num_bones), np.ones(count), np.sqrt(0.3) * start]
    return matrix, target, start


@given(SEEDS, st.integers(1, 40), st.integers(1, 20))
@settings(max_examples=60, deadline=None)
def test_small_dense_problems_agree_with_scipy(seed, rows, columns):
    matrix, target = dense_problem(seed, rows, columns)
    result = solved(torch.from_numpy(matrix), torch.from_numpy(target))
    expected = dense_nnls(matrix, target)[1] ** 2
    assert result.converged
    assert result.objective <= expected + 1e-6 * (target @ target)
    assert result.objective == pytest.approx(((matrix @ result.x.numpy() - target) ** 2).sum(), rel=1e-9)
    assert (result.x >= 0).all()


def test_a_problem_of_weights_agrees_with_another_method():
    matrix, target, start = weight_problem()
    result = solved(matrix, torch.from_numpy(target), start=torch.from_numpy(start))
    assert len(result.x) == 1536
    assert result.converged
    assert result.ridge == 0

    def value_and_slope(x):
        residual = matrix @ x - target
        return residual @ residual, 2 * (matrix.T @ residual)

    options = {"maxiter": 2000, "maxfun": 5000, "ftol": 1e-14, "gtol": 1e-8}
    oracle = minimize(
        value_and_slope, start, jac=True, method="L-BFGS-B", bounds=[(0, None)] * len(start), options=options
    )
    assert result.objective == pytest.approx(oracle.fun, rel=1e-6)
    assert result.objective <= oracle.fun * (1 + 1e-9)


def test_every_form_of_matrix_gives_the_same():
    matrix, target = dense_problem(3)
    matrix[np.abs(matrix) < 0.7] = 0
    dense, b = torch.from_numpy(matrix), torch.from_numpy(target)
    forms = [dense, dense.to_sparse_coo(), sp.coo_matrix(matrix), matrix]
    solutions = [solved(form, b).x for form in forms]
    for solution in solutions[1:]:
        assert torch.equal(solution, solutions[0])


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


def test_zero_columns_stay_zero():
    matrix, target = dense_problem(2)
    matrix[:, [0, 5]] = 0
    result = solved(matrix, target, start=np.ones(12))
    assert result.converged
    assert result.ridge == 0
    assert result.x[[0, 5]].tolist() == [0, 0]
    assert result.objective == pytest.approx(dense_nnls(matrix, target)[1] ** 2)


@pytest.mark.parametrize("repeats", [2, 60])
def test_equal_columns_are_solved_with_a_visible_ridge_at_most(repeats):
    matrix, target = dense_problem(8)
    twice = np.tile(matrix, (1, repeats))
    result = solved(twice, target)
    assert 0 <= result.ridge <= 1e-8
    assert result.objective == pytest.approx(dense_nnls(matrix, target)[1] ** 2, rel=1e-6)


def test_fewer_rows_than_columns_leave_no_residual_and_a_recorded_ridge():
    generator = np.random.default_rng(0)
    matrix = generator.normal(size=(6, 20))
    result = solved(matrix, matrix @ generator.random(20))
    assert 0 < result.ridge <= 1e-8
    assert result.objective < 1e-10


def test_when_nothing_helps_the_solution_is_zero():
    matrix = np.abs(dense_problem(1)[0])
    result = solved(matrix, -np.ones(30))
    assert result.x.tolist() == [0] * 12
    assert result.objective == 30
    assert result.converged
    assert solved(matrix, np.zeros(30)).x.tolist() == [0] * 12
    assert solved(sp.csr_matrix((3, 2)), np.ones(3)).x.tolist() == [0, 0]


def test_a_long_chain_beyond_conjugate_gradients_is_factored():
    size = 3000
    first = sp.diags([1.0, -1.0], [0, 1], shape=(size - 1, size))
    ends = sp.csr_matrix(([1.0, 1.0], ([0, 1], [0, size - 1])), shape=(2, size))
    result = solved(sp.vstack([first, ends]), np.r_[np.zeros(size - 1), 1.0, 2.0])
    low, high = 1 + 1 / (size + 1), 2 - 1 / (size + 1)
    expected = torch.linspace(low, high, size, dtype=torch.float64)
    torch.testing.assert_close(result.x, expected, atol=1e-5, rtol=0)
    assert result.ridge == 0
