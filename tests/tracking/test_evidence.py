"""What a tracker takes for evidence: where limbs can be, and what lies as densely as a surface."""

import math

import pytest
import torch

from torchreg.alignment.objectives import GaussianPosePrior
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.limbs import find_limbs
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import sample_skin
from torchreg.tracking.evidence import LimbReach, dense_strays, nearest_distance

CELL = 0.01


@pytest.fixture(scope="module")
def reach(plain_hand, plain_hand_skin):
    return LimbReach(plain_hand_skin, find_limbs(plain_hand)[0], CELL)


def moved_pose(hand):
    pose = hand.rest_pose()
    pose[:6] = torch.tensor([0.3, -0.2, 0.6, 1.0, -2.0, 0.5])
    return pose


def test_limbs_reach_where_they_are_within_their_limits(reach, plain_hand, plain_hand_skin):
    shares = torch.rand(20, 21, generator=torch.Generator().manual_seed(0))
    pose = moved_pose(plain_hand)
    poses = pose.repeat(20, 1)
    poses[:, 6:] = plain_hand.lower[6:] + shares * (plain_hand.upper - plain_hand.lower)[6:]
    fingers = plain_hand_skin.weights.argmax(-1) > 0
    trunk = plain_hand.part_transforms(pose)[0]
    reached = torch.stack([reach(points[fingers], trunk) for points in plain_hand_skin(poses)])
    assert reached.float().mean() > 0.98


def test_no_limb_reaches_behind_the_wrist_or_far_away(reach, plain_hand):
    pose = moved_pose(plain_hand)
    palm = plain_hand.part_transforms(pose)[0]
    fingertips = torch.linalg.inv(palm) @ torch.nn.functional.pad(plain_hand.keypoints(pose), (0, 1), value=1.0).T
    outwards = torch.nn.functional.normalize(fingertips[:3, 12], dim=0)
    behind = transform_points(palm, -0.06 * torch.arange(1.0, 5.0).unsqueeze(-1) * outwards)
    assert not bool(reach(behind, palm).any())
    assert not bool(reach(pose[:3] + torch.tensor([[9.0, 0, 0], [0, -9.0, 0]]), palm).any())


def test_without_limbs_every_place_counts():
    tree = KinematicTree((Joint("ball", -1, torch.eye(4, dtype=torch.float64)),))
    ball = ArticulatedShape(
        tree, ["ball"], [Primitive("ellipsoid", (0.1, 0.1, 0.1), torch.eye(4, dtype=torch.float64))]
    )
    skin = sample_skin(ball.requires_grad_(False), 30)
    points = 5 * torch.randn(7, 3, generator=torch.Generator().manual_seed(1))
    assert bool(LimbReach(skin, find_limbs(ball)[0], CELL)(points, torch.eye(4)).all())


def test_strays_are_as_dense_as_the_surface():
    generator = torch.Generator().manual_seed(2)
    sheet, patch = torch.rand(400, 3, generator=generator), torch.rand(30, 3, generator=generator)
    sheet[:, 2] = 0
    patch = torch.tensor([0.2, 0.2, 0.4]) + 0.1 * patch
    thin = torch.rand(20, 3, generator=generator) + torch.tensor([0, 0, 1.0])
    data, near = torch.cat([sheet, patch, thin]), torch.arange(450) < 400
    strays = dense_strays(data, near, 3.0)
    assert len(strays) >= 28
    assert float(nearest_distance(strays, patch).max()) < 1e-3
    assert len(dense_strays(data, torch.ones_like(near), 3.0)) == 0
    assert math.isinf(float(nearest_distance(strays, patch[:0]).min()))


def test_turns_compose_where_the_prior_holds_the_base():
    mean = torch.tensor([[0.1, 0.2, 0.3, math.pi - 0.01, 0.0, 0.0, 0.5]], dtype=torch.float64)
    step = torch.tensor([[0.05, 0.0, 0.0]], dtype=torch.float64)
    pose = mean.clone()
    pose[:, 3:6] = compose_rotation_vectors(step, mean[:, 3:6])
    prior = GaussianPosePrior(mean, torch.full((7,), 4.0, dtype=torch.float64), holds_base=True)
    assert pose[0, 3] < 0
    assert torch.allclose(prior.cost(pose), 2 * step.square().sum(-1))
