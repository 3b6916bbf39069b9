"""The E-step against a plain double loop and the dense posterior, at any sigma, mask, batch and place."""

import math
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import D, rand
from torchreg.solvers import e_step as em

FIELDS = ("weights", "targets", "inlier_posterior", "squared_error")


def cloud(*shape, seed=0, dtype=D):
    return rand(*shape, 3, seed=seed).to(dtype)


def by_loops(model, data, sigma, c):
    """Eqs. 17 and 20 as printed, in Python floats."""
    n, m = len(model), len(data)
    alpha = [[0.0] * m for _ in range(n)]
    for j in range(m):
        e = [math.exp(-(math.dist(model[i], data[j]) ** 2) / (2 * sigma**2)) for i in range(n)]
        for i in range(n):
            alpha[i][j] = e[i] / (sum(e) + c)
    weights = [sum(row) for row in alpha]
    targets = [[sum(a * y[k] for a, y in zip(row, data, strict=True)) / sum(row) for k in range(3)] for row in alpha]
    inlier = [sum(alpha[i][j] for i in range(n)) for j in range(m)]
    squares = sum(alpha[i][j] * math.dist(model[i], data[j]) ** 2 for i in range(n) for j in range(m))
    return alpha, weights, targets, inlier, squares


def assert_same(first, second, index=..., **tolerance):
    for field in FIELDS:
        torch.testing.assert_close(
            getattr(first, field)[index], getattr(second, field), **tolerance, msg=lambda m, f=field: f + m
        )


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float32, {"atol": 1e-5, "rtol": 1e-4}), (D, {"atol": 1e-12, "rtol": 1e-12})]
)
@pytest.mark.parametrize("sigma", [0.1, 0.5])
def test_the_e_step_is_the_papers(dtype, tolerance, sigma):
    model, data = cloud(7), cloud(11, seed=1)
    expected = by_loops(model.tolist(), data.tolist(), sigma, 2.5)
    inputs = (model.to(dtype), data.to(dtype), torch.tensor(sigma, dtype=dtype), 2.5)
    step = em.expectation(*inputs)
    for found, value in zip((em.posterior(*inputs), *(getattr(step, f) for f in FIELDS)), expected, strict=True):
        assert found.dtype == dtype
        torch.testing.assert_close(found, torch.tensor(value, dtype=dtype), **tolerance)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.005, 2.0), st.floats(0.1, 5.0), st.integers(0, 1000))
def test_the_chunked_e_step_sums_the_dense_posterior(n, m, sigma, c, seed):
    model, data = cloud(n, seed=seed), cloud(m, seed=seed + 1)
    alpha = em.posterior(model, data, torch.tensor(sigma, dtype=D), c)
    step = em.expectation(model, data, torch.tensor(sigma, dtype=D), c)
    torch.testing.assert_close(step.weights, alpha.sum(-1), atol=1e-12, rtol=1e-9)
    torch.testing.assert_close(step.inlier_posterior, alpha.sum(-2), atol=1e-12, rtol=1e-9)
    held = step.weights > 1e-12
    torch.testing.assert_close(step.targets[held], ((alpha @ data) / alpha.sum(-1, keepdim=True))[held])
    squares = (alpha * torch.cdist(model, data).square()).sum()
    torch.testing.assert_close(step.squared_error, squares, atol=1e-10, rtol=1e-9)


@pytest.mark.parametrize("entries", [1, 7, 50, 10_000])
def test_chunks_do_not_change_the_answer(monkeypatch, entries):
    sigma, c = torch.tensor([0.1, 0.2, 0.4], dtype=D), torch.tensor([1.0, 2.0, 3.0], dtype=D)
    inputs, mask = (cloud(3, 6), cloud(3, 9, seed=1), sigma, c), rand(3, 9, seed=2) > 0.3
    whole = em.expectation(*inputs, mask=mask)
    monkeypatch.setattr(em, "BUDGET", replace(em.BUDGET, table_entries=entries))
    assert_same(em.expectation(*inputs, mask=mask), whole)


def test_a_datum_on_an_isolated_model_point_is_held_by_a_fifth():
    step = em.expectation(torch.zeros(1, 3), torch.zeros(1, 3), torch.tensor(0.01))
    assert float(step.inlier_posterior) == pytest.approx(1 / (1 + 3 * math.sqrt(math.pi / 2)))
    assert float(step.squared_error) == 0


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("sigma", [1e-2, 1e-4, 1e-8, 1e-12, 1e-20, 1e-30])
def test_sigma_may_vanish(dtype, sigma):
    model = cloud(40, dtype=dtype)
    data = torch.cat([model[:5], cloud(30, seed=1, dtype=dtype) + 3])
    step = em.expectation(model, data, torch.tensor(sigma, dtype=dtype))
    alpha = em.posterior(model, data, torch.tensor(sigma, dtype=dtype))
    for field in FIELDS:
        assert torch.isfinite(getattr(step, field)).all()
    assert torch.isfinite(alpha).all()
    # Coincident points hold each other, everything else is an outlier for certain.
    torch.testing.assert_close(step.inlier_posterior[:5], torch.full((5,), 1 / (1 + em.OUTLIER_CONSTANT), dtype=dtype))
    torch.testing.assert_close(step.targets, model)
    assert step.inlier_posterior[5:].tolist() == [0] * 30
    assert step.weights[5:].tolist() == [0] * 35
    torch.testing.assert_close(alpha.sum(-1), step.weights)


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_far_outliers_get_nothing_and_move_nothing(dtype):
    model, data = cloud(30, dtype=dtype), cloud(30, seed=1, dtype=dtype)
    far = torch.cat([data, cloud(3, dtype=dtype) + 1e6])
    plain, other = (em.expectation(model, points, torch.tensor(0.1)) for points in (data, far))
    assert other.inlier_posterior[30:].tolist() == [0, 0, 0]
    torch.testing.assert_close(other.weights, plain.weights, rtol=0.2 if dtype == torch.float32 else 1e-6, atol=1e-3)
    alone = em.expectation(model, far[30:], torch.tensor(0.1))
    assert alone.weights.tolist() == [0] * 30
    assert torch.equal(alone.targets, model)
    assert float(alone.squared_error) == 0


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_a_batch_is_a_loop(dtype):
    sigma, c = (torch.linspace(*ends, 6, dtype=dtype).reshape(2, 3) for ends in ((0.1, 0.6), (1, 3)))
    inputs, mask = (
        (cloud(2, 3, 5, dtype=dtype), cloud(2, 3, 7, seed=1, dtype=dtype), sigma, c),
        rand(2, 3, 7, seed=2) > 0.3,
    )
    together, dense = em.expectation(*inputs, mask=mask), em.posterior(*inputs, mask=mask)
    for index in ((b, k) for b in range(2) for k in range(3)):
        alone = em.expectation(*(value[index] for value in inputs), mask=mask[index])
        assert_same(together, alone, index, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(dense[index].sum(-1), alone.weights, rtol=1e-4, atol=1e-5)


def test_float32_is_right_far_from_the_origin():
    # On a grid of 1/1024, which float32 still holds exactly at 1000.
    model, data = (cloud(50) * 256).round() / 1024, (cloud(60, seed=1) * 256).round() / 1024
    sigma = torch.tensor(0.01, dtype=D)
    exact = em.expectation(model, data, sigma)
    shifted = em.expectation((model + 1000).float(), (data + 1000).float(), sigma.float())
    torch.testing.assert_close(shifted.weights.double(), exact.weights, atol=1e-3, rtol=1e-2)
    torch.testing.assert_close(shifted.targets.double() - 1000, exact.targets, atol=1e-4, rtol=0)
    torch.testing.assert_close(shifted.inlier_posterior.double(), exact.inlier_posterior, atol=1e-3, rtol=0)


@pytest.mark.parametrize("ratio", [10.0, 100.0, 127.0, 1e3, 1e5])
def test_both_forms_of_the_square_are_exact_enough_in_float32(ratio):
    # Pairs one sigma apart, out to the edge of the extent.
    model = 2 * cloud(200) - 1
    inputs = (
        model,
        model + torch.nn.functional.normalize(cloud(200, seed=3) - 0.5, dim=-1) / ratio,
        torch.tensor(1 / ratio),
    )
    single, exact = (em.expectation(*(v.to(t) for v in inputs)).inlier_posterior for t in (torch.float32, D))
    # At 1e5 the points themselves are rounded by a hundredth of sigma in float32.
    assert (single.double() - exact).abs().max() < (4e-3 if ratio < 1e4 else 2e-2) * exact.max()


def test_the_dense_posterior_is_differentiable():
    inputs = [cloud(3), cloud(4, seed=1), torch.tensor(0.3, dtype=D)]
    assert torch.autograd.gradcheck(em.posterior, [value.requires_grad_() for value in inputs], check_forward_ad=False)


def test_the_outlier_constant_is_eq_18():
    sigma = torch.tensor([1e-9, 0.05, 10.0], dtype=D)
    middle = 3 * math.sqrt(math.pi / 2) * (1 - 100 * 4 / 3 * math.pi * 0.05**3)
    expected = [3.7599424, middle, 0.05 * 3 * math.sqrt(math.pi / 2)]
    assert em.outlier_constant(100, sigma, torch.tensor(1.0, dtype=D)).tolist() == pytest.approx(expected)
    assert math.isclose(em.OUTLIER_CONSTANT, 3.7599424, rel_tol=1e-7)


def test_the_working_volume_is_the_grown_box():
    model = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], dtype=D)
    data = torch.tensor([[0.0, 2.0, 0.5], [9.0, 9.0, 9.0]], dtype=D)
    sigma, first = torch.tensor(0.1, dtype=D), torch.tensor([True, False])
    for mask, expected in ((first, 1.6 * 2.6 * 1.6), (None, 9.6**3), (first & ~first, 1.6**3)):
        assert float(em.working_volume(model, data, sigma, mask)) == pytest.approx(expected)
    both = em.working_volume(torch.stack([model, 2 * model]), data, sigma, first)
    assert both.tolist() == pytest.approx([1.6 * 2.6 * 1.6, 2.6**3])


@pytest.mark.slow
def test_no_table_of_all_pairs_is_held():
    code = """
import resource, torch
from torchreg.solvers.e_step import expectation
model, data = torch.rand(10_000, 3), torch.rand(10_000, 3)
expectation(model[:10], data[:10], torch.tensor(0.05))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
step = expectation(model, data, torch.tensor(0.05))
assert torch.isfinite(step.targets).all()
print(before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    before, after = (int(kilobytes) / 1024 for kilobytes in run.stdout.split())
    # The dense matrix alone would add 400 MB.
    assert after - before < 150
