"""Surfaces of a shape: brute force over a ball's skin, the ball itself, and differences through ``retract``."""

import math

import numpy as np
import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import FusedSurface, SkinSurface, dense_file_skin

RADIUS = 0.05
EYE = torch.eye(4, dtype=torch.float64)


def sunflower(count):
    """Evenly spread unit vectors."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * index / count, index * math.pi * (1 + math.sqrt(5))
    across = (1 - height.square()).sqrt()
    return torch.stack([across * turn.cos(), across * turn.sin(), height], dim=-1)


def random_pose(shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape.num_dofs, dtype=torch.float64, generator=generator) * 0.3


@pytest.fixture(scope="module")
def two_balls():
    """Two balls, the second on a hinge at the middle of the first."""
    offset = rigid_matrix(torch.eye(3, dtype=torch.float64), torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64))
    tree = KinematicTree(
        (Joint("body", -1, EYE), Joint("hinge", 0, EYE, "revolute", (0.0, 0.0, 1.0)), Joint("head", 1, offset))
    )
    balls = [Primitive("ellipsoid", (RADIUS,) * 3, EYE)] * 2
    return ArticulatedShape(tree, ["body", "head"], balls, nu=0.002, dtype=torch.float64)


@pytest.fixture(scope="module")
def ball_skin(two_balls):
    """Dense points with normals on both balls, each riding on its own."""
    normals = sunflower(1500)
    points = torch.cat([RADIUS * normals, RADIUS * normals + torch.tensor([0.2, 0.0, 0.0])])
    weights = torch.zeros(3000, 2, dtype=torch.float64)
    weights[:1500, 0] = weights[1500:, 1] = 1
    return LinearBlendSkin(two_balls, points, weights, two_balls.rest_pose(), normals=normals.repeat(2, 1))


def around_balls(shape, pose, count=200, reach=0.02):
    generator = torch.Generator().manual_seed(1)
    centers = shape.keypoints(pose).detach()[torch.randint(2, (count,), generator=generator)]
    outward = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator).double(), dim=-1)
    height = reach * (2 * torch.rand(count, 1, generator=generator).double() - 1)
    return centers + (RADIUS + height) * outward


def distance_to_balls(shape, points, pose):
    """Return the exact distance to the nearer of two balls of which the second circles the first."""
    first = pose[:3]
    arm = torch.stack([pose[6].cos(), pose[6].sin(), torch.zeros(())]) * 0.2
    second = first + so3_exp(pose[3:6]) @ arm
    return torch.minimum((points - first).norm(dim=-1), (points - second).norm(dim=-1)) - RADIUS


def differences(surface, points, shape, pose, step=1e-6):
    """Return the derivative of the distances by tangent steps, from central differences."""
    steps = step * torch.eye(shape.num_dofs, dtype=torch.float64)
    ahead = surface.distance(points, shape.retract(pose.expand_as(steps), steps))
    behind = surface.distance(points, shape.retract(pose.expand_as(steps), -steps))
    return ((ahead - behind) / (2 * step)).mT


@pytest.mark.parametrize("kind", ["fused", "skin"])
def test_distances_are_those_to_the_balls(two_balls, ball_skin, kind):
    surface = FusedSurface(two_balls) if kind == "fused" else SkinSurface(ball_skin)
    pose = random_pose(two_balls)
    points = around_balls(two_balls, pose)
    # The skin has points every 4.6 mm of a ball of 50 mm, whose tangent planes lie within 0.1 mm near the surface.
    exact = distance_to_balls(two_balls, points, pose)
    torch.testing.assert_close(surface.distance(points, pose), exact, rtol=0, atol=1e-9 if kind == "fused" else 3e-4)


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
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


def test_data_between_skin_points_are_near_the_surface():
    """On a plane sampled every centimeter a datum between the points is as far away as the plane, not as the points."""
    grid = 0.01 * torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1)).double()
    tree = KinematicTree((Joint("body", -1, EYE),))
    shape = ArticulatedShape(tree, ["body"], [Primitive("ellipsoid", (0.1,) * 3, EYE)], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(grid)
    # Vertices that coincide, as at the seams of a texture, do not make the skin look dense.
    skin = LinearBlendSkin(shape, grid.repeat(2, 1), torch.ones(800, 1), shape.rest_pose(), normals=up.repeat(2, 1))
    points = grid[:100] + torch.tensor([0.005, 0.005, 0.0001], dtype=torch.float64)
    found = SkinSurface(skin).distance(points, shape.rest_pose())
    torch.testing.assert_close(found, torch.full_like(found, 0.0001))


def test_beside_an_open_skin_the_distance_is_to_its_rim(two_balls):
    """A single patch of skin: far beside it the plane would be near, but the patch is not."""
    weights = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    skin = LinearBlendSkin(two_balls, torch.zeros(1, 3), weights, two_balls.rest_pose(), normals=up)
    points = torch.tensor([[0.3, 0.0, 0.01], [0.3, 0.4, -0.01], [0.01, 0.0, 0.3]], dtype=torch.float64)
    found = SkinSurface(skin).distance(points, two_balls.rest_pose())
    expected = torch.tensor([math.hypot(0.3, 0.01), -math.hypot(0.5, 0.01), 0.3], dtype=torch.float64)
    torch.testing.assert_close(found, expected)


@torch.no_grad()
@pytest.mark.parametrize("kind", ["fused", "skin"])
def test_jacobian_matches_differences(two_balls, ball_skin, kind):
    pose = random_pose(two_balls, 2)
    surface = FusedSurface(two_balls) if kind == "fused" else SkinSurface(ball_skin)
    if kind == "fused":
        points = around_balls(two_balls, pose)
    else:
        # Straight above skin points, where turning normals change the distance to second order only.
        height = torch.linspace(-0.004, 0.006, len(ball_skin), dtype=torch.float64).unsqueeze(-1)
        points = (ball_skin(pose) + height * ball_skin.posed_normals(pose))[::20]
    distance, jacobian = surface.distance_jacobian(points, pose)
    torch.testing.assert_close(distance, surface.distance(points, pose))
    torch.testing.assert_close(jacobian, differences(surface, points, two_balls, pose), rtol=0, atol=2e-8)


@torch.no_grad()
@pytest.mark.parametrize("kind", ["fused", "skin"])
def test_batches_are_loops(two_balls, ball_skin, kind):
    surface = FusedSurface(two_balls) if kind == "fused" else SkinSurface(ball_skin)
    poses = torch.stack([random_pose(two_balls, seed) for seed in range(3)])
    points = torch.stack([around_balls(two_balls, pose, 40) for pose in poses])
    distance, jacobian = surface.distance_jacobian(points, poses)
    for row in range(3):
        single = surface.distance_jacobian(points[row], poses[row])
        torch.testing.assert_close((distance[row], jacobian[row]), single)
    shared = surface.distance(points[:1], poses)
    torch.testing.assert_close(shared[2], surface.distance(points[0], poses[2]))
    grid = surface.distance(points.unsqueeze(1), torch.stack([poses, poses.flip(0)], dim=1))
    torch.testing.assert_close(grid[0, 1], surface.distance(points[0], poses[2]))


def test_distances_move_with_the_base(two_balls, ball_skin):
    pose = random_pose(two_balls, 3)
    points = around_balls(two_balls, pose, 50)
    step = torch.tensor([0.1, -0.3, 0.2, 0.5, -1.0, 2.0, 0.0], dtype=torch.float64)
    moved_pose = two_balls.retract(pose, step)
    turn = so3_exp(step[3:6])
    moved = (points - pose[:3]) @ turn.mT + pose[:3] + step[:3]
    for surface in (FusedSurface(two_balls), SkinSurface(ball_skin)):
        torch.testing.assert_close(surface.distance(moved, moved_pose), surface.distance(points, pose))


def test_of_copies_of_a_point_the_first_one_counts(two_balls, ball_skin):
    """A copy that rides on another part is a point of its own."""
    order = torch.cat([torch.arange(3000), torch.randperm(3000, generator=torch.Generator().manual_seed(5))])
    points, normals, weights = ball_skin.points[order], ball_skin.normals[order].clone(), ball_skin.weights[order]
    normals[3000:] *= -1
    copied = LinearBlendSkin(two_balls, points, weights, two_balls.rest_pose(), normals=normals)
    pose = random_pose(two_balls, 6)
    data = around_balls(two_balls, pose, 60)
    expected = SkinSurface(ball_skin)
    torch.testing.assert_close(SkinSurface(copied).distance(data, pose), expected.distance(data, pose))
    for found, wanted in zip(
        SkinSurface(copied).distance_jacobian(data, pose), expected.distance_jacobian(data, pose), strict=True
    ):
        torch.testing.assert_close(found, wanted)
    weights = weights.clone()
    weights[3000:] = weights[3000:].flip(-1)
    other = LinearBlendSkin(two_balls, points, weights, two_balls.rest_pose(), normals=normals)
    assert torch.equal(SkinSurface(other).first, torch.arange(6000))


def sphere_rig(rings):
    """Return a ball of triangles around one joint, as arrays and as a shape."""
    theta = torch.linspace(0.0, math.pi, rings + 1, dtype=torch.float64)[1:-1]
    turn = 2 * math.pi * torch.arange(2 * rings, dtype=torch.float64) / (2 * rings)
    body = torch.stack([
        theta.sin()[:, None] * turn.cos(), theta.sin()[:, None] * turn.sin(), theta.cos()[:, None].expand(-1, 2 * rings)
    ], dim=-1).flatten(0, 1)  # fmt: skip
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    vertices = RADIUS * torch.cat([body, poles])
    wide, top = 2 * rings, len(body)
    faces = []
    for j in range(wide):
        k = (j + 1) % wide
        faces += [[top, j, k], [top + 1, top - wide + k, top - wide + j]]
        for i in range(0, top - wide, wide):
            faces += [[i + j, i + wide + j, i + wide + k], [i + j, i + wide + k, i + k]]
    weights = torch.ones(len(vertices), 1, dtype=torch.float64)
    return ArticulatedShape.from_skinned_mesh(
        vertices, torch.tensor(faces), weights, torch.zeros(1, 3), [-1], axes={"joint_0": []}, dtype=torch.float64
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


def test_dense_file_skin_needs_a_file(two_balls):
    with pytest.raises(InputError, match="no file surface: it was not read from a file with a mesh"):
        dense_file_skin(two_balls)
