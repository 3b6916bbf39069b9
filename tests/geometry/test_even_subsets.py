"""Subsets that cover a cloud evenly: Poisson disks and farthest points."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import directions, rand, seeded
from torchreg.geometry.poisson_disk import poisson_disk, poisson_disk_count
from torchreg.geometry.sampling import draw_spread, even_order, farthest_points


def cloud(count, seed=0):
    return directions(count, seed).float()


def test_the_rule_walked_point_by_point():
    points, radius, kept = cloud(150).double(), 0.25, []
    for index in torch.randperm(150, generator=seeded()).tolist():
        if all(float((points[index] - points[other]).norm()) > radius for other in kept):
            kept.append(index)
    assert poisson_disk(points, radius).tolist() == sorted(kept)


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(1, 300), radius=st.floats(1e-3, 3), seed=st.integers(0, 99), scale=st.sampled_from([1e-3, 1e3])
)
def test_no_two_are_within_the_radius_and_no_other_point_is_out_of_reach(count, radius, seed, scale):
    points = cloud(count, seed).double()
    few = poisson_disk(points, radius)
    assert len(few.unique()) == len(few)
    apart = torch.cdist(points[few], points[few]).fill_diagonal_(torch.inf)
    assert float(apart.min()) > radius or len(few) == 1
    # Each thinning before the last may leave a point out of reach of the last one by its own radius.
    assert float(torch.cdist(points, points[few]).min(dim=1).values.max()) <= 1.5 * radius + 1e-12
    assert torch.equal(poisson_disk(points * scale, radius * scale), few)


@settings(max_examples=25, deadline=None)
@given(size=st.integers(1, 300), count=st.integers(1, 300), seed=st.integers(0, 99), doubles=st.booleans())
def test_as_many_as_asked_for(size, count, seed, doubles):
    points = cloud(size, seed)
    if doubles:
        points = torch.cat((points, points[:1].expand(50, 3)))
    few = poisson_disk_count(points, count)
    assert len(few) == min(count, len(points))
    assert torch.equal(few, few.unique())


def test_a_count_is_spread_far_better_than_at_random():
    points = cloud(5000).double()
    few, even = poisson_disk_count(points, 400), np.sqrt(4 * np.pi / 400)
    spread, random = (torch.cdist(p, p).fill_diagonal_(torch.inf).min() for p in (points[few], points[:400]))
    assert spread > max(0.6 * even, 10 * random)
    assert torch.cdist(points, points[few]).amin(1).max() < 1.3 * even


def test_the_generator_decides():
    points = cloud(500)
    first, again, other, same = (poisson_disk(points, 0.3, g) for g in (None, None, seeded(5), seeded(5)))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(other, same)


def test_each_point_is_the_farthest_from_those_before_also_in_the_even_order():
    points = rand(60, 3)
    chosen = farthest_points(points, 20, start=7)
    assert chosen[0] == 7
    for k in range(1, 20):
        gaps = torch.cdist(points, points[chosen[:k]]).amin(-1)
        assert gaps[chosen[k]] == gaps.max()
    order = even_order(points)
    assert int(order[0]) == int((points - points.mean(0)).norm(dim=-1).argmax())
    assert torch.equal(order, farthest_points(points, 60, int(order[0])))
    assert torch.equal(even_order((points + 1000).float()).sort().values, torch.arange(60))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 30), st.data())
def test_indices_are_all_different_also_among_duplicates(size, data):
    count = data.draw(st.integers(1, size))
    points = rand(size, 3).mul(2).round()
    chosen = farthest_points(points, count)
    assert chosen.dtype == torch.int64
    assert len(chosen.unique()) == count
    assert len(points[chosen].unique(dim=0)) == min(count, len(points.unique(dim=0)))


# Draws in which no crowded place outvotes others


def drawn(points, count, seed=0):
    index = draw_spread(points, count, 2.0, seeded(seed))
    assert len(index.unique()) == count
    assert torch.equal(index, index.sort().values)
    return index


def test_points_that_lie_evenly_are_drawn_as_at_random_and_thin_outliers_stay_thin():
    points = torch.cat([cloud(20_000), 3 * rand(5000, 3, seed=1).float()])
    index = drawn(points, 4000)
    assert float((index >= 20_000).double().mean()) == pytest.approx(0.2, abs=0.02)
    # Each half of the ball as often.
    assert float((points[index][index < 20_000, 2] > 0).double().mean()) == pytest.approx(0.5, abs=0.03)
    assert not torch.equal(index, drawn(points, 4000, seed=1))


@pytest.mark.parametrize("spread", [0.0, 0.03])
def test_a_clump_of_most_points_is_drawn_as_one_place_of_many(spread):
    clump = torch.tensor([0.0, 0.0, 1.0]) + spread * rand(95_000, 3, seed=1).float()
    index = drawn(torch.cat([cloud(5000), clump]), 2000)
    # The clump fills up to eight cubes of the two hundred or more that count.
    assert 0 < float((index >= 5000).double().mean()) < 0.05


@pytest.mark.parametrize("points", [torch.zeros(50, 3), 1e12 * torch.eye(3).repeat(20, 1), torch.full((30, 3), -1e30)])
def test_points_of_few_places_or_far_away_can_be_drawn(points):
    drawn(points, 20)
    drawn(points.double(), len(points))
