"""Which limb is which: rigid fits of a few tips or curves, trying all mappings or, with many limbs, good guesses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import combinations, permutations

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.skeleton import nearest_rotation
from torchreg.solvers.assignment import assign

# Up to so many mappings are tried one by one; above, guesses are refined by assignments.
_MAX_TRIED = 10_000
_MAX_ROUNDS = 20
# Turns about the three axes from which assignments start, beside none: 24 all over.
_GUESSES = 24


@dataclass(frozen=True, eq=False)
class TipReference:
    """Limbs of a known frame, against which others are compared.

    Args:
        tips: (K, 3), or curves (K, S, 3) of the limbs, from the tip inwards.
        lengths: (K, K) along the skeleton from tip to tip; None: not compared.
        share: weight of this reference among several.
        turn: weight of the turn of the whole: near in time it should be small.
    """

    tips: Tensor
    lengths: Tensor | None = None
    share: float = 1.0
    turn: float = 0.1


@dataclass(frozen=True, eq=False)
class TipMatch:
    """Tips with their identity.

    Args:
        index: (K,) which of the M tips each known tip is, -1 for none.
        cost: mean over the K tips of squared errors as a share of the size, that of missing ones included.
    """

    index: Tensor
    cost: float


def match_tips(
    references: list[TipReference],
    tips: Tensor,
    lengths: Tensor | None = None,
    *,
    weights: Tensor | None = None,
    missing: float = 0.5,
    length_weight: float = 0.5,
) -> TipMatch:
    """Return which tip is which of the known ones, by the mapping of least error.

    A mapping m of K known tips A to tips B, or to none, costs, with ``s^2`` the mean squared distance of the A from
    their middle and R, T the best rigid motion (det R = +1) of those that are mapped (for curves, squared errors are
    means over their points: the roots of limbs stay apart where their ends pass each other)::

        1 / K [ sum_k |B_m(k) - R A_k - T|^2 / s^2  +  turn * sum_k |R A_k - A_k|^2 / s^2     (centered A)
                + length_weight * sum_k mean_l (d(B_m(k), B_m(l)) - d(A_k, A_l))^2 / 2 s^2  +  missing * their number ]

    The first term is the paper's. The second tells apart what the first cannot where a creature is symmetric: near in
    time it has hardly turned. The third compares lengths along the skeleton, which bending does not change. All
    mappings are tried if they are few, with at most two known tips missing beyond what must be; else assignments are
    refined from many turns.

    Args:
        references: frames whose tips are known, all with the same K; their costs are added, by ``share``.
        tips: (M, 3), or curves (M, S, 3), to be named; or (M, K, S, 3): curves that depend on what they are compared
            with, so that limbs can be cut to the length of the known one.
        lengths: (M, M) along the skeleton from tip to tip; None: not compared.
        weights: (S,) of the points of a curve; their mean should be one. All one by default.
        missing: cost of a known tip that is not found, a squared share of the size.
        length_weight: of the third term.

    Raises:
        InputError: if there is no reference, a shape is wrong or a number out of range.

    Differentiable: no.

    Cost: 20 ms for 5 tips of 6, on one CPU core.

    References: Brostow, Essa, Steedly and Kwatra 2004, eqs. 6-8; Arun, Huang and Blostein 1987.
    """
    maps, costs = rank_mappings(
        references, tips, lengths, weights=weights, missing=missing, length_weight=length_weight
    )
    return TipMatch(maps[0], float(costs[0]))


def rank_mappings(
    references: list[TipReference],
    tips: Tensor,
    lengths: Tensor | None = None,
    *,
    weights: Tensor | None = None,
    missing: float = 0.5,
    length_weight: float = 0.5,
) -> tuple[Tensor, Tensor]:
    """Return all mappings (P, K) that `match_tips` compares, and their costs (P,), the best first; see there."""
    if not references:
        raise InputError("references must hold at least one known frame, got none")
    tips = as_float_tensor(tips, "tips")
    tips = _as_curves(tips, "tips") if tips.ndim < 4 else tips
    check_finite(tips, "tips")
    check_positive(missing, "missing")
    check_positive(length_weight, "length_weight", allow_zero=True)
    known = [_as_curves(row.tips, f"references[{number}].tips") for number, row in enumerate(references)]
    count = len(known[0])
    for row in known:
        if len(row) != count:
            raise InputError(f"references must have the same number of tips, got {count} and {len(row)}")
        if row.shape[1] != tips.shape[-2]:
            raise InputError(
                f"tips must have as many points each as the references, got {tips.shape[-2]} of {row.shape[1]}"
            )
    if tips.ndim == 3:
        tips = tips.unsqueeze(1).expand(-1, count, -1, -1)
    check_shape(tips, "tips", ("M", count, "S", 3))
    if lengths is not None:
        check_shape(lengths, "lengths", (len(tips), len(tips)))
    weights = tips.new_ones(tips.shape[2]) if weights is None else as_float_tensor(weights, "weights", like=tips)
    check_shape(weights, "weights", (tips.shape[2],))
    problem = _Problem(references, known, tips.double(), weights.double(), lengths, missing, length_weight)
    with torch.no_grad():
        fixed = _all_mappings(count, len(tips))
        maps = _guessed(problem) if fixed is None else fixed.to(tips.device)
        costs, order = problem.costs(maps).sort(stable=True)
        return maps[order], costs


def _as_curves(value: Tensor, name: str) -> Tensor:
    """Return tips as curves (K, S, 3)."""
    value = as_float_tensor(value, name)
    value = value.unsqueeze(1) if value.ndim == 2 else value
    check_shape(value, name, ("K", "S", 3))
    check_finite(value, name)
    return value


class _Problem:
    """Tips to be named, and the cost of naming them; see `match_tips`."""

    def __init__(
        self,
        references: list[TipReference],
        known: list[Tensor],
        tips: Tensor,
        weights: Tensor,
        lengths: Tensor | None,
        missing: float,
        length_weight: float,
    ) -> None:
        tips = tips - tips.mean((0, 1, 2)) if len(tips) else tips
        self.tips, self.weights, self.missing, self.length_weight = tips, weights, missing, length_weight
        self.lengths = None if lengths is None else lengths.to(tips)
        self.references = references
        # About the middle: the sums of products below would round far from the origin.
        self.known = [row.to(tips) - row.to(tips).mean((0, 1)) for row in known]
        self.sizes = [_squared_size(row[:, 0]) for row in self.known]

    def costs(self, maps: Tensor) -> Tensor:
        """Return the costs (P,) of mappings (P, K)."""
        found = maps >= 0
        total = torch.zeros(len(maps)).to(self.tips)
        for number, reference in enumerate(self.references):
            error = self._rigid_errors(number, maps)
            if self.lengths is not None and reference.lengths is not None:
                error = error + self.length_weight * self._length_errors(number, maps)
            total += reference.share * error / self.sizes[number]
        share = sum(reference.share for reference in self.references)
        return (total / share + self.missing * (~found).sum(-1)) / maps.shape[1]

    def _rigid_errors(self, number: int, maps: Tensor) -> Tensor:
        """Return the squared errors (P,) of the rigid fits, those of the turns included.

        Sums of products of coordinates are all that a fit needs, and they add up over the limbs of a mapping.
        """
        known, weights = self.known[number], self.weights
        limb = torch.arange(len(known), device=maps.device)

        def chosen(table: Tensor) -> Tensor:
            """Return the sums over the limbs of a mapping of a table (M, K, ...); nothing for a missing one."""
            return torch.cat((table, table.new_zeros(1, *table.shape[1:])))[maps, limb].sum(1)

        spread = known.expand(len(self.tips), -1, -1, -1)
        count = chosen(weights.sum().expand(len(self.tips), len(known))).clamp_min(1e-12)
        middle = chosen((weights[:, None] * spread).sum(2))
        middle_there = chosen((weights[:, None] * self.tips).sum(2))
        own = chosen(torch.einsum("s,mksi,mksj->mkij", weights, spread, spread))
        square = chosen((weights * self.tips.square().sum(-1)).sum(-1)) - middle_there.square().sum(-1) / count
        moment = chosen(torch.einsum("s,mksi,mksj->mkij", weights, self.tips, spread))
        moment = moment - middle_there.unsqueeze(-1) * middle.unsqueeze(-2) / count[:, None, None]
        own = own - middle.unsqueeze(-1) * middle.unsqueeze(-2) / count[:, None, None]
        rotation = nearest_rotation(moment)
        size = own.diagonal(dim1=-2, dim2=-1).sum(-1)
        error = square + size - 2 * (rotation * moment).sum((-2, -1))
        turned = 2 * size - 2 * (rotation * own).sum((-2, -1))
        return (error + self.references[number].turn * turned).clamp_min(0) / known.shape[1]

    def _length_errors(self, number: int, maps: Tensor) -> Tensor:
        """Return the squared errors (P,) of the lengths from tip to tip: per tip the mean over the others, summed."""
        reference = self.references[number].lengths
        if self.lengths is None or reference is None or not len(self.lengths):
            return torch.zeros(len(maps)).to(self.tips)
        known = reference.to(self.tips)
        index = maps.clamp_min(0)
        there = self.lengths[index.unsqueeze(-1), index.unsqueeze(-2)]
        both = ((maps >= 0).unsqueeze(-1) & (maps >= 0).unsqueeze(-2)).to(known)
        others = (both.sum(-1) - 1).clamp_min(1)
        # Half of it is each tip's own: an error of one length is seen from both of its ends.
        return 0.5 * ((there - known).square() * both).sum(-1).div(others).sum(-1)

    def refined(self, rotation: Tensor) -> Tensor:
        """Return the mapping (K,) that assignments and rigid fits agree on, from a turn (3, 3) of the known."""
        known, size = self.known[0], self.sizes[0]
        moved = (known - known.mean((0, 1))) @ rotation.mT + self.tips.mean((0, 1, 2))
        mapping = torch.full((len(known),), -2)
        for _ in range(_MAX_ROUNDS):
            costs = ((moved - self.tips).square().sum(-1) * self.weights).mean(-1).mT / size
            before, mapping = mapping, assign(costs, self.missing)
            if torch.equal(before, mapping):
                break
            found = ((mapping >= 0).to(known).unsqueeze(-1) * self.weights).flatten()
            there = self.tips[mapping.clamp_min(0), torch.arange(len(mapping))].flatten(0, 1)
            motion = fit_rigid(known.flatten(0, 1), there, found)
            moved = transform_points(motion, known.flatten(0, 1)).reshape(known.shape)
        return mapping


def _squared_size(tips: Tensor) -> float:
    size = float((tips - tips.mean(0)).square().sum(-1).mean())
    return size if size > 0 else 1.0


def _guessed(problem: _Problem) -> Tensor:
    """Return the mappings (P, K) that assignments reach from many turns."""
    # Golden-angle axes: even enough, and the same at every call.
    number = torch.arange(_GUESSES, dtype=torch.float64)
    height = 1 - 2 * (number + 0.5) / _GUESSES
    around = math.pi * (3 - math.sqrt(5)) * number
    ring = (1 - height * height).sqrt()
    axes = torch.stack((ring * around.cos(), ring * around.sin(), height), -1)
    angles = math.pi * (number % 4 + 1)[:, None] / 4
    turns = torch.cat((torch.eye(3, dtype=torch.float64)[None], so3_exp(angles * axes)))
    return torch.stack([problem.refined(turn.to(problem.tips)) for turn in turns]).unique(dim=0)


@cache
def _all_mappings(known: int, given: int) -> Tensor | None:
    """Return all mappings (P, K) of known tips to given ones or none (-1); None if they are too many."""
    most = min(known, given)
    fewest = max(most - 2, min(most, 1))
    for least in range(fewest, most + 1):
        total = sum(math.comb(known, n) * math.perm(given, n) for n in range(least, most + 1))
        if total <= _MAX_TRIED:
            break
    else:
        return None
    rows = []
    for number in range(least, most + 1):
        for places in combinations(range(known), number):
            for chosen in permutations(range(given), number):
                row = [-1] * known
                for place, choice in zip(places, chosen, strict=True):
                    row[place] = choice
                rows.append(row)
    return torch.tensor(rows).reshape(-1, known)
