"""The made-up errors of depth cameras."""

import pytest
import torch

import torchreg as tr
from experiments.made_up.depth_noise import DepthNoise


@pytest.mark.parametrize("noise", [DepthNoise.structured_light(), DepthNoise.time_of_flight()])
@pytest.mark.parametrize("distance", [0.6, 2.0])
def test_spread_is_what_depth_std_says(noise, distance):
    flat = torch.full((150, 150), distance, dtype=torch.float64)
    seen = noise.measured(flat)
    error = seen[seen > 0] - distance
    assert float(error.std()) == pytest.approx(float(noise.depth_std(flat[0, 0])), rel=0.1)
    assert float(error.mean().abs()) < 0.1 * float(error.std()) + 0.5 * noise.step * distance**2
    assert float((seen == 0).double().mean()) == pytest.approx(noise.dropout, abs=0.005)


def test_depths_come_in_steps_of_nearness():
    seen = DepthNoise(step=0.1).measured(torch.linspace(1.0, 2.0, 100).reshape(10, 10))
    steps = 1 / seen / 0.1
    assert torch.allclose(steps, steps.round(), atol=1e-4)


def test_flying_pixels_hang_between_the_two_sides():
    truth = torch.full((20, 20), 2.0)
    truth[5:15, 5:15] = 1.0
    seen = DepthNoise(flying=1.0).measured(truth)
    between = (seen > 1.0) & (seen < 2.0)
    assert between.sum() == 36
    assert torch.equal(between, between & (truth == 1.0))


def test_jitter_ruffles_edges_only():
    truth = torch.full((20, 20), 2.0)
    truth[:, 10:] = 1.0
    seen = DepthNoise(jitter=0.5).measured(truth)
    moved = (seen != truth).nonzero()[:, 1]
    assert len(moved)
    assert ((moved - 9.5).abs() < 4).all()


def test_nothing_stays_nothing_and_seeds_decide():
    empty = torch.tensor([[0.0, torch.nan], [torch.inf, -1.0]])
    noise = DepthNoise.time_of_flight()
    assert not noise.measured(empty).any()
    flat = torch.ones(2, 5, 5)
    assert torch.equal(noise.measured(flat), noise.measured(flat))
    other = noise.measured(flat, torch.Generator().manual_seed(1))
    assert not torch.equal(noise.measured(flat), other)
    assert torch.equal(DepthNoise().measured(flat), flat)


def test_numbers_are_checked():
    with pytest.raises(tr.errors.InputError, match="quadratic must be zero or positive"):
        DepthNoise(quadratic=-1.0)
    with pytest.raises(tr.errors.InputError, match="flying is a share"):
        DepthNoise(flying=1.5)
