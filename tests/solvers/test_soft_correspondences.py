"""The E-step against a plain double loop and the dense posterior, at any sigma, mask, batch and place."""

import math
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.solvers import e_step as em

D = torch.float64
FIELDS = ("weights", "targets", "inlier_posterior", "squared_error")


def cloud(*shape, seed=0, dtype=D):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=D).to(dtype)


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


def assert_same(one, other, **tolerance):
    for field in FIELDS:
        torch.testing.assert_close(
            getattr(one, field), getattr(other, field), **tolerance, msg=lambda m, f=field: f + m
        )


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("sigma", [0.1, 0.5])
def test_the_e_step_is_the_papers(dtype, sigma):
    model, data = cloud(7), cloud(11, seed=1)
    alpha, *expected = by_loops(model.tolist(), data.tolist(), sigma, 2.5)
    step = em.expectation(model.to(dtype), data.to(dtype), torch.tensor(sigma, dtype=dtype), 2.5)
    tol = {"atol": 1e-5, "rtol": 1e-4} if dtype == torch.float32 else {"atol": 1e-12, "rtol": 1e-12}
    for field, value in zip(FIELDS, expected, strict=True):
        assert getattr(step, field).dtype == dtype
        torch.testing.assert_close(getattr(step, field), torch.tensor(value, dtype=dtype), **tol)
    dense = em.posterior(model.to(dtype), data.to(dtype), torch.tensor(sigma, dtype=dtype), 2.5)
    torch.testing.assert_close(dense, torch.tensor(alpha, dtype=dtype), **tol)


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
    model, data = cloud(3, 6), cloud(3, 9, seed=1)
    mask = torch.rand(3, 9, generator=torch.Generator().manual_seed(2)) > 0.3
    sigma, c = torch.tensor([0.1, 0.2, 0.4], dtype=D), torch.tensor([1.0, 2.0, 3.0], dtype=D)
    whole = em.expectation(model, data, sigma, c, mask=mask)
    monkeypatch.setattr(em, "BUDGET", replace(em.BUDGET, table_entries=entries))
    assert_same(em.expectation(model, data, sigma, c, mask=mask), whole)


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
    model, data = cloud(2, 3, 5, dtype=dtype), cloud(2, 3, 7, seed=1, dtype=dtype)
    sigma = torch.linspace(0.1, 0.6, 6, dtype=dtype).reshape(2, 3)
    c = torch.linspace(1, 3, 6, dtype=dtype).reshape(2, 3)
    mask = torch.rand(2, 3, 7, generator=torch.Generator().manual_seed(2)) > 0.3
    together = em.expectation(model, data, sigma, c, mask=mask)
    dense = em.posterior(model, data, sigma, c, mask=mask)
    for b in range(2):
        for k in range(3):
            alone = em.expectation(model[b, k], data[b, k], sigma[b, k], c[b, k], mask=mask[b, k])
            for field in FIELDS:
                torch.testing.assert_close(getattr(together, field)[b, k], getattr(alone, field), rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(dense[b, k].sum(-1), alone.weights, rtol=1e-4, atol=1e-5)


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
    sigma = 1.0 / ratio
    model = 2 * cloud(200) - 1
    data = model + sigma * torch.nn.functional.normalize(cloud(200, seed=3) - 0.5, dim=-1)
    single, exact = (
        em.expectation(model.to(t), data.to(t), torch.tensor(sigma, dtype=t)).inlier_posterior
        for t in (torch.float32, D)
    )
    # At 1e5 the points themselves are rounded by a hundredth of sigma in float32.
    assert (single.double() - exact).abs().max() < (4e-3 if ratio < 1e4 else 2e-2) * exact.max()


def test_the_dense_posterior_is_differentiable():
    inputs = [cloud(3), cloud(4, seed=1), torch.tensor(0.3, dtype=D)]
    assert torch.autograd.gradcheck(em.posterior, [value.requires_grad_() for value in inputs], check_forward_ad=False)


def test_the_outlier_constant_is_eq_18():
    volume = torch.tensor(1.0, dtype=D)
    sigma = torch.tensor([1e-9, 0.05, 10.0], dtype=D)
    limit, middle, floor = em.outlier_constant(100, sigma, volume)
    assert float(limit) == pytest.approx(3.7599424)
    share = 100 * 4 / 3 * math.pi * 0.05**3
    assert float(middle) == pytest.approx(3 * math.sqrt(math.pi / 2) * (1 - share))
    assert float(floor) == pytest.approx(0.05 * 3 * math.sqrt(math.pi / 2))
    assert math.isclose(em.OUTLIER_CONSTANT, 3.7599424, rel_tol=1e-7)


def test_the_working_volume_is_the_grown_box():
    model = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], dtype=D)
    data = torch.tensor([[0.0, 2.0, 0.5], [9.0, 9.0, 9.0]], dtype=D)
    sigma = torch.tensor(0.1, dtype=D)
    mask = torch.tensor([True, False])
    assert float(em.working_volume(model, data, sigma, mask)) == pytest.approx(1.6 * 2.6 * 1.6)
    assert float(em.working_volume(model, data, sigma)) == pytest.approx(9.6**3)
    nothing = em.working_volume(model, data, sigma, torch.zeros(2, dtype=torch.bool))
    assert float(nothing) == pytest.approx(1.6**3)
    both = em.working_volume(torch.stack([model, 2 * model]), data, sigma, mask)
    assert both.tolist() == pytest.approx([1.6 * 2.6 * 1.6, 2.6**3])


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
