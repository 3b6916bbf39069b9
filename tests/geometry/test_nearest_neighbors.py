"""Neighbors against plain tables of all pairs, by the tree and the table, in batches and degenerate sets."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import rand, randn
from torchreg.geometry import neighbors


def clouds(seed, count, size, batch=()):
    both = rand(*batch, count + size, 3, seed=seed)
    return both[..., :count, :], both[..., count:, :]


def by_loop(points, targets):
    return [min(range(len(targets)), key=lambda k: math.dist(x, targets[k])) for x in points.tolist()]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 20), st.integers(1, 30))
def test_neighbors_are_those_of_a_loop_over_all_pairs(seed, count, size):
    points, targets = clouds(seed, count, size)
    index, distance = neighbors.nearest_neighbor(points, targets)
    assert index.dtype == torch.int64
    assert index.tolist() == by_loop(points, targets.tolist())
    torch.testing.assert_close(distance, (points - targets[index]).norm(dim=-1))


@pytest.mark.parametrize("chunk", [1, 700, 4_000_000])
@pytest.mark.parametrize("tree", [True, False])
def test_nearest_index_is_brute_force_far_from_the_origin_and_in_chunks(monkeypatch, chunk, tree):
    monkeypatch.setattr(neighbors, "BUDGET", replace(neighbors.BUDGET, distance_entries=chunk))
    if not tree:
        monkeypatch.setattr(neighbors, "_by_tree", neighbors._by_table)
    points, targets = rand(2, 30, 3, seed=4).float(), rand(2, 50, 3, seed=5).float()
    expected = [by_loop(p, y) for p, y in zip(points, targets.tolist(), strict=True)]
    assert neighbors.nearest_neighbor(points + 100, targets + 100)[0].tolist() == expected


@pytest.mark.parametrize(("ahead", "behind"), [((), (2,)), ((2,), ()), ((2, 1), (1, 3)), ((2, 3), (3,)), ((0,), ())])
def test_batch_dimensions_broadcast(ahead, behind):
    points, targets = clouds(2, 7, 9, ahead)[0], clouds(3, 7, 9, behind)[1]
    index, distance = neighbors.nearest_neighbor(points, targets)
    batch = torch.broadcast_shapes(ahead, behind)
    assert index.shape == distance.shape == (*batch, 7)
    for place in torch.ones(batch).nonzero().tolist():
        one = neighbors.nearest_neighbor(
            points.expand(*batch, 7, 3)[tuple(place)], targets.expand(*batch, 9, 3)[tuple(place)]
        )
        assert torch.equal(index[tuple(place)], one[0])
        assert torch.equal(distance[tuple(place)], one[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_dtypes_are_kept(dtype):
    points, targets = clouds(4, 20, 30)
    index, distance = neighbors.nearest_neighbor(points.to(dtype), targets.to(dtype))
    assert distance.dtype == dtype
    assert index.tolist() == by_loop(points.to(dtype), targets.to(dtype).tolist())


def test_a_broken_problem_leaves_the_others_of_its_batch_alone():
    points, targets = clouds(6, 10, 12, (2,))
    expected = neighbors.nearest_neighbor(points, targets)
    targets = targets.clone()
    targets[1] = torch.nan
    index, distance = neighbors.nearest_neighbor(points, targets)
    assert torch.equal(index[0], expected[0][0])
    assert torch.equal(distance[0], expected[1][0])
    assert distance[1].isnan().all()


def test_the_distance_is_differentiable():
    both = [part.requires_grad_() for part in clouds(7, 5, 6)]
    assert torch.autograd.gradcheck(lambda p, t: neighbors.nearest_neighbor(p, t)[1], both)


def grown_cloud(seed, count, size, copies):
    """Points of a lattice or at random, many of them more than once, so that distances tie."""
    points = rand(count, size, seed=seed)
    return (3 * points).round() if copies else points


def table(points, targets):
    return (points.double()[:, None] - targets.double()).square().sum(-1).sqrt()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 25), st.integers(1, 6), st.booleans(), st.integers(1, 25))
def test_the_k_nearest_are_the_least_of_each_row_of_a_table(seed, count, size, copies, k):
    targets, points, k = grown_cloud(seed, count, size, copies), rand(7, size, seed=seed + 1).float(), min(k, count)
    tree = neighbors.NeighborTree(targets)
    index, distance = tree.k_nearest(points, k)
    apart = table(points, targets)
    assert index.shape == (7, k)
    assert index.dtype == torch.int64
    assert all(len(set(row)) == k for row in index.tolist())
    torch.testing.assert_close(distance, apart.sort(dim=1).values[:, :k])
    torch.testing.assert_close(apart.gather(1, index), distance)
    for found, nearest in zip(neighbors.k_nearest(points, targets, 1), tree.nearest(points), strict=True):
        assert torch.equal(found[:, 0], nearest)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 25), st.integers(1, 4), st.booleans(), st.integers(1, 30))
def test_the_nearest_others_leave_out_the_point_itself_alone(seed, count, size, copies, k):
    points = grown_cloud(seed, count, size, copies)
    index, distance = neighbors.k_nearest_others(points, k)
    assert index.shape == (count, min(k, count - 1))
    assert not (index == torch.arange(count)[:, None]).any()
    assert all(len(set(row)) == len(row) for row in index.tolist())
    apart = table(points, points)
    torch.testing.assert_close(apart.gather(1, index), distance)
    torch.testing.assert_close(distance, apart.fill_diagonal_(torch.inf).sort(dim=1).values[:, :k][:, : count - 1])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 25), st.booleans(), st.floats(0, 2))
def test_pairs_within_a_radius_are_those_of_a_table(seed, count, copies, radius):
    points = grown_cloud(seed, count, 3, copies)
    near = (table(points, points) <= radius).triu(1)
    assert sorted(neighbors.pairs_within(points, radius).tolist()) == near.nonzero().tolist()


def test_the_sampling_distance_is_the_lower_median_of_the_nearest_others():
    points = torch.tensor([[0.0], [1.0], [3.0], [10.0]])
    assert neighbors.sampling_distance(points) == 1.0
    assert neighbors.sampling_distance(points, points[1:]) == 2.0
    assert neighbors.sampling_distance(torch.cat((points, points))) == 0.0
    assert neighbors.sampling_distance(points[:1]) == neighbors.sampling_distance(points[:0]) == math.inf
    cloud = torch.rand(501, 3, generator=torch.Generator().manual_seed(0))
    apart = table(cloud, cloud).fill_diagonal_(torch.inf).amin(1)
    assert neighbors.sampling_distance(cloud) == pytest.approx(float(apart.median()))
    assert neighbors.sampling_distance(7 * cloud - 3) == pytest.approx(7 * float(apart.median()), rel=1e-4)


def test_points_at_one_place_share_a_number():
    points = torch.tensor([[0.0, 0, 1], [2, 0, 0], [-0.0, 0, 1], [2, 0, 0], [0, 0, 2]])
    which = neighbors.weld(points)
    assert torch.equal(which[:, None] == which, (points[:, None] == points).all(-1))
    assert sorted(which.unique().tolist()) == [0, 1, 2]
    places, which = neighbors.distinct_positions(points)
    torch.testing.assert_close(places[which], points.double())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no graphics card")
def test_answers_stay_on_the_device_of_the_points():
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    there = points.cuda()
    for search in (
        lambda p: neighbors.k_nearest(p, p, 4),
        lambda p: neighbors.k_nearest_others(p, 3),
        lambda p: [neighbors.pairs_within(p, 0.3)],
    ):
        for found, expected in zip(search(there), search(points), strict=True):
            assert found.device == there.device
            assert torch.equal(found.cpu(), expected)
    assert neighbors.sampling_distance(there) == neighbors.sampling_distance(points)
    assert torch.equal(
        neighbors.nearest_neighbor(there, there + 0.1)[0].cpu(), neighbors.nearest_neighbor(points, points + 0.1)[0]
    )


def test_neighbors_beyond_a_radius_are_not_looked_for():
    points, targets = randn(300, 3, seed=1), randn(300, 3, seed=2)
    index, distance = neighbors.NeighborTree(targets).nearest_within(points, 0.3)
    truth = torch.cdist(points, targets).min(-1)
    near = truth.values < 0.3
    assert 10 < int(near.sum()) < 290
    torch.testing.assert_close(index, torch.where(near, truth.indices, 0))
    torch.testing.assert_close(distance, torch.where(near, truth.values, torch.inf))
