import pytest
import torch


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("confidence") as module:
        yield module


def test_the_model_finds_the_odds_that_made_the_cases(bench):
    generator = torch.Generator().manual_seed(0)
    evidence = torch.rand(4000, 3, generator=generator)
    odds = 2.0 - evidence @ torch.tensor([4.0, 0.0, 1.0])
    right = torch.rand(4000, generator=generator) < torch.sigmoid(odds)
    bias, weights = bench.fitted_model(evidence, right)
    assert bias == pytest.approx(2.0, abs=0.4)
    assert weights == pytest.approx((4.0, 0.0, 1.0), abs=0.6)


def test_the_area_under_the_curve_is_that_of_all_pairs(bench):
    confidence, right = torch.tensor([0.9, 0.6, 0.6, 0.2]), torch.tensor([True, True, False, False])
    assert bench.area_under_curve(confidence, right) == pytest.approx((1 + 1 + 0.5 + 1) / 4)
