"""Settings of scan registration: values out of range are refused by name, pairs run in even ratios."""

import math

import pytest

from torchreg.errors import InputError, InputTypeError
from torchreg.registration.annealing import geometric_at
from torchreg.registration.config import RegisterConfig


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_samples", 0), ("label_steps", 0), ("motion_steps", 0), ("refine_steps", -1),
        ("match_steps", 0), ("hinge_weight", -1.0),
        ("smoothness", -1.0), ("label_cost", -1.0), ("normal_scale", -1.0),
        ("joint_weight", (-1.0, -1.0)), ("joint_weight", (1.0, 0.0)), ("joint_weight", (1.0,)), ("rtol", -1.0),
        ("point_to_point", 2.0), ("point_to_point", 0.0), ("min_matched", 1.5), ("max_distance", (0.1,)),
        ("max_distance", (0.1, 0.0)), ("max_angle", (4.0, 1.0)), ("blend", "cubic"),
        ("seam", -1.0), ("turn_weight", -1.0), ("turn_scale", 0.0),
    ],
)  # fmt: skip
def test_what_is_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        RegisterConfig(**{name: value})


def test_numbers_must_be_numbers():
    with pytest.raises(InputTypeError, match="num_samples"):
        RegisterConfig(num_samples=1.5)
    with pytest.raises(InputTypeError, match="joint_weight must be two numbers, first and last, got float"):
        RegisterConfig(joint_weight=0.01)
    assert RegisterConfig() == RegisterConfig()


def test_the_weight_of_joints_falls_in_even_ratios():
    config = RegisterConfig(joint_weight=(1.0, 0.05))
    weights = [config.joint_weight_at(k / 5) for k in range(8)]
    # The paper's exp(k ln(0.05) / 5), constant after.
    expected = [math.exp(k * math.log(0.05) / 5) for k in range(6)] + [0.05, 0.05]
    assert weights == pytest.approx(expected)
    assert RegisterConfig(joint_weight=(0.0, 0.0)).joint_weight_at(0.5) == 0


def test_values_between_first_and_last_are_in_even_ratios():
    values = [geometric_at((8.0, 0.5), progress) for progress in (0, 0.5, 1, 2)]
    assert values == pytest.approx([8, 2, 0.5, 0.5])
