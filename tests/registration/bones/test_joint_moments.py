"""Moments of shared regions: against Monte Carlo and brute quadrature, and what motions of the grid do to them."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchreg.errors import InputError
from torchreg.registration.bones.joint_moments import joint_moments
from torchreg.registration.bones.sparse_grid import SparseGrid


def grid_and_weights(num_bones=4, resolution=6, seed=0, sparse=True):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(120, 3, generator=generator, dtype=torch.float64) * torch.tensor([2.0, 1.0, 0.5])
    grid = SparseGrid.from_points(points, resolution)
    weights = torch.rand(grid.num_corners, num_bones, generator=generator, dtype=torch.float64)
    if sparse:
        far = torch.cdist(grid.corner_points(), points[:num_bones])
        weights = weights * (far < far.amin(-1, keepdim=True) + 0.4)
    return grid, weights / weights.sum(-1, keepdim=True)


def quadrature(grid, weights, i, j, order=6):
    """The integral of w_i w_j x~ x~^T by a Gauss rule of higher order, one cell and node at a time."""
    nodes, gauss = np.polynomial.legendre.leggauss(order)
    total = torch.zeros(4, 4, dtype=torch.float64)
    for cell in range(grid.num_cells):
        corners = grid.cell_corners[cell]
        for a in range(order):
            for b in range(order):
                for c in range(order):
                    y = np.array([nodes[a], nodes[b], nodes[c]]) / 2 + 0.5
                    volume = gauss[a] * gauss[b] * gauss[c] / 8 * grid.spacing**3
                    side = np.stack([1 - y, y])
                    shape = np.array([side[n >> 2, 0] * side[n >> 1 & 1, 1] * side[n & 1, 2] for n in range(8)])
                    value = torch.from_numpy(shape) @ weights[corners]
                    x = grid.origin + grid.axes @ ((grid.cells[cell] + torch.from_numpy(y)) * grid.spacing)
                    x = torch.cat([x, x.new_ones(1)])
                    total += volume * value[i] * value[j] * torch.outer(x, x)
    return total


def test_moments_equal_quadrature():
    grid, weights = grid_and_weights(3, 3)
    moments = joint_moments(grid, weights)
    assert moments.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    for (i, j), matrix in zip(moments.pairs.tolist(), moments.matrix, strict=True):
        torch.testing.assert_close(matrix, quadrature(grid, weights, i, j), rtol=1e-10, atol=1e-14)


def test_moments_equal_monte_carlo():
    grid, weights = grid_and_weights(2, 4, sparse=False)
    moments = joint_moments(grid, weights)
    generator = torch.Generator().manual_seed(3)
    count = 200_000
    cell = torch.randint(grid.num_cells, (count,), generator=generator)
    local = grid.cells[cell] + torch.rand(count, 3, generator=generator, dtype=torch.float64)
    points = grid.origin + (grid.spacing * local) @ grid.axes.mT
    product = grid.interpolate(weights, points).prod(-1)
    volume = grid.num_cells * grid.spacing**3
    assert float(moments.mass[0]) == pytest.approx(float(volume * product.mean()), rel=0.01)
    mean = (product[:, None] * points).sum(0) / product.sum()
    torch.testing.assert_close(moments.center[0], mean, atol=0.005, rtol=0)
    off = points - mean
    spread = (product[:, None, None] * off[:, :, None] * off[:, None]).sum(0) / product.sum()
    torch.testing.assert_close(moments.spread[0], spread, atol=0.005, rtol=0)


def test_only_pairs_that_meet_are_returned():
    grid, weights = grid_and_weights(6, 8)
    moments = joint_moments(grid, weights)
    meets = torch.zeros(6, 6, dtype=torch.bool)
    for corners in grid.cell_corners:
        reach = weights[corners].amax(0) > 0
        meets |= reach[:, None] & reach
    assert moments.pairs.tolist() == meets.triu(1).nonzero().tolist()
    alone = torch.zeros_like(weights)
    alone[:, 0] = 1
    nothing = joint_moments(grid, alone)
    assert nothing.pairs.shape == (0, 2)
    assert nothing.matrix.shape == (0, 4, 4)


def test_tiny_pairs_are_skipped():
    grid, weights = grid_and_weights(2, 4, sparse=False)
    trace = torch.cat([weights[:, :1], torch.full_like(weights[:, :1], 1e-8)], dim=1)
    assert len(joint_moments(grid, trace).pairs) == 0
    assert len(joint_moments(grid, trace, min_mass=1e-12).pairs) == 1


def test_given_pairs_come_in_their_order():
    grid, weights = grid_and_weights(5, 8)
    moments = joint_moments(grid, weights)
    order = torch.randperm(len(moments.pairs), generator=torch.Generator().manual_seed(0))
    given = joint_moments(grid, weights, pairs=moments.pairs[order])
    for name in ("pairs", "mass", "center", "spread"):
        torch.testing.assert_close(getattr(given, name), getattr(moments.select(order), name))


def test_far_from_the_origin_single_precision_suffices():
    grid, weights = grid_and_weights()
    far = SparseGrid(grid.cells, grid.shape, grid.origin + 100.0, grid.axes, grid.spacing)
    exact, single = joint_moments(far, weights), joint_moments(far.to(torch.float32), weights.float())
    torch.testing.assert_close(single.spread.double(), exact.spread, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(single.center.double(), exact.center, rtol=1e-6, atol=1e-4)


def test_moments_move_with_the_grid():
    grid, weights = grid_and_weights()
    turn = torch.from_numpy(Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix())
    moved = SparseGrid(grid.cells, grid.shape, 10 * turn @ grid.origin + 1, turn @ grid.axes, 10 * grid.spacing)
    before, after = joint_moments(grid, weights), joint_moments(moved, weights)
    assert torch.equal(before.pairs, after.pairs)
    torch.testing.assert_close(after.mass, 1000 * before.mass)
    torch.testing.assert_close(after.center, 10 * before.center @ turn.mT + 1)
    torch.testing.assert_close(after.spread, 100 * turn @ before.spread @ turn.mT)


def test_gradients_in_the_weights():
    grid, weights = grid_and_weights(3, 2)
    pairs = joint_moments(grid, weights).pairs

    def values(w):
        moments = joint_moments(grid, w, pairs=pairs)
        return moments.mass, moments.center, moments.spread

    # Entries at zero are the ones that a list of meetings alone would miss.
    assert bool((weights == 0).any())
    assert torch.autograd.gradcheck(values, (weights.clone().requires_grad_(),))


def test_conversion_and_bad_input():
    grid, weights = grid_and_weights()
    moments = joint_moments(grid, weights).to(torch.float32)
    assert moments.mass.dtype == moments.center.dtype == moments.spread.dtype == torch.float32
    with pytest.raises(InputError, match="weights must have shape"):
        joint_moments(grid, weights[1:])
    with pytest.raises(InputError, match="min_mass must be positive"):
        joint_moments(grid, weights, min_mass=0.0)
