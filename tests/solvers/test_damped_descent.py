"""The damped loop on problems with known minima: steps handed in, damping that follows the rule, batches like loops."""

from typing import NamedTuple

import pytest
import torch

from torchreg.solvers.damped_descent import DampingRule, Trial, damped_descent

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


def test_the_minimum_of_rosenbrock_is_found():
    found = run()
    torch.testing.assert_close(torch.stack(found.state, -1), torch.ones(3, 2, dtype=D))
    assert float(found.system.cost.max()) < 1e-12


def test_costs_never_rise_and_the_system_is_that_of_the_state():
    last = banana(STARTS).cost
    for steps in range(1, 12):
        found = run(max_steps=steps)
        assert bool((found.system.cost <= last).all())
        for value, expected in zip(found.system, banana(found.state), strict=True):
            torch.testing.assert_close(value, expected)
        last = found.system.cost


def test_problems_of_a_batch_proceed_by_themselves():
    def settled(trial, before, after):
        return (before - after).abs() <= 1e-3 * before

    both = run(converged=settled)
    for row in range(3):
        alone = run(Place(*(value[row : row + 1] for value in STARTS)), converged=settled)
        torch.testing.assert_close(both.state.x[row : row + 1], alone.state.x)
        assert bool(alone.done)
    assert both.num_steps < 200


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
