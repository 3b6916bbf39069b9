import pytest

from torchreg.errors import InputError
from torchreg.registration.dense.config import (
    ChoiceConfig,
    CoarseConfig,
    EMConfig,
    ScanAlignConfig,
    ScanAlignRecord,
)
from torchreg.registration.dense.e_step import ScanEMConfig


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (CoarseConfig, {"num_steps": 0}, "num_steps must be at least 1"),
        (CoarseConfig, {"sigma": (0.1, 0.0)}, "sigma must be positive"),
        (CoarseConfig, {"doubt": (0.1,)}, "doubt must be two numbers"),
        (CoarseConfig, {"area": 0.0}, "area must be positive"),
        (CoarseConfig, {"normal_weight": -0.1}, "normal_weight must be"),
        (EMConfig, {"doubt": 0.0}, "doubt must be positive"),
        (EMConfig, {"tangential_weight": (1.0, 0.0)}, "tangential_weight must be positive"),
        (ScanAlignConfig, {"density": -1.0}, "density must be"),
        (ChoiceConfig, {"cap": 0.0}, "cap must be positive"),
        (ChoiceConfig, {"smoothness": -1.0}, "smoothness must be"),
        (ScanAlignConfig, {"num_nodes": 0}, "num_nodes must be at least 1"),
        (ScanAlignConfig, {"curvature_radii": ()}, "curvature_radii must hold"),
        (ScanAlignConfig, {"curvature_radii": (-0.1,)}, "curvature_radii must be positive"),
        (EMConfig, {"fused_sigma": 0.0}, "fused_sigma must be positive"),
        (EMConfig, {"expected": -1.0}, "expected must be"),
        (EMConfig, {"expected_scale": 0.0}, "expected_scale must be positive"),
        (ChoiceConfig, {"deviation": -1.0}, "deviation must be"),
        (ChoiceConfig, {"deviation_cap": 0.0}, "deviation_cap must be positive"),
    ],
)
def test_values_out_of_range_are_named(kind, arguments, message):
    with pytest.raises(InputError, match=message):
        kind(**arguments)


def test_defaults_are_shared_by_nobody():
    assert ScanAlignConfig().refine == ScanAlignConfig().refine == EMConfig()
    assert EMConfig().compatible == ScanEMConfig()


def test_the_energy_of_a_record_is_that_of_its_terms():
    record = ScanAlignRecord("again", "refine", 0, 5, 0.1, 2.0, 3.0, 0.5, 0.9)
    assert record.energy == 3.5
