"""How sure a number over few seeds is: 95 % confidence intervals of medians, means and shares."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

# Of the normal distribution, two-sided 95 %.
_Z = 1.959964
_RESAMPLES = 1000


def confidence_interval(values: Sequence[float], *, mean: bool) -> tuple[float, float] | None:
    """Return the 95 % interval of the median or the mean of values, None of fewer than two.

    Shares of yes and no, values of zero and one, have Wilson's interval; others are resampled with replacement.

    References: Wilson 1927; Efron 1979, the bootstrap's percentile interval.
    """
    if len(values) < 2:
        return None
    if mean and set(values) <= {0.0, 1.0}:
        return _wilson(sum(values), len(values))
    numbers = np.asarray(values)
    drawn = numbers[np.random.default_rng(0).integers(len(numbers), size=(_RESAMPLES, len(numbers)))]
    low, high = np.quantile(drawn.mean(1) if mean else np.median(drawn, axis=1), (0.025, 0.975))
    return float(low), float(high)


def _wilson(count: float, total: int) -> tuple[float, float]:
    share, spread = count / total, _Z**2 / total
    middle = (share + spread / 2) / (1 + spread)
    half = math.sqrt(spread * share * (1 - share) + spread**2 / 4) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)
