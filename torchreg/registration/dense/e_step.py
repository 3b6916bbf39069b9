"""Soft matches of two scans, with an outlier class: an E-step over the nearest compatible samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.geometry.neighbors import k_nearest
from torchreg.registration.dense.match_prior import MatchPrior
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.solvers.e_step import responsibilities

# Least outlier density: two samples within an area of one sigma squared.
_DENSITY = 2.0
# How much the features of right matches differ, squared, in the mean; the density of outliers takes it into account.
_FEATURE_MISS = 0.6


@dataclass(frozen=True)
class ScanEMConfig:
    """What makes samples compatible.

    Args:
        normal_weight: exponent lost by normals at right angles.
        feature_weight: exponent lost by features that differ by sqrt(2), as those of samples at random do.
        outliers: expected outliers, as a share of what a sample in the middle of its matches gets.
        num_candidates: targets looked at for each sample: the most compatible.

    Raises:
        InputError: if a value is out of range.
    """

    normal_weight: float = 5.0
    feature_weight: float = 8.0
    outliers: float = 0.3
    num_candidates: int = 6

    def __post_init__(self) -> None:
        check_positive(self.normal_weight, "normal_weight", allow_zero=True)
        check_positive(self.feature_weight, "feature_weight", allow_zero=True)
        check_positive(self.outliers, "outliers")
        check_count(self.num_candidates, "num_candidates", 1)


@dataclass(frozen=True)
class SoftMatches:
    """What source samples match.

    Args:
        posterior: (S,) in [0, 1], mass of all matches of a sample: how much it counts.
        targets: (S, 3) mean places of the matches.
        normals: (S, 3) unit mean normals of the matches; zero where there is none.
    """

    posterior: Tensor
    targets: Tensor
    normals: Tensor


def match_softly(
    source: OrientedSamples,
    target: OrientedSamples,
    sigma: float,
    config: ScanEMConfig | None = None,
    *,
    prior: MatchPrior | None = None,
    doubt: float = 1.0,
) -> SoftMatches:
    """Return the expected matches of source samples, by an E-step in which every sample may be an outlier.

    ``a_ij = e_ij / (sum_k e_ik + c)`` with ``e_ij = exp(-|x_i - y_j|^2 / 2 sigma^2 - normal_weight (1 - n_i . n_j) -
    feature_weight |f_i - f_j|^2 / 2)``.

    Args:
        source: (S) samples where they are now.
        target: (T) samples.
        sigma: width of the kernel, in the unit of the points.
        config: see `ScanEMConfig`.
        prior: what a matcher says of matches, by which ``e_ij`` are multiplied; None if nothing is known.
        doubt: see `MatchPrior.logarithm`.

    Returns:
        `SoftMatches`.

    Raises:
        InputError: if ``sigma`` is not positive.

    Differentiable: no.

    Cost: O((S + T) log(S + T)); 8 ms for 1,200 and 2,500 samples.

    References: eqs. 17 and 20 of the articulated EM, with the normals and features of both surfaces.
    """
    check_positive(sigma, "sigma")
    config = ScanEMConfig() if config is None else config
    scales = (sigma * math.sqrt(config.normal_weight), sigma * math.sqrt(config.feature_weight))
    here, there = source.embedded(*scales), target.embedded(*scales)
    support = None if prior is None else lambda index: prior.logarithm(index, doubt)
    index, chosen = _choices(here, there, sigma, config, support)
    posterior = chosen.sum(1)
    ends = torch.cat((target.points, target.normals), dim=1)
    sums = torch.einsum("sk,skd->sd", chosen, ends[index])
    targets = sums[:, :3] / posterior.clamp_min(torch.finfo(posterior.dtype).tiny).unsqueeze(-1)
    targets = torch.where(posterior.unsqueeze(-1) > 0, targets, source.points)
    return SoftMatches(posterior, targets, torch.nn.functional.normalize(sums[:, 3:], dim=-1))


def _choices(
    chooser: Tensor,
    offered: Tensor,
    sigma: float,
    config: ScanEMConfig,
    support: Callable[[Tensor], Tensor] | None,
) -> tuple[Tensor, Tensor]:
    """Return the most compatible others (N, K) of each sample and their posteriors."""
    index, distance = k_nearest(chooser, offered, min(config.num_candidates, len(offered)))
    # In the middle of a surface a sample has about this many others within its reach.
    density = max(1.0, _DENSITY * len(offered) * sigma**2)
    outlier = config.outliers * density * math.exp(-0.5 * _FEATURE_MISS * config.feature_weight)
    exponent = -0.5 * (distance.to(chooser) / sigma).square()
    return index, responsibilities(exponent if support is None else exponent + support(index), outlier, dim=1)
