"""Patches of a grid: connected groups of cells of about one size."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg.geometry.graphs import Graph
from torchreg.geometry.sampling import farthest_points
from torchreg.registration.bones.sparse_grid import SparseGrid


def grid_patches(grid: SparseGrid, count: int, gap: float = 0.0) -> Tensor:
    """Return which patch (C,) int64 each cell belongs to: that of the seed nearest along the cells.

    Seeds are spread evenly, and every connected region has one at least.

    Args:
        grid: the grid.
        count: patches wanted; fewer if there are fewer cells, more if there are more regions.
        gap: see `SparseGrid.neighbors`.

    Raises:
        InputError: if ``count`` is below one.

    Differentiable: no.

    Cost: 5 ms for 1,000 cells and 100 patches.

    References: Chang and Zwicker 2009, section 4.3, but along the surface: patches do not span limbs that come near.
    """
    check_count(count, "count", 1)
    pairs = grid.neighbors(gap).cpu()
    places = grid.cells.cpu().double()
    size = len(places)
    length = (places[pairs[:, 0]] - places[pairs[:, 1]]).norm(dim=-1)
    seeds = farthest_points(places, min(count, size))
    region = grid.regions(gap).cpu()
    # A region that is small and near another may have been passed over.
    first = torch.full((int(region.max()) + 1,), size).scatter_reduce(0, region, torch.arange(size), "amin")
    seeds = torch.cat([seeds, first[~torch.isin(first.new_tensor(range(len(first))), region[seeds])]])
    return Graph.from_edges(pairs, length, size).nearest(seeds)[1].to(grid.cells.device)
