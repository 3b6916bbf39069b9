"""Correspondences between the tips of two skeletons: the mapping whose rigid fit has the least error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, permutations

import torch
from torch import Tensor

from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.skeleton import nearest_rotation
from torchreg.solvers.assignment import assign


@dataclass(frozen=True)
class MappingSearch:
    """The cost of mappings, and which are tried."""

    missing_cost: float = 0.5  # of a known tip that is not found, a squared share of the size
    length_weight: float = 0.5  # of the term that compares path lengths
    max_missing: int = 2  # known tips missing beyond those that must be, where all mappings are tried
    max_mappings: int = 10_000  # that are tried; if there are more, with fewer tips missing, or by assignments
    num_rotations: int = 24  # about axes all over the sphere, from which assignments start, and the identity
    max_rounds: int = 20  # of an assignment and a rigid fit


_SEARCH = MappingSearch()


@dataclass(frozen=True, eq=False)
class TipReference:
    """The limbs of a known frame, to which others are matched."""

    tips: Tensor  # (K, 3), or curves (K, S, 3) of the limbs, from the tip inwards
    lengths: Tensor | None = None  # (K, K) path lengths along the skeleton from tip to tip; None: not compared
    weight: float = 1.0
    rotation_weight: float = 0.0  # of the rotation itself, which should be small between frames near in time


def rank_mappings(
    references: Sequence[TipReference],
    tips: Tensor,
    lengths: Tensor | None = None,
    *,
    weights: Tensor | None = None,
    missing_cost: float = _SEARCH.missing_cost,
) -> tuple[Tensor, Tensor]:
    """Return mappings (P, K) of known tips to given ones, -1 for none, and their costs (P,), the best first.

    A mapping m of K known tips A to tips B, or to none, costs, with ``s^2`` the mean squared distance of the A from
    their mean and R, T the best rigid motion (det R = +1) of those that are mapped::

        1 / K [ sum_k |B_m(k) - R A_k - T|^2 / s^2  +  rotation_weight * sum_k |R A_k - A_k|^2 / s^2   (centered A)
                + length_weight * sum_k mean_l (d(B_m(k), B_m(l)) - d(A_k, A_l))^2 / 2 s^2  +  missing_cost * number ]

    The first term is the paper's (6), for curves the mean over their points. All mappings are tried if they are few;
    else assignments are refined from many rotations.

    Args:
        references: frames whose tips are known, all with the same K and S; their weighted costs are added.
        tips: (M, 3), or curves (M, S, 3), to be identified; or (M, K, S, 3): curves cut to the length of each known
            one.
        lengths: (M, M) along the skeleton from tip to tip; None: not compared.
        weights: (S,) of the points of a curve, of mean one; all one by default.
        missing_cost: see `MappingSearch`.

    References: Brostow, Essa, Steedly and Kwatra 2004, eqs. 6-8; Arun, Huang and Blostein 1987.
    """
    known = [_as_curves(reference.tips) for reference in references]
    tips = _as_curves(tips)
    if tips.ndim == 3:
        tips = tips.unsqueeze(1).expand(-1, len(known[0]), -1, -1)
    weights = tips.new_ones(tips.shape[2]) if weights is None else weights.to(tips)
    with torch.no_grad():
        costs = _MappingCosts(references, known, tips, lengths, weights=weights.double(), missing_cost=missing_cost)
        every = _all_mappings(len(known[0]), len(tips))
        maps = _assigned_mappings(costs) if every is None else every.to(tips.device)
        ranked, order = costs(maps).sort(stable=True)
        return maps[order], ranked


def _as_curves(tips: Tensor) -> Tensor:
    """Return tips (K, 3) as curves (K, 1, 3) of one point; curves as they are."""
    return tips.unsqueeze(1) if tips.ndim == 2 else tips


class _MappingCosts:
    """The cost of mappings, see `rank_mappings`."""

    def __init__(
        self,
        references: Sequence[TipReference],
        known: Sequence[Tensor],
        tips: Tensor,
        lengths: Tensor | None,
        *,
        weights: Tensor,
        missing_cost: float,
    ) -> None:
        tips = tips.double()
        self.tips = tips - tips.mean((0, 1, 2)) if len(tips) else tips
        self.lengths = None if lengths is None else lengths.to(self.tips)
        self.references, self.weights, self.missing_cost = references, weights, missing_cost
        # Centered: the sums of products below would round far from the origin.
        self.known = [row.to(tips) - row.to(tips).mean((0, 1)) for row in known]
        self.sizes = [_squared_size(row[:, 0]) for row in self.known]

    def __call__(self, maps: Tensor) -> Tensor:
        """Return the costs (P,) of mappings (P, K)."""
        total = torch.zeros(len(maps)).to(self.tips)
        for number, reference in enumerate(self.references):
            error = self._rigid_errors(number, maps)
            if self.lengths is not None and reference.lengths is not None and len(self.lengths):
                known = reference.lengths.to(self.tips)
                error = error + _SEARCH.length_weight * _length_errors(self.lengths, known, maps)
            total += reference.weight * error / self.sizes[number]
        weight = sum(reference.weight for reference in self.references)
        return (total / weight + self.missing_cost * (maps < 0).sum(-1).to(total)) / maps.shape[1]

    def _rigid_errors(self, number: int, maps: Tensor) -> Tensor:
        """Return the squared errors (P,) of the rigid fits, and of their rotations, to a reference."""
        known, weights = self.known[number], self.weights
        limb = torch.arange(len(known), device=maps.device)

        def mapped(table: Tensor) -> Tensor:
            """Return the sums over the limbs of a mapping of a table (M, K, ...); missing limbs add nothing."""
            return torch.cat((table, table.new_zeros(1, *table.shape[1:])))[maps, limb].sum(1)

        source = known.expand(len(self.tips), -1, -1, -1)
        count = mapped(weights.sum().expand(len(self.tips), len(known))).clamp_min(1e-12)
        source_sum = mapped((weights[:, None] * source).sum(2))
        target_sum = mapped((weights[:, None] * self.tips).sum(2))
        spread = mapped(torch.einsum("s,mksi,mksj->mkij", weights, source, source))
        square = mapped((weights * self.tips.square().sum(-1)).sum(-1)) - target_sum.square().sum(-1) / count
        moment = mapped(torch.einsum("s,mksi,mksj->mkij", weights, self.tips, source))  # eq. 7
        moment = moment - target_sum.unsqueeze(-1) * source_sum.unsqueeze(-2) / count[:, None, None]
        spread = spread - source_sum.unsqueeze(-1) * source_sum.unsqueeze(-2) / count[:, None, None]
        rotation = nearest_rotation(moment)  # eq. 8
        size = spread.diagonal(dim1=-2, dim2=-1).sum(-1)
        error = square + size - 2 * (rotation * moment).sum((-2, -1))  # eq. 6
        rotated = 2 * size - 2 * (rotation * spread).sum((-2, -1))
        return (error + self.references[number].rotation_weight * rotated).clamp_min(0) / known.shape[1]

    def assigned(self, rotation: Tensor) -> Tensor:
        """Return the mapping (K,) on which assignments and rigid fits agree, from a rotation (3, 3) of the known."""
        known, size = self.known[0], self.sizes[0]
        moved = (known - known.mean((0, 1))) @ rotation.mT + self.tips.mean((0, 1, 2))
        mapping = torch.full((len(known),), -2)
        for _ in range(_SEARCH.max_rounds):
            costs = ((moved - self.tips).square().sum(-1) * self.weights).mean(-1).mT / size
            before, mapping = mapping, assign(costs, self.missing_cost)
            if torch.equal(before, mapping):
                break
            weights = ((mapping >= 0).to(known).unsqueeze(-1) * self.weights).flatten()
            targets = self.tips[mapping.clamp_min(0), torch.arange(len(mapping))].flatten(0, 1)
            motion = fit_rigid(known.flatten(0, 1), targets, weights)
            moved = transform_points(motion, known.flatten(0, 1)).reshape(known.shape)
        return mapping


def _length_errors(lengths: Tensor, known: Tensor, maps: Tensor) -> Tensor:
    """Return the squared errors (P,) of path lengths from tip to tip: per tip the mean over the others, summed."""
    index = maps.clamp_min(0)
    mapped = lengths[index.unsqueeze(-1), index.unsqueeze(-2)]
    paired = ((maps >= 0).unsqueeze(-1) & (maps >= 0).unsqueeze(-2)).to(known)
    num_others = (paired.sum(-1) - 1).clamp_min(1)
    # Half of it: an error of one length counts for both of its tips.
    return 0.5 * ((mapped - known).square() * paired).sum(-1).div(num_others).sum(-1)


def _squared_size(tips: Tensor) -> float:
    """Return the mean squared distance of tips (K, 3) from their mean; one if it is zero."""
    size = float((tips - tips.mean(0)).square().sum(-1).mean())
    return size if size > 0 else 1.0


def _assigned_mappings(costs: _MappingCosts) -> Tensor:
    """Return the mappings (P, K) that assignments reach from many rotations."""
    # Golden-angle axes: even enough, and the same at every call.
    number = torch.arange(_SEARCH.num_rotations, dtype=torch.float64)
    height = 1 - 2 * (number + 0.5) / _SEARCH.num_rotations
    azimuth = math.pi * (3 - math.sqrt(5)) * number
    radius = (1 - height * height).sqrt()
    axes = torch.stack((radius * azimuth.cos(), radius * azimuth.sin(), height), -1)
    angles = math.pi * (number % 4 + 1)[:, None] / 4
    rotations = torch.cat((torch.eye(3, dtype=torch.float64)[None], so3_exp(angles * axes)))
    return torch.stack([costs.assigned(rotation.to(costs.tips)) for rotation in rotations]).unique(dim=0)


def tries_all_mappings(num_known: int, num_tips: int) -> bool:
    """Return whether `rank_mappings` tries all mappings, so that no rotation it starts from matters."""
    return _all_mappings(num_known, num_tips) is not None


@cache
def _all_mappings(num_known: int, num_tips: int) -> Tensor | None:
    """Return all mappings (P, K) of known tips to given ones or none (-1); None if they are too many."""
    most = min(num_known, num_tips)
    fewest = max(most - _SEARCH.max_missing, min(most, 1))
    for least in range(fewest, most + 1):
        total = sum(math.comb(num_known, n) * math.perm(num_tips, n) for n in range(least, most + 1))
        if total <= _SEARCH.max_mappings:
            break
    else:
        return None
    rows = []
    for number in range(least, most + 1):
        for known in combinations(range(num_known), number):
            for given in permutations(range(num_tips), number):
                pairs = dict(zip(known, given, strict=True))
                rows.append([pairs.get(tip, -1) for tip in range(num_known)])
    return torch.tensor(rows).reshape(-1, num_known)
