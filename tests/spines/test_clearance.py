import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.spines.clearance import Clearance, Inside


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
    with pytest.raises(InputError, match="points must be finite"):
        Inside(unit_sphere(0))(torch.full((1, 3), torch.nan))
    with pytest.raises(InputError, match="points must have shape"):
        Inside(unit_sphere(0))(torch.zeros(2))


def test_clearance_is_the_distance_to_the_surface():
    clearance = Clearance(unit_sphere(5, dtype=torch.float64))
    points = torch.tensor([[0.5, 0, 0], [0, 0, 0], [0, 0, 2.0]], dtype=torch.float64)
    assert clearance(points).tolist() == pytest.approx([0.5, 1, 1], abs=1e-2)


def test_middles_are_on_the_axis_and_not_out_of_reach():
    clearance = Clearance(capsule())
    points = torch.tensor([[0.4, 0.2, 0.05], [-0.5, -0.1, 0.2], [1.25, 0.0, 0.0]], dtype=torch.float64)
    middles = clearance.middles(points, 1.0)
    assert middles[:2, 1:].norm(dim=1).max() < 0.03
    assert clearance(middles).min() > 0.27
    assert bool((clearance(middles) >= clearance(points)).all())
    near = clearance.middles(points, 0.05)
    assert (near - points).norm(dim=1).max() <= 0.05


def test_points_outside_are_moved_past_the_surface():
    mesh = capsule()
    points = torch.tensor([[0.0, 0.5, 0.0], [1.5, 0, 0]], dtype=torch.float64)
    moved = Clearance(mesh).beyond(points, 0.1)
    assert bool(Inside(mesh)(moved).all())
    assert Clearance(mesh)(moved).tolist() == pytest.approx([0.1, 0.1], abs=0.02)
