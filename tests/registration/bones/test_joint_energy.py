"""The joint energy and its moments: against brute quadrature and motions of grid and bones."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.bones.sparse_grid import SparseGrid


def grid_and_weights(num_bones=4, resolution=6, sparse=True):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(120, 3, generator=generator, dtype=torch.float64) * torch.tensor([2.0, 1.0, 0.5])
    grid = SparseGrid.from_points(points, resolution)
    weights = torch.rand(grid.num_corners, num_bones, generator=generator, dtype=torch.float64)
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
    """The integral of w_i w_j x~ x~^T by a Gauss rule of higher order, one cell and node at a time."""
    nodes, gauss = np.polynomial.legendre.leggauss(order)
    total = torch.zeros(4, 4, dtype=torch.float64)
    for cell in range(grid.num_cells):
        corners = grid.cell_corners[cell]
        for a, b, c in np.ndindex(order, order, order):
            y = np.array([nodes[a], nodes[b], nodes[c]]) / 2 + 0.5
            volume = gauss[a] * gauss[b] * gauss[c] / 8 * grid.spacing**3
            side = np.stack([1 - y, y])
            shape = np.array([side[n >> 2, 0] * side[n >> 1 & 1, 1] * side[n & 1, 2] for n in range(8)])
            value = torch.from_numpy(shape) @ weights[corners]
            x = grid.origin + grid.axes @ ((grid.cells[cell] + torch.from_numpy(y)) * grid.spacing)
            x = torch.cat([x, x.new_ones(1)])
            total += volume * value[i] * value[j] * torch.outer(x, x)
    return total


def test_moments_equal_quadrature_and_the_energy_is_their_trace():
    grid, weights = grid_and_weights(3, 3)
    moments, transforms = (
        moments_of(grid, weights),
        se3_exp(torch.randn(3, 6, generator=torch.Generator().manual_seed(0))),
    )
    transforms, expected = transforms.double(), 0.0
    assert moments.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    for (i, j), matrix in zip(moments.pairs.tolist(), matrices(moments), strict=True):
        integral = quadrature(grid, weights, i, j)
        torch.testing.assert_close(matrix, integral, rtol=1e-10, atol=1e-14)
        difference = (transforms[i] - transforms[j])[:3]
        expected += torch.trace(difference @ integral @ difference.mT) / integral[3, 3]
    torch.testing.assert_close(joint_energy(grid, weights, transforms), expected)


def test_only_pairs_that_meet_are_returned_and_given_ones_in_their_order():
    grid, weights = grid_and_weights(6, 8)
    moments = moments_of(grid, weights)
    meets = torch.zeros(6, 6, dtype=torch.bool)
    for corners in grid.cell_corners:
        reach = weights[corners].amax(0) > 0
        meets |= reach[:, None] & reach
    assert moments.pairs.tolist() == meets.triu(1).nonzero().tolist()
    order = torch.randperm(len(moments.pairs), generator=torch.Generator().manual_seed(0))
    given = moments_of(grid, weights, pairs=moments.pairs[order])
    for name in ("pairs", "mass", "center", "spread"):
        torch.testing.assert_close(getattr(given, name), getattr(moments.select(order), name))
    alone = torch.zeros_like(weights)
    alone[:, 0] = 1
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
    transforms = se3_exp(torch.randn(2, 3, 6, generator=torch.Generator().manual_seed(0)).double())
    assert float(joint_energy(grid, weights, transforms[0, :1].expand(3, 4, 4))) == 0
    expected = joint_energy(grid, weights, transforms)
    torch.testing.assert_close(expected[1], joint_energy(grid, weights, transforms[1]))
    wide = SparseGrid(grid.cells, grid.shape, 10 * grid.origin, grid.axes, 10 * grid.spacing)
    scaled = transforms.clone()
    scaled[..., :3, 3] *= 10
    torch.testing.assert_close(joint_energy(wide, weights, scaled), 100 * expected)
    order = torch.tensor([2, 0, 1])
    torch.testing.assert_close(joint_energy(grid, weights[:, order], transforms[:, order]), expected)
