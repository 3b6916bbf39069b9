"""The joint energy and its moments: against brute quadrature and motions of grid and bones."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.geometry.draws import rand, randn, seeded
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.bones.sparse_grid import SparseGrid


def grid_and_weights(num_bones=4, resolution=6, sparse=True):
    points = rand(120, 3) * torch.tensor([2.0, 1.0, 0.5])
    grid = SparseGrid.from_points(points, resolution)
    weights = rand(grid.num_corners, num_bones, seed=1)
    if sparse:
        far = torch.cdist(grid.corner_points(), points[:num_bones])
        weights = weights * (far < far.amin(-1, keepdim=True) + 0.4)
    return grid, weights / weights.sum(-1, keepdim=True)


def moments_of(grid, weights, **options):
    return tr.GridLBS(grid, weights).joint_moments(**options)


def joint_energy(grid, weights, transforms):
    """Eq. 4, in squared units."""
    energy = tr.RegistrationEnergy(tr.GridLBS(grid, weights), distance=0.0, joint=1.0, smoothness=0.0, norm=0.0)
    points = grid.origin.expand(1, 3)
    return grid.spacing**2 * energy(points, points, points, transforms=transforms).detach()


def matrices(moments):
    """The moments (P, 4, 4) of eq. 4 in homogeneous coordinates."""
    column = torch.cat([moments.center, torch.ones(len(moments.center), 1).double()], dim=-1)
    central = torch.nn.functional.pad(moments.spread, (0, 1, 0, 1))
    return moments.mass[:, None, None] * (central + column.unsqueeze(-1) * column.unsqueeze(-2))


def quadrature(grid, weights, i, j, order=6):
    """The integral of w_i w_j x~ x~^T by a Gauss rule of higher order, one node at a time."""
    nodes, gauss = np.polynomial.legendre.leggauss(order)
    total = torch.zeros(4, 4, dtype=torch.float64)
    for step in np.ndindex(order, order, order):
        y = nodes[list(step)] / 2 + 0.5
        side = np.stack([1 - y, y])
        shape = torch.tensor([side[n >> 2, 0] * side[n >> 1 & 1, 1] * side[n & 1, 2] for n in range(8)])
        value = torch.einsum("c,ncb->nb", shape, weights[grid.cell_corners])
        x = grid.origin + (grid.cells + torch.from_numpy(y)) @ grid.axes.mT * grid.spacing
        x = torch.cat([x, torch.ones(len(x), 1)], dim=1)
        volume = np.prod(gauss[list(step)]) / 8 * grid.spacing**3
        total += volume * torch.einsum("n,na,nb->ab", value[:, i] * value[:, j], x, x)
    return total


def test_moments_equal_quadrature_and_the_energy_is_their_trace():
    grid, weights = grid_and_weights(3, 3)
    moments, transforms, expected = moments_of(grid, weights), se3_exp(randn(3, 6)), 0.0
    assert moments.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    for (i, j), matrix in zip(moments.pairs.tolist(), matrices(moments), strict=True):
        integral = quadrature(grid, weights, i, j)
        torch.testing.assert_close(matrix, integral, rtol=1e-10, atol=1e-14)
        difference = (transforms[i] - transforms[j])[:3]
        expected += torch.trace(difference @ integral @ difference.mT) / integral[3, 3]
    torch.testing.assert_close(joint_energy(grid, weights, transforms), expected)


def test_only_pairs_that_meet_are_returned_and_given_ones_in_their_order():
    grid, weights = grid_and_weights(6, 8)
    moments, reach = moments_of(grid, weights), (weights[grid.cell_corners].amax(1) > 0).double()
    assert moments.pairs.tolist() == (reach.mT @ reach > 0).triu(1).nonzero().tolist()
    order = torch.randperm(len(moments.pairs), generator=seeded())
    given = moments_of(grid, weights, pairs=moments.pairs[order])
    for name in ("pairs", "mass", "center", "spread"):
        torch.testing.assert_close(getattr(given, name), getattr(moments.select(order), name))
    alone = torch.nn.functional.one_hot(torch.zeros(len(weights)).long(), 6).double()
    assert moments_of(grid, alone).pairs.shape == (0, 2)
    trace = torch.cat([alone[:, :1], torch.full_like(alone[:, :1], 1e-8)], dim=1)
    assert [len(moments_of(grid, trace, min_mass=least).pairs) for least in (1e-6, 1e-12)] == [0, 1]


def test_far_from_the_origin_single_precision_suffices():
    grid, weights = grid_and_weights()
    far = SparseGrid(grid.cells, grid.shape, grid.origin + 100.0, grid.axes, grid.spacing)
    exact, single = moments_of(far, weights), moments_of(far.to(torch.float32), weights.float())
    torch.testing.assert_close(single.spread.double(), exact.spread, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(single.center.double(), exact.center, rtol=1e-6, atol=1e-4)


def test_moments_move_with_the_grid():
    grid, weights = grid_and_weights()
    turn = torch.from_numpy(Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix())
    moved = SparseGrid(grid.cells, grid.shape, 10 * turn @ grid.origin + 1, turn @ grid.axes, 10 * grid.spacing)
    before, after = moments_of(grid, weights), moments_of(moved, weights)
    assert torch.equal(before.pairs, after.pairs)
    torch.testing.assert_close(after.mass, 1000 * before.mass)
    torch.testing.assert_close(after.center, 10 * before.center @ turn.mT + 1)
    torch.testing.assert_close(after.spread, 100 * turn @ before.spread @ turn.mT)


def test_energy_vanishes_when_all_bones_move_alike_and_grows_with_the_square():
    grid, weights = grid_and_weights(3, 4, sparse=False)
    transforms, order = se3_exp(randn(2, 3, 6)), torch.tensor([2, 0, 1])
    assert float(joint_energy(grid, weights, transforms[0, :1].expand(3, 4, 4))) == 0
    expected = joint_energy(grid, weights, transforms)
    torch.testing.assert_close(expected[1], joint_energy(grid, weights, transforms[1]))
    wide = SparseGrid(grid.cells, grid.shape, 10 * grid.origin, grid.axes, 10 * grid.spacing)
    scaled = transforms * torch.tensor([[1.0, 1, 1, 10]] * 3 + [[1.0] * 4])
    torch.testing.assert_close(joint_energy(wide, weights, scaled), 100 * expected)
    torch.testing.assert_close(joint_energy(grid, weights[:, order], transforms[:, order]), expected)
