"""Closest compatible points: every reason to drop a match on its own, counts that add up, units, what is refused."""

import math

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.bones.closest_compatible import CompatibleMatcher


@pytest.fixture(scope="module")
def plane():
    """A square of 21 x 21 points that look up, without its boundary in the middle."""
    side = torch.linspace(-1, 1, 21, dtype=torch.float64)
    points = torch.stack([*torch.meshgrid(side, side, indexing="ij"), torch.zeros(21, 21)], dim=-1).reshape(-1, 3)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(points), 3)
    return RangeScan(points, normals=up)


def lifted(plane, height, tilt=0.0):
    normals = torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)], dtype=torch.float64).expand(len(plane), 3)
    return plane.points + torch.tensor([0.0, 0.0, height]), normals


def test_points_above_the_middle_match_what_is_below_them(plane):
    found = CompatibleMatcher(plane, 0.1).match(*lifted(plane, 0.05), max_distance=0.1, max_angle=0.5)
    assert found.index.tolist() == list(range(len(plane)))
    assert torch.equal(found.kept, ~plane.boundary)
    torch.testing.assert_close(found.distances, torch.full((len(plane),), 0.05, dtype=torch.float64))
    torch.testing.assert_close(found.targets, plane.points)
    torch.testing.assert_close(found.normals, plane.normals)
    assert found.counts.kept == int((~plane.boundary).sum())
    assert found.counts.boundary == int(plane.boundary.sum())
    assert found.counts.far == found.counts.turned == 0


def test_far_and_turned_points_match_nobody_and_are_counted(plane):
    matcher, inner = CompatibleMatcher(plane, 0.0), int((~plane.boundary).sum())
    far = matcher.match(*lifted(plane, 0.2), max_distance=0.1, max_angle=0.5)
    assert (far.counts.far, far.counts.turned, far.counts.kept) == (inner, 0, 0)
    turned = matcher.match(*lifted(plane, 0.05, 0.6), max_distance=0.1, max_angle=0.5)
    assert (turned.counts.far, turned.counts.turned, turned.counts.kept) == (0, inner, 0)
    assert not turned.kept.any()
    assert matcher.match(*lifted(plane, 0.05, 0.4), max_distance=0.1, max_angle=0.5).counts.kept == inner


def test_normals_tell_the_sides_of_a_thin_plate_apart(plane):
    both = torch.cat([plane.points, plane.points - torch.tensor([0.0, 0.0, 0.5])])
    plate = RangeScan(both, normals=torch.cat([plane.normals, -plane.normals]))
    points, normals = lifted(plane, -0.3)
    near = CompatibleMatcher(plate, 0.0).match(points, normals, max_distance=1.0, max_angle=math.pi)
    assert (near.index >= len(plane)).all()
    right = CompatibleMatcher(plate, 1.0).match(points, normals, max_distance=1.0, max_angle=math.pi)
    assert right.index.tolist() == list(range(len(plane)))


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_change_nothing(plane, scale):
    scaled = plane.transformed(torch.diag(torch.tensor([scale, scale, scale, 1.0], dtype=torch.float64)))
    points, normals = lifted(plane, 0.07, 0.3)
    one = CompatibleMatcher(plane, 0.1).match(points, normals, max_distance=0.1, max_angle=0.5)
    other = CompatibleMatcher(scaled, 0.1 * scale).match(
        scale * points, normals, max_distance=0.1 * scale, max_angle=0.5
    )
    assert torch.equal(one.index, other.index)
    assert one.counts == other.counts


def test_bad_numbers_are_refused(plane):
    matcher = CompatibleMatcher(plane, 0.1)
    points, normals = lifted(plane, 0.1)
    with pytest.raises(InputError, match="max_distance"):
        matcher.match(points, normals, max_distance=0.0, max_angle=0.5)
    with pytest.raises(InputError, match="max_angle must be at most pi"):
        matcher.match(points, normals, max_distance=1.0, max_angle=4.0)
    with pytest.raises(InputError, match="normals"):
        matcher.match(points, normals[1:], max_distance=1.0, max_angle=0.5)
    with pytest.raises(InputTypeError, match="points"):
        matcher.match(points.float(), normals, max_distance=1.0, max_angle=0.5)
    with pytest.raises(InputError, match="normal_scale"):
        CompatibleMatcher(plane, -1.0)
