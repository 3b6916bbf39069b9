import pytest

from torchreg.errors import InputError
from torchreg.registration.dense.config import EMConfig, ScanAlignConfig, ScanAlignRecord


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_nodes": 0}, "num_nodes must be at least 1"),
        ({"edge_scale": 0.0}, "edge_scale must be positive"),
        ({"normal_weight": -0.1}, "normal_weight must be"),
        ({"tangential_weight": 0.0}, "tangential_weight must be positive"),
        ({"outliers": 0.0}, "outliers must be positive"),
        ({"doubt": 0.0}, "doubt must be positive"),
        ({"cap": 0.0}, "cap must be positive"),
        ({"smoothness": -1.0}, "smoothness must be"),
    ],
)
def test_values_out_of_range_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        ScanAlignConfig(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_steps": 0}, "num_steps must be at least 1"),
        ({"sigma": (0.1, 0.0)}, "sigma must be positive"),
        ({"stiffness": (0.1,)}, "stiffness must be two numbers"),
    ],
)
def test_values_of_an_em_out_of_range_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        EMConfig(**{"num_steps": 3, "sigma": (0.1, 0.01), "stiffness": (1.0, 0.1), **arguments})


def test_defaults_are_shared_by_nobody():
    assert ScanAlignConfig() == ScanAlignConfig()


def test_the_energy_of_a_record_is_that_of_its_terms():
    record = ScanAlignRecord("again", "refine", 0, 5, 0.1, 2.0, 3.0, 0.5, 0.9)
    assert record.energy == 3.5
