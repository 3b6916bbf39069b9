"""Confidence intervals beside closed forms and simulated coverage."""

import numpy as np
import pytest
from scipy import stats

from experiments.report.intervals import confidence_interval


def test_shares_have_the_interval_of_a_score_test():
    for count, total in ((0, 10), (3, 12), (12, 12)):
        values = [1.0] * count + [0.0] * (total - count)
        expected = stats.binomtest(count, total).proportion_ci(method="wilson")
        assert confidence_interval(values, mean=True) == pytest.approx((expected.low, expected.high), abs=1e-6)


def test_the_interval_of_a_mean_is_that_of_many_values_in_theory():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    low, high = confidence_interval(values.tolist(), mean=True)
    half = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.03)


def test_most_intervals_hold_the_true_median():
    random = np.random.default_rng(2)
    found = [confidence_interval(random.exponential(1.0, 25).tolist(), mean=False) for _ in range(200)]
    assert 0.88 < np.mean([low <= np.log(2) <= high for low, high in found]) <= 1.0


def test_one_value_tells_nothing():
    assert confidence_interval([1.0], mean=False) is None
    assert confidence_interval([2.0, 2.0], mean=False) == (2.0, 2.0)
