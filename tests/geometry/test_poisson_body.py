"""Bodies around points: volume and place of a ball, thin limbs, gaps that part limbs, what one view shows."""

import math

import pytest
import torch

from experiments.made_up.bodies import person
from tests.geometry.draws import D, randn, seeded, volume
from torchreg.geometry.joined_pieces import join_pieces
from torchreg.geometry.mesh import sample_surface, unit_sphere
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.poisson_body import poisson_body
from torchreg.geometry.voxels import voxelize


def noisy_ball(count):
    return sample_surface(unit_sphere(3, dtype=D), count, seeded())[0] + 0.005 * randn(count, 3)


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


@pytest.mark.parametrize(
    ("spans", "thick", "expected"),
    [(((1, 20), (24, 32)), 1, 1), (((1, 20), (37, 39)), 1, 0), (((1, 19), (21, 39)), 3, 0), ((), 0, 0)],
    ids=["a cut limb", "far away", "another body", "nothing"],
)
def test_a_limb_that_a_gap_cuts_is_joined_and_what_floats_far_away_is_not(spans, thick, expected):
    inside = torch.zeros(40, 12, 12, dtype=torch.bool)
    for (start, end), half in zip(spans, (3, thick), strict=False):
        inside[start:end, 6 - half : 6 + half, 6 - half : 6 + half] = True
    bars, number = join_pieces(inside)
    assert number == expected
    assert bool(bars[20:24, 5:7, 5:7].any(-1).any(-1).all()) == (expected == 1)


def test_two_thin_bodies_near_each_other_stay_apart():
    ball = noisy_ball(1000)
    slender = torch.tensor([1.0, 0.15, 0.15], dtype=torch.float64) * ball
    body = poisson_body(torch.cat((slender, slender + torch.tensor([0.0, 0.45, 0.0]))))
    above = (body.mesh.vertices[:, 1] > 0.225)[body.mesh.faces]
    assert bool((above.all(1) | ~above.any(1)).all())


def test_thin_hands_and_feet_are_not_inside_out():
    body = voxelize(person().mesh, 80).mesh()
    points = sample_surface(body, 4000, seeded())[0].double()
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    points = points + 0.002 * diagonal * randn(4000, 3)
    found = poisson_body(points).mesh
    # Where normals point inwards the surface is a bubble around the limb, far from the points.
    far = NeighborTree(points).nearest(found.vertices)[1] > 0.03 * diagonal
    assert float(far.double().mean()) < 0.003
    assert volume(found) == pytest.approx(volume(body), rel=0.05)
