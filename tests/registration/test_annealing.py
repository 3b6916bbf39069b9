import pytest

from torchreg.registration.annealing import geometric_at


def test_values_between_first_and_last_are_in_even_ratios():
    values = [geometric_at((8.0, 0.5), progress) for progress in (0, 0.5, 1, 2)]
    assert values == pytest.approx([8, 2, 0.5, 0.5])
