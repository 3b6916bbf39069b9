"""Closest compatible points of a scan: which are taken, why matches are dropped, units."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.registration.bones.closest_compatible import CompatibleMatcher


@pytest.fixture(scope="module")
def plane():
    """A square of 21 x 21 points that look up, without its boundary in the middle."""
    side = torch.linspace(-1, 1, 21, dtype=torch.float64)
    points = torch.stack([*torch.meshgrid(side, side, indexing="ij"), torch.zeros(21, 21)], dim=-1).reshape(-1, 3)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(points), 3)
    return tr.RangeScan(points, normals=up)


def lifted(plane, height, tilt=0.0):
    normals = torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)], dtype=torch.float64).expand(len(plane), 3)
    return plane.points + torch.tensor([0.0, 0.0, height]), normals


def test_points_above_the_middle_match_what_is_below_them(plane):
    found = CompatibleMatcher(plane, 0.1).match(*lifted(plane, 0.05), max_distance=0.1, max_angle=0.5)
    assert torch.equal(found.kept, ~plane.boundary)
    assert torch.equal(found.boundary, plane.boundary)
    assert not (found.far | found.turned).any()
    assert torch.equal(found.targets, plane.points)
    assert torch.equal(found.normals, plane.normals)


def test_far_and_turned_points_match_nobody(plane):
    matcher, inner = CompatibleMatcher(plane, 0.0), ~plane.boundary
    far = matcher.match(*lifted(plane, 0.5), max_distance=0.3, max_angle=0.5)
    assert torch.equal(far.far, inner)
    assert not (far.turned | far.kept).any()
    turned = matcher.match(*lifted(plane, 0.05, 0.6), max_distance=0.3, max_angle=0.5)
    assert torch.equal(turned.turned, inner)
    assert not (turned.far | turned.kept).any()
    assert torch.equal(matcher.match(*lifted(plane, 0.05, 0.4), max_distance=0.3, max_angle=0.5).kept, inner)
    for height, kept in ((0.19, True), (0.21, False)):
        # Matches within two sampling distances are never too far.
        found = matcher.match(*lifted(plane, height), max_distance=1e-3, max_angle=0.5)
        assert bool(found.kept.any()) is kept


@pytest.mark.parametrize("scale", [0.0, 0.5, 3.0])
def test_the_match_has_the_least_mixed_distance(scale):
    generator = torch.Generator().manual_seed(0)
    points, others = torch.randn(2, 200, 3, generator=generator, dtype=torch.float64)
    normals, sides = torch.nn.functional.normalize(torch.randn(2, 200, 3, generator=generator).double(), dim=-1)
    target = tr.RangeScan(others, normals=sides)
    mixed = torch.cdist(points, others).square() + scale**2 * torch.cdist(normals, target.normals).square()
    found = CompatibleMatcher(target, scale).match(points, normals, max_distance=1.0, max_angle=0.5)
    assert torch.equal(found.targets, target.points[mixed.argmin(-1)])


def test_normals_tell_the_sides_of_a_thin_plate_apart(plane):
    both = torch.cat([plane.points, plane.points - torch.tensor([0.0, 0.0, 0.5])])
    plate = tr.RangeScan(both, normals=torch.cat([plane.normals, -plane.normals]))
    points, normals = lifted(plane, -0.3)
    near = CompatibleMatcher(plate, 0.0).match(points, normals, max_distance=1.0, max_angle=math.pi)
    assert torch.equal(near.targets, plate.points[len(plane) :])
    right = CompatibleMatcher(plate, 1.0).match(points, normals, max_distance=1.0, max_angle=math.pi)
    assert torch.equal(right.targets, plane.points)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_change_nothing(plane, scale):
    scaled = plane.transformed(torch.diag(torch.tensor([scale, scale, scale, 1.0], dtype=torch.float64)))
    points, normals = lifted(plane, 0.07, 0.3)
    match = CompatibleMatcher(plane, 0.1).match(points, normals, max_distance=0.25, max_angle=0.5)
    in_other_unit = CompatibleMatcher(scaled, 0.1 * scale).match(
        scale * points, normals, max_distance=0.25 * scale, max_angle=0.5
    )
    for name in ("kept", "boundary", "far", "turned"):
        assert torch.equal(getattr(match, name), getattr(in_other_unit, name))
    torch.testing.assert_close(in_other_unit.targets, scale * match.targets)
