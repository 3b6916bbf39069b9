"""Bodies around points: volume and place of a ball, thin limbs, gaps that part limbs, what one view shows."""

import math

import pytest
import torch

from experiments.made_up.bodies import person
from torchreg.geometry.joined_pieces import join_pieces
from torchreg.geometry.mesh import sample_surface, unit_sphere
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.poisson_body import poisson_body
from torchreg.geometry.voxels import voxelize


def noisy_ball(count):
    generator = torch.Generator().manual_seed(0)
    points = sample_surface(unit_sphere(3, dtype=torch.float64), count, generator)[0]
    return points + 0.005 * torch.randn(points.shape, generator=generator, dtype=points.dtype)


def volume(mesh):
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_points_of_a_ball_make_a_ball_that_faces_outwards():
    body = poisson_body(noisy_ball(1000))
    distance = body.mesh.vertices.norm(dim=-1)
    assert float(distance.mean()) == pytest.approx(1, abs=0.02)
    assert float((distance - distance.mean()).abs().max()) < 0.06
    assert volume(body.mesh) == pytest.approx(4 / 3 * math.pi, rel=0.06)
    assert body.shown > 0.95
    assert body.joined == 0


def test_a_hole_is_closed_and_a_cap_shows_no_far_side():
    points = noisy_ball(1000)
    body = poisson_body(points[points[:, 2] < 0.8])
    assert volume(body.mesh) == pytest.approx(4 / 3 * math.pi, rel=0.1)
    assert poisson_body(points[points[:, 2] < -0.3]).shown < 0.3


def test_a_limb_that_a_gap_cuts_is_joined_and_what_floats_far_away_is_not():
    inside = torch.zeros(40, 12, 12, dtype=torch.bool)
    inside[1:20, 3:9, 3:9] = inside[24:32, 5:7, 5:7] = True
    bars, number = join_pieces(inside)
    assert number == 1
    assert bool(bars[20:24, 5:7, 5:7].any(-1).any(-1).all())
    far = torch.zeros_like(inside)
    far[1:20, 3:9, 3:9] = far[37:39, 5:7, 5:7] = True
    assert join_pieces(far)[1] == 0
    another = torch.zeros_like(inside)
    another[1:19, 3:9, 3:9] = another[21:39, 3:9, 3:9] = True
    assert join_pieces(another)[1] == 0
    assert join_pieces(torch.zeros_like(inside))[1] == 0


def test_two_thin_bodies_near_each_other_stay_apart():
    ball = noisy_ball(1000)
    slender = torch.tensor([1.0, 0.15, 0.15], dtype=torch.float64) * ball
    body = poisson_body(torch.cat((slender, slender + torch.tensor([0.0, 0.45, 0.0]))))
    above = (body.mesh.vertices[:, 1] > 0.225)[body.mesh.faces]
    assert bool((above.all(1) | ~above.any(1)).all())


def test_thin_hands_and_feet_are_not_inside_out():
    body = voxelize(person().mesh, 80).mesh()
    generator = torch.Generator().manual_seed(0)
    points = sample_surface(body, 4000, generator)[0].double()
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    points = points + 0.002 * diagonal * torch.randn(points.shape, generator=generator, dtype=points.dtype)
    found = poisson_body(points).mesh
    # Where normals point inwards the surface is a bubble around the limb, far from the points.
    far = NeighborTree(points).nearest(found.vertices)[1] > 0.03 * diagonal
    assert float(far.double().mean()) < 0.003
    assert volume(found) == pytest.approx(float(volume(body)), rel=0.05)
