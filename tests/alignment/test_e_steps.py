"""What everything that may stand in the place of the E-step has in common: masks, nothing, broadcasts, order, place."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.alignment.closest_point import closest_point
from torchreg.alignment.softassign import assignment, softassign
from torchreg.solvers.e_step import expectation, posterior

D = torch.float64
FIELDS = ("weights", "targets", "inlier_posterior", "squared_error")

every_step = pytest.mark.parametrize("step", [expectation, softassign, closest_point])


def cloud(*shape, seed=0):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=D)


@every_step
@pytest.mark.parametrize("sigma", [0.1, 0.15])
def test_masking_is_removing(step, sigma):
    model, data, sigma = cloud(8), cloud(12, seed=1), torch.tensor(sigma, dtype=D)
    mask = torch.rand(12, generator=torch.Generator().manual_seed(2)) > 0.4
    removed = step(model, data[mask], sigma)
    for padding in (0.0, 1e9, math.nan, math.inf):
        masked = step(model, torch.where(mask[:, None], data, padding), sigma, mask=mask)
        for field in ("weights", "targets", "squared_error"):
            torch.testing.assert_close(getattr(masked, field), getattr(removed, field))
        torch.testing.assert_close(masked.inlier_posterior[mask], removed.inlier_posterior)
        assert masked.inlier_posterior[~mask].eq(0).all()


@pytest.mark.parametrize("dense", [posterior, assignment])
def test_masking_is_removing_from_dense_matrices(dense):
    model, data, sigma = cloud(8), cloud(12, seed=1), torch.tensor(0.15, dtype=D)
    mask = torch.rand(12, generator=torch.Generator().manual_seed(2)) > 0.4
    for padding in (0.0, 1e9, math.nan, math.inf):
        alpha = dense(model, torch.where(mask[:, None], data, padding), sigma, mask=mask)
        assert alpha[:, ~mask].eq(0).all()
        torch.testing.assert_close(alpha[:, mask], dense(model, data[mask], sigma))
    assert dense(model, data, sigma, mask=torch.zeros(12, dtype=torch.bool)).eq(0).all()


@every_step
def test_no_data_and_no_points_hold_nothing(step):
    model, sigma = cloud(4), torch.tensor(0.1, dtype=D)
    nothing = step(model, cloud(3), sigma, mask=torch.zeros(3, dtype=torch.bool))
    empty = step(model, cloud(0), sigma)
    for found in (nothing, empty):
        assert found.weights.tolist() == [0] * 4
        assert torch.equal(found.targets, model)
        assert float(found.squared_error) == 0
    assert nothing.inlier_posterior.tolist() == [0] * 3
    assert empty.inlier_posterior.shape == (0,)
    assert step(cloud(0), cloud(3), sigma).inlier_posterior.tolist() == [0] * 3
    assert step(cloud(0, 4), cloud(0, 3), torch.zeros(0, dtype=D)).targets.shape == (0, 4, 3)


@every_step
def test_one_cloud_serves_many_poses(step):
    models, data, sigma = cloud(4, 5), cloud(7, seed=1), torch.tensor(0.2, dtype=D)
    mask = torch.arange(7) < 5
    broadcast = step(models, data, sigma, mask=mask)
    repeated = step(models, data.expand(4, 7, 3), sigma.expand(4), mask=mask.expand(4, 7))
    for field in FIELDS:
        torch.testing.assert_close(getattr(broadcast, field), getattr(repeated, field))
    assert broadcast.inlier_posterior.shape == (4, 7)


@every_step
@pytest.mark.parametrize("sigma", [0.1, 0.2])
@settings(max_examples=15, deadline=None)
@given(rows=st.permutations(range(9)), columns=st.permutations(range(6)))
def test_order_does_not_matter_and_neither_do_place_and_unit(step, sigma, rows, columns):
    model, data, sigma = cloud(9), cloud(6, seed=1), torch.tensor(sigma, dtype=D)
    plain = step(model, data, sigma)
    moved = step(1000 * model[rows] + 5, 1000 * data[columns] + 5, 1000 * sigma)
    torch.testing.assert_close(moved.weights, plain.weights[rows])
    torch.testing.assert_close((moved.targets - 5) / 1000, plain.targets[rows])
    torch.testing.assert_close(moved.inlier_posterior, plain.inlier_posterior[columns])
    torch.testing.assert_close(moved.squared_error / 1e6, plain.squared_error)
