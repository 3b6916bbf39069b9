"""Closest-point matches against plain loops and SciPy's tree, with trimming, masks, batches and far places."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from torchreg.alignment import closest_point as closest
from torchreg.alignment.closest_point import closest_point
from torchreg.errors import InputError, InputTypeError
from torchreg.solvers.e_step import expectation

D = torch.float64
FIELDS = ("weights", "targets", "inlier_posterior", "squared_error")


def cloud(*shape, seed=0, dtype=D):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=D).to(dtype)


def assert_same(one, other, **tolerance):
    for field in FIELDS:
        torch.testing.assert_close(getattr(one, field), getattr(other, field), **tolerance)


def test_matches_by_hand():
    model = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    data = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.3, 0.0], [1.2, 0.0, 0.0], [3.0, 0.0, 0.0]])
    step = closest_point(model, data, torch.tensor(0.2), trim=2.0)
    assert step.weights.tolist() == [2, 1, 0]
    torch.testing.assert_close(step.targets, torch.tensor([[0.05, 0.15, 0.0], [1.2, 0.0, 0.0], [5.0, 0.0, 0.0]]))
    assert step.inlier_posterior.tolist() == [1, 1, 1, 0]
    assert float(step.squared_error) == pytest.approx(0.01 + 0.09 + 0.04)
    assert closest_point(model, data, torch.tensor(0.2), trim=10.0).inlier_posterior.tolist() == [1] * 4
    assert closest_point(model, data, torch.tensor(0.2), trim=1.1).inlier_posterior.tolist() == [1, 0, 1, 0]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.005, 0.5), st.integers(0, 1000))
def test_matches_are_those_of_a_tree(n, m, sigma, seed):
    model, data = cloud(n, seed=seed), cloud(m, seed=seed + 1)
    step = closest_point(model, data, torch.tensor(sigma, dtype=D), trim=2.0)
    distance, index = cKDTree(model.numpy()).query(data.numpy())
    for i in range(n):
        mine = (index == i) & (distance <= 2.0 * sigma)
        assert float(step.weights[i]) == mine.sum()
        expected = data[torch.from_numpy(mine)].mean(0) if mine.any() else model[i]
        torch.testing.assert_close(step.targets[i], expected)
    assert step.inlier_posterior.tolist() == (distance <= 2.0 * sigma).tolist()
    assert float(step.squared_error) == pytest.approx((distance[distance <= 2.0 * sigma] ** 2).sum(), abs=1e-12)


def test_it_is_the_limit_of_the_e_step():
    model = cloud(30)
    data = model[torch.arange(50) % 30] + 2e-3 * cloud(50, seed=1)
    # So light an outlier class that every datum finds its partner, so narrow a kernel that it is the closest.
    soft = expectation(model, data, torch.tensor(1e-3, dtype=D), 1e-20)
    assert_same(closest_point(model, data, torch.tensor(1.0, dtype=D)), soft, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("entries", [1, 7, 50, 10_000])
def test_chunks_do_not_change_the_answer(monkeypatch, entries):
    model, data, sigma = cloud(3, 6), cloud(3, 9, seed=1), torch.tensor([0.1, 0.2, 0.4], dtype=D)
    mask = torch.rand(3, 9, generator=torch.Generator().manual_seed(2)) > 0.3
    whole = closest_point(model, data, sigma, mask=mask)
    monkeypatch.setattr(closest, "_CHUNK_ENTRIES", entries)
    assert_same(closest_point(model, data, sigma, mask=mask), whole)


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("sigma", [1e-2, 1e-8, 1e-30])
def test_sigma_may_vanish(dtype, sigma):
    model = cloud(40, dtype=dtype)
    data = torch.cat([model[:5], cloud(30, seed=1, dtype=dtype) + 3])
    step = closest_point(model, data, torch.tensor(sigma, dtype=dtype))
    assert step.inlier_posterior.tolist() == [1] * 5 + [0] * 30
    assert step.weights.tolist() == [1] * 5 + [0] * 35
    torch.testing.assert_close(step.targets, model)
    assert float(step.squared_error) == 0


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("far", [1e6, 1e25])
def test_far_outliers_get_nothing_and_move_nothing(dtype, far):
    model, data, sigma = cloud(30, dtype=dtype), cloud(30, seed=1, dtype=dtype), torch.tensor(0.1, dtype=dtype)
    plain = closest_point(model, data, sigma)
    other = closest_point(model, torch.cat([data, far + cloud(3, dtype=dtype)]), sigma)
    assert other.inlier_posterior[30:].tolist() == [0, 0, 0]
    for field in ("weights", "targets", "squared_error"):
        torch.testing.assert_close(getattr(other, field), getattr(plain, field))


def test_a_single_model_point_takes_all():
    one = closest_point(cloud(1), cloud(5, seed=1), torch.tensor(10.0, dtype=D))
    assert one.weights.tolist() == [5]


def test_a_batch_is_a_loop_and_one_cloud_serves_many_poses():
    model, data, mask = cloud(2, 3, 5), cloud(7, seed=1), torch.arange(7) < 5
    sigma = torch.linspace(0.05, 0.3, 6, dtype=D).reshape(2, 3)
    together = closest_point(model, data, sigma, mask=mask)
    for b in range(2):
        for k in range(3):
            alone = closest_point(model[b, k], data, sigma[b, k], mask=mask)
            for field in FIELDS:
                torch.testing.assert_close(getattr(together, field)[b, k], getattr(alone, field))


def test_float32_is_right_far_from_the_origin():
    # On a grid of 1/1024, which float32 still holds exactly at 1000.
    model, data = (cloud(50) * 256).round() / 1024, (cloud(60, seed=1) * 256).round() / 1024
    sigma = torch.tensor(0.02, dtype=D)
    exact = closest_point(model, data, sigma)
    shifted = closest_point((model + 1000).float(), (data + 1000).float(), sigma.float())
    # Equal distances may be decided either way.
    assert (shifted.weights.double() - exact.weights).abs().sum() <= 4
    torch.testing.assert_close(shifted.squared_error.double(), exact.squared_error, rtol=1e-3, atol=1e-6)


def test_nothing_is_recorded_for_autograd():
    step = closest_point(cloud(4).requires_grad_(), cloud(5), torch.tensor(0.1, dtype=D))
    assert not any(getattr(step, field).requires_grad for field in FIELDS)


@pytest.mark.parametrize(("trim", "error"), [(0.0, InputError), (-1.0, InputError), ("a", InputTypeError)])
def test_bad_options_are_refused(trim, error):
    with pytest.raises(error, match="trim must be"):
        closest_point(cloud(2), cloud(2), torch.tensor(0.1, dtype=D), trim=trim)
