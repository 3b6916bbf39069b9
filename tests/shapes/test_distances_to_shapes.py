"""Surfaces of a shape: brute force over a ball's skin, the ball itself, and differences through ``retract``."""

import math

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.shapes.kinds import D, at, compare, seeded
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.surface import SkinSurface, dense_file_skin

RADIUS = 0.05
EYE = at()


def sunflower(count):
    """Evenly spread unit vectors."""
    index = torch.arange(count, dtype=D) + 0.5
    height, turn = 1 - 2 * index / count, index * math.pi * (1 + math.sqrt(5))
    across = (1 - height.square()).sqrt()
    return torch.stack([across * turn.cos(), across * turn.sin(), height], dim=-1)


def random_pose(shape, seed=0):
    return 0.3 * seeded(shape.num_dofs, seed=seed)


@pytest.fixture(scope="module")
def two_balls():
    """Two balls, the second on a hinge at the middle of the first."""
    hinge = Joint("hinge", 0, EYE, "revolute", (0.0, 0.0, 1.0))
    tree = KinematicTree((Joint("body", -1, EYE), hinge, Joint("head", 1, at(0.2))))
    balls = [Primitive("ellipsoid", (RADIUS,) * 3, EYE)] * 2
    return tr.ArticulatedShape(tree, ["body", "head"], balls, nu=0.002, dtype=D)


@pytest.fixture(scope="module")
def ball_skin(two_balls):
    """Dense points with normals on both balls, each riding on its own."""
    normals = sunflower(1500)
    points = torch.cat([RADIUS * normals, RADIUS * normals + torch.tensor([0.2, 0.0, 0.0])])
    weights = torch.zeros(3000, 2, dtype=D)
    weights[:1500, 0] = weights[1500:, 1] = 1
    return tr.LinearBlendSkin(two_balls, points, weights, two_balls.rest_pose(), normals=normals.repeat(2, 1))


def around_balls(shape, pose, count=200, reach=0.02):
    generator = torch.Generator().manual_seed(1)
    centers = shape.keypoints(pose).detach()[torch.randint(2, (count,), generator=generator)]
    outward = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator).double(), dim=-1)
    height = reach * (2 * torch.rand(count, 1, generator=generator).double() - 1)
    return centers + (RADIUS + height) * outward


def test_distances_are_those_to_the_balls(two_balls, ball_skin):
    pose = random_pose(two_balls)
    points, centers = around_balls(two_balls, pose), two_balls.keypoints(pose)
    exact = torch.cdist(points, centers).amin(-1) - RADIUS
    torch.testing.assert_close(two_balls.distance(points, pose), exact, rtol=0, atol=1e-9)
    # The skin has points every 4.6 mm of a ball of 50 mm, whose tangent planes lie within 0.1 mm near the surface.
    torch.testing.assert_close(SkinSurface(ball_skin).distance(points, pose), exact, rtol=0, atol=3e-4)


@torch.no_grad()
def test_skin_distance_is_the_literal_one(two_balls, ball_skin):
    """The nearest point's tangent plane; far beside it, the distance to the point itself, with the plane's sign."""
    pose = random_pose(two_balls, 1)
    points = torch.cat([around_balls(two_balls, pose, 60), 0.5 * sunflower(20)])
    posed, normals = ball_skin(pose), ball_skin.posed_normals(pose)
    posed, normals = posed.numpy(), normals.numpy()
    apart = [np.sort(np.linalg.norm(posed - x, axis=-1))[1] for x in posed[::6]]
    expected = []
    for x in points.numpy():
        reaches = np.linalg.norm(posed - x, axis=-1)
        i = reaches.argmin()
        plane = float(normals[i] @ (x - posed[i]))
        beside = abs(plane) < 0.2 * reaches[i] and reaches[i] > 2 * np.median(apart)
        expected.append(math.copysign(reaches[i], plane) if beside else plane)
    found = SkinSurface(ball_skin).distance(points, pose)
    torch.testing.assert_close(found, torch.tensor(expected, dtype=D))


def test_data_between_skin_points_are_near_the_surface():
    """On a plane sampled every centimeter a datum between the points is as far away as the plane, not as the points."""
    grid = 0.01 * torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1)).double()
    tree = KinematicTree((Joint("body", -1, EYE),))
    shape = tr.ArticulatedShape(tree, ["body"], [Primitive("ellipsoid", (0.1,) * 3, EYE)], dtype=D)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=D).expand_as(grid)
    # Vertices that coincide, as at the seams of a texture, do not make the skin look dense.
    skin = tr.LinearBlendSkin(shape, grid.repeat(2, 1), torch.ones(800, 1), shape.rest_pose(), normals=up.repeat(2, 1))
    points = grid[:100] + torch.tensor([0.005, 0.005, 0.0001], dtype=D)
    found = SkinSurface(skin).distance(points, shape.rest_pose())
    torch.testing.assert_close(found, torch.full_like(found, 0.0001))


@torch.no_grad()
def test_jacobian_matches_differences(two_balls, ball_skin):
    pose, surface = random_pose(two_balls, 2), SkinSurface(ball_skin)
    # Straight above skin points, where turning normals change the distance to second order only.
    height = torch.linspace(-0.004, 0.006, len(ball_skin), dtype=D).unsqueeze(-1)
    points = (ball_skin(pose) + height * ball_skin.posed_normals(pose))[::20]
    steps = 1e-6 * torch.eye(two_balls.num_dofs, dtype=D)
    ahead, behind = (two_balls.retract(pose.expand_as(steps), sign * steps) for sign in (1, -1))
    slope = ((surface.distance(points, ahead) - surface.distance(points, behind)) / 2e-6).mT
    compare(surface.distance_jacobian(points, pose), (surface.distance(points, pose), slope), atol=2e-8)


def test_of_copies_of_a_point_the_first_one_counts(two_balls, ball_skin):
    """A copy that rides on another part is a point of its own."""
    order = torch.cat([torch.arange(3000), torch.randperm(3000, generator=torch.Generator().manual_seed(5))])
    points, normals, weights = ball_skin.points[order], ball_skin.normals[order].clone(), ball_skin.weights[order]
    normals[3000:] *= -1
    copied = tr.LinearBlendSkin(two_balls, points, weights, two_balls.rest_pose(), normals=normals)
    pose = random_pose(two_balls, 6)
    data = around_balls(two_balls, pose, 60)
    expected = SkinSurface(ball_skin)
    compare(SkinSurface(copied).distance_jacobian(data, pose), expected.distance_jacobian(data, pose))
    weights = weights.clone()
    weights[3000:] = weights[3000:].flip(-1)
    other = tr.LinearBlendSkin(two_balls, points, weights, two_balls.rest_pose(), normals=normals)
    assert torch.equal(SkinSurface(other).first, torch.arange(6000))


def sphere_rig(rings):
    """Return a ball of triangles around one joint, as arrays and as a shape."""
    theta = torch.linspace(0.0, math.pi, rings + 1, dtype=D)[1:-1]
    turn = 2 * math.pi * torch.arange(2 * rings, dtype=D) / (2 * rings)
    body = torch.stack([
        theta.sin()[:, None] * turn.cos(), theta.sin()[:, None] * turn.sin(), theta.cos()[:, None].expand(-1, 2 * rings)
    ], dim=-1).flatten(0, 1)  # fmt: skip
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=D)
    vertices = RADIUS * torch.cat([body, poles])
    wide, top = 2 * rings, len(body)
    faces = []
    for j in range(wide):
        k = (j + 1) % wide
        faces += [[top, j, k], [top + 1, top - wide + k, top - wide + j]]
        for i in range(0, top - wide, wide):
            faces += [[i + j, i + wide + j, i + wide + k], [i + j, i + wide + k, i + k]]
    weights = torch.ones(len(vertices), 1, dtype=D)
    return tr.ArticulatedShape.from_skinned_mesh(
        vertices, torch.tensor(faces), weights, torch.zeros(1, 3), [-1], axes={"joint_0": []}, dtype=D
    )


@pytest.mark.parametrize("rings", [8, 24, 60])
def test_dense_file_skin_covers_the_mesh(rings):
    shape = sphere_rig(rings)
    skin = dense_file_skin(shape)
    assert len(skin) == 4000
    outward = torch.nn.functional.normalize(skin.points, dim=-1)
    assert float((outward * skin.normals).sum(-1).min()) > math.cos(1.3 * math.pi / rings)
    torch.testing.assert_close(skin(shape.rest_pose()), skin.points)
    surface = SkinSurface(skin)
    points = RADIUS * 1.1 * sunflower(200)
    # Where edges are longest, a mesh of this many rings lies inside the ball by 1 - cos(pi / 2 rings) of its radius.
    sag = 2 * RADIUS * (1 - math.cos(math.pi / (2 * rings)))
    found = surface.distance(points, shape.rest_pose()).detach()
    assert float((found - 0.1 * RADIUS).abs().max()) < 2 * sag + 4e-4
