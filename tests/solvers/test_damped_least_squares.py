"""Damped least squares: the loop, steps on manifolds and within limits, and singular systems."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from torch.func import jacrev, vmap

from torchreg.geometry.rotation import compose_rotation_vectors, left_jacobian, so3_exp
from torchreg.solvers.damped_descent import DampingRule, Trial, damped_descent
from torchreg.solvers.levenberg_marquardt import Linearization, damped_step, levenberg_marquardt

D = torch.float64
RULE = DampingRule(trusted=0.5, down=0.1, doubtful=2.0, up=10.0, least=1e-9)


class Banana(NamedTuple):
    """Rosenbrock's function of (B,) x and y, as two residuals."""

    cost: torch.Tensor
    gradient: torch.Tensor
    hessian: torch.Tensor


class Place(NamedTuple):
    x: torch.Tensor
    y: torch.Tensor


def banana(place):
    x, y = place
    residual = torch.stack([10 * (y - x**2), 1 - x], dim=-1)
    one = torch.ones_like(x)
    jacobian = torch.stack([torch.stack([-20 * x, 10 * one], -1), torch.stack([-one, 0 * one], -1)], dim=-2)
    gradient = (jacobian.mT @ residual.unsqueeze(-1)).squeeze(-1)
    return Banana(0.5 * residual.square().sum(-1), gradient, jacobian.mT @ jacobian)


def solve(place, system, damping):
    """A step damped by a multiple of the identity; refused where the damping is tiny."""
    eye = torch.eye(2, dtype=D)
    step = -torch.linalg.solve(system.hessian + damping[:, None, None] * eye, system.gradient)
    sound = damping > 1e-6
    step = step * sound.unsqueeze(-1)
    return Trial(
        Place(*(torch.stack(place, -1) + step).unbind(-1)), step, -0.5 * (system.gradient * step).sum(-1), sound
    )


STARTS = Place(torch.tensor([-1.2, 0.5, 3.0], dtype=D), torch.tensor([1.0, -2.0, 0.0], dtype=D))


def run(place=STARTS, max_steps=200, **options):
    damping = torch.full_like(place.x, 1e-8)  # not sound at first
    return damped_descent(banana, solve, place, damping, rule=RULE, max_steps=max_steps, **options)


def test_steps_that_are_not_sound_change_nothing_but_the_damping():
    found = run(max_steps=1, converged=lambda trial, before, after: torch.ones_like(before, dtype=torch.bool))
    assert torch.equal(found.state.x, STARTS.x)
    torch.testing.assert_close(found.damping, torch.full((3,), 1e-7, dtype=D))
    assert not bool(found.done.any())


@pytest.mark.parametrize(("promised", "factor"), [(0.5, 0.1), (10.0, 2.0)])
def test_the_damping_follows_the_rule(promised, factor):
    """One dimension, from 2 to 1: the cost falls from 2 to 0.5."""

    class System(NamedTuple):
        cost: torch.Tensor

    def step(state, system, damping):
        return Trial(state - 1, torch.full_like(state, -1), torch.full_like(state, promised), state > -10)

    found = damped_descent(
        lambda state: System(0.5 * state**2), step, torch.tensor(2.0), torch.tensor(1.0), rule=RULE, max_steps=1
    )
    assert float(found.state) == 1
    assert float(found.damping) == pytest.approx(factor)
    # From 0 the same step raises the cost.
    risen = damped_descent(
        lambda state: System(0.5 * state**2), step, torch.tensor(0.0), torch.tensor(1.0), rule=RULE, max_steps=1
    )
    assert (float(risen.state), float(risen.damping), float(risen.last_step)) == (0, 10, 0)


def test_what_is_done_stays_and_a_final_cost_is_enough():
    done = torch.tensor([False, True, False])
    found = run(max_steps=5, converged=lambda trial, before, after: torch.zeros_like(done), done=done)
    assert float(found.state.x[1]) == float(STARTS.x[1])
    cheap = run(max_steps=5, final_cost=lambda place: banana(place).cost)
    torch.testing.assert_close(cheap.system.cost, run(max_steps=5).system.cost)
    assert run(max_steps=0).num_steps == 0


def problem(residuals, seen=None):
    """Linearize residuals (D,) -> (R,), batched; costs are appended to ``seen``."""
    jacobian = vmap(jacrev(residuals))

    def linearize(state):
        r, j = vmap(residuals)(state), jacobian(state)
        cost = 0.5 * r.square().sum(-1)
        if seen is not None:
            seen.append((state.clone(), cost.clone()))
        return Linearization(cost, (j.mT @ r.unsqueeze(-1)).squeeze(-1), j.mT @ j)

    return linearize


def rosenbrock(x):
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell(x):
    return torch.stack(
        [x[0] + 10 * x[1], math.sqrt(5) * (x[2] - x[3]), (x[1] - 2 * x[2]) ** 2, math.sqrt(10) * (x[0] - x[3]) ** 2]
    )


def decay(x):
    t = torch.linspace(0, 2, 12, dtype=D)
    return x[0] * torch.exp(-x[1] * t) + x[2] - (2 * torch.exp(-1.5 * t) + 0.3)


PROBLEMS = {
    "rosenbrock": (rosenbrock, [-1.2, 1.0], [-2.0, -2.0], [0.6, 2.0]),
    "powell": (powell, [3.0, -1.0, 0.5, 1.0], [-5.0, -5.0, 0.2, -5.0], [5.0, 5.0, 5.0, 0.9]),
    "decay": (decay, [1.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.6, 5.0, 1.0]),
}


@pytest.mark.parametrize("name", list(PROBLEMS))
@pytest.mark.parametrize("bounded", [False, True])
def test_minima_are_those_of_scipy(name, bounded):
    residuals, start, low, high = PROBLEMS[name]
    bounds = (low, high) if bounded else (-np.inf, np.inf)
    x0 = np.clip(start, low, high) if bounded else np.array(start)
    expected = least_squares(
        lambda x: residuals(torch.from_numpy(x)).numpy(), x0, bounds=bounds, xtol=1e-14, ftol=1e-14
    )
    result = levenberg_marquardt(
        problem(residuals),
        torch.tensor([start], dtype=D),
        lower=torch.tensor(low, dtype=D) if bounded else None,
        upper=torch.tensor(high, dtype=D) if bounded else None,
        max_steps=100,
    )
    assert float(result.cost) <= expected.cost * (1 + 1e-9) + 1e-12
    np.testing.assert_allclose(result.state[0], expected.x, atol=2e-3 if name == "powell" else 1e-6)
    assert result.num_steps == 100


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 100_000))
def test_bounded_linear_problems_meet_the_optimality_conditions(seed):
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(7, 4, generator=generator, dtype=D)
    b = 3 * torch.randn(7, generator=generator, dtype=D)
    low = -torch.rand(4, generator=generator, dtype=D)
    high = torch.rand(4, generator=generator, dtype=D)
    result = levenberg_marquardt(
        problem(lambda x: a @ x - b), torch.zeros(1, 4, dtype=D), lower=low, upper=high, max_steps=60
    )
    x = result.state[0]
    assert bool(((x >= low) & (x <= high)).all())
    gradient = a.mT @ (a @ x - b)
    free = (x > low) & (x < high)
    assert float(torch.where(free, gradient.abs(), 0).max()) < 1e-5
    assert float(torch.where(x == low, -gradient, 0).max()) < 1e-5
    assert float(torch.where(x == high, gradient, 0).max()) < 1e-5


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 100_000))
def test_an_increase_is_never_accepted(seed):
    generator = torch.Generator().manual_seed(seed)
    start = 3 * torch.randn(3, 4, generator=generator, dtype=D)
    linearize, costs = problem(powell), []
    state, damping = start, None
    for _ in range(12):
        result = levenberg_marquardt(linearize, state, damping=damping, max_steps=1)
        costs.append(linearize(state).cost)
        assert bool((result.cost <= costs[-1]).all())
        torch.testing.assert_close(result.cost, linearize(result.state).cost)
        state, damping = result.state, result.damping
    # Stepping once with the damping carried on is the same as stepping twelve times.
    torch.testing.assert_close(levenberg_marquardt(linearize, start, max_steps=12).state, state)


def test_a_step_that_brings_little_is_kept_but_raises_the_damping():
    def linearize(state):
        # The Hessian is just over half of the true one: undamped steps reach nearly the same height on the other side.
        return Linearization(0.5 * state.square().sum(-1), state, torch.full((1, 1, 1), 0.505, dtype=D))

    start = torch.ones(1, 1, dtype=D)
    one = levenberg_marquardt(linearize, start, max_steps=1)
    assert float(one.cost) < 0.5
    assert float(one.damping) == pytest.approx(2e-3)
    assert float(levenberg_marquardt(linearize, start, max_steps=20).cost) < 1e-3


def test_problems_of_a_batch_proceed_independently():
    starts = torch.randn(5, 4, generator=torch.Generator().manual_seed(0), dtype=D)
    damping = torch.logspace(-4, 1, 5, dtype=D)
    low, high = torch.full((4,), -0.9, dtype=D), torch.full((4,), 0.9, dtype=D)
    linearize = problem(powell)
    together = levenberg_marquardt(linearize, starts, damping=damping, lower=low, upper=high, max_steps=8)
    for i in range(5):
        alone = levenberg_marquardt(
            linearize, starts[i : i + 1], damping=damping[i : i + 1], lower=low, upper=high, max_steps=8
        )
        for field in ("state", "cost", "damping", "last_step"):
            torch.testing.assert_close(getattr(together, field)[i], getattr(alone, field)[0])


def test_a_problem_that_breaks_leaves_the_others_alone():
    plain = problem(rosenbrock)

    def linearize(state):
        at = plain(state)
        bad = torch.tensor([False, True])
        return Linearization(
            torch.where(bad, torch.nan, at.cost),
            torch.where(bad[:, None], torch.nan, at.gradient),
            torch.where(bad[:, None, None], torch.nan, at.hessian),
        )

    start = torch.tensor([[-1.2, 1.0], [-1.2, 1.0]], dtype=D)
    result = levenberg_marquardt(linearize, start, max_steps=60)
    torch.testing.assert_close(result.state[0], torch.ones(2, dtype=D), atol=1e-6, rtol=0)
    assert torch.equal(result.state[1], start[1])
    assert result.cost[1].isnan()


def test_steps_on_the_rotation_group():
    target = torch.tensor([2.0, -2.0, 1.2], dtype=D)
    points = torch.randn(10, 3, generator=torch.Generator().manual_seed(0), dtype=D)
    moved = points @ so3_exp(target).mT

    def linearize(state):
        residual, jacobian = [], []
        for w in state:
            posed = points @ so3_exp(w).mT
            residual.append((posed - moved).reshape(-1))
            jacobian.append(jacrev(lambda d, at=posed: at @ so3_exp(d).mT)(torch.zeros(3, dtype=D)).reshape(-1, 3))
        r, j = torch.stack(residual), torch.stack(jacobian)
        return Linearization(0.5 * r.square().sum(-1), (j.mT @ r.unsqueeze(-1)).squeeze(-1), j.mT @ j)

    # Starts on both sides of the half turn and near the whole turn, where plain addition goes astray.
    starts = torch.tensor([[0.0, 0, 0], [math.pi, 0, 0], [-2.0, 2.0, -1.0], [1.9, -1.9, 1.3]], dtype=D)
    result = levenberg_marquardt(
        linearize, starts, retract=lambda w, step: compose_rotation_vectors(step, w), max_steps=40
    )
    assert result.cost.max() < 1e-18
    torch.testing.assert_close(so3_exp(result.state), so3_exp(target).expand(4, 3, 3), atol=1e-9, rtol=0)
    # At the solution the retraction's derivative is the inverse left Jacobian.
    assert torch.linalg.det(left_jacobian(result.state)).abs().min() > 0


def test_limits_clamp_the_start_freeze_and_release():
    low, high = torch.tensor([-1.0, 0.5], dtype=D), torch.tensor([1.0, 0.5], dtype=D)
    seen = []
    linearize = problem(lambda x: torch.stack([x[0] - 3, x[1] - 2, x[0] * x[1]]), seen)
    result = levenberg_marquardt(linearize, torch.tensor([[-7.0, 9.0]], dtype=D), lower=low, upper=high, max_steps=20)
    assert seen[0][0].tolist() == [[-1.0, 0.5]]
    assert all(bool(((state >= low) & (state <= high)).all()) for state, _ in seen)
    # From the lower limit it leaves for the upper one; equal limits hold a variable.
    assert result.state.tolist() == [[1.0, 0.5]]


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_singular_problems_converge_and_hold_what_nothing_constrains(dtype):
    a = torch.randn(6, 3, generator=torch.Generator().manual_seed(0), dtype=dtype)
    # Variables 3 and 4 only matter as their sum, 5 not at all.
    mix = torch.cat([a, a[:, :1], a[:, :1], torch.zeros(6, 1, dtype=dtype)], dim=1)
    start = torch.arange(6, dtype=dtype).unsqueeze(0)
    result = levenberg_marquardt(problem(lambda x: mix @ x - 1), start, max_steps=15)
    least = torch.linalg.lstsq(a.double(), torch.ones(6, dtype=D)[:, None]).solution
    residual = a.double() @ least - 1
    assert float(result.cost) == pytest.approx(float(0.5 * residual.square().sum()), rel=1e-4)
    assert torch.isfinite(result.state).all()
    assert float(result.state[0, 5]) == 5
    nothing = levenberg_marquardt(lambda s: problem(lambda x: 0 * x)(s), start, max_steps=3)
    assert torch.equal(nothing.state, start)


def test_a_hessian_without_a_factor_raises_the_damping_until_it_has_one():
    indefinite = torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=D)

    def linearize(state):
        # The true cost is convex; the Hessian given for it is indefinite.
        return Linearization(0.5 * state.square().sum(-1), state, indefinite.expand(1, 2, 2))

    start = torch.tensor([[1.0, -0.5]], dtype=D)
    step, sound = damped_step(linearize(start), torch.tensor([1e-3], dtype=D))
    assert step.tolist() == [[0, 0]]
    assert sound.tolist() == [False]
    result = levenberg_marquardt(linearize, start, max_steps=60, atol=1e-9)
    assert result.num_steps > 3
    assert float(result.cost) < 1e-6


@pytest.mark.parametrize("max_steps", [0, 1, 3, 8])
def test_a_known_start_and_a_cheap_cost_save_linearizations_and_change_nothing(max_steps):
    seen, bare = [], problem(rosenbrock)
    start = torch.tensor([[-1.2, 1.0], [2.0, -3.0]], dtype=D)
    expected = levenberg_marquardt(problem(rosenbrock), start, max_steps=max_steps)
    found = levenberg_marquardt(
        problem(rosenbrock, seen), start, max_steps=max_steps, start=bare(start), cost=lambda x: bare(x).cost
    )
    for name in ("state", "cost", "damping", "last_step"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=0, atol=0)
    assert len(seen) == max(max_steps - 1, 0)


def test_the_damped_step_is_marquardts():
    generator = torch.Generator().manual_seed(0)
    j = torch.randn(2, 8, 5, generator=generator, dtype=D) * torch.tensor([1e-4, 1, 1e3, 1, 10], dtype=D)
    hessian, gradient = j.mT @ j, torch.randn(2, 5, generator=generator, dtype=D)
    damping = torch.tensor([1e-3, 0.5], dtype=D)
    diagonal = torch.diag_embed(hessian.diagonal(dim1=-2, dim2=-1)) * damping[:, None, None]
    expected = -torch.linalg.solve(hessian + diagonal, gradient)
    at = Linearization(torch.zeros(2, dtype=D), gradient, hessian)
    torch.testing.assert_close(damped_step(at, damping)[0], expected, rtol=1e-8, atol=0)
    frozen = torch.tensor([[False, True, False, False, False]] * 2)
    held, _ = damped_step(at, damping, frozen=frozen)
    keep = [0, 2, 3, 4]
    reduced = -torch.linalg.solve((hessian + diagonal)[:, keep][:, :, keep], gradient[:, keep])
    assert held[:, 1].tolist() == [0, 0]
    torch.testing.assert_close(held[:, keep], reduced, rtol=1e-8, atol=0)


def test_a_rejected_step_keeps_the_state_and_raises_the_damping():
    def linearize(state):
        # The gradient points the wrong way: every step raises the cost.
        return Linearization(0.5 * state.square().sum(-1), -state, torch.eye(2, dtype=D).expand(1, 2, 2))

    start = torch.ones(1, 2, dtype=D)
    result = levenberg_marquardt(linearize, start, max_steps=4)
    assert torch.equal(result.state, start)
    assert result.last_step.tolist() == [[0, 0]]
    assert float(result.damping) == pytest.approx(1e-3 * 6**4)
    assert float(levenberg_marquardt(linearize, start, max_steps=40).damping) == 1e7
