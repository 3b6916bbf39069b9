"""How firmly joints hold: what turns and gaps cost, hinges, and robust weights."""

import pytest
import torch

from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.registration.bones.grid_losses import JointEnergy
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.joint_prior import joint_weights, with_stiffness
from torchreg.registration.config import RegisterConfig

JOINT = JointMoments(
    torch.tensor([[0, 1]]), torch.ones(1).double(), torch.zeros(1, 3).double(), torch.ones(1, 3, 3).double()
)
BETA = 0.01


def turns(*vectors):
    """Rotations (F, 2, 3, 3) of a bone that stays and of one that turns by a rotation vector per frame."""
    vectors = torch.tensor(vectors, dtype=torch.float64)
    return so3_exp(torch.stack([torch.zeros_like(vectors), vectors], dim=1))


def spread(rotations, **settings):
    return with_stiffness(JOINT, rotations, RegisterConfig(**settings), BETA).spread[0]


def cost(stiff, *vector):
    """The weighted joint energy of a turn by a rotation vector."""
    motions = rigid_matrix(turns(vector)[0], torch.zeros(2, 3).double())
    return BETA * float(JointEnergy()(motions, JointMoments(JOINT.pairs, JOINT.mass, JOINT.center, stiff[None])))


@pytest.mark.parametrize("vector", [(0.1, 0.0, 0.0), (0.0, -0.05, 0.08)])
def test_a_turn_costs_its_squared_angle(vector):
    stiff = spread(turns([0.0, 0.0, 0.0]), turn_weight=0.3, turn_scale=1e3)
    assert cost(stiff, *vector) == pytest.approx(0.3 * sum(x * x for x in vector), rel=1e-2)
    assert cost(spread(turns([0.0, 0.0, 0.0]), turn_weight=0.0), *vector) == 0


def test_turns_cost_less_the_wider_they_were():
    widths = [float(spread(turns([0.0, 0.0, angle]), turn_weight=1.0, turn_scale=0.1)[0, 0]) for angle in (0, 0.1, 1)]
    # Cauchy's weight: a half at the scale.
    assert widths[1] == pytest.approx(widths[0] / 2, rel=0.01)
    assert widths[2] < 0.02 * widths[0]


def test_a_hinge_costs_turns_about_other_axes_alone_and_needs_three_frames():
    bends = [[0.0, 0.0, angle] for angle in (0.0, 0.5, -0.4, 0.7)]
    hinge = spread(turns(*bends), turn_weight=0.0, hinge_weight=0.2)
    assert cost(hinge, 0.0, 0.0, 0.5) == pytest.approx(0, abs=1e-12)
    for other in ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0)):
        # By how clear the axis is, of at most the weight.
        assert 0.95 * 0.2 * 0.01 < cost(hinge, *other) < 0.2 * 0.01
    assert not spread(turns(*bends[:2]), turn_weight=0.0, hinge_weight=0.2).any()


def test_joints_that_turn_about_several_axes_or_not_at_all_are_no_hinges():
    ball = turns([0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5])
    still = turns(*[[0.0, 0.0, 0.0]] * 3)
    for rotations in (ball, still):
        found = spread(rotations, turn_weight=0.0, hinge_weight=1.0)
        assert float(found.abs().max()) < 1e-6 / BETA


def test_joints_hold_less_the_wider_their_gaps():
    gaps = torch.tensor([[0.0, 0.1, 0.1, 1.0], [0.0, 0.1, 0.0, 1.0]], dtype=torch.float64)
    weights = joint_weights(gaps, 0.1)
    # Geman and McClure's weight of mean squares: a quarter at the scale.
    expected = torch.tensor([1.0, 1 / 4, 1 / 1.5**2, 1 / 101**2], dtype=torch.float64)
    torch.testing.assert_close(weights, expected)
