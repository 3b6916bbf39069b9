"""The inside of a surface: which points lie in it, how deep, where its middle is, and curves moved there."""

import pytest
import torch

import torchreg as tr
from tests.spines.bodies import circle, line, random, tube, with_mixed_winding
from torchreg.geometry.mesh import concatenate, unit_sphere
from torchreg.spines.limbs.depth_field import DepthField, move_inside
from torchreg.spines.skeleton.centering import centered_curves
from torchreg.spines.skeleton.clearance import Clearance, Inside

CAPSULE = tube(line([-1.0, 0, 0], [1.0, 0, 0]), 0.3, 0.06)
BEND = tube(circle(count=60, turn=(0, 0.5)), 0.25, 0.06)
BALL = unit_sphere(4, dtype=torch.float64)
HELD = [(False, False)]  # both ends of a curve stay


def test_inside_of_a_ball_whatever_the_winding_and_small_holes():
    points = 0.8 * random(10, 200, 3)
    sure = (points.norm(dim=-1) - 1).abs() > 0.01
    for mesh in (BALL, with_mixed_winding(BALL)):
        assert torch.equal(Inside(mesh)(points)[sure], (points.norm(dim=-1) < 1)[sure])
    closed = BALL.vertices[BALL.faces].mean(1)[:, 2] < 0.97
    assert bool(Inside(tr.TriangleMesh(BALL.vertices, BALL.faces[closed]))(torch.zeros(3)))
    assert not Inside(tr.TriangleMesh(torch.zeros(1, 3), torch.zeros(0, 3).long()))(torch.zeros(2, 3)).any()


def test_clearance_is_the_distance_to_the_surface_and_is_climbed_to_the_axis_within_reach():
    points = torch.tensor([[0.5, 0, 0], [0, 0, 0], [0, 0, 2.0]], dtype=torch.float64)
    assert Clearance(unit_sphere(5, dtype=torch.float64))(points).tolist() == pytest.approx([0.5, 1, 1], abs=1e-2)
    clearance = Clearance(CAPSULE)
    points = torch.tensor([[0.4, 0.2, 0.05], [-0.5, -0.1, 0.2], [1.25, 0.0, 0.0]], dtype=torch.float64)
    middles = clearance.ascend(points, 1.0)
    assert middles[:2, 1:].norm(dim=1).max() < 0.03
    assert clearance(middles).min() > 0.27
    assert bool((clearance(middles) >= clearance(points)).all())
    assert (clearance.ascend(points, 0.05) - points).norm(dim=1).max() <= 0.05
    # Points outside are moved past the surface.
    within = clearance.behind_surface(torch.tensor([[0.0, 0.5, 0.0], [1.5, 0, 0]]).double(), 0.1)
    assert bool(Inside(CAPSULE)(within).all())
    assert clearance(within).tolist() == pytest.approx([0.1, 0.1], abs=0.02)


@pytest.fixture(scope="module")
def sphere():
    return DepthField(BALL, 48)


def test_depth_in_a_sphere_is_the_distance_to_it_and_grows_towards_the_middle(sphere):
    points = 0.75 * random(300, 3)
    points = points[points.norm(dim=-1) < 1.2]
    error = (sphere(points) - (1 - points.norm(dim=-1))).abs()
    assert float(error.max()) < 1.2 * sphere.spacing
    assert float(error.mean()) < 0.4 * sphere.spacing
    # Whatever was asked before.
    fresh = DepthField(BALL, 48)
    assert torch.equal(torch.stack([fresh(point) for point in points.flip(0)]).flip(0), sphere(points))
    points = torch.nn.functional.normalize(random(50, 3, seed=1).float(), dim=-1)
    for share, cosine in ((0.7, 0.9), (1.1, 0.8)):
        up = torch.nn.functional.normalize(sphere.gradient(share * points), dim=-1)
        assert float((up * -points).sum(-1).min()) > cosine
        assert up.dtype == torch.float32


def test_a_sheet_without_a_voxel_inside_has_depths():
    field = DepthField(tr.TriangleMesh(BALL.vertices * torch.tensor([1.0, 1.0, 1e-6]), BALL.faces), 48)
    depth, gradient = field.with_gradient(torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.2, 0.3], [0.0, 0.0, 0.5]]).double())
    assert bool(depth.isfinite().all() & gradient.isfinite().all())
    assert depth[0] > depth[1] > depth[2]


def test_a_curve_moves_into_its_arm_and_its_ends_stay(sphere):
    axis = circle(count=48, turn=(0, 0.5))
    away = torch.zeros_like(axis)
    away[5:-1] = 0.12 * torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8]).double(), dim=0)
    free, field = torch.ones(48, dtype=torch.bool), DepthField(BEND, 64)
    free[[0, -1]] = False
    moved = move_inside(field, axis + away, torch.full((48,), 0.25).double(), free)
    assert torch.equal(moved[[0, -1]], axis[[0, -1]])
    before, after = (torch.cdist(curve[5:-1], axis).amin(-1) for curve in (axis + away, moved))
    assert float(after.max()) < 0.5 * float(before.max())
    outside = torch.tensor([[1.15, 0.0, 0.0], [0.0, 1.1, 0.0], [0.0, 0.0, -1.05]], dtype=torch.float64)
    inside = move_inside(sphere, outside, torch.zeros(3), torch.ones(3, dtype=torch.bool), stiffness=0.0)
    assert bool((inside.norm(dim=-1) < 1).all())


def arc(radius):
    return circle(radius, 60, (0.008, 0.492), z=0.03)


def off_axis(curve):
    return torch.stack((curve[:, :2].norm(dim=1) - 1, curve[:, 2]), dim=1).norm(dim=1)


@pytest.mark.parametrize("ends", [HELD, [(True, False)]])
def test_a_curve_near_the_axis_of_a_bend_is_moved_onto_it(ends):
    (moved,), (again,) = (centered_curves([arc(0.97)], row, 0.05, ends) for row in (BEND, with_mixed_winding(BEND)))
    assert off_axis(arc(0.97)).min() > 0.04
    assert off_axis(moved)[5:-5].max() < 0.02
    assert torch.equal(moved[-1], arc(0.97)[-1])
    assert (off_axis(moved)[0] < 0.02) == ends[0][0]
    assert torch.allclose(moved, again)


def test_every_curve_takes_the_surface_around_it_and_stays_where_none_goes_around():
    shift = torch.tensor([0.0, 0, 0.7], dtype=torch.float64)
    pair = concatenate([BEND, tr.TriangleMesh(BEND.vertices + shift, BEND.faces)])
    first, second = centered_curves([arc(0.97), arc(1.03) + shift], pair, 0.05, 2 * HELD)
    assert off_axis(first)[5:-5].max() < 0.02
    assert off_axis(second - shift)[5:-5].max() < 0.02
    half = BEND.vertices[BEND.faces].mean(1)[:, 2] > 0
    (same,) = centered_curves([arc(0.97)], tr.TriangleMesh(BEND.vertices, BEND.faces[half]), 0.05, HELD)
    assert (same - arc(0.97)).norm(dim=1).max() < 0.12
    assert torch.equal(centered_curves([arc(3.0)], BEND, 0.05, HELD)[0], arc(3.0))
