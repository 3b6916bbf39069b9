"""The inside of a surface: which points lie in it, how deep, where its middle is, and curves moved there."""

import math

import pytest
import torch

from torchreg.datasets.creatures import CreatureForm, creature_sequence
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.spines.limbs.depth_field import DepthField, move_inside
from torchreg.spines.skeleton.centering import centered_curves
from torchreg.spines.skeleton.clearance import Clearance, Inside


def capsule():
    """Return a tube of radius 0.3 along x from -1 to 1 with round ends."""

    def field(points):
        x = points[:, :1].clamp(-1, 1)
        return (points - torch.cat((x, 0 * x, 0 * x), dim=1)).norm(dim=1) - 0.3

    return isosurface(field, torch.tensor([-1.4, -0.4, -0.4]).double(), torch.tensor([1.4, 0.4, 0.4]).double(), 0.06)


def test_inside_of_a_ball_whatever_the_winding():
    mesh = unit_sphere(4, dtype=torch.float64)
    points = 0.8 * torch.randn(10, 200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sure = (points.norm(dim=-1) - 1).abs() > 0.01
    turned = mesh.faces.clone()
    turned[::2] = turned[::2].flip(1)
    for faces in (mesh.faces, turned):
        found = Inside(TriangleMesh(mesh.vertices, faces))(points)
        assert found.shape == (10, 200)
        assert torch.equal(found[sure], (points.norm(dim=-1) < 1)[sure])


def test_a_small_hole_is_outvoted():
    mesh = unit_sphere(3, dtype=torch.float64)
    hole = mesh.vertices[mesh.faces].mean(1)[:, 2] < 0.97
    assert bool(Inside(TriangleMesh(mesh.vertices, mesh.faces[hole]))(torch.zeros(3)))


def test_nothing_is_inside_nothing():
    assert not Inside(TriangleMesh(torch.zeros(1, 3), torch.zeros(0, 3, dtype=torch.int64)))(torch.zeros(2, 3)).any()


def test_clearance_is_the_distance_to_the_surface():
    clearance = Clearance(unit_sphere(5, dtype=torch.float64))
    points = torch.tensor([[0.5, 0, 0], [0, 0, 0], [0, 0, 2.0]], dtype=torch.float64)
    assert clearance(points).tolist() == pytest.approx([0.5, 1, 1], abs=1e-2)


def test_the_clearance_is_climbed_to_the_axis_within_reach():
    clearance = Clearance(capsule())
    points = torch.tensor([[0.4, 0.2, 0.05], [-0.5, -0.1, 0.2], [1.25, 0.0, 0.0]], dtype=torch.float64)
    middles = clearance.ascend(points, 1.0)
    assert middles[:2, 1:].norm(dim=1).max() < 0.03
    assert clearance(middles).min() > 0.27
    assert bool((clearance(middles) >= clearance(points)).all())
    near = clearance.ascend(points, 0.05)
    assert (near - points).norm(dim=1).max() <= 0.05


def test_points_outside_are_moved_past_the_surface():
    mesh = capsule()
    points = torch.tensor([[0.0, 0.5, 0.0], [1.5, 0, 0]], dtype=torch.float64)
    moved = Clearance(mesh).behind_surface(points, 0.1)
    assert bool(Inside(mesh)(moved).all())
    assert Clearance(mesh)(moved).tolist() == pytest.approx([0.1, 0.1], abs=0.02)


@pytest.fixture(scope="module")
def sphere():
    return DepthField(unit_sphere(4, dtype=torch.float64), 48)


def test_depth_in_a_sphere_is_the_distance_to_it(sphere):
    generator = torch.Generator().manual_seed(0)
    points = 0.75 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    points = points[points.norm(dim=-1) < 1.2]
    true = 1 - points.norm(dim=-1)
    assert float((sphere(points) - true).abs().max()) < 1.2 * sphere.spacing
    assert float((sphere(points) - true).abs().mean()) < 0.4 * sphere.spacing


def test_the_gradient_of_depth_points_to_the_middle(sphere):
    points = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    up = torch.nn.functional.normalize(sphere.gradient(0.7 * points), dim=-1)
    assert float((up * -points).sum(-1).min()) > 0.9
    outside = torch.nn.functional.normalize(sphere.gradient(1.1 * points), dim=-1)
    assert float((outside * -points).sum(-1).min()) > 0.8
    assert sphere.gradient(points).dtype == torch.float32


def test_a_sheet_without_a_voxel_inside_has_depths():
    flat = unit_sphere(3, dtype=torch.float64)
    field = DepthField(TriangleMesh(flat.vertices * torch.tensor([1.0, 1.0, 1e-6]), flat.faces), 48)
    depth, gradient = field.with_gradient(torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.2, 0.3], [0.0, 0.0, 0.5]]).double())
    assert bool(depth.isfinite().all() & gradient.isfinite().all())
    assert depth[0] > depth[1] > depth[2]


def test_the_depth_does_not_depend_on_what_was_asked_before(sphere):
    points = torch.randn(40, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    fresh = DepthField(unit_sphere(4, dtype=torch.float64), 48)
    assert torch.equal(torch.stack([fresh(point) for point in points.flip(0)]).flip(0), sphere(points))


def test_batches_equal_loops(sphere):
    points = torch.randn(2, 3, 5, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    torch.testing.assert_close(sphere(points)[1, 2], sphere(points[1, 2]))


def test_a_curve_moves_into_its_arm_and_its_ends_stay():
    form = CreatureForm(3, 0.3, 0.15, 0.1, sway=0.8, curl=0.5)
    sequence = creature_sequence(form, 1, resolution=48, dtype=torch.float64, seed=1)
    field = DepthField(sequence.meshes[0], 64)
    axis, radii = sequence.curves[0, 0], sequence.radii[0]
    away = torch.zeros_like(axis)
    away[5:-1] = 0.12 * torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0)
    free = torch.ones(len(axis), dtype=torch.bool)
    free[[0, -1]] = False
    moved = move_inside(field, axis + away, radii, free)
    assert torch.equal(moved[[0, -1]], axis[[0, -1]])
    before, after = (torch.cdist(curve[5:-1], axis).amin(-1) for curve in (axis + away, moved))
    assert float(after.max()) < 0.5 * float(before.max())
    assert float(field(moved)[1:-1].min()) > 0.04


def test_points_outside_are_brought_inside(sphere):
    curve = torch.tensor([[1.15, 0.0, 0.0], [0.0, 1.1, 0.0], [0.0, 0.0, -1.05]], dtype=torch.float64)
    moved = move_inside(sphere, curve, torch.zeros(3), torch.ones(3, dtype=torch.bool), stiffness=0.0)
    assert bool((moved.norm(dim=-1) < 1).all())


# Both ends of a curve stay.
HELD = [(False, False)]


def bent_tube(radius=0.25, spacing=0.06):
    """Return half a torus of radius 1 with round ends."""

    def field(points):
        flat = points[:, :2] * torch.tensor([1.0, 1.0], dtype=points.dtype)
        around = torch.stack((flat.norm(dim=1) - 1, points[:, 2]), dim=1).norm(dim=1)
        ends = torch.minimum((points - points.new_tensor([1.0, 0, 0])).norm(dim=1),
                             (points - points.new_tensor([-1.0, 0, 0])).norm(dim=1))  # fmt: skip
        return torch.where(points[:, 1] > 0, around, ends) - radius

    lower, upper = torch.tensor([-1.4, -0.4, -0.4]).double(), torch.tensor([1.4, 1.4, 0.4]).double()
    return isosurface(field, lower, upper, spacing)


def arc(radius, count=60):
    turn = torch.linspace(0.05, math.pi - 0.05, count).double()
    return torch.stack((radius * turn.cos(), radius * turn.sin(), 0.03 + 0 * turn), dim=1)


def off_axis(curve):
    return torch.stack((curve[:, :2].norm(dim=1) - 1, curve[:, 2]), dim=1).norm(dim=1)


def test_a_curve_beside_the_axis_of_a_bend_is_moved_onto_it():
    mesh = bent_tube()
    (moved,) = centered_curves([arc(0.97)], mesh, 0.05, HELD)
    assert off_axis(arc(0.97)).min() > 0.04
    assert off_axis(moved)[5:-5].max() < 0.02
    assert torch.equal(moved[[0, -1]], arc(0.97)[[0, -1]])
    turned = mesh.faces.clone()
    turned[::2] = turned[::2].flip(1)
    (again,) = centered_curves([arc(0.97)], TriangleMesh(mesh.vertices, turned), 0.05, HELD)
    assert torch.allclose(moved, again)


def test_free_ends_go_along():
    (moved,) = centered_curves([arc(0.97)], bent_tube(), 0.05, [(True, False)])
    assert off_axis(moved)[0] < 0.02
    assert torch.equal(moved[-1], arc(0.97)[-1])


def test_every_curve_takes_the_surface_around_it():
    mesh = bent_tube()
    pair = TriangleMesh(
        torch.cat((mesh.vertices, mesh.vertices + torch.tensor([0.0, 0, 0.7]))),
        torch.cat((mesh.faces, mesh.faces + mesh.num_vertices)),
    )
    shift = torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64)
    first, second = centered_curves([arc(0.97), arc(1.03) + shift], pair, 0.05, 2 * HELD)
    assert off_axis(first)[5:-5].max() < 0.02
    assert off_axis(second - shift)[5:-5].max() < 0.02


def test_curves_stay_where_the_surface_does_not_go_around_them():
    mesh = bent_tube()
    half = mesh.vertices[mesh.faces].mean(1)[:, 2] > 0
    (same,) = centered_curves([arc(0.97)], TriangleMesh(mesh.vertices, mesh.faces[half]), 0.05, HELD)
    assert (same - arc(0.97)).norm(dim=1).max() < 0.12
    outside = arc(3.0)
    assert torch.equal(centered_curves([outside], mesh, 0.05, HELD)[0], outside)
