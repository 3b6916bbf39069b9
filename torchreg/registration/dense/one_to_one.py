"""Matches in which no target is taken twice: what moved far does not crowd upon what lies nearest."""

from __future__ import annotations

from torch import Tensor

from torchreg._checks import check_positive
from torchreg.geometry.neighbors import sampling_distance
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.solvers.assignment import assign_within


def match_one_to_one(
    source: OrientedSamples,
    target: OrientedSamples,
    reach: float,
    *,
    normal_weight: float = 0.01,
    feature_weight: float = 0.02,
) -> Tensor:
    """Return the target of each source sample in the cheapest one-to-one assignment.

    A pair costs ``|x - y|^2 + normal_weight (1 - n . n') + feature_weight |f - f'|^2``; pairs that cost ``reach^2`` or
    more are none. Closest points send a limb that moved far to the nearest limb, which is taken already here.

    Args:
        source: (S) samples where they are now; about as dense as the target's.
        target: (T) samples.
        reach: see above, in the unit of the points.
        normal_weight: what normals at right angles cost, that unit squared.
        feature_weight: see above.

    Returns:
        (S,) int64 indices of targets, -1 for samples without one.

    Raises:
        InputError: if the reach is not positive or a weight is negative.

    Differentiable: no.

    Cost: 10 ms for 400 samples each.

    References: Kuhn 1955; Rangarajan et al. 1997 for what one-to-one matches bring to registration.
    """
    check_positive(reach, "reach")
    check_positive(normal_weight, "normal_weight", allow_zero=True)
    check_positive(feature_weight, "feature_weight", allow_zero=True)
    # |n - n'|^2 = 2 (1 - n . n').
    scales = ((0.5 * normal_weight) ** 0.5, feature_weight**0.5)
    return assign_within(squared_distances(source.embedded(*scales), target.embedded(*scales)), reach**2)


def squared_distances(one: Tensor, other: Tensor) -> Tensor:
    """Return the squared distances (S, T) of vectors (S, D) and (T, D)."""
    product = one @ other.mT
    return (one.square().sum(1)[:, None] + other.square().sum(1) - 2 * product).clamp_min_(0)


def count_of_spacing(points: Tensor, spacing: float, least: int = 50) -> int:
    """Return how many of the first points are about as far apart as ``spacing``.

    Args:
        points: (N, 3) in an order in which each first few are spread evenly, and ever denser.
        spacing: in the unit of the points.
        least: not fewer than these.
    """
    lower, upper = min(least, len(points)), len(points)
    while upper - lower > 10:
        middle = (lower + upper) // 2
        lower, upper = (middle, upper) if sampling_distance(points[:middle]) > spacing else (lower, middle)
    return upper
