"""Merging by rigid fits: parts of a jointed chain, both stopping rules, regions that nothing joins, many poses."""

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.geometry.rigid_moments import rigid_moments
from torchreg.registration.bones.rigid_parts import merge_rigid


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


def test_bad_numbers_are_refused():
    moments, edges, _ = chain(turns(2))
    with pytest.raises(InputError, match="num_parts"):
        merge_rigid(moments, edges, 0)
    with pytest.raises(InputError, match="tolerance"):
        merge_rigid(moments, edges, 2, tolerance=-1.0)
    with pytest.raises(InputError, match="edges"):
        merge_rigid(moments, edges[0], 2)
