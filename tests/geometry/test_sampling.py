"""Farthest-point sampling: cover, order, and duplicates."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.geometry.sampling import even_order, farthest_points


def cloud(count, seed=0):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_each_point_is_the_farthest_from_those_before():
    points = cloud(60)
    chosen = farthest_points(points, 20, start=7)
    assert chosen[0] == 7
    for k in range(1, 20):
        gaps = torch.cdist(points, points[chosen[:k]]).amin(-1)
        assert gaps[chosen[k]] == gaps.max()


def test_the_cover_is_within_twice_the_best():
    # Four tight groups: four choices find one point in each.
    centers = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    points = (centers.unsqueeze(1) + 0.01 * cloud(40).reshape(4, 10, 3)).reshape(-1, 3)
    groups = farthest_points(points, 4) // 10
    assert sorted(groups.tolist()) == [0, 1, 2, 3]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 30), st.data())
def test_indices_are_all_different_also_among_duplicates(size, data):
    count = data.draw(st.integers(1, size))
    points = cloud(size).mul(2).round()
    chosen = farthest_points(points, count)
    assert chosen.dtype == torch.int64
    assert len(set(chosen.tolist())) == count
    distinct = len(torch.unique(points, dim=0))
    assert len(torch.unique(points[chosen], dim=0)) == min(count, distinct)


def test_float32_and_a_shift_choose_alike():
    points = cloud(50)
    expected = farthest_points(points, 10)
    assert torch.equal(farthest_points(points.float(), 10), expected)
    assert torch.equal(farthest_points(points + 5, 10), expected)


def test_the_even_order_chooses_the_farthest_each_time():
    points = cloud(60)
    order = even_order(points)
    assert torch.equal(order.sort().values, torch.arange(60))
    assert int(order[0]) == int((points - points.mean(0)).norm(dim=-1).argmax())
    assert torch.equal(order, farthest_points(points, 60, int(order[0])))
    shifted = even_order((points + 1000).float())
    assert torch.equal(shifted.sort().values, torch.arange(60))


def test_the_even_order_holds_duplicates_once():
    points = cloud(5).repeat(4, 1)
    order = even_order(points)
    assert torch.equal(order.sort().values, torch.arange(20))
    assert len((order[:5] % 5).unique()) == 5
    assert even_order(cloud(1)).tolist() == [0]
