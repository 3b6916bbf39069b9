"""Wide regions: the larger part of each moves rigidly, what leaves that far is free."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.dense.rigid_regions import WideRegions

F64 = torch.float64
MOTION = se3_exp(torch.tensor([0.2, -0.1, 0.3, 0.4, 0.9, -0.5], dtype=F64))


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def regions_of(points, centers=8, reach=1.5, give=0.05):
    return WideRegions.of(points, torch.cdist(points[:centers], points), reach, give)


@pytest.fixture
def regions():
    return regions_of(draw(60, 3))


def shaken(regions, size=0.03):
    """Return places that no rigid motion leads to."""
    return transform_points(MOTION, regions.points) + size * draw(*regions.points.shape, seed=1)


def followers(regions, seed=2):
    """Return how far samples follow, any from 0 to 1."""
    return torch.rand(len(regions.points), generator=torch.Generator().manual_seed(seed), dtype=F64)


def fitted_one_by_one(points, places, shares, give):
    """Return where the motion of one region takes its points, by SciPy's rotations: iteratively reweighted."""
    points, places, shares = (value.numpy() for value in (points, places, shares))
    trust = np.ones(len(points))
    for _ in range(3):
        weights = shares * trust
        here, there = (np.average(each, axis=0, weights=weights) for each in (points, places))
        turn, _ = Rotation.align_vectors(places - there, points - here, weights=weights)
        aims = turn.apply(points - here) + there
        misses = ((aims - places) ** 2).sum(-1)
        trust = (give**2 / (give**2 + misses)) ** 2
    return torch.from_numpy(aims), torch.from_numpy(trust), torch.from_numpy(misses)


def test_shares_fall_with_the_way_and_sum_to_one_in_the_mean():
    ways = torch.tensor([[0.0, 1.0, 2.0, torch.inf], [2.0, 1.0, 0.5, 0.0]], dtype=F64)
    shares = WideRegions.of(draw(4, 3), ways, 2.0, 0.1).shares
    assert float(shares.sum(0).mean()) == pytest.approx(1)
    torch.testing.assert_close(shares[0] / shares[0, 0], torch.tensor([1.0, 0.5625, 0.0, 0.0], dtype=F64))


def test_what_moves_rigidly_is_not_strained_and_stays(regions):
    places = transform_points(MOTION, regions.points)
    assert regions.strain(places) == pytest.approx(0, abs=1e-12)
    found = regions.matches(places, torch.full_like(places[:, 0], 0.4), 0.3)
    torch.testing.assert_close(found.targets, places)
    torch.testing.assert_close(found.weights, 0.3 * 0.4 * 0.6 * regions.shares.sum(0))


def test_motions_are_those_of_reweighted_fits_one_by_one(regions):
    places, follow = shaken(regions), followers(regions)
    (aims, trust, _), (_, _, misses) = (
        [
            torch.stack(value)
            for value in zip(
                *(fitted_one_by_one(regions.points, places, share, regions.give) for share in shares), strict=True
            )
        ]
        for shares in (regions.shares * (1 - follow), regions.shares)
    )
    shown = (regions.shares * trust * (1 - follow)).sum(1) / regions.shares.sum(1)
    held = regions.shares * trust * torch.outer(shown, follow)
    found = regions.matches(places, follow, 0.3)
    torch.testing.assert_close(found.weights, 0.3 * held.sum(0))
    mean = torch.einsum("jm,jmc->mc", held, aims) / held.sum(0).unsqueeze(1)
    expected = torch.where(held.sum(0).unsqueeze(1) > 0, mean, places)
    torch.testing.assert_close(found.targets, expected)
    expected = float((regions.shares * misses / (misses + regions.give**2)).sum() / len(places))
    assert regions.strain(places) == pytest.approx(expected)


def test_matches_pull_as_the_regions_do(regions):
    """With the motions held, one target per sample has the gradient of a target per sample and region."""
    places, follow = shaken(regions).requires_grad_(), followers(regions)
    found = regions.matches(places.detach(), follow, 0.7)
    motions, trust, _ = regions._fitted(places.detach(), 1 - follow)
    aims = transform_points(motions, regions.points)
    shown = (regions.shares * trust * (1 - follow)).sum(1) / regions.shares.sum(1)
    every = 0.7 * (regions.shares * trust * torch.outer(shown, follow) * (aims - places).square().sum(-1)).sum()
    joint = (found.weights * (found.targets - places).square().sum(-1)).sum()
    torch.testing.assert_close(*(torch.autograd.grad(cost, places)[0] for cost in (every, joint)))


def test_what_follows_goes_where_the_rest_of_its_regions_goes():
    """Wherever the followers were: they have no say in how regions move."""
    regions = regions_of(draw(60, 3), reach=8)
    follow = (torch.arange(len(regions.points)) % 3 == 0).to(F64)
    places = transform_points(MOTION, regions.points)
    astray = places + 0.03 * follow.unsqueeze(1) * draw(*places.shape, seed=3)
    found = regions.matches(astray, follow, 1.0)
    torch.testing.assert_close(found.targets[follow > 0], places[follow > 0])
    assert float(found.weights[follow > 0].min()) > 0
    # What need not follow is not held, and of what all follows nothing is known.
    assert float(found.weights[follow == 0].max()) == 0
    assert float(regions.matches(astray, torch.ones_like(follow), 1.0).weights.max()) == 0


def test_of_a_bent_limb_the_smaller_part_is_free():
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0), dtype=F64) * torch.tensor([1.0, 0.2, 0.2])
    # The middle is all that there is a region about.
    ways = (points - torch.tensor([0.5, 0.1, 0.1])).norm(dim=-1).unsqueeze(0)
    regions = WideRegions.of(points, ways, 1.0, 0.05)
    bent = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 1.2], dtype=F64))
    hinge = torch.tensor([0.75, 0.1, 0.1], dtype=F64)
    beyond = points[:, 0] > hinge[0]
    places = torch.where(beyond.unsqueeze(1), transform_points(bent, points - hinge) + hinge, points)
    found = regions.matches(places, torch.full_like(places[:, 0], 0.5), 1.0)
    # The larger part is held where it is, but for what the smaller one still pulls at it.
    assert float((found.targets - places)[~beyond].norm(dim=-1).max()) < 0.5 * regions.give
    far = (places - points).norm(dim=-1) > 5 * regions.give
    weights = found.weights / regions.shares.sum(0)
    assert float(weights[far].max()) < 2e-3 * float(weights.max())
    held = float(regions.shares[:, far].sum() / len(points))
    assert held < regions.strain(places) < float(regions.shares[:, beyond].sum() / len(points))


@settings(deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=12, max_size=12))
def test_motions_of_the_whole_change_nothing_but_the_frame(values):
    """Turns and shifts of what lies at rest, and of where it went, are taken up by the regions' motions."""
    regions = regions_of(draw(40, 3), 5)
    before, after = se3_exp(torch.tensor(values, dtype=F64).view(2, 6))
    places = shaken(regions)
    other = WideRegions(transform_points(before, regions.points), regions.shares, regions.give)
    assert other.strain(transform_points(after, places)) == pytest.approx(regions.strain(places), rel=1e-6)
    follow = followers(regions)
    one, two = regions.matches(places, follow, 0.2), other.matches(transform_points(after, places), follow, 0.2)
    torch.testing.assert_close(two.targets, transform_points(after, one.targets), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(two.weights, one.weights, rtol=1e-6, atol=1e-9)


def test_units_change_nothing(regions):
    places, follow = shaken(regions), followers(regions)
    larger = WideRegions(100 * regions.points, regions.shares, 100 * regions.give)
    assert larger.strain(100 * places) == pytest.approx(regions.strain(places))
    one, other = regions.matches(places, follow, 1.0), larger.matches(100 * places, follow, 1.0)
    torch.testing.assert_close(other.targets, 100 * one.targets)
    torch.testing.assert_close(other.weights, one.weights)


def test_fewer_and_more_samples_than_the_regions_have(regions):
    places, follow, count = shaken(regions), followers(regions), 25
    fewer = WideRegions(regions.points[:count], regions.shares[:, :count], regions.give)
    some, own = (each.matches(places[:count], follow[:count], 1.0) for each in (regions, fewer))
    assert some.which == own.which == slice(0, count)
    torch.testing.assert_close(some.targets, own.targets)
    assert regions.strain(places[:count]) == pytest.approx(fewer.strain(places[:count]))
    # What is fitted is a mean over all matches of an E-step: of four times as many, each counts four times.
    more = regions.matches(torch.cat([places, draw(3 * len(places), 3)]), follow.repeat(4), 1.0)
    all_of_them = regions.matches(places, follow, 1.0)
    torch.testing.assert_close(more.weights, 4 * all_of_them.weights)
    torch.testing.assert_close(more.targets, all_of_them.targets)


def test_regions_without_samples_hold_nothing():
    points = draw(30, 3)
    ways = torch.full((3, 30), torch.inf, dtype=F64)
    ways[0, :20] = 0.1
    regions = WideRegions.of(points, ways, 0.5, 0.05)
    half = torch.full_like(points[:, 0], 0.5)
    found = regions.matches(points + 1, half, 1.0)
    assert bool((found.weights[20:] == 0).all())
    assert bool(found.targets.isfinite().all())
    nothing = WideRegions.of(points, torch.full_like(ways, torch.inf), 0.5, 0.05)
    assert nothing.strain(points + 1) == 0
    assert float(nothing.matches(points + 1, half, 1.0).weights.max()) == 0
