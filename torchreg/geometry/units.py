"""Units of length that people measure in, and which of them explains that two sizes differ."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torch import Tensor

# Metres per unit.
LENGTHS = {"metres": 1.0, "millimeters": 0.001, "centimeters": 0.01, "inches": 0.0254, "kilometers": 1000.0}
# What one unit is in another one, of the pairs that are mixed up.
_PAIRS = (
    ("millimeters", "metres"), ("centimeters", "metres"), ("inches", "metres"), ("millimeters", "centimeters"),
    ("millimeters", "inches"),
)  # fmt: skip


def likely_unit(ratio: float, units: Mapping[str, float] = LENGTHS) -> tuple[str, float]:
    """Return the unit that explains best that numbers are some times too large for metres, and its metres."""
    return min(units.items(), key=lambda item: abs(math.log(max(ratio, 1e-30) * item[1])))


def likely_pair(ratio: float) -> tuple[str, str, float]:
    """Return the units of two numbers of one length of which the first is some times the second, and their ratio."""
    size = abs(math.log(ratio))
    fine, coarse = min(_PAIRS, key=lambda pair: abs(size + math.log(LENGTHS[pair[0]] / LENGTHS[pair[1]])))
    first, second = (fine, coarse) if ratio > 1 else (coarse, fine)
    return first, second, LENGTHS[first] / LENGTHS[second]


def robust_size(points: Tensor) -> float:
    """Return twice the median distance of finite points (N, 3) from their median, which outliers hardly change."""
    middle = points.median(0).values
    size = 2 * float((points - middle).norm(dim=-1).median())
    return size or float((points.amax(0) - points.amin(0)).norm())
