import pytest
import torch

from torchreg.datasets.hand import surface_skin
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive

EYE = torch.eye(4, dtype=torch.float64)


@pytest.fixture(scope="module")
def hand():
    return Hand().requires_grad_(False)


@pytest.fixture(scope="module")
def skin(hand):
    return surface_skin(hand, spacing=0.006)


@pytest.fixture(scope="module")
def arm():
    away = EYE.clone()
    away[2, 3] = 0.1
    joints = (Joint("root", -1, EYE), Joint("arm", 0, away, "revolute", (1.0, 0.0, 0.0), -0.5, 1.5))
    balls = [Primitive("ellipsoid", (0.03, 0.03, 0.06), EYE)] * 2
    return ArticulatedShape(KinematicTree(joints), ["root", "arm"], balls, nu=0.006).requires_grad_(False)


@pytest.fixture(scope="module")
def arm_skin(arm):
    return surface_skin(arm, spacing=0.008)
