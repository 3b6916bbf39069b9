import pytest
import torch

import torchreg as tr
from torchreg.datasets import hand as made
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.primitives import Primitive


@pytest.fixture(scope="session")
def skin(plain_hand):
    return made.surface_skin(plain_hand, spacing=0.006)


def arm_of(upper=1.5, free_base=True):
    """Two balls on a hinge."""
    eye = torch.eye(4, dtype=torch.float64)
    away = eye.clone()
    away[2, 3] = 0.1
    joints = (Joint("root", -1, eye), Joint("arm", 0, away, "revolute", (1.0, 0.0, 0.0), -0.5, upper))
    balls = [Primitive("ellipsoid", (0.03, 0.03, 0.06), eye)] * 2
    shape = tr.ArticulatedShape(KinematicTree(joints), ["root", "arm"], balls, nu=0.006, free_base=free_base)
    return shape.requires_grad_(False)


@pytest.fixture(scope="session")
def arms():
    """A hinge with two limits, one without an upper limit, and one whose base cannot move."""
    return arm_of(), arm_of(float("inf")), arm_of(0.5, free_base=False)
