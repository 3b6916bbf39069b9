"""Parts that move rigidly, by merging patches of a surface two by two."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive, check_shape
from torchreg.geometry.rigid_moments import RigidMoments, least_cost


@torch.no_grad()
def merge_rigid(moments: RigidMoments, edges: Tensor, num_parts: int, *, tolerance: float = 0.0) -> Tensor:
    """Return which part (G,) each patch belongs to, when the two cheapest neighbors are merged again and again.

    A merger costs by how much the squared error of one rigid motion for both exceeds that of a motion each, summed over
    the poses of a batch.

    Args:
        moments: of G patches.
        edges: (E, 2) pairs of patches that touch; parts that nothing joins never merge, however many are left.
        num_parts: merging stops when so many are left and
        tolerance: no merger is left that costs at most this, in the unit of `RigidMoments.cost`: fewer parts are left
            where more say little.

    Returns:
        (G,) int64 parts from 0, numbered by their first patches.

    Raises:
        InputError: if an argument is out of range.

    Differentiable: no.

    Cost: 20 ms for 100 patches.

    References: Ward 1963, for merging by the growth of the squared error.
    """
    check_count(num_parts, "num_parts", 1)
    check_positive(tolerance, "tolerance", allow_zero=True)
    check_shape(edges, "edges", ("E", 2))
    size = moments.num_groups
    sums = moments.sums.reshape(-1, size, moments.sums.shape[-1]).clone()
    part = torch.arange(size, device=edges.device)
    touching = torch.zeros(size, size, dtype=torch.bool, device=edges.device)
    touching[edges[:, 0], edges[:, 1]] = True
    touching = (touching | touching.mT).fill_diagonal_(False)
    own = _cost(sums)
    price = torch.full((size, size), torch.inf, dtype=sums.dtype, device=sums.device)
    one, two = touching.triu().nonzero().unbind(-1)
    price[one, two] = _cost(sums[:, one] + sums[:, two]) - own[one] - own[two]
    left = size
    while left > 1:
        first, second = divmod(int(price.argmin()), size)
        cost = float(price[first, second])
        if cost == float("inf") or (left <= num_parts and cost > tolerance):
            break
        left -= 1
        sums[:, first] += sums[:, second]
        part[part == second] = first
        touching[first] |= touching[second]
        touching[:, first] |= touching[second]
        touching[first, first] = False
        touching[second], touching[:, second] = False, False
        for gone in (first, second):
            price[gone], price[:, gone] = torch.inf, torch.inf
        others = touching[first].nonzero()[:, 0]
        costs = _cost(sums[:, [first]] + torch.cat((torch.zeros_like(sums[:, :1]), sums[:, others]), dim=1))
        own[first] = costs[0]
        low, high = others.clamp(max=first), others.clamp(min=first)
        price[low, high] = costs[1:] - own[first] - own[others]
    return part.unique(return_inverse=True)[1]


def _cost(sums: Tensor) -> Tensor:
    """Return the least squared errors (...) of sums (poses, ..., 17), added up over the poses."""
    return least_cost(sums).sum(0)
