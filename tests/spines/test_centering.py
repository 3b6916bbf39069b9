import math

import torch

from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.mesh import TriangleMesh
from torchreg.spines.centering import centered_curves


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
    (moved,) = centered_curves([arc(0.97)], mesh, 0.05)
    assert off_axis(arc(0.97)).min() > 0.04
    assert off_axis(moved)[5:-5].max() < 0.02
    assert torch.equal(moved[[0, -1]], arc(0.97)[[0, -1]])
    turned = mesh.faces.clone()
    turned[::2] = turned[::2].flip(1)
    (again,) = centered_curves([arc(0.97)], TriangleMesh(mesh.vertices, turned), 0.05)
    assert torch.allclose(moved, again)


def test_free_ends_go_along():
    (moved,) = centered_curves([arc(0.97)], bent_tube(), 0.05, [(True, False)])
    assert off_axis(moved)[0] < 0.02
    assert torch.equal(moved[-1], arc(0.97)[-1])


def test_every_curve_takes_the_surface_around_it():
    mesh = bent_tube()
    both = TriangleMesh(
        torch.cat((mesh.vertices, mesh.vertices + torch.tensor([0.0, 0, 0.7]))),
        torch.cat((mesh.faces, mesh.faces + mesh.num_vertices)),
    )
    shift = torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64)
    first, second = centered_curves([arc(0.97), arc(1.03) + shift], both, 0.05)
    assert off_axis(first)[5:-5].max() < 0.02
    assert off_axis(second - shift)[5:-5].max() < 0.02


def test_curves_stay_where_the_surface_does_not_go_around_them():
    mesh = bent_tube()
    half = mesh.vertices[mesh.faces].mean(1)[:, 2] > 0
    (same,) = centered_curves([arc(0.97)], TriangleMesh(mesh.vertices, mesh.faces[half]), 0.05)
    assert (same - arc(0.97)).norm(dim=1).max() < 0.12
    outside = arc(3.0)
    assert torch.equal(centered_curves([outside], mesh, 0.05)[0], outside)
