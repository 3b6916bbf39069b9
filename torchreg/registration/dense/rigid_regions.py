"""Wide regions of a surface, most of each moving rigidly: folds wander over cloth, the cloth stays on the body."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rigid_moments import rigid_moments
from torchreg.registration.dense.graph_fit import GraphMatches
from torchreg.solvers.robust import geman_mcclure_loss, geman_mcclure_weight

# Rounds of fitting and of trusting less what does not fit.
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class WideRegions:
    """Overlapping regions of the first samples of a surface.

    The gaps between neighboring nodes of a graph cost little where each is small, however much they add up to over a
    wide region. Here each region has one rigid motion, fitted robustly to where its samples are: of a bent limb it
    takes the larger part, and what leaves that by more than ``give`` is free.

    Args:
        points: (M, 3) samples at rest.
        shares: (J, M) how much each sample belongs to each region; columns sum to one in the mean.
        give: samples that a region's motion misses by more than this follow it ever less, length.
    """

    points: Tensor
    shares: Tensor
    give: float

    @classmethod
    def of(cls, points: Tensor, ways: Tensor, reach: float, give: float) -> WideRegions:
        """Return the regions about some places.

        Args:
            points: (M, 3) samples at rest.
            ways: (J, M) their distances from the places along the surface; infinite for any beyond the reach.
            reach: radius of a region, length, within which most samples have a place.
            give: see above.
        """
        shares = (1 - (ways / reach).square()).clamp_min(0).square()
        return cls(points, shares / shares.sum(0).mean().clamp_min(torch.finfo(shares.dtype).tiny), give)

    def matches(self, places: Tensor, follow: Tensor, weight: float) -> GraphMatches:
        """Return what takes samples along with their regions, from places (S, 3) of which the first are the regions'.

        Regions move as those samples do that need not follow. It costs ``weight`` times the mean over the M samples of
        the squared misses of the regions' motions, by share, by how far the sample follows, and by the share of the
        region that shows how it moves.

        Args:
            places: where samples are now.
            follow: (S,) from 0, for a sample whose own match is to be trusted, to 1.
            weight: see above.

        References: Geman and McClure 1987, for how a miss that is large counts less.
        """
        count, tiny = min(len(self.points), len(places)), torch.finfo(places.dtype).tiny
        points, follow, shares = self.points[:count], follow[:count], self.shares[:, :count]
        motions, trust, _ = self._fitted(places, 1 - follow)
        held = shares * trust
        shown = (held * (1 - follow)).sum(1) / shares.sum(1).clamp_min(tiny)
        held = held * torch.outer(shown, follow)
        total = held.sum(0)
        mean = (held.mT / total.clamp_min(tiny).unsqueeze(-1) @ motions.flatten(1)).view(-1, 4, 4)
        aims = transform_points(mean, points.unsqueeze(1)).squeeze(1)
        targets = torch.where(total.unsqueeze(-1) > 0, aims, places[:count])
        return GraphMatches(slice(0, count), targets, weight * total * (len(places) / count))

    def strain(self, places: Tensor) -> float:
        """Return the mean, over samples and by share, of ``r^2 / (r^2 + give^2)``, r a miss of a region's motion."""
        _, _, misses = self._fitted(places, torch.ones_like(places[:, 0]))
        return float((self.shares[:, : misses.shape[1]] * geman_mcclure_loss(misses / self.give**2)).sum(0).mean())

    def _fitted(self, places: Tensor, sure: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return motions (J, 4, 4) of the regions, how far samples (J, m) go along, and their squared misses."""
        count = min(len(self.points), len(places))
        points, places, shares = self.points[:count], places[:count], self.shares[:, :count] * sure[:count]
        trust, each = torch.ones_like(shares), torch.arange(count, device=points.device)
        alone = rigid_moments(points, places, torch.ones_like(points[:, 0]), each, count)
        for _ in range(_ROUNDS):
            motions = replace(alone, sums=(shares * trust) @ alone.sums).motions()
            misses = _squared_misses(motions, points, places)
            trust = geman_mcclure_weight(misses / self.give**2)
        return motions, trust, misses


def _squared_misses(motions: Tensor, points: Tensor, places: Tensor) -> Tensor:
    """Return ``|R x + t - y|^2`` (J, m), multiplied out: less than half the time of (J, m, 3)."""
    turns, shifts = motions[:, :3, :3], motions[:, :3, 3]
    both = torch.einsum("mi,mj->mij", places, points).flatten(1)
    back = torch.einsum("jik,ji->jk", turns, shifts)
    mixed = back @ points.mT - shifts @ places.mT - turns.flatten(1) @ both.mT
    own = points.square().sum(-1) + places.square().sum(-1)
    return (own + shifts.square().sum(-1, keepdim=True) + 2 * mixed).clamp_min(0)
