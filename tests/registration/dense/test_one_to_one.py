from itertools import permutations

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.neighbors import sampling_distance
from torchreg.geometry.sampling import farthest_points
from torchreg.registration.dense.one_to_one import (
    count_of_spacing,
    match_one_to_one,
    squared_distances,
)
from torchreg.registration.dense.oriented_samples import OrientedSamples

F64 = torch.float64


def samples(count, seed):
    generator = torch.Generator().manual_seed(seed)
    points, normals, features = (torch.randn(count, 3, generator=generator, dtype=F64) for _ in range(3))
    normals = torch.nn.functional.normalize(normals, dim=-1)
    return OrientedSamples(0.2 * points, normals, features, torch.zeros(count, dtype=torch.bool))


def test_no_matching_is_cheaper():
    source, target = samples(5, 0), samples(5, 1)
    cost = torch.cdist(source.points, target.points).square() + 0.02 * (1 - source.normals @ target.normals.mT)
    cost = (cost + 0.01 * torch.cdist(source.features, target.features).square()).clamp(max=0.3**2)
    found = match_one_to_one(source, target, 0.3, normal_weight=0.02, feature_weight=0.01)
    best = min(sum(float(cost[row, column]) for row, column in enumerate(way)) for way in permutations(range(5)))
    paid = sum(float(cost[row, column]) if column >= 0 else 0.3**2 for row, column in enumerate(found.tolist()))
    assert paid == pytest.approx(best)
    kept = found[found >= 0]
    assert len(kept.unique()) == len(kept)


def test_a_row_that_moved_on_is_matched_in_order():
    # Closest points would send most of them to the wrong one.
    line = torch.zeros(10, 3, dtype=F64)
    line[:, 0] = torch.arange(10) * 0.1
    same = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(10, 3)
    still = OrientedSamples(line, same, torch.zeros(10, 1, dtype=F64), torch.zeros(10, dtype=torch.bool))
    moved = still.moved(line + torch.tensor([0.17, 0.05, 0.0], dtype=F64), same)
    assert match_one_to_one(moved, still, 1.0).tolist() != torch.cdist(moved.points, line).argmin(1).tolist()
    assert sorted(match_one_to_one(moved, still, 1.0).tolist()) == list(range(10))


def test_units_and_motion_change_nothing():
    source, target = samples(30, 0), samples(40, 1)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=F64))[0]
    plain = match_one_to_one(source, target, 0.3)
    turned = [each.moved(each.points @ turn.mT + 2, each.normals @ turn.mT) for each in (source, target)]
    assert torch.equal(match_one_to_one(*turned, 0.3), plain)
    larger = [each.moved(10 * each.points, each.normals) for each in (source, target)]
    scaled = match_one_to_one(*larger, 3.0, normal_weight=1.0, feature_weight=2.0)
    assert torch.equal(scaled, plain)


def test_nothing_within_reach_is_no_match():
    source = samples(4, 0)
    far = source.moved(source.points + 10, source.normals)
    assert match_one_to_one(source, far, 0.5).tolist() == [-1] * 4
    with pytest.raises(InputError, match="reach must be positive"):
        match_one_to_one(source, far, 0.0)


def test_squared_distances_are_those_of_a_loop():
    one, other = samples(5, 0).points, samples(3, 1).points
    torch.testing.assert_close(squared_distances(one, other), torch.cdist(one, other).square())
    assert float(squared_distances(one, one).min()) == 0


def test_spacing_decides_how_many():
    points = torch.rand(600, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    points = points[farthest_points(points, 600)]
    spacing = sampling_distance(points[:200])
    assert 170 <= count_of_spacing(points, spacing) <= 230
    assert count_of_spacing(points, 1e9) <= 60
    assert count_of_spacing(points, 1e-9) == 600
    assert count_of_spacing(points[:20], spacing) == 20
