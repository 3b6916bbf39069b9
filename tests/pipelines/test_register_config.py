"""Settings of scan registration: what is out of range is refused by name."""

import pytest

from torchreg.errors import InputError, InputTypeError
from torchreg.pipelines.register_config import RegisterConfig


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_samples", 0), ("num_patches", 0), ("label_steps", 0), ("motion_steps", 0), ("refine_steps", -1),
        ("truncation", 0.0), ("unmatched", 0.0), ("smoothness", -1.0), ("label_cost", -1.0), ("joint_weight", -1.0),
        ("normal_scale", -1.0), ("rtol", -1.0), ("point_to_point", 2.0), ("point_to_point", 0.0), ("min_matched", 1.5),
        ("max_distance", (0.1,)), ("max_distance", (0.1, 0.0)), ("max_angle", (4.0, 1.0)), ("blend", "cubic"),
    ],
)  # fmt: skip
def test_what_is_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        RegisterConfig(**{name: value})


def test_numbers_must_be_numbers():
    with pytest.raises(InputTypeError, match="num_samples"):
        RegisterConfig(num_samples=1.5)
    assert RegisterConfig() == RegisterConfig()
