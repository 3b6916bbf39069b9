"""Multivariate t-densities of groups of features, and their robust fit to few samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class HeavyTails:
    """How samples are judged that are far from the rest."""

    dof: float = 5.0  # of the densities of features: a limb that touches another spoils all features of a frame
    displacement_dof: float = 3.0  # of displacements, whose largest are ten times the usual ones
    num_rounds: int = 8  # of reweighting


TAILS = HeavyTails()


def t_log_density(squares: Tensor, scale: Tensor, size: int, dof: float = TAILS.displacement_dof) -> Tensor:
    """Return the log-density of isotropic t-distributed vectors of some size, given their squared norms."""
    constant = math.lgamma((dof + size) / 2) - math.lgamma(dof / 2) - size / 2 * math.log(dof * math.pi)
    return constant - size * scale.log() - (dof + size) / 2 * torch.log1p(squares / (dof * scale.square()))


@dataclass(frozen=True, eq=False)
class FeatureGroup:
    """Features whose errors go together, columns ``index`` (n,), the rank of their space, at most n, and their kind."""

    index: Tensor
    rank: int
    number: int = 0


class GroupedDensity:
    """A t-density of zero mean for each of G groups, with scatter matrices of the leading ``rank`` dimensions."""

    def __init__(self, groups: Sequence[FeatureGroup], covariances: Sequence[Tensor]) -> None:
        self.groups, self.covariances = groups, covariances
        self._whitening, self._log_volume = [], []
        for group, covariance in zip(groups, covariances, strict=True):
            values, vectors = (rows[..., -group.rank :] for rows in torch.linalg.eigh(covariance))
            self._whitening.append(vectors / values.sqrt())
            self._log_volume.append(-0.5 * float(values.log().sum()))

    def whitened(self, residuals: Tensor) -> list[Tensor]:
        """Return the residuals (..., n) of each group, NaN where unknown, as standard deviations (..., rank)."""
        known = torch.nan_to_num(residuals)
        return [known[..., g.index] @ w for g, w in zip(self.groups, self._whitening, strict=True)]

    def __call__(self, residuals: Tensor) -> Tensor:
        """Return the log-densities (..., G) of residuals (..., n); unknown features, NaN, count nothing."""
        rows = []
        for group, white, volume in zip(self.groups, self.whitened(residuals), self._log_volume, strict=True):
            share = (~residuals[..., group.index].isnan()).to(white).mean(-1)
            size = group.rank * share
            constant = torch.lgamma((TAILS.dof + size) / 2) - math.lgamma(TAILS.dof / 2)
            constant = constant - size / 2 * math.log(TAILS.dof * math.pi) + volume * share
            rows.append(constant - (TAILS.dof + size) / 2 * torch.log1p(white.square().sum(-1) / TAILS.dof))
        return torch.stack(rows, -1)


@dataclass(frozen=True)
class Shrinkage:
    """How much a covariance of few samples leans on the one that is known beforehand."""

    samples: float = 2.0  # that the known one counts for, and one more for each dimension
    variance: float = 0.1  # known beforehand, in those of the background


SHRINKAGE = Shrinkage()


def fit_groups(samples: Tensor, background: GroupedDensity) -> tuple[Tensor, GroupedDensity]:
    """Return the means (n,) of samples (T, n) and the density around them; of a single sample nothing is known, NaN."""
    samples = torch.where((~samples.isnan()).sum(0) > 1, samples, torch.nan)
    mean, covariances = samples.nanmedian(0).values, []
    for group, wide in zip(background.groups, background.covariances, strict=True):
        rows = samples[:, group.index]
        known = (~rows.isnan()).to(rows)
        size = known.mean(1) * group.rank
        count, prior = float(known.mean(1).sum()), SHRINKAGE.samples + group.rank
        weights, covariance = torch.ones(len(rows), 1).to(rows), wide
        for _ in range(TAILS.num_rounds):
            heavy = weights * known
            center = (heavy * torch.nan_to_num(rows)).sum(0) / heavy.sum(0)
            residuals = torch.nan_to_num(rows - center)
            scatter = (weights * residuals).mT @ residuals / max(count - 1, 1.0)
            level = float(scatter.trace() / wide.trace())
            level = (count * level + SHRINKAGE.samples * SHRINKAGE.variance) / (count + SHRINKAGE.samples)
            covariance = (count * scatter + prior * level * wide) / (count + prior)
            white = GroupedDensity([FeatureGroup(torch.arange(rows.shape[1]), group.rank)], [covariance])
            distance = white.whitened(residuals)[0].square().sum(-1)
            weights = ((TAILS.dof + size) / (TAILS.dof + distance)).unsqueeze(-1)
        mean[group.index] = center
        covariances.append(covariance)
    return mean, GroupedDensity(background.groups, covariances)
