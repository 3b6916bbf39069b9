"""Patches of a grid, and parts that move rigidly, by merging patches two by two."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph
from torchreg.geometry.rigid_moments import RigidMoments, least_cost
from torchreg.geometry.sampling import farthest_points
from torchreg.registration.bones.sparse_grid import SparseGrid


def grid_patches(grid: SparseGrid, count: int, gap: float = 0.0) -> Tensor:
    """Return the patch (C,) int64 of each cell, that of the seed nearest along the cells, of about ``count`` patches.

    Seeds are spread evenly, one at least in every connected region; patches do not span limbs that come near each
    other.
    """
    pairs = grid.neighbors(gap).cpu()
    cells = grid.cells.cpu().double()
    size = len(cells)
    length = (cells[pairs[:, 0]] - cells[pairs[:, 1]]).norm(dim=-1)
    seeds = farthest_points(cells, min(count, size))
    region = grid.regions(gap).cpu()
    # A region that is small and near another may have been passed over.
    first = torch.full((int(region.max()) + 1,), size).scatter_reduce(0, region, torch.arange(size), "amin")
    seeds = torch.cat([seeds, first[~torch.isin(torch.arange(len(first)), region[seeds])]])
    return Graph.from_edges(pairs, length, size).nearest(seeds)[1].to(grid.cells.device)


@torch.no_grad()
def merge_rigid(moments: RigidMoments, edges: Tensor, num_parts: int, *, tolerance: float = 0.0) -> Tensor:
    """Return the part (G,) int64 of each patch after the cheapest neighbors are merged again and again (Ward 1963)."""
    size = moments.num_groups
    sums = moments.sums.reshape(-1, size, moments.sums.shape[-1]).clone()
    part = torch.arange(size, device=edges.device)
    touching = torch.zeros(size, size, dtype=torch.bool, device=edges.device)
    touching[edges[:, 0], edges[:, 1]] = True
    touching = (touching | touching.mT).fill_diagonal_(False)
    cost = _cost(sums)
    price = torch.full((size, size), torch.inf, dtype=sums.dtype, device=sums.device)
    low, high = touching.triu().nonzero().unbind(-1)
    price[low, high] = _cost(sums[:, low] + sums[:, high]) - cost[low] - cost[high]
    for num_left in range(size - 1, 0, -1):
        first, second = divmod(int(price.argmin()), size)
        cheapest = float(price[first, second])
        if cheapest == float("inf") or (num_left < num_parts and cheapest > tolerance):
            break
        sums[:, first] += sums[:, second]
        part[part == second] = first
        touching[first] |= touching[second]
        touching[:, first] |= touching[second]
        touching[first, first] = False
        touching[second], touching[:, second] = False, False
        for merged in (first, second):
            price[merged], price[:, merged] = torch.inf, torch.inf
        neighbors = touching[first].nonzero()[:, 0]
        costs = _cost(sums[:, [first]] + torch.cat((torch.zeros_like(sums[:, :1]), sums[:, neighbors]), dim=1))
        cost[first] = costs[0]
        low, high = neighbors.clamp(max=first), neighbors.clamp(min=first)
        price[low, high] = costs[1:] - cost[first] - cost[neighbors]
    return part.unique(return_inverse=True)[1]


def _cost(sums: Tensor) -> Tensor:
    """Return the least squared errors (...) of sums (poses, ..., 17), added up over the poses."""
    return least_cost(sums).sum(0)
