"""Projected gradients: against scipy's and our own active sets, batches, scales, other convex costs, refusals."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.optimize import nnls as dense_nnls

from torchreg.solvers.nnls import nnls
from torchreg.solvers.projected_gradient import projected_gradient


def problem(seed, rows=30, columns=12, batch=()):
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.randn(*batch, rows, columns, generator=generator, dtype=torch.float64)
    return matrix, torch.randn(*batch, rows, generator=generator, dtype=torch.float64)


def squares(matrix, target):
    return lambda x: ((matrix @ x.unsqueeze(-1)).squeeze(-1) - target).square().sum(-1)


@pytest.mark.parametrize("seed", range(6))
def test_the_cost_is_scipys(seed):
    matrix, target = problem(seed)
    result = projected_gradient(squares(matrix, target), torch.zeros(12, dtype=torch.float64))
    assert bool(result.converged)
    assert float(result.cost) == pytest.approx(dense_nnls(matrix.numpy(), target.numpy())[1] ** 2, rel=1e-8)
    assert (result.x >= 0).all()


def test_sums_of_one_smoothness_and_data_come_within_a_percent_of_the_active_set():
    generator = torch.Generator().manual_seed(0)
    data = torch.randn(400, 40, 5, generator=generator, dtype=torch.float64).square()
    data = data * (torch.rand(400, 40, 1, generator=generator, dtype=torch.float64) < 0.05)
    step = torch.eye(40, dtype=torch.float64)[1:] - torch.eye(40, dtype=torch.float64)[:-1]
    bones = torch.eye(5, dtype=torch.float64)
    sums = torch.kron(torch.eye(40, dtype=torch.float64), torch.ones(1, 5, dtype=torch.float64))
    matrix = torch.cat([data.flatten(1), 3 * torch.kron(step, bones), 3 * sums])
    target = torch.cat([torch.zeros(400 + 39 * 5, dtype=torch.float64), torch.full((40,), 3.0, dtype=torch.float64)])
    expected = nnls(matrix, target)
    scale = 1 / matrix.square().sum(0)
    result = projected_gradient(squares(matrix, target), torch.full((200,), 0.2, dtype=torch.float64), scale=scale)
    assert expected.converged
    assert expected.objective * (1 - 1e-9) <= float(result.cost) <= expected.objective * 1.01


def test_a_batch_equals_a_loop():
    matrix, target = problem(1, batch=(2, 3))
    start = torch.rand(2, 3, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    batch = projected_gradient(squares(matrix, target), start)
    for index in np.ndindex(2, 3):
        alone = projected_gradient(squares(matrix[index], target[index]), start[index])
        torch.testing.assert_close(batch.x[index], alone.x, atol=1e-8, rtol=1e-8)
        torch.testing.assert_close(batch.cost[index], alone.cost)
    assert batch.converged.all()


def test_the_cost_never_rises_with_more_steps():
    matrix, target = problem(2, 60, 50)
    matrix = matrix * torch.logspace(-1, 1, 50, dtype=torch.float64)
    start = torch.ones(50, dtype=torch.float64)
    costs = [float(projected_gradient(squares(matrix, target), start, max_steps=steps).cost) for steps in range(1, 60)]
    assert all(after <= before for before, after in pairwise(costs))


def test_scaling_by_the_curvature_saves_steps_where_units_differ():
    matrix, target = problem(3)
    matrix = matrix * torch.logspace(-3, 3, 12, dtype=torch.float64)
    start = torch.zeros(12, dtype=torch.float64)
    scaled = projected_gradient(squares(matrix, target), start, scale=1 / matrix.square().sum(0))
    plain = projected_gradient(squares(matrix, target), start, max_steps=scaled.num_steps)
    assert float(scaled.cost) == pytest.approx(dense_nnls(matrix.numpy(), target.numpy())[1] ** 2, rel=1e-6)
    assert plain.cost > scaled.cost * (1 + 1e-6)
    assert not bool(plain.converged)


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_the_unit_of_the_target_changes_nothing_but_the_unit(size):
    matrix, target = problem(4)
    start = torch.zeros(12, dtype=torch.float64)
    plain = projected_gradient(squares(matrix, target), start)
    other = projected_gradient(squares(matrix, size * target), start)
    torch.testing.assert_close(other.x / size, plain.x, atol=1e-6, rtol=1e-5)


def test_float32_ends_at_its_own_rounding():
    matrix, target = problem(5)
    result = projected_gradient(squares(matrix.float(), target.float()), torch.zeros(12))
    assert result.x.dtype == torch.float32
    assert bool(result.converged)
    assert result.num_steps < 500
    assert float(result.cost) == pytest.approx(dense_nnls(matrix.numpy(), target.numpy())[1] ** 2, rel=1e-5)


def test_convex_costs_that_are_no_squares_meet_their_conditions():
    # Logarithmic loss with a barrier that makes too long a step infinite.
    matrix, target = problem(6)
    matrix = matrix.abs()

    def cost(x):
        return (matrix @ x - (target.exp() * (matrix @ x + 0.1).log())).sum(-1)

    result = projected_gradient(cost, torch.ones(12, dtype=torch.float64), max_steps=3000, tol=1e-9)
    x = result.x.requires_grad_()
    (slope,) = torch.autograd.grad(cost(x), x)
    assert bool(result.converged)
    assert slope[x > 0].abs().max() < 1e-4
    assert slope[x == 0].min() > -1e-4


def test_when_nothing_helps_the_solution_is_zero():
    matrix, _ = problem(7)
    cost = squares(matrix.abs(), -torch.ones(30, dtype=torch.float64))
    result = projected_gradient(cost, torch.ones(12, dtype=torch.float64))
    assert result.x.tolist() == [0] * 12
    assert bool(result.converged)
    again = projected_gradient(cost, torch.zeros(12, dtype=torch.float64))
    assert again.num_steps == 1


def test_negative_starts_are_clamped_and_left_as_they_were():
    matrix, target = problem(8)
    start = -torch.ones(12, dtype=torch.float64)
    result = projected_gradient(squares(matrix, target), start)
    assert start.tolist() == [-1] * 12
    assert bool(result.converged)
    assert not result.x.requires_grad
