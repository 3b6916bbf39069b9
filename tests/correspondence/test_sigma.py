"""Sigma schedules: values, ends and refusals."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchreg.correspondence.sigma import SigmaSchedule
from torchreg.errors import InputError, InputTypeError

lengths = st.floats(1e-6, 1e3)


def test_values():
    assert SigmaSchedule.geometric(0.08, 0.005, 5).values == pytest.approx((0.08, 0.04, 0.02, 0.01, 0.005))
    assert SigmaSchedule.linear(0.05, 0.01, 5).values == pytest.approx((0.05, 0.04, 0.03, 0.02, 0.01))
    assert SigmaSchedule.constant(0.01, 3).values == (0.01, 0.01, 0.01)
    adaptive = SigmaSchedule.adaptive(0.05, 0.002, 7)
    assert (adaptive.values, adaptive.steps, adaptive.kind) == ((0.05, 0.002), 7, "adaptive")


@given(lengths, lengths, st.integers(2, 30), st.sampled_from(["geometric", "linear"]))
def test_schedules_fall_steadily_between_their_exact_ends(a, b, steps, name):
    start, stop = max(a, b), min(a, b)
    schedule = getattr(SigmaSchedule, name)(start, stop, steps)
    values = schedule.values
    assert len(values) == schedule.steps == steps
    assert values[0] == start
    assert values[-1] == pytest.approx(stop, rel=1e-9)
    assert all(stop <= later <= earlier for earlier, later in itertools.pairwise(values))
    if name == "geometric":
        ratios = [later / earlier for earlier, later in itertools.pairwise(values)]
        assert max(ratios) == pytest.approx(min(ratios), rel=1e-6)
    else:
        falls = [earlier - later for earlier, later in itertools.pairwise(values)]
        assert max(falls) - min(falls) <= 1e-9 * start


@pytest.mark.parametrize("name", ["geometric", "linear"])
def test_one_step_is_the_start(name):
    assert getattr(SigmaSchedule, name)(0.05, 0.01, 1).values == (0.05,)


def test_schedules_are_values():
    assert SigmaSchedule.constant(0.01, 2) == SigmaSchedule((0.01, 0.01), 2)
    assert hash(SigmaSchedule.constant(0.01, 2)) == hash(SigmaSchedule((0.01, 0.01), 2))


@pytest.mark.parametrize("name", ["geometric", "linear", "adaptive"])
@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((0.0, 0.0, 5), InputError, "start must be positive and finite, got 0.0"),
        ((0.1, -1.0, 5), InputError, "stop must be positive and finite, got -1.0"),
        ((math.nan, 0.1, 5), InputError, "start must be positive and finite, got nan"),
        ((math.inf, 0.1, 5), InputError, "start must be positive and finite, got inf"),
        ((0.01, 0.1, 5), InputError, "stop must not exceed start, got start 0.01 and stop 0.1"),
        ((0.1, 0.01, 0), InputError, "steps must be at least 1, got 0"),
        ((0.1, 0.01, 2.5), InputTypeError, "steps must be an integer, got float"),
        ((0.1, 0.01, True), InputTypeError, "steps must be an integer, got bool"),
        (("a", 0.01, 5), InputTypeError, "start must be a number, got str"),
    ],
)
def test_bad_ranges_are_refused(name, arguments, error, message):
    with pytest.raises(error, match=message):
        getattr(SigmaSchedule, name)(*arguments)


def test_bad_records_are_refused():
    with pytest.raises(InputError, match="values must hold 3 sigmas for 3 fixed steps"):
        SigmaSchedule((0.1, 0.05), 3)
    with pytest.raises(InputError, match="values must hold 2 sigmas for 3 adaptive steps"):
        SigmaSchedule((0.1, 0.05, 0.01), 3, "adaptive")
    with pytest.raises(InputError, match=r"values\[1\] must be positive"):
        SigmaSchedule((0.1, -0.05), 2)
    with pytest.raises(InputError, match="values must not rise"):
        SigmaSchedule((0.1, 0.2), 2)
    with pytest.raises(InputError, match="kind must be one of fixed, adaptive; got 'other'"):
        SigmaSchedule((0.1,), 1, "other")
    with pytest.raises(InputTypeError, match="steps must be an integer"):
        SigmaSchedule((0.1,), "1")
    with pytest.raises(InputError, match="start must be positive"):
        SigmaSchedule.constant(0.0)
