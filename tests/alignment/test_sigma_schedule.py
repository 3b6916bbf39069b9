"""Sigma schedules: values, ends and refusals."""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import torchreg as tr
from torchreg.alignment.fit.sigma_schedule import estimate_sigma
from torchreg.solvers.e_step import expectation, posterior

lengths = st.floats(1e-6, 1e3)


def test_values():
    assert tr.SigmaSchedule.geometric(0.08, 0.005, 5).values == pytest.approx((0.08, 0.04, 0.02, 0.01, 0.005))
    assert tr.SigmaSchedule.linear(0.05, 0.01, 5).values == pytest.approx((0.05, 0.04, 0.03, 0.02, 0.01))
    assert tr.SigmaSchedule.constant(0.01, 3).values == (0.01, 0.01, 0.01)
    adaptive = tr.SigmaSchedule.adaptive(0.05, 0.002, 7)
    assert (adaptive.values, adaptive.steps, adaptive.kind) == ((0.05, 0.002), 7, "adaptive")


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
    else:
        falls = [earlier - later for earlier, later in itertools.pairwise(values)]
        assert max(falls) - min(falls) <= 1e-9 * start


@pytest.mark.parametrize("name", ["geometric", "linear", "adaptive"])
@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((0.0, 0.0, 5), tr.errors.InputError, "start must be positive and finite, got 0.0"),
        ((0.1, -1.0, 5), tr.errors.InputError, "stop must be positive and finite, got -1.0"),
        ((math.nan, 0.1, 5), tr.errors.InputError, "start must be positive and finite, got nan"),
        ((math.inf, 0.1, 5), tr.errors.InputError, "start must be positive and finite, got inf"),
        ((0.01, 0.1, 5), tr.errors.InputError, "stop must not exceed start, got start 0.01 and stop 0.1"),
        ((0.1, 0.01, 0), tr.errors.InputError, "steps must be at least 1, got 0"),
        ((0.1, 0.01, 2.5), tr.errors.InputTypeError, "steps must be an integer, got float"),
        ((0.1, 0.01, True), tr.errors.InputTypeError, "steps must be an integer, got bool"),
        (("a", 0.01, 5), tr.errors.InputTypeError, "start must be a number, got str"),
    ],
)
def test_bad_ranges_are_refused(name, arguments, error, message):
    with pytest.raises(error, match=message):
        getattr(tr.SigmaSchedule, name)(*arguments)


def moved_cloud(seed=0):
    """Model points, data, and the model points moved a little."""
    generator = torch.Generator().manual_seed(seed)
    model, data, step = (torch.rand(size, 3, generator=generator, dtype=torch.float64) for size in (12, 20, 12))
    return model, data, model + 0.1 * step


def test_the_estimate_is_the_maximum_of_the_expected_likelihood():
    model, data, moved = moved_cloud()
    sigma = torch.tensor(0.2, dtype=torch.float64)
    alpha, squares = posterior(model, data, sigma), torch.cdist(moved, data).square()
    found = float(estimate_sigma(expectation(model, data, sigma), model, moved))
    tried = torch.linspace(0.5 * found, 2 * found, 30_001, dtype=torch.float64)
    # Eq. 14 as a function of sigma alone: the logarithm of 3-D Gaussians, weighted by the matches.
    likelihood = -(alpha * squares).sum() / (2 * tried.square()) - 3 * alpha.sum() * tried.log()
    assert float(tried[likelihood.argmax()]) == pytest.approx(found, rel=1e-4)


def test_the_estimate_of_nothing_is_zero_and_a_batch_is_a_loop():
    model, data, moved = moved_cloud()
    far = expectation(model, data + 100, torch.tensor(0.1, dtype=torch.float64))
    assert float(estimate_sigma(far, model, moved)) == 0
    sigma = torch.tensor([0.1, 0.3], dtype=torch.float64)
    models = torch.stack([model, model + 0.05])
    together = estimate_sigma(expectation(models, data, sigma), models, models + 0.01)
    for row in range(2):
        alone = estimate_sigma(expectation(models[row], data, sigma[row]), models[row], models[row] + 0.01)
        torch.testing.assert_close(together[row], alone)
