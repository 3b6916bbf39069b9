"""Patches: connected, even, along the surface. Merging them: parts of a chain, both stopping rules, many poses."""

import torch

from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.geometry.rigid_moments import rigid_moments
from torchreg.registration.bones.rigid_parts import grid_patches, merge_rigid
from torchreg.registration.bones.sparse_grid import SparseGrid


def chain(motions, patches_per_part=5, seed=0, noise=1e-3):
    """Return moments of patches in a row, the edges between them, and the part of each."""
    generator = torch.Generator().manual_seed(seed)
    count = len(motions) * patches_per_part
    patch = torch.arange(count).repeat_interleave(30)
    points = torch.rand(len(patch), 3, generator=generator, dtype=torch.float64) + patch[:, None] * torch.tensor(
        [1.0, 0.0, 0.0]
    )
    part = patch // patches_per_part
    moved = transform_points(motions[part], points[:, None])[:, 0]
    moved = moved + noise * torch.randn(moved.shape, generator=generator, dtype=torch.float64)
    moments = rigid_moments(points, moved, torch.ones(len(patch), dtype=torch.float64), patch, count)
    return (
        moments,
        torch.stack([torch.arange(count - 1), torch.arange(1, count)], dim=-1),
        torch.arange(count) // patches_per_part,
    )


def turns(count, seed=1):
    return se3_exp(0.5 * torch.randn(count, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


def test_parts_of_a_chain_are_found():
    moments, edges, truth = chain(turns(4))
    assert merge_rigid(moments, edges, 4).tolist() == truth.tolist()


def test_what_moves_alike_merges_below_the_number_asked_for():
    motions = turns(3)
    moments, edges, truth = chain(motions[[0, 0, 1, 2]])
    assert len(merge_rigid(moments, edges, 12).unique()) == 12
    found = merge_rigid(moments, edges, 12, tolerance=1e-2)
    assert found.tolist() == (truth - 1).clamp(min=0).tolist()
    assert len(merge_rigid(moments, edges, 1).unique()) == 1


def test_regions_that_nothing_joins_stay_apart():
    moments, edges, truth = chain(turns(1)[[0, 0]])
    apart = edges[(truth[edges[:, 0]] == truth[edges[:, 1]])]
    assert merge_rigid(moments, apart, 1).tolist() == truth.tolist()
    assert merge_rigid(moments, apart[:0], 1).tolist() == list(range(10))


def test_parts_that_differ_in_one_pose_only_are_told_apart():
    one = turns(3)[[0, 0, 2]]
    first, edges, truth = chain(one)
    second, _, _ = chain(turns(3, 5)[[0, 1, 1]])
    sums = torch.stack([first.sums, second.sums])
    both = type(first)(
        sums, torch.stack([first.source_origin] * 2), torch.stack([first.target_origin, second.target_origin])
    )
    assert merge_rigid(both, edges, 3).tolist() == truth.tolist()


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
