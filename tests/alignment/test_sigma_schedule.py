"""Sigma schedules: values, ends and refusals."""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import torchreg as tr
from torchreg.alignment.fit.annealed_em import estimate_sigma
from torchreg.solvers.e_step import expectation, posterior

lengths = st.floats(1e-6, 1e3)


@given(lengths, lengths, st.integers(2, 30), st.sampled_from(["geometric", "linear"]))
def test_schedules_fall_steadily_between_their_exact_ends(a, b, steps, name):
    start, stop = max(a, b), min(a, b)
    schedule = getattr(tr.SigmaSchedule, name)(start, stop, steps)
    values = schedule.values
    assert len(values) == schedule.steps == steps
    assert values[0] == start
    assert values[-1] == pytest.approx(stop, rel=1e-9)
    assert all(stop <= later <= earlier for earlier, later in itertools.pairwise(values))
    if name == "geometric":
        ratios = [later / earlier for earlier, later in itertools.pairwise(values)]
        assert max(ratios) == pytest.approx(min(ratios), rel=1e-6)
        assert tr.SigmaSchedule.constant(start, steps).values == (start,) * steps
    else:
        falls = [earlier - later for earlier, later in itertools.pairwise(values)]
        assert max(falls) - min(falls) <= 1e-9 * start


@pytest.mark.parametrize("name", ["geometric", "linear", "adaptive"])
@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((0.0, 0.0, 5), "InputError", "start must be positive and finite, got 0.0"),
        ((0.1, -1.0, 5), "InputError", "stop must be positive and finite, got -1.0"),
        ((math.inf, 0.1, 5), "InputError", "start must be positive and finite, got inf"),
        ((0.01, 0.1, 5), "InputError", "stop must not exceed start, got start 0.01 and stop 0.1"),
        ((0.1, 0.01, 0), "InputError", "steps must be at least 1, got 0"),
        ((0.1, 0.01, 2.5), "InputTypeError", "steps must be an integer, got float"),
        (("a", 0.01, 5), "InputTypeError", "start must be a number, got str"),
    ],
)
def test_bad_ranges_are_refused(name, arguments, error, message):
    with pytest.raises(getattr(tr.errors, error), match=message):
        getattr(tr.SigmaSchedule, name)(*arguments)


def test_the_estimate_is_the_maximum_of_the_expected_likelihood_and_zero_for_nothing():
    generator = torch.Generator().manual_seed(0)
    model, data, step = (torch.rand(2, size, 3, generator=generator, dtype=torch.float64) for size in (12, 20, 12))
    moved, sigma = model + 0.1 * step, torch.tensor([0.2, 0.3], dtype=torch.float64)
    found = estimate_sigma(expectation(model, data, sigma), model, moved)
    for row, value in enumerate(found.tolist()):
        alpha = posterior(model[row], data[row], sigma[row])
        tried = torch.linspace(0.5 * value, 2 * value, 30_001, dtype=torch.float64)
        # Eq. 14 as a function of sigma alone: the logarithm of 3-D Gaussians, weighted by the matches.
        squares = (alpha * torch.cdist(moved[row], data[row]).square()).sum()
        likelihood = -squares / (2 * tried.square()) - 3 * alpha.sum() * tried.log()
        assert float(tried[likelihood.argmax()]) == pytest.approx(value, rel=1e-4)
    assert estimate_sigma(expectation(model, data + 100, sigma), model, moved).tolist() == [0, 0]
