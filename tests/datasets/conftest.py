import pytest
import torch

from torchreg.datasets.hand import surface_skin
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive


@pytest.fixture(scope="package")
def hand():
    return Hand().requires_grad_(False)


@pytest.fixture(scope="package")
def skin(hand):
    return surface_skin(hand, spacing=0.006)


@pytest.fixture(scope="package")
def arm_of():
    """A function that returns two balls on a hinge."""

    def make(upper=1.5, free_base=True):
        eye = torch.eye(4, dtype=torch.float64)
        away = eye.clone()
        away[2, 3] = 0.1
        joints = (Joint("root", -1, eye), Joint("arm", 0, away, "revolute", (1.0, 0.0, 0.0), -0.5, upper))
        balls = [Primitive("ellipsoid", (0.03, 0.03, 0.06), eye)] * 2
        shape = ArticulatedShape(KinematicTree(joints), ["root", "arm"], balls, nu=0.006, free_base=free_base)
        return shape.requires_grad_(False)

    return make


@pytest.fixture(scope="package")
def arm(arm_of):
    return arm_of()


@pytest.fixture(scope="package")
def arm_skin(arm):
    return surface_skin(arm, spacing=0.008)
