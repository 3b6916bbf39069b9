"""Soft matches of two scans, with an outlier class: an E-step over the nearest compatible samples."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.geometry.neighbors import k_nearest
from torchreg.registration.dense.match_prior import MatchPrior
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.solvers.e_step import responsibilities

# Least outlier density: two samples within an area of one sigma squared.
_DENSITY = 2.0


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
    *,
    normal_weight: float = 5.0,
    outliers: float = 0.3,
    visible: Tensor | None = None,
    num_candidates: int = 6,
    prior: MatchPrior | None = None,
    doubt: float = 1.0,
) -> SoftMatches:
    """Return the expected matches of source samples, by an E-step in which every sample may be an outlier.

    ``a_ij = e_ij / (sum_k e_ik + c_i)`` with
    ``e_ij = exp(-|x_i - y_j|^2 / 2 sigma^2 - normal_weight (1 - n_i . n_j))``. The prior odds of an outlier are those
    of a hidden sample, or of a visible one that is an outlier after all: ``c_i = (1 + c) / v_i - 1``, which for what is
    surely visible is c.

    ``outliers``: c, as a share of what a sample in the middle of its matches gets. ``visible``: (S,) v, probability
    that the target shows each sample; one by default. ``prior``: what a matcher says of matches, by which ``e_ij`` are
    multiplied; None if nothing is known.

    References: eqs. 17 and 20 of the articulated EM, with the normals of both surfaces.
    """
    check_positive(sigma, "sigma")
    scale = sigma * math.sqrt(normal_weight)
    here, there = source.embedded(scale), target.embedded(scale)
    index, distance = k_nearest(here, there, min(num_candidates, len(there)))
    exponent = -0.5 * (distance.to(here) / sigma).square()
    if prior is not None:
        exponent = exponent + prior.logarithm(index, doubt)
    # In the middle of a surface a sample has about this many others within its reach.
    density = max(1.0, _DENSITY * len(there) * sigma**2)
    shown = torch.ones_like(exponent[:, 0]) if visible is None else visible
    odds = (1 + outliers) / shown.clamp_min(torch.finfo(shown.dtype).eps) - 1
    chosen = responsibilities(exponent, (odds * density).unsqueeze(1), dim=1)
    posterior = chosen.sum(1)
    ends = torch.cat((target.points, target.normals), dim=1)
    sums = torch.einsum("sk,skd->sd", chosen, ends[index])
    targets = sums[:, :3] / posterior.clamp_min(torch.finfo(posterior.dtype).tiny).unsqueeze(-1)
    targets = torch.where(posterior.unsqueeze(-1) > 0, targets, source.points)
    return SoftMatches(posterior, targets, torch.nn.functional.normalize(sums[:, 3:], dim=-1))
