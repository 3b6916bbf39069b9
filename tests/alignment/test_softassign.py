"""SoftAssign against the convex problem that it solves, the normalizations as printed, and assignments by hand."""

import itertools
import math

import numpy as np
import pytest
import scipy.optimize
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.alignment.softassign import MODEL_OUTLIER, assignment, softassign
from torchreg.errors import InputError, InputTypeError
from torchreg.solvers.e_step import OUTLIER_CONSTANT, expectation

D = torch.float64
FIELDS = ("weights", "targets", "inlier_posterior", "squared_error")
EXACT = {"sweeps": 20_000, "tolerance": 1e-13}


def cloud(*shape, seed=0, dtype=D):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=D).to(dtype)


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
    return matrix[:n, :m]


@pytest.mark.parametrize("sigma", [0.05, 0.2, 1.0])
@pytest.mark.parametrize(("n", "m"), [(6, 9), (9, 6), (7, 7), (1, 5)])
def test_the_matrix_is_the_one_of_the_printed_normalizations(n, m, sigma):
    model, data = cloud(n), cloud(m, seed=1)
    expected = torch.from_numpy(as_printed(model.tolist(), data.tolist(), sigma, 0.7, 2.5))
    options = {"model_outlier": 0.7, **EXACT}
    found = assignment(model, data, torch.tensor(sigma, dtype=D), 2.5, **options)
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=1e-7)
    step = softassign(model, data, torch.tensor(sigma, dtype=D), 2.5, **options)
    torch.testing.assert_close(step.weights, expected.sum(-1), atol=1e-9, rtol=1e-7)
    torch.testing.assert_close(step.inlier_posterior, expected.sum(-2), atol=1e-9, rtol=1e-7)
    torch.testing.assert_close(step.targets, expected @ data / expected.sum(-1, keepdim=True), atol=1e-7, rtol=1e-7)
    squares = (expected * torch.cdist(model, data).square()).sum()
    torch.testing.assert_close(step.squared_error, squares, atol=1e-9, rtol=1e-7)


def test_the_matrix_solves_a_convex_problem():
    """The dual of entropic assignment with slack, minimized by another solver."""
    model, data, sigma, b, c = cloud(5), cloud(8, seed=1), 0.3, MODEL_OUTLIER, OUTLIER_CONSTANT
    kernel = torch.exp(-torch.cdist(model, data).square() / (2 * sigma**2)).numpy()

    def dual(logs):
        u, v = np.exp(logs[:5]), np.exp(logs[5:])
        value = u @ kernel @ v + b * u.sum() + c * v.sum() - logs.sum()
        return value, np.concatenate([u * (kernel @ v + b) - 1, v * (kernel.T @ u + c) - 1])

    best = scipy.optimize.minimize(dual, np.zeros(13), jac=True, method="BFGS", options={"gtol": 1e-10})
    u, v = np.exp(best.x[:5]), np.exp(best.x[5:])
    found = assignment(model, data, torch.tensor(sigma, dtype=D), **EXACT)
    np.testing.assert_allclose(found.numpy(), u[:, None] * kernel * v, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 30), st.integers(1, 30), st.floats(0.01, 2.0), st.floats(0.1, 5.0), st.integers(0, 1000))
def test_rows_and_columns_with_their_slack_sum_to_one(n, m, sigma, c, seed):
    model, data = cloud(n, seed=seed), cloud(m, seed=seed + 1)
    alpha = assignment(model, data, torch.tensor(sigma, dtype=D), c, **EXACT)
    row_slack, column_slack = 1 - alpha.sum(-1), 1 - alpha.sum(-2)
    assert row_slack.min() > 0
    assert column_slack.min() > 0
    # What remains of rows and columns is in the fixed ratio to the pairs that the kernel and c state.
    kernel = torch.exp(-torch.cdist(model, data).square() / (2 * sigma**2))
    expected = row_slack.unsqueeze(-1) * kernel * column_slack / (MODEL_OUTLIER * c)
    torch.testing.assert_close(alpha, expected, atol=1e-9, rtol=1e-5)


def test_both_forms_agree():
    model, data = cloud(3, 6), cloud(3, 9, seed=1)
    mask = torch.rand(3, 9, generator=torch.Generator().manual_seed(2)) > 0.3
    sigma, c = torch.tensor([0.1, 0.2, 0.4], dtype=D), torch.tensor([1.0, 2.0, 3.0], dtype=D)
    for options in ({}, EXACT, {"sweeps": 2}):
        alpha = assignment(model, data, sigma, c, mask=mask, **options)
        step = softassign(model, data, sigma, c, mask=mask, **options)
        close = {"atol": 1e-10, "rtol": 1e-8} if options else {"atol": 2e-3, "rtol": 0}
        torch.testing.assert_close(step.weights, alpha.sum(-1), **close)
        torch.testing.assert_close(step.inlier_posterior, alpha.sum(-2), **close)


def test_without_a_sweep_it_is_the_e_step():
    model, data, sigma = cloud(20), cloud(30, seed=1), torch.tensor(0.1, dtype=D)
    plain, other = expectation(model, data, sigma), softassign(model, data, sigma, sweeps=0)
    for field in FIELDS:
        torch.testing.assert_close(getattr(other, field), getattr(plain, field))


def test_one_pair_has_a_closed_form():
    model, data, sigma, c = torch.zeros(1, 3, dtype=D), torch.zeros(1, 3, dtype=D), torch.tensor(0.01, dtype=D), 2.0
    share = float(softassign(model, data, sigma, c, **EXACT).weights)
    assert share / (1 - share) ** 2 == pytest.approx(1 / (MODEL_OUTLIER * c))
    share = float(softassign(model, data, sigma, c, model_outlier=0.3, **EXACT).weights)
    assert share / (1 - share) ** 2 == pytest.approx(1 / (0.3 * c))


def test_it_is_one_to_one_where_the_e_step_is_one_to_many():
    # Five data around one model point: the E-step gives it all of them, SoftAssign no more than one.
    model = torch.zeros(1, 3, dtype=D)
    data = 0.001 * cloud(5)
    sigma = torch.tensor(0.1, dtype=D)
    assert float(expectation(model, data, sigma, 0.01).weights) == pytest.approx(5, abs=0.1)
    assert 0.99 < float(softassign(model, data, sigma, 0.01, **EXACT).weights) <= 1


def test_a_narrow_kernel_finds_the_permutation():
    model = cloud(12)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(3))
    alpha = assignment(model, model[order], torch.tensor(1e-3, dtype=D), 1e-6, **EXACT)
    torch.testing.assert_close(alpha, torch.nn.functional.one_hot(order).T.to(D), atol=2e-3, rtol=0)
    shuffled = softassign(model, model[order], torch.tensor(1e-3, dtype=D), 1e-6, **EXACT)
    torch.testing.assert_close(shuffled.targets, model)


def test_sweeps_stop_at_the_tolerance():
    model, data, sigma = cloud(40), cloud(40, seed=1), torch.tensor(0.5, dtype=D)
    exact = softassign(model, data, sigma, **EXACT).weights
    off = [float((softassign(model, data, sigma, sweeps=n, tolerance=0.0).weights - exact).abs().max()) for n in (1, 9)]
    assert off[1] < 0.5 * off[0]
    assert float((softassign(model, data, sigma).weights - exact).abs().max()) < 0.02
    assert float((softassign(model, data, sigma, sweeps=1000, tolerance=1e-8).weights - exact).abs().max()) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("sigma", [1e-3, 1e-8, 1e-20, 1e-40])
def test_sigma_may_vanish(dtype, sigma):
    model = cloud(40, dtype=dtype)
    data = torch.cat([model[:5], cloud(30, seed=1, dtype=dtype) + 3])
    step = softassign(model, data, torch.tensor(sigma, dtype=dtype), **EXACT)
    for field in FIELDS:
        assert torch.isfinite(getattr(step, field)).all()
    # Coincident points share the closed form of one pair, everything else is an outlier for certain.
    share = step.inlier_posterior[:5]
    torch.testing.assert_close(
        share / (1 - share).square(), torch.full_like(share, 1 / (MODEL_OUTLIER * OUTLIER_CONSTANT)), rtol=1e-4, atol=0
    )
    torch.testing.assert_close(step.targets, model)
    assert step.inlier_posterior[5:].tolist() == [0] * 30
    assert step.weights[5:].tolist() == [0] * 35
    alpha = assignment(model, data, torch.tensor(sigma, dtype=dtype), **EXACT)
    torch.testing.assert_close(alpha.sum(-1), step.weights)


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("far", [1e6, 1e25])
def test_far_outliers_get_nothing_and_move_nothing(dtype, far):
    model, data, sigma = cloud(30, dtype=dtype), cloud(30, seed=1, dtype=dtype), torch.tensor(0.1, dtype=dtype)
    plain = softassign(model, data, sigma)
    other = softassign(model, torch.cat([data, far + cloud(3, dtype=dtype)]), sigma)
    assert other.inlier_posterior[30:].tolist() == [0, 0, 0]
    for field in ("weights", "targets", "squared_error"):
        torch.testing.assert_close(getattr(other, field), getattr(plain, field))
    alone = softassign(model, far + cloud(3, dtype=dtype), sigma)
    assert alone.weights.tolist() == [0] * 30
    assert torch.equal(alone.targets, model)
    assert float(alone.squared_error) == 0


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_a_batch_is_a_loop(dtype):
    model, data = cloud(2, 3, 5, dtype=dtype), cloud(2, 3, 7, seed=1, dtype=dtype)
    sigma = torch.linspace(0.1, 0.6, 6, dtype=dtype).reshape(2, 3)
    c = torch.linspace(1, 3, 6, dtype=dtype).reshape(2, 3)
    mask = torch.rand(2, 3, 7, generator=torch.Generator().manual_seed(2)) > 0.3
    tight = {"sweeps": 500, "tolerance": 1e-6}
    together = softassign(model, data, sigma, c, mask=mask, **tight)
    for b, k in itertools.product(range(2), range(3)):
        alone = softassign(model[b, k], data[b, k], sigma[b, k], c[b, k], mask=mask[b, k], **tight)
        for field in FIELDS:
            torch.testing.assert_close(getattr(together, field)[b, k], getattr(alone, field), rtol=1e-4, atol=1e-5)


def test_it_is_differentiable():
    inputs = [cloud(3), cloud(4, seed=1), torch.tensor(0.3, dtype=D), torch.tensor(2.0, dtype=D)]
    inputs = [value.requires_grad_() for value in inputs]
    mask = torch.tensor([True, True, False, True])

    def step(*values):
        result = softassign(*values, mask=mask, sweeps=30, tolerance=0.0)
        return tuple(getattr(result, field) for field in FIELDS)

    assert torch.autograd.gradcheck(step, inputs)
    assert torch.autograd.gradcheck(
        lambda *values: assignment(*values, mask=mask, sweeps=30, tolerance=0.0), inputs, check_forward_ad=False
    )


def test_gradients_stay_finite_where_nothing_is_held():
    model, data = cloud(4).requires_grad_(), (cloud(3, seed=1) + 50).requires_grad_()
    step = softassign(model, data, torch.tensor(0.01, dtype=D), mask=torch.tensor([True, False, True]))
    total = step.weights.sum() + step.targets.sum() + step.squared_error
    for gradient in torch.autograd.grad(total, [model, data]):
        assert torch.isfinite(gradient).all()
    alpha = assignment(model, data, torch.tensor(0.01, dtype=D), mask=torch.zeros(3, dtype=torch.bool))
    for gradient in torch.autograd.grad(alpha.sum(), [model, data]):
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("function", [softassign, assignment])
@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"sweeps": 1.5}, InputTypeError, "sweeps must be an integer, got float"),
        ({"sweeps": True}, InputTypeError, "sweeps must be an integer, got bool"),
        ({"sweeps": -1}, InputError, "sweeps must be zero or more, got -1"),
        ({"tolerance": -0.1}, InputError, "tolerance must be zero or positive and finite, got -0.1"),
        ({"model_outlier": 0.0}, InputError, "model_outlier must be positive and finite, got 0.0"),
        ({"tolerance": "a"}, InputTypeError, "tolerance must be a number, got str"),
    ],
)
def test_bad_options_are_refused(function, options, error, message):
    with pytest.raises(error, match=message):
        function(cloud(2), cloud(2), torch.tensor(0.1, dtype=D), **options)
