"""Which candidate matches agree: bending keeps the ways along a surface as long as they were."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.registration.dense.descriptor_matching import DescriptorMatches

# Share of a way by which it may be longer or shorter: of paths along graphs, and of skin that stretches.
_STRETCH = 0.1
# How fast similarities of descriptors turn into beliefs: a lead of 0.1 in correlation is one of e.
_SHARPNESS = 10.0


@dataclass(frozen=True)
class ConsistentMatches:
    """The candidate of each source point that its surroundings speak for.

    Args:
        index: (Q,) int64 target, -1 for points without a candidate.
        support: (Q,) how well the surroundings agree, 0 to 1. On pairs of scans of a dancer, a horse and a walking
            person, of those above 0.5, which is nearly every other point, 98 % were right, of those above 0.3 87 %.
    """

    index: Tensor
    support: Tensor


def consistent_matches(
    matches: DescriptorMatches,
    source_distances: Tensor,
    target_distances: Tensor,
    *,
    radius: float,
    slack: float,
    num_voters: int = 24,
    steps: int = 10,
) -> ConsistentMatches:
    """Return for each point the candidate that keeps its distances along the surface to the points around it.

    Every point i believes in its candidates a to a degree ``s_ia``, at first by their similarity. A voter j at distance
    ``d_ij <= radius`` supports a by its own most fitting candidate b, ``max_b s_jb exp(-(d_ab - d_ij)^2 / 2 w^2)`` with
    ``w = slack + 0.1 d_ij``. Beliefs are multiplied by the square of the mean support and scaled to sum to one, and so
    on. Ways over holes and to parts that look cut off in one scan spoil single votes; near voters are the safest ones.
    Surroundings that look alike when turned, such as the sides of a box, agree on wrong matches just as well: let
    `match_descriptors` leave out candidates that are too far away (0.3 diagonals).

    Args:
        matches: k candidates of each of Q points, with finite scores in the range of correlations.
        source_distances: (Q, Q) along the source's surface, between the points; infinite where no way leads.
        target_distances: (K, K) the same of the targets.
        radius: see above, in the unit of the distances; 0.2 diagonals does well.
        slack: see above; 0.02 diagonals does well.
        num_voters: how many points vote on each, spread evenly over the ranks of distance within the radius.
        steps: how often beliefs are updated.

    Returns:
        `ConsistentMatches`; a point without voters keeps its first candidate, with support zero.

    Raises:
        InputError: if a size does not fit or a number is out of range.

    Differentiable: no.

    Cost: O(Q k^2 num_voters) a step.

    References: Rosenfeld, Hummel and Zucker 1976, relaxation labeling; Huang et al. 2008 for geodesic consistency of
    matches between scans, which Chang and Zwicker 2009 name as future work (section 6).
    """
    here = as_float_tensor(source_distances, "source_distances")
    there = as_float_tensor(target_distances, "target_distances", like=here)
    count = len(matches.index)
    check_shape(here, "source_distances", (count, count))
    check_shape(there, "target_distances", (there.shape[0], there.shape[0]))
    if matches.index.numel() and int(matches.index.max()) >= len(there):
        raise InputError(
            f"target_distances must cover the matches, which go up to target {int(matches.index.max())}, "
            f"got {len(there)} targets"
        )
    check_positive(radius, "radius")
    check_positive(slack, "slack")
    check_count(num_voters, "num_voters", 1)
    check_count(steps, "steps", 1)
    if matches.index.numel() == 0:
        return ConsistentMatches(torch.full((count,), -1, device=here.device), here.new_zeros(count))
    with torch.no_grad():
        voter, vote = _voters(here, radius, num_voters)
        fit = _fit(matches.index, here, there, voter, slack)
        valid = matches.valid
        belief = torch.softmax((_SHARPNESS * matches.score.to(here)).masked_fill(~valid, -1e30), dim=1) * valid
        votes = vote.sum(1, keepdim=True)
        support = torch.zeros_like(belief)
        for _ in range(steps):
            best = (fit * belief[voter].unsqueeze(1)).amax(-1)
            support = (best * vote.unsqueeze(1)).sum(-1) / votes.clamp_min(1) * valid
            belief = belief * torch.where(votes > 0, support.square(), 1.0)
            belief = belief / belief.sum(1, keepdim=True).clamp_min(torch.finfo(belief.dtype).tiny)
        choice = torch.where(valid, belief, -1.0).argmax(1, keepdim=True)
        return ConsistentMatches(matches.index.gather(1, choice)[:, 0], support.gather(1, choice)[:, 0])


def _voters(distances: Tensor, radius: float, count: int) -> tuple[Tensor, Tensor]:
    """Return the voters (Q, M) of each point, and whether (Q, M) they have a vote."""
    apart = distances.masked_fill(torch.eye(len(distances), dtype=torch.bool, device=distances.device), torch.inf)
    order = apart.argsort(dim=1, stable=True)
    number = (apart <= radius).sum(1, keepdim=True)
    slot = torch.arange(count, device=distances.device)
    # All of them if there are few, else every so many-th.
    rank = torch.where(number <= count, slot, (slot * number) // count)
    return order.gather(1, rank.clamp(max=len(distances) - 1)), rank < number


def _fit(index: Tensor, here: Tensor, there: Tensor, voter: Tensor, slack: float) -> Tensor:
    """Return how well candidates (Q, k) keep the distance to each candidate of each voter, (Q, k, M, k)."""
    own = here.gather(1, voter)[:, None, :, None]
    target = index.clamp(min=0)
    other = there[target[:, :, None, None], target[voter][:, None]]
    miss = (other - own) / (slack + _STRETCH * own)
    return torch.where(other.isfinite() & own.isfinite(), torch.exp(-0.5 * miss.square()), 0.0)
