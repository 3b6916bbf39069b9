"""Closest compatible points of a scan: which are taken, why matches are dropped, units."""

import math

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import directions, randn
from torchreg.registration.bones.closest_compatible import CompatibleMatcher


@pytest.fixture(scope="module")
def plane():
    """A square of 21 x 21 points that look up, without its boundary in the middle."""
    side = torch.linspace(-1, 1, 21, dtype=torch.float64)
    points = torch.stack([*torch.meshgrid(side, side, indexing="ij"), torch.zeros(21, 21)], dim=-1).reshape(-1, 3)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(points), 3)
    return tr.RangeScan(points, normals=up)


def matched(plane, height, tilt=0.0, target=None, scale=0.0, size=1.0, max_distance=0.3, max_angle=0.5):
    """The matches of the square lifted and tilted, all in units of a size."""
    normals = torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)], dtype=torch.float64).expand(len(plane), 3)
    points = size * (plane.points + torch.tensor([0.0, 0.0, height]))
    matcher = CompatibleMatcher(plane if target is None else target, size * scale)
    return matcher.match(points, normals, max_distance=size * max_distance, max_angle=max_angle)


def test_points_above_the_middle_match_what_is_below_them(plane):
    found = matched(plane, 0.05, scale=0.1, max_distance=0.1)
    assert torch.equal(found.kept, ~plane.boundary)
    assert torch.equal(found.boundary, plane.boundary)
    assert not (found.far | found.turned).any()
    assert torch.equal(found.targets, plane.points)
    assert torch.equal(found.normals, plane.normals)


def test_far_and_turned_points_match_nobody(plane):
    for height, tilt, reason in ((0.5, 0.0, "far"), (0.05, 0.6, "turned"), (0.05, 0.4, "kept")):
        found = matched(plane, height, tilt)
        for name in ("far", "turned", "kept"):
            assert torch.equal(getattr(found, name), ~plane.boundary & (name == reason))
    for height, kept in ((0.19, True), (0.21, False)):
        # Matches within two sampling distances are never too far.
        assert bool(matched(plane, height, max_distance=1e-3).kept.any()) is kept


@pytest.mark.parametrize("scale", [0.0, 0.5, 3.0])
def test_the_match_has_the_least_mixed_distance(scale):
    points, target = randn(200, 3), tr.RangeScan(randn(200, 3, seed=1), normals=directions(200, 1))
    normals = directions(200, 2)
    mixed = torch.cdist(points, target.points).square() + scale**2 * torch.cdist(normals, target.normals).square()
    found = CompatibleMatcher(target, scale).match(points, normals, max_distance=1.0, max_angle=0.5)
    assert torch.equal(found.targets, target.points[mixed.argmin(-1)])


def test_normals_decide_between_the_sides_of_a_thin_plate(plane):
    both = torch.cat([plane.points, plane.points - torch.tensor([0.0, 0.0, 0.5])])
    plate = tr.RangeScan(both, normals=torch.cat([plane.normals, -plane.normals]))
    for scale, expected in ((0.0, plate.points[len(plane) :]), (1.0, plane.points)):
        found = matched(plane, -0.3, target=plate, scale=scale, max_distance=1.0, max_angle=math.pi)
        assert torch.equal(found.targets, expected)


@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_units_change_nothing(plane, size):
    target = plane.transformed(torch.diag(torch.tensor([size, size, size, 1.0], dtype=torch.float64)))
    plain, found = (matched(plane, 0.07, 0.3, scale=0.1, **more) for more in ({}, {"target": target, "size": size}))
    for name in ("kept", "boundary", "far", "turned"):
        assert torch.equal(getattr(found, name), getattr(plain, name))
    torch.testing.assert_close(found.targets, size * plain.targets)
