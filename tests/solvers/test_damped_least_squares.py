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

from tests.geometry.draws import D, rand, randn
from torchreg.geometry.rotation import compose_rotation_vectors, so3_exp
from torchreg.solvers.damped_descent import DampingRule, Trial, damped_descent
from torchreg.solvers.levenberg_marquardt import Linearization, SharedRows, damped_step, levenberg_marquardt

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
    sound = damping > 1e-6
    step = -torch.linalg.solve(system.hessian + torch.diag_embed(damping.unsqueeze(-1).expand(-1, 2)), system.gradient)
    step = step * sound.unsqueeze(-1)
    moved = Place(*(torch.stack(place, -1) + step).unbind(-1))
    return Trial(moved, step, -0.5 * (system.gradient * step).sum(-1), sound)


STARTS = Place(torch.tensor([-1.2, 0.5, 3.0], dtype=D), torch.tensor([1.0, -2.0, 0.0], dtype=D))


def run(max_steps, **options):
    damping = torch.full_like(STARTS.x, 1e-8)  # not sound at first
    return damped_descent(banana, solve, STARTS, damping, rule=RULE, max_steps=max_steps, **options)


def test_unsound_steps_change_nothing_but_the_damping_what_is_done_stays_and_a_final_cost_is_enough():
    done = torch.tensor([False, True, False])
    found = run(1, converged=lambda trial, before, after: torch.ones_like(done))
    assert torch.equal(found.state.x, STARTS.x)
    torch.testing.assert_close(found.damping, torch.full((3,), 1e-7, dtype=D))
    assert not bool(found.done.any())
    stopped = run(5, converged=lambda trial, before, after: torch.zeros_like(done), done=done)
    assert float(stopped.state.x[1]) == float(STARTS.x[1])
    cheap = run(5, final_cost=lambda place: banana(place).cost)
    torch.testing.assert_close(cheap.system.cost, run(5).system.cost)
    assert run(0).num_steps == 0


@pytest.mark.parametrize(
    ("start", "promised", "expected"), [(2.0, 0.5, (1, 0.1, 1)), (2.0, 10.0, (1, 2, 1)), (0.0, 0.5, (0, 10, 0))]
)
def test_the_damping_follows_the_rule(start, promised, expected):
    """A step of -1: from 2 the cost falls from 2 to 0.5, from 0 it rises."""

    class System(NamedTuple):
        cost: torch.Tensor

    def step(state, system, damping):
        return Trial(state - 1, torch.full_like(state, -1), torch.full_like(state, promised), state > -10)

    begin, damping = torch.tensor(start), torch.tensor(1.0)
    found = damped_descent(lambda state: System(0.5 * state**2), step, begin, damping, rule=RULE, max_steps=1)
    assert (float(found.state), float(found.damping), -float(found.last_step)) == pytest.approx(expected)


def problem(residuals, seen=None):
    """Linearize residuals (D,) -> (R,), batched; states are appended to ``seen``."""
    jacobian = vmap(jacrev(residuals))

    def linearize(state):
        r, j = vmap(residuals)(state), jacobian(state)
        if seen is not None:
            seen.append(state.clone())
        return Linearization(0.5 * r.square().sum(-1), (j.mT @ r.unsqueeze(-1)).squeeze(-1), j.mT @ j)

    return linearize


def rosenbrock(x):
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell(x):
    first, second = math.sqrt(5) * (x[2] - x[3]), math.sqrt(10) * (x[0] - x[3]) ** 2
    return torch.stack([x[0] + 10 * x[1], first, (x[1] - 2 * x[2]) ** 2, second])


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
    residuals, start, *bounds = PROBLEMS[name]
    bounds = bounds if bounded else (-np.inf, np.inf)
    lower, upper = (torch.tensor(side, dtype=D) if bounded else None for side in bounds)
    precise = {"xtol": 1e-14, "ftol": 1e-14}
    plain = lambda x: residuals(torch.from_numpy(x)).numpy()  # noqa: E731
    expected = least_squares(plain, np.clip(start, *bounds), bounds=bounds, **precise)
    begin = torch.tensor([start], dtype=D)
    result = levenberg_marquardt(problem(residuals), begin, lower=lower, upper=upper, max_steps=100)
    assert float(result.cost) <= expected.cost * (1 + 1e-9) + 1e-12
    np.testing.assert_allclose(result.state[0], expected.x, atol=2e-3 if name == "powell" else 1e-6)
    assert result.num_steps == 100


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 100_000))
def test_bounded_linear_problems_meet_the_optimality_conditions(seed):
    a, b, low, high = randn(7, 4, seed=seed), 3 * randn(7, seed=seed), -rand(4, seed=seed), rand(4, seed=seed + 1)
    start, linearize = torch.zeros(1, 4, dtype=D), problem(lambda x: a @ x - b)
    x = levenberg_marquardt(linearize, start, lower=low, upper=high, max_steps=60).state[0]
    assert bool(((x >= low) & (x <= high)).all())
    gradient = a.mT @ (a @ x - b)
    # Free variables have no slope, and at a limit it points outwards.
    slope = torch.where(x == low, -gradient, torch.where(x == high, gradient, gradient.abs()))
    assert float(slope.max()) < 1e-5


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 100_000))
def test_an_increase_is_never_accepted(seed):
    start, linearize, damping = 3 * randn(3, 4, seed=seed), problem(powell), None
    state = start
    for _ in range(12):
        result = levenberg_marquardt(linearize, state, damping=damping, max_steps=1)
        assert bool((result.cost <= linearize(state).cost).all())
        torch.testing.assert_close(result.cost, linearize(result.state).cost)
        state, damping = result.state, result.damping
    # Stepping once with the damping carried on is the same as stepping twelve times.
    torch.testing.assert_close(levenberg_marquardt(linearize, start, max_steps=12).state, state)


def test_problems_of_a_batch_proceed_independently():
    starts, damping, linearize = randn(5, 4), torch.logspace(-4, 1, 5, dtype=D), problem(powell)
    options = {"lower": torch.full((4,), -0.9, dtype=D), "upper": torch.full((4,), 0.9, dtype=D), "max_steps": 8}
    together = levenberg_marquardt(linearize, starts, damping=damping, **options)
    for i in range(5):
        alone = levenberg_marquardt(linearize, starts[i : i + 1], damping=damping[i : i + 1], **options)
        for field in ("state", "cost", "damping", "last_step"):
            torch.testing.assert_close(getattr(together, field)[i], getattr(alone, field)[0])


def test_a_problem_that_breaks_leaves_the_others_alone():
    plain, bad = problem(rosenbrock), torch.tensor([False, True])

    def linearize(state):
        found = plain(state)
        return Linearization(*(part.masked_fill(bad.reshape(2, *[1] * (part.ndim - 1)), torch.nan) for part in found))

    start = torch.tensor([[-1.2, 1.0], [-1.2, 1.0]], dtype=D)
    result = levenberg_marquardt(linearize, start, max_steps=60)
    torch.testing.assert_close(result.state[0], torch.ones(2, dtype=D), atol=1e-6, rtol=0)
    assert torch.equal(result.state[1], start[1])
    assert result.cost[1].isnan()


def test_steps_on_the_rotation_group():
    target, points = torch.tensor([2.0, -2.0, 1.2], dtype=D), randn(10, 3)
    zero = torch.zeros(3, dtype=D)

    def residuals(w, d):
        return (points @ so3_exp(w).mT @ so3_exp(d).mT - points @ so3_exp(target).mT).reshape(-1)

    def linearize(state):
        r = torch.stack([residuals(w, zero) for w in state])
        j = torch.stack([jacrev(residuals, argnums=1)(w, zero) for w in state])
        return Linearization(0.5 * r.square().sum(-1), (j.mT @ r.unsqueeze(-1)).squeeze(-1), j.mT @ j)

    # Starts on both sides of the half turn and near the whole turn, where plain addition goes astray.
    starts = torch.tensor([[0.0, 0, 0], [math.pi, 0, 0], [-2.0, 2.0, -1.0], [1.9, -1.9, 1.3]], dtype=D)
    compose = {"retract": lambda w, step: compose_rotation_vectors(step, w)}
    result = levenberg_marquardt(linearize, starts, **compose, max_steps=40)
    assert result.cost.max() < 1e-18
    torch.testing.assert_close(so3_exp(result.state), so3_exp(target).expand(4, 3, 3), atol=1e-9, rtol=0)


def test_limits_clamp_the_start_freeze_and_release():
    low, high, seen = torch.tensor([-1.0, 0.5], dtype=D), torch.tensor([1.0, 0.5], dtype=D), []
    linearize = problem(lambda x: torch.stack([x[0] - 3, x[1] - 2, x[0] * x[1]]), seen)
    result = levenberg_marquardt(linearize, torch.tensor([[-7.0, 9.0]], dtype=D), lower=low, upper=high, max_steps=20)
    assert seen[0].tolist() == [[-1.0, 0.5]]
    assert all(bool(((state >= low) & (state <= high)).all()) for state in seen)
    # From the lower limit it leaves for the upper one; equal limits fix a variable.
    assert result.state.tolist() == [[1.0, 0.5]]


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_singular_problems_converge_and_hold_what_nothing_constrains(dtype):
    a = randn(6, 3, dtype=dtype)
    # Variables 3 and 4 only matter as their sum, 5 not at all.
    mix = torch.cat([a, a[:, :1], a[:, :1], torch.zeros(6, 1, dtype=dtype)], dim=1)
    start = torch.arange(6, dtype=dtype).unsqueeze(0)
    result = levenberg_marquardt(problem(lambda x: mix @ x - 1), start, max_steps=15)
    least = torch.linalg.lstsq(a.double(), torch.ones(6, dtype=D)[:, None]).solution
    assert float(result.cost) == pytest.approx(float(0.5 * (a.double() @ least - 1).square().sum()), rel=1e-4)
    assert torch.isfinite(result.state).all()
    assert float(result.state[0, 5]) == 5
    assert torch.equal(levenberg_marquardt(problem(lambda x: 0 * x), start, max_steps=3).state, start)


def bowl(slope, hessian):
    """A system whose true cost is |x|^2 / 2."""
    return lambda state: Linearization(0.5 * state.square().sum(-1), slope * state, torch.tensor([hessian], dtype=D))


def test_a_hessian_without_a_factor_raises_the_damping_until_it_has_one():
    linearize, start = bowl(1, [[1.0, 2.0], [2.0, 1.0]]), torch.tensor([[1.0, -0.5]], dtype=D)
    step, sound = damped_step(linearize(start), torch.tensor([1e-3], dtype=D))
    assert (step.tolist(), sound.tolist()) == ([[0, 0]], [False])
    result = levenberg_marquardt(linearize, start, max_steps=60, atol=1e-9)
    assert result.num_steps > 3
    assert float(result.cost) < 1e-6


def test_steps_that_bring_little_or_raise_the_cost_raise_the_damping():
    # Just over half of the true Hessian: undamped steps reach nearly the same height on the other side.
    little, one = bowl(1, [[0.505]]), torch.ones(1, 1, dtype=D)
    found = levenberg_marquardt(little, one, max_steps=1)
    assert float(found.cost) < 0.5
    assert float(found.damping) == pytest.approx(2e-3)
    assert float(levenberg_marquardt(little, one, max_steps=20).cost) < 1e-3
    uphill = bowl(-1, [[1.0]])
    found = levenberg_marquardt(uphill, one, max_steps=4)
    assert (found.state.tolist(), found.last_step.tolist()) == ([[1]], [[0]])
    assert float(found.damping) == pytest.approx(1e-3 * 6**4)
    assert float(levenberg_marquardt(uphill, one, max_steps=40).damping) == 1e7


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
    j = randn(2, 8, 5) * torch.tensor([1e-4, 1, 1e3, 1, 10], dtype=D)
    hessian, gradient, damping = j.mT @ j, randn(2, 5), torch.tensor([1e-3, 0.5], dtype=D)
    damped = hessian + torch.diag_embed(hessian.diagonal(dim1=-2, dim2=-1)) * damping[:, None, None]
    system = Linearization(torch.zeros(2, dtype=D), gradient, hessian)
    for keep in ([0, 1, 2, 3, 4], [0, 2, 3, 4]):
        frozen = torch.tensor([[k not in keep for k in range(5)]] * 2)
        step, _ = damped_step(system, damping, frozen=frozen)
        expected = -torch.linalg.solve(damped[:, keep][:, :, keep], gradient[:, keep])
        torch.testing.assert_close(step[:, keep], expected, rtol=1e-8, atol=0)
        assert not bool(step[frozen].any())
    torch.testing.assert_close(
        damped_step(system, damping)[0], -torch.linalg.solve(damped, gradient), rtol=1e-8, atol=0
    )


def test_rows_that_share_unknowns_reach_the_joint_minimum():
    """Two groups of three rows with two unknowns of their own and two shared ones, against one lstsq a group."""
    slopes, values = randn(6, 5, 4), randn(6, 5)

    def linearize(rows):
        residual = (slopes @ rows.unsqueeze(-1)).squeeze(-1) - values
        gradient = (slopes.mT @ residual.unsqueeze(-1)).squeeze(-1)
        return Linearization(0.5 * residual.square().sum(-1), gradient, slopes.mT @ slopes)

    free, start = torch.full((4,), torch.inf, dtype=D), torch.zeros(6, 4, dtype=D)
    shared = SharedRows(torch.add, count=3, own=2)
    found = shared.descend(
        linearize, start, lower=-free, upper=free, max_steps=30, cost=lambda rows: linearize(rows).cost
    )
    step = shared.step(linearize(start), start, lower=-free, upper=free, damping=0.0)
    for group in range(2):
        one, right = slopes[3 * group : 3 * group + 3], values[3 * group : 3 * group + 3].flatten()
        joint = torch.cat([torch.block_diag(*one[..., :2]), one[..., 2:].flatten(0, 1)], dim=1)
        solution = torch.linalg.lstsq(joint, right).solution
        expected = torch.cat([solution[:6].reshape(3, 2), solution[6:].expand(3, 2)], dim=1)
        for rows in (found.state, step.state):
            torch.testing.assert_close(rows[3 * group : 3 * group + 3], expected, atol=1e-7, rtol=1e-7)
