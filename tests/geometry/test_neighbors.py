"""Nearest neighbors against a plain loop over all pairs, by the tree and the table, in batches and degenerate sets."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.errors import InputError
from torchreg.geometry import neighbors
from torchreg.geometry.neighbors import nearest_few, nearest_neighbor


def clouds(seed, count, size, batch=(), dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(*batch, count + size, 3, generator=generator, dtype=dtype)
    return draw[..., :count, :], draw[..., count:, :]


def by_loop(points, targets):
    return [min(range(len(targets)), key=lambda k: math.dist(x, targets[k])) for x in points.tolist()]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 20), st.integers(1, 30))
def test_neighbors_are_those_of_a_loop_over_all_pairs(seed, count, size):
    points, targets = clouds(seed, count, size)
    index, distance = nearest_neighbor(points, targets)
    assert index.dtype == torch.int64
    assert index.tolist() == by_loop(points, targets.tolist())
    torch.testing.assert_close(distance, (points - targets[index]).norm(dim=-1))


@pytest.mark.parametrize("chunk", [1, 700, 4_000_000])
@pytest.mark.parametrize("tree", [True, False])
def test_nearest_index_is_brute_force_far_from_the_origin_and_in_chunks(monkeypatch, chunk, tree):
    monkeypatch.setattr(neighbors, "_CHUNK_ENTRIES", chunk)
    if not tree:
        monkeypatch.setattr(neighbors, "_by_tree", neighbors._by_table)
    generator = torch.Generator().manual_seed(4)
    points, targets = torch.rand(2, 30, 3, generator=generator), torch.rand(2, 50, 3, generator=generator)
    expected = [by_loop(p, y) for p, y in zip(points, targets.tolist(), strict=True)]
    assert nearest_neighbor(points + 100, targets + 100)[0].tolist() == expected


def test_the_table_finds_what_the_tree_finds():
    points, targets = clouds(1, 60, 80, (3,))
    assert torch.equal(neighbors._by_table(points, targets), neighbors._by_tree(points, targets))


@pytest.mark.parametrize(("ahead", "behind"), [((), (2,)), ((2,), ()), ((2, 1), (1, 3)), ((2, 3), (3,)), ((0,), ())])
def test_batch_dimensions_broadcast(ahead, behind):
    points, targets = clouds(2, 7, 9, ahead)[0], clouds(3, 7, 9, behind)[1]
    index, distance = nearest_neighbor(points, targets)
    batch = torch.broadcast_shapes(ahead, behind)
    assert index.shape == distance.shape == (*batch, 7)
    for place in torch.ones(batch).nonzero().tolist():
        one = nearest_neighbor(points.expand(*batch, 7, 3)[tuple(place)], targets.expand(*batch, 9, 3)[tuple(place)])
        assert torch.equal(index[tuple(place)], one[0])
        assert torch.equal(distance[tuple(place)], one[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_dtypes_are_kept(dtype):
    points, targets = clouds(4, 20, 30)
    index, distance = nearest_neighbor(points.to(dtype), targets.to(dtype))
    assert distance.dtype == dtype
    assert index.tolist() == by_loop(points.to(dtype), targets.to(dtype).tolist())


def test_a_rigid_motion_changes_no_neighbor_and_a_permutation_is_followed():
    points, targets = clouds(5, 50, 70)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    index, distance = nearest_neighbor(points, targets)
    moved = nearest_neighbor(points @ turn.mT + 3, targets @ turn.mT + 3)
    assert torch.equal(moved[0], index)
    torch.testing.assert_close(moved[1], distance)
    order = torch.randperm(70, generator=torch.Generator().manual_seed(1))
    assert torch.equal(order[nearest_neighbor(points, targets[order])[0]], index)


def test_duplicates_coincidences_and_a_single_target():
    points = torch.zeros(4, 3)
    index, distance = nearest_neighbor(points, points)
    assert set(index.tolist()) <= {0, 1, 2, 3}
    assert distance.tolist() == [0.0] * 4
    assert nearest_neighbor(points, torch.ones(1, 3))[0].tolist() == [0] * 4


def test_a_broken_problem_leaves_the_others_of_its_batch_alone():
    points, targets = clouds(6, 10, 12, (2,))
    expected = nearest_neighbor(points, targets)
    targets = targets.clone()
    targets[1] = torch.nan
    index, distance = nearest_neighbor(points, targets)
    assert torch.equal(index[0], expected[0][0])
    assert torch.equal(distance[0], expected[1][0])
    assert distance[1].isnan().all()


def test_the_distance_is_differentiable():
    points, targets = clouds(7, 5, 6)
    assert torch.autograd.gradcheck(
        lambda p, t: nearest_neighbor(p, t)[1], (points.requires_grad_(), targets.requires_grad_())
    )


@pytest.mark.parametrize(
    ("points", "targets", "message"),
    [
        (torch.zeros(4, 2), torch.zeros(4, 3), r"points must have shape \(\.\.\., N, 3\), got \(4, 2\)"),
        (torch.zeros(4, 3), torch.zeros(3), r"targets must have shape \(\.\.\., K, 3\), got \(3,\)"),
        (torch.zeros(4, 3), torch.zeros(0, 3), "targets must hold at least one point"),
        (
            torch.zeros(4, 3),
            torch.zeros(2, 3).double(),
            "points are torch.float32 on cpu but targets are torch.float64",
        ),
    ],
)
def test_what_does_not_fit_is_refused(points, targets, message):
    with pytest.raises(InputError, match=message):
        nearest_neighbor(points, targets)


def test_the_nearest_few_are_those_of_a_sorted_table():
    generator = torch.Generator().manual_seed(0)
    points, targets = (torch.randn(count, 5, generator=generator) for count in (30, 40))
    index, distance = nearest_few(points, targets, 3)
    expected = torch.cdist(points.double(), targets.double()).topk(3, largest=False)
    assert torch.equal(index, expected.indices)
    torch.testing.assert_close(distance, expected.values)
    assert nearest_few(points, targets[:1], 1)[0].shape == (30, 1)
    with pytest.raises(InputError, match="count must be between 1 and the number of targets 40, got 41"):
        nearest_few(points, targets, 41)
    with pytest.raises(InputError, match="targets must have shape"):
        nearest_few(points, targets[:, :3], 1)
