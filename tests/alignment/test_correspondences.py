"""The rules that match model points and data: what all have in common, and what makes each of them what it is."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from torchreg.alignment.fit.softassign import closest_point, softassign
from torchreg.solvers import e_step
from torchreg.solvers.e_step import expectation

D = torch.float64
TRIM, MODEL_OUTLIER, OUTLIER_CONSTANT = 1.5, 0.01, 3 * math.sqrt(math.pi / 2)
FIELDS = ("weights", "targets", "inlier_posterior", "squared_error")
EXACT = {"sweeps": 20_000, "tolerance": 1e-13}

every_rule = pytest.mark.parametrize("rule", [expectation, softassign, closest_point])
every_rival = pytest.mark.parametrize("rule", [softassign, closest_point])
both_precisions = pytest.mark.parametrize("dtype", [torch.float32, D])


def cloud(*shape, seed=0, dtype=D):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=D).to(dtype)


def scalar(value, dtype=D):
    return torch.tensor(value, dtype=dtype)


def some_mask(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(2)) > 0.3


def assert_same(found, expected, **tolerance):
    for field in FIELDS:
        torch.testing.assert_close(getattr(found, field), getattr(expected, field), **tolerance)


@every_rule
@pytest.mark.parametrize("sigma", [0.1, 0.15])
def test_masking_is_removing(rule, sigma):
    model, data, mask = cloud(8), cloud(12, seed=1), some_mask(12)
    removed = rule(model, data[mask], scalar(sigma))
    for padding in (0.0, 1e9, math.nan, math.inf):
        masked = rule(model, torch.where(mask[:, None], data, padding), scalar(sigma), mask=mask)
        for field in ("weights", "targets", "squared_error"):
            torch.testing.assert_close(getattr(masked, field), getattr(removed, field))
        torch.testing.assert_close(masked.inlier_posterior[mask], removed.inlier_posterior)
        assert masked.inlier_posterior[~mask].eq(0).all()


@every_rule
def test_without_data_or_model_points_there_are_no_matches(rule):
    model, sigma = cloud(4), scalar(0.1)
    nothing = rule(model, cloud(3), sigma, mask=torch.zeros(3, dtype=torch.bool))
    empty = rule(model, cloud(0), sigma)
    for found in (nothing, empty):
        assert found.weights.tolist() == [0] * 4
        assert torch.equal(found.targets, model)
        assert float(found.squared_error) == 0
    assert nothing.inlier_posterior.tolist() == [0] * 3
    assert empty.inlier_posterior.shape == (0,)
    assert rule(cloud(0), cloud(3), sigma).inlier_posterior.tolist() == [0] * 3
    assert rule(cloud(0, 4), cloud(0, 3), torch.zeros(0, dtype=D)).targets.shape == (0, 4, 3)


@every_rule
@pytest.mark.parametrize("sigma", [0.1, 0.2])
@settings(max_examples=15, deadline=None)
@given(rows=st.permutations(range(9)), columns=st.permutations(range(6)))
def test_order_does_not_matter_and_neither_do_position_and_unit(rule, sigma, rows, columns):
    model, data, sigma = cloud(9), cloud(6, seed=1), scalar(sigma)
    plain = rule(model, data, sigma)
    moved = rule(1000 * model[rows] + 5, 1000 * data[columns] + 5, 1000 * sigma)
    torch.testing.assert_close(moved.weights, plain.weights[rows])
    torch.testing.assert_close((moved.targets - 5) / 1000, plain.targets[rows])
    torch.testing.assert_close(moved.inlier_posterior, plain.inlier_posterior[columns])
    torch.testing.assert_close(moved.squared_error / 1e6, plain.squared_error)


@every_rule
def test_a_batch_is_a_loop_and_one_cloud_serves_many_poses(rule):
    model, data, mask = cloud(2, 3, 5), cloud(7, seed=1), torch.arange(7) < 5
    sigma = torch.linspace(0.05, 0.3, 6, dtype=D).reshape(2, 3)
    # Sweeps of a batch end together.
    tight = {"sweeps": 500, "tolerance": 1e-9} if rule is softassign else {}
    together = rule(model, data, sigma, mask=mask, **tight)
    assert together.inlier_posterior.shape == (2, 3, 7)
    for b, k in itertools.product(range(2), range(3)):
        alone = rule(model[b, k], data, sigma[b, k], mask=mask, **tight)
        for field in FIELDS:
            torch.testing.assert_close(getattr(together, field)[b, k], getattr(alone, field))


@every_rival
@both_precisions
@pytest.mark.parametrize("sigma", [1e-3, 1e-8, 1e-20, 1e-30])
def test_sigma_may_vanish(rule, dtype, sigma):
    """Points that coincide match, with certainty or as one pair does; everything else is an outlier for certain."""
    model = cloud(40, dtype=dtype)
    data = torch.cat([model[:5], cloud(15, seed=1, dtype=dtype) + 3, cloud(15, seed=2, dtype=dtype) + 1e25])
    matches = rule(model, data, scalar(sigma, dtype), **(EXACT if rule is softassign else {}))
    torch.testing.assert_close(matches.targets, model)
    assert matches.inlier_posterior[5:].tolist() == [0] * 30
    assert matches.weights[5:].tolist() == [0] * 35
    assert float(matches.squared_error) == pytest.approx(0, abs=1e-9)
    share = matches.inlier_posterior[:5]
    if rule is closest_point:
        assert share.tolist() == [1] * 5
    else:
        expected = torch.full_like(share, 1 / (MODEL_OUTLIER * OUTLIER_CONSTANT))
        torch.testing.assert_close(share / (1 - share).square(), expected, rtol=1e-4, atol=0)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.005, 0.5), st.integers(0, 1000))
def test_closest_points_are_those_of_a_tree(n, m, sigma, seed):
    model, data = cloud(n, seed=seed), cloud(m, seed=seed + 1)
    matches = closest_point(model, data, scalar(sigma))
    distance, index = cKDTree(model.numpy()).query(data.numpy())
    near = distance <= TRIM * sigma
    for i in range(n):
        voters = (index == i) & near
        assert float(matches.weights[i]) == voters.sum()
        expected = data[torch.from_numpy(voters)].mean(0) if voters.any() else model[i]
        torch.testing.assert_close(matches.targets[i], expected)
    assert matches.inlier_posterior.tolist() == near.tolist()
    assert float(matches.squared_error) == pytest.approx((distance[near] ** 2).sum(), abs=1e-12)


@pytest.mark.parametrize("entries", [1, 7, 50])
def test_memory_does_not_change_the_answer(monkeypatch, entries):
    model, data, sigma = cloud(3, 6), cloud(3, 9, seed=1), torch.tensor([0.1, 0.2, 0.4], dtype=D)
    at_once = closest_point(model, data, sigma, mask=some_mask(3, 9))
    monkeypatch.setattr(e_step, "BUDGET", replace(e_step.BUDGET, table_entries=entries))
    assert_same(closest_point(model, data, sigma, mask=some_mask(3, 9)), at_once)


def as_printed(model, data, sigma, b, c, sweeps=3000):
    """The extended matrix, its first N rows and first M columns normalized in turn, in plain numbers."""
    n, m = len(model), len(data)
    matrix = np.empty((n + 1, m + 1))
    for i, j in itertools.product(range(n), range(m)):
        matrix[i, j] = math.exp(-(math.dist(model[i], data[j]) ** 2) / (2 * sigma**2))
    matrix[:n, m], matrix[n, :m], matrix[n, m] = b, c, 0.0
    for _ in range(sweeps):
        matrix[:, :m] /= matrix[:, :m].sum(0, keepdims=True)
        matrix[:n] /= matrix[:n].sum(1, keepdims=True)
    return torch.from_numpy(matrix[:n, :m])


@pytest.mark.parametrize("sigma", [0.05, 0.2, 1.0])
@pytest.mark.parametrize(("n", "m"), [(6, 9), (9, 6), (7, 7), (1, 5)])
def test_softassign_is_the_printed_normalizations(n, m, sigma):
    model, data = cloud(n), cloud(m, seed=1)
    matrix = as_printed(model.tolist(), data.tolist(), sigma, 0.7, 2.5)
    matches = softassign(model, data, scalar(sigma), 2.5, model_outlier=0.7, **EXACT)
    torch.testing.assert_close(matches.weights, matrix.sum(-1), atol=1e-7, rtol=1e-7)
    torch.testing.assert_close(matches.inlier_posterior, matrix.sum(-2), atol=1e-7, rtol=1e-7)
    torch.testing.assert_close(matches.targets, matrix @ data / matrix.sum(-1, keepdim=True), atol=1e-6, rtol=1e-7)
    squares = (matrix * torch.cdist(model, data).square()).sum()
    torch.testing.assert_close(matches.squared_error, squares, atol=1e-7, rtol=1e-7)


def test_without_a_sweep_softassign_is_the_e_step():
    model, data, sigma = cloud(20), cloud(30, seed=1), scalar(0.1)
    assert_same(softassign(model, data, sigma, sweeps=0), expectation(model, data, sigma))


def test_softassign_is_differentiable():
    inputs = [cloud(3), cloud(4, seed=1), scalar(0.3), scalar(2.0)]
    inputs = [value.requires_grad_() for value in inputs]
    mask = torch.tensor([True, True, False, True])

    def matches(*values):
        result = softassign(*values, mask=mask, sweeps=30, tolerance=0.0)
        return tuple(getattr(result, field) for field in FIELDS)

    assert torch.autograd.gradcheck(matches, inputs)


def test_gradients_stay_finite_where_nothing_matches():
    model, data = cloud(4).requires_grad_(), (cloud(3, seed=1) + 50).requires_grad_()
    matches = softassign(model, data, scalar(0.01), mask=torch.tensor([True, False, True]))
    total = matches.weights.sum() + matches.targets.sum() + matches.squared_error
    for gradient in torch.autograd.grad(total, [model, data]):
        assert torch.isfinite(gradient).all()
