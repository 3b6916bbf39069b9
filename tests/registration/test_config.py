"""Settings of scan registration: values out of range are refused by name, pairs run in even ratios."""

import math
from dataclasses import replace

import pytest

import torchreg as tr

InputError, InputTypeError = tr.errors.InputError, tr.errors.InputTypeError


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
        tr.RegisterConfig(**{name: value})


def test_numbers_must_be_numbers():
    with pytest.raises(InputTypeError, match="num_samples"):
        tr.RegisterConfig(num_samples=1.5)
    with pytest.raises(InputTypeError, match="joint_weight must be two numbers, first and last, got float"):
        tr.RegisterConfig(joint_weight=0.01)


def test_the_weight_of_joints_falls_in_even_ratios():
    config = tr.RegisterConfig(joint_weight=(1.0, 0.05))
    weights = [config.joint_weight_at(k / 5) for k in range(8)]
    # The paper's exp(k ln(0.05) / 5), constant after.
    expected = [math.exp(k * math.log(0.05) / 5) for k in range(6)] + [0.05, 0.05]
    assert weights == pytest.approx(expected)
    assert tr.RegisterConfig(joint_weight=(0.0, 0.0)).joint_weight_at(0.5) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"num_nodes": 0}, "num_nodes must be at least 1"),
        ({"edge_scale": 0.0}, "edge_scale must be positive"),
        ({"normal_weight": -0.1}, "normal_weight must be"),
        ({"tangential_weight": 0.0}, "tangential_weight must be positive"),
        ({"outliers": 0.0}, "outliers must be positive"),
        ({"doubt": 0.0}, "doubt must be positive"),
        ({"cap": 0.0}, "cap must be positive"),
        ({"smoothness": -1.0}, "smoothness must be"),
        ({"num_steps": 0}, "num_steps must be at least 1"),
        ({"sigma": (0.1, 0.0)}, "sigma must be positive"),
        ({"stiffness": (0.1,)}, "stiffness must be two numbers"),
    ],
)
def test_values_of_an_alignment_out_of_range_are_named(change, words):
    align = tr.RegisterConfig().align
    with pytest.raises(InputError, match=words):
        replace(align if hasattr(align, next(iter(change))) else align.refine, **change)
