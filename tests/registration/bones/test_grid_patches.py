"""Patches of a grid: connected, even, along the surface, one at least per region."""

import pytest
import torch

from torchreg.errors import InputError
from torchreg.registration.bones.grid_patches import grid_patches
from torchreg.registration.bones.sparse_grid import SparseGrid


def strips(gap, count=2000):
    """Two long strips side by side, ``gap`` apart, joined at one end."""
    generator = torch.Generator().manual_seed(0)
    along = torch.rand(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([10.0, 0.5, 0.5])
    across = torch.rand(200, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 1.0 + gap, 0.5])
    return SparseGrid.from_points(
        torch.cat([along, along + torch.tensor([0.0, 0.5 + gap, 0.0]), across]), 40, frame="world"
    )


def test_every_patch_is_connected_and_of_about_one_size():
    grid = strips(1.0)
    patches = grid_patches(grid, 20)
    assert patches.unique().tolist() == list(range(20))
    sizes = torch.bincount(patches)
    assert sizes.max() < 4 * sizes.float().mean()
    pairs = grid.neighbors()
    within = pairs[patches[pairs[:, 0]] == patches[pairs[:, 1]]]
    for patch in range(20):
        cells = (patches == patch).nonzero()[:, 0]
        reached = cells[:1]
        for _ in range(len(cells)):
            ends = within[torch.isin(within, reached).any(1)].flatten()
            reached = torch.cat([reached, ends]).unique()
        assert len(reached) == len(cells)


def test_patches_do_not_jump_between_limbs():
    grid = strips(1.0)
    patches, centers = grid_patches(grid, 20), grid.cell_centers()
    far = centers[:, 0] > 3
    lower, upper = (patches[far & side] for side in (centers[:, 1] < 0.6, centers[:, 1] > 1.4))
    assert not set(lower.tolist()) & set(upper.tolist())


def test_every_region_has_a_patch_and_no_cell_is_left():
    near = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    grid = SparseGrid.from_points(torch.cat([near, near[:2] + 3.0, near[:2] - 3.0]), 30)
    patches = grid_patches(grid, 1)
    assert len(patches.unique()) == int(grid.regions().max()) + 1
    assert patches.unique().tolist() == list(range(int(patches.max()) + 1))
    regions = grid.regions()
    for patch in patches.unique():
        assert len(regions[patches == patch].unique()) == 1


def test_more_patches_than_cells_are_cells():
    grid = SparseGrid.from_points(torch.rand(20, 3, generator=torch.Generator().manual_seed(0)), 3)
    assert len(grid_patches(grid, 500, 3.0).unique()) == grid.num_cells
    with pytest.raises(InputError, match="count"):
        grid_patches(grid, 0)
