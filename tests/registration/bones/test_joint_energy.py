"""The joint energy and its moments: against Monte Carlo and brute quadrature, motions of grid and bones, gradients."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.grid_losses import JointEnergy
from torchreg.registration.bones.joint_moments import joint_moments
from torchreg.registration.bones.sparse_grid import SparseGrid


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def grid_and_weights(num_bones=4, resolution=6, seed=0, sparse=True):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(120, 3, generator=generator, dtype=torch.float64) * torch.tensor([2.0, 1.0, 0.5])
    grid = SparseGrid.from_points(points, resolution)
    weights = torch.rand(grid.num_corners, num_bones, generator=generator, dtype=torch.float64)
    if sparse:
        far = torch.cdist(grid.corner_points(), points[:num_bones])
        weights = weights * (far < far.amin(-1, keepdim=True) + 0.4)
    return grid, weights / weights.sum(-1, keepdim=True)


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
    for (i, j), matrix in zip(moments.pairs.tolist(), matrices(moments), strict=True):
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
    assert nothing.spread.shape == (0, 3, 3)


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


def monte_carlo(grid, weights, transforms, count=300_000):
    """Equation 4 by random points of the grid's volume, each pair once."""
    generator = torch.Generator().manual_seed(5)
    cell = torch.randint(grid.num_cells, (count,), generator=generator)
    local = grid.cells[cell] + torch.rand(count, 3, generator=generator, dtype=torch.float64)
    points = grid.origin + (grid.spacing * local) @ grid.axes.mT
    shares = grid.interpolate(weights, points)
    total = 0.0
    for i in range(len(transforms)):
        for j in range(i + 1, len(transforms)):
            product = shares[:, i] * shares[:, j]
            apart = transform_points(transforms[i], points) - transform_points(transforms[j], points)
            total += float((product * apart.square().sum(-1)).sum() / product.sum())
    return total


def test_the_joint_energy_is_the_integral():
    grid, weights = grid_and_weights(3, 4, sparse=False)
    transforms = se3_exp(0.5 * draw(3, 6))
    found = float(JointEnergy()(transforms, joint_moments(grid, weights)))
    assert found == pytest.approx(monte_carlo(grid, weights, transforms), rel=0.01)


def test_the_joint_energy_is_the_trace():
    grid, weights = grid_and_weights(3, 4, sparse=False)
    moments, transforms = joint_moments(grid, weights), se3_exp(draw(3, 6))
    first, second = moments.pairs.unbind(-1)
    difference = (transforms[first] - transforms[second])[:, :3]
    expected = torch.einsum("pab,pbc,pac->p", difference, matrices(moments), difference) / moments.mass
    torch.testing.assert_close(JointEnergy.per_pair(transforms, moments), expected)
    counts = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    torch.testing.assert_close(JointEnergy()(transforms, moments, counts), (counts * expected).sum())


def test_it_vanishes_when_all_bones_move_alike():
    grid, weights = grid_and_weights(3, 4, sparse=False)
    moments = joint_moments(grid, weights)
    together = se3_exp(draw(1, 6)).expand(3, 4, 4)
    assert float(JointEnergy()(together, moments)) == 0
    hinge = torch.stack([together[0], together[0], se3_exp(draw(6, seed=7))])
    assert float(JointEnergy()(hinge, moments)) > 0


def test_it_ignores_what_moves_everything_and_scales_with_the_square():
    grid, weights = grid_and_weights(3, 4, sparse=False)
    moments, transforms = joint_moments(grid, weights), se3_exp(draw(3, 6))
    expected = JointEnergy()(transforms, moments)
    after = se3_exp(draw(6, seed=3)) @ transforms
    torch.testing.assert_close(JointEnergy()(after, moments), expected)
    wide = SparseGrid(grid.cells, grid.shape, 10 * grid.origin, grid.axes, 10 * grid.spacing)
    scaled = transforms.clone()
    scaled[:, :3, 3] *= 10
    torch.testing.assert_close(JointEnergy()(scaled, joint_moments(wide, weights)), 100 * expected)
    order = torch.tensor([2, 0, 1])
    torch.testing.assert_close(JointEnergy()(transforms[order], joint_moments(grid, weights[:, order])), expected)


def test_joint_batches_equal_loops():
    grid, weights = grid_and_weights(3, 4, sparse=False)
    moments, transforms = joint_moments(grid, weights), se3_exp(draw(2, 4, 3, 6))
    found = JointEnergy()(transforms, moments)
    assert found.shape == (2, 4)
    torch.testing.assert_close(found[1, 2], JointEnergy()(transforms[1, 2], moments))


def test_joint_gradients_in_motions_and_weights():
    grid, weights = grid_and_weights(3, 2, sparse=False)
    pairs = joint_moments(grid, weights).pairs

    def energy(transforms, weights):
        return JointEnergy()(transforms, joint_moments(grid, weights, pairs=pairs))

    alike = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    for transforms in (se3_exp(draw(3, 6)), alike):
        assert torch.autograd.gradcheck(energy, (transforms.clone().requires_grad_(), weights.clone().requires_grad_()))


def test_bad_input_is_named():
    grid, weights = grid_and_weights(3, 4, sparse=False)
    moments, transforms = joint_moments(grid, weights), se3_exp(draw(3, 6))
    with pytest.raises(InputError, match="transforms must have shape"):
        JointEnergy()(transforms[:, :3], moments)
    with pytest.raises(InputTypeError, match="moments is"):
        JointEnergy()(transforms.float(), moments)
    with pytest.raises(InputError, match="pair_weights must have shape"):
        JointEnergy()(transforms, moments, torch.ones(2))
