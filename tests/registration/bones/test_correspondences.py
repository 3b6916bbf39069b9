"""Residuals of matched scans against a loop, and closest compatible points: why matches are dropped, units."""

import math

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.closest_compatible import CompatibleMatcher
from torchreg.registration.bones.correspondences import Correspondences, ScanDistance


def matches(*batch, count=12, seed=0):
    generator = torch.Generator().manual_seed(seed)
    moved, targets, normals = torch.randn(3, *batch, count, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(*batch, count, generator=generator, dtype=torch.float64)
    weights = weights * (weights > 0.3)
    return moved, targets, torch.nn.functional.normalize(normals, dim=-1), weights


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_mean_is_that_of_its_definition(share):
    moved, targets, normals, weights = matches()
    total = 0.0
    for x, y, n, b in zip(moved, targets, normals, weights, strict=True):
        total += float(b) * ((1 - share) * float(n @ (x - y)) ** 2 + share * float((x - y) @ (x - y)))
    expected = total / float(weights.sum())
    assert float(ScanDistance(share)(moved, targets, normals, weights)) == pytest.approx(expected)
    plain = ScanDistance(share)(moved, targets, normals)
    assert float(plain) == pytest.approx(float(ScanDistance(share)(moved, targets, normals, torch.ones(12).double())))


def test_dropped_matches_are_never_looked_at():
    moved, targets, normals, weights = matches()
    expected = ScanDistance(0.2)(moved, targets, normals, weights)
    targets[weights == 0] = math.inf
    moved.requires_grad_()
    loss = ScanDistance(0.2)(moved, targets, normals, weights)
    assert float(loss.detach()) == pytest.approx(float(expected))
    loss.backward()
    assert bool((moved.grad[weights == 0] == 0).all())
    assert float(ScanDistance()(moved.detach(), targets, normals, torch.zeros(12).double())) == 0


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_gradients(share):
    *rest, weights = matches(2, count=3)
    inputs = tuple(value.requires_grad_() for value in (*rest, weights + 0.1))
    assert torch.autograd.gradcheck(ScanDistance(share), inputs)


def test_motions_orders_and_units():
    moved, targets, normals, weights = matches()
    loss = ScanDistance(0.1)
    expected = float(loss(moved, targets, normals, weights))
    motion = se3_exp(torch.tensor([1.0, -2, 0.3, 0.5, 1, 2], dtype=torch.float64))
    turned = normals @ motion[:3, :3].mT
    both = transform_points(motion, moved), transform_points(motion, targets)
    assert float(loss(*both, turned, weights)) == pytest.approx(expected)
    assert float(loss(10 * moved, 10 * targets, normals, weights)) == pytest.approx(100 * expected)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    assert float(loss(moved[order], targets[order], normals[order], weights[order])) == pytest.approx(expected)


def test_batches_equal_loops():
    moved, targets, normals, weights = matches(2, 3)
    found = ScanDistance(0.4)(moved, targets, normals, weights)
    assert found.shape == (2, 3)
    one = ScanDistance(0.4)(moved[1, 2], targets[1, 2], normals[1, 2], weights[1, 2])
    torch.testing.assert_close(found[1, 2], one)
    shared = ScanDistance(0.4)(moved, targets[0, 0], normals[0, 0])
    torch.testing.assert_close(shared[1, 1], ScanDistance(0.4)(moved[1, 1], targets[0, 0], normals[0, 0]))


def test_bad_input_is_named():
    moved, targets, normals, weights = matches()
    for share in (-0.1, 1.5):
        with pytest.raises(InputError, match="point_to_point must be"):
            ScanDistance(share)
    with pytest.raises(InputError, match="normals are needed"):
        ScanDistance()(moved, targets)
    with pytest.raises(InputError, match="targets must have shape"):
        ScanDistance()(moved, targets[1:], normals)
    with pytest.raises(InputError, match="match_weights must have shape"):
        ScanDistance()(moved, targets, normals, weights[1:])
    with pytest.raises(InputTypeError, match=r"moved is torch.float64 .* targets is torch.float32"):
        ScanDistance()(moved, targets.float(), normals)
    assert float(ScanDistance(1.0)(moved, moved)) == 0
    assert repr(ScanDistance(0.25)) == "ScanDistance(point_to_point=0.25)"


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
    assert torch.equal(found.kept, ~plane.boundary)
    assert torch.equal(found.boundary, plane.boundary)
    assert not (found.far | found.turned).any()
    assert torch.equal(found.targets, plane.points)
    assert torch.equal(found.normals, plane.normals)


def test_far_and_turned_points_match_nobody_and_it_is_told_why(plane):
    matcher, inner = CompatibleMatcher(plane, 0.0), ~plane.boundary
    far = matcher.match(*lifted(plane, 0.5), max_distance=0.3, max_angle=0.5)
    assert torch.equal(far.far, inner)
    assert not (far.turned | far.kept).any()
    turned = matcher.match(*lifted(plane, 0.05, 0.6), max_distance=0.3, max_angle=0.5)
    assert torch.equal(turned.turned, inner)
    assert not (turned.far | turned.kept).any()
    assert torch.equal(matcher.match(*lifted(plane, 0.05, 0.4), max_distance=0.3, max_angle=0.5).kept, inner)


def test_matches_within_two_sampling_distances_are_never_too_far(plane):
    for height, kept in ((0.19, True), (0.21, False)):
        found = CompatibleMatcher(plane, 0.0).match(*lifted(plane, height), max_distance=1e-3, max_angle=0.5)
        assert bool(found.kept.any()) is kept


@pytest.mark.parametrize("scale", [0.0, 0.5, 3.0])
def test_the_match_has_the_least_mixed_distance(scale):
    generator = torch.Generator().manual_seed(0)
    points, others = torch.randn(2, 200, 3, generator=generator, dtype=torch.float64)
    normals, sides = torch.nn.functional.normalize(torch.randn(2, 200, 3, generator=generator).double(), dim=-1)
    target = RangeScan(others, normals=sides)
    mixed = torch.cdist(points, others).square() + scale**2 * torch.cdist(normals, target.normals).square()
    found = CompatibleMatcher(target, scale).match(points, normals, max_distance=1.0, max_angle=0.5)
    assert torch.equal(found.targets, target.points[mixed.argmin(-1)])


def test_normals_tell_the_sides_of_a_thin_plate_apart(plane):
    both = torch.cat([plane.points, plane.points - torch.tensor([0.0, 0.0, 0.5])])
    plate = RangeScan(both, normals=torch.cat([plane.normals, -plane.normals]))
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


def test_residuals_of_several_motions_are_those_of_each_frame():
    moved, targets, normals, weights = matches(2, 1)
    pairs = Correspondences(targets[:, 0], normals[:, 0], weights[:, 0], 0.2)
    positions = torch.cat([moved, moved + 1.0], dim=1)
    found = pairs.squared_residuals(positions)
    assert found.shape == (2, 2, 12)
    offsets = positions - targets
    expected = 0.8 * (offsets * normals).sum(-1).square() + 0.2 * offsets.square().sum(-1)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(pairs.squared_residuals(moved[:, 0]), expected[:, 0])


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_rows_give_the_squared_residuals(share):
    moved, targets, normals, weights = matches()
    pairs = Correspondences(targets, normals, weights, share)
    residuals = pairs.residual_rows() @ (moved - targets).unsqueeze(-1)
    squares = Correspondences(targets[None], normals[None], weights[None], share).squared_residuals(moved[None])[0]
    torch.testing.assert_close(residuals.square().sum((-1, -2)), squares)


def test_distances_to_points_alone_take_no_normals():
    moved, targets, normals, weights = matches()
    with_normals, without = (ScanDistance(1.0)(moved, targets, given, weights) for given in (normals, None))
    torch.testing.assert_close(with_normals, without)
    with pytest.raises(InputError, match="normals are needed for point to plane"):
        ScanDistance(1.0 - 1e-9)(moved, targets, None, weights)


def test_compatible_points_take_finite_normals_only():
    points = torch.randn(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with pytest.raises(InputError, match="normals"):
        RangeScan(points, normals=torch.full((40, 3), math.nan, dtype=torch.float64))
