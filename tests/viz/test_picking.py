"""Rays meet spheres where the quadratic says so, and points where a search over all of them does."""

import math

import pytest
import torch

from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.viz.picking import meet_triangles, pick_vertex

BALL = unit_sphere(4)


def rays(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    origin = 3 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    return origin, 0.8 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.4 - origin


def test_a_ball_is_met_where_the_quadratic_says():
    for origin, direction in zip(*rays(20), strict=True):
        face, share = meet_triangles(BALL.vertices, BALL.faces, origin, direction)
        assert float(share.sum()) == pytest.approx(1.0)
        assert bool((share >= 0).all())
        place = share.double() @ BALL.vertices[BALL.faces[face]].double()
        unit = direction / direction.norm()
        along = -(origin @ unit)
        depth = along - math.sqrt(along**2 - float(origin @ origin) + 1)
        assert float((place - origin - depth * unit).norm()) < 0.03  # the facets of the ball lie this far inside
        off = place - origin
        assert float((off - (off @ unit) * unit).norm()) < 1e-5  # on the ray


def test_moving_all_changes_nothing():
    motion = se3_exp(torch.tensor([3.0, -2, 1, 0.4, 1.1, -0.7], dtype=torch.float64))
    moved = transform_points(motion, BALL.vertices.double())
    for origin, direction in zip(*rays(5, seed=1), strict=True):
        turned = motion[:3, :3] @ direction
        place = transform_points(motion, origin[None])[0]
        one = pick_vertex(BALL.vertices.double(), BALL.faces, origin, direction)
        assert pick_vertex(moved, BALL.faces, place, 7 * turned) == one


def test_what_lies_behind_or_beside_is_not_met():
    origin = torch.tensor([0.0, 0, 3])
    assert meet_triangles(BALL.vertices, BALL.faces, origin, torch.tensor([0.0, 0, 1])) is None
    assert meet_triangles(BALL.vertices, BALL.faces, origin, torch.tensor([1.0, 0, -0.5])) is None
    assert pick_vertex(BALL.vertices, BALL.faces, origin, torch.tensor([0.0, 0, 1])) is None
    inside = meet_triangles(BALL.vertices, BALL.faces, torch.zeros(3), torch.tensor([0.0, 0, 1]))
    assert inside is not None  # also from within
    edge_on = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    flat = torch.tensor([[0, 1, 2]])
    assert meet_triangles(edge_on, flat, torch.tensor([-1.0, 0.2, 0]), torch.tensor([1.0, 0, 0])) is None


def test_points_are_met_near_the_ray_the_first_one_first():
    points = torch.tensor([[0.0, 0, 5], [0.01, 0, 2], [0.5, 0, 1], [0, 0, -1]])
    ray = torch.zeros(3), torch.tensor([0.0, 0, 2])
    assert pick_vertex(points, None, *ray) == 1
    assert pick_vertex(points, torch.zeros(0, 3, dtype=torch.long), *ray, reach=0.001) == 0
    assert pick_vertex(points[2:], None, *ray) is None
