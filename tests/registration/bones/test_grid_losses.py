"""Joint energy against Monte Carlo integrals, weight terms against loops, gradients, and what leaves them alone."""

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.grid_losses import JointEnergy, WeightCloseness, WeightNormalization, WeightSmoothness
from torchreg.registration.bones.joint_moments import joint_moments
from torchreg.registration.bones.sparse_grid import SparseGrid


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def grid_and_weights(bones=3, resolution=4):
    points = draw(80, 3) * torch.tensor([2.0, 1.0, 0.5])
    grid = SparseGrid.from_points(points, resolution)
    weights = draw(grid.num_corners, bones, seed=1).abs()
    return grid, weights / weights.sum(-1, keepdim=True)


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
    grid, weights = grid_and_weights()
    transforms = se3_exp(0.5 * draw(3, 6))
    found = float(JointEnergy()(transforms, joint_moments(grid, weights)))
    assert found == pytest.approx(monte_carlo(grid, weights, transforms), rel=0.01)


def test_the_joint_energy_is_the_trace():
    grid, weights = grid_and_weights()
    moments, transforms = joint_moments(grid, weights), se3_exp(draw(3, 6))
    first, second = moments.pairs.unbind(-1)
    difference = (transforms[first] - transforms[second])[:, :3]
    expected = torch.einsum("pab,pbc,pac->p", difference, moments.matrix, difference) / moments.mass
    torch.testing.assert_close(JointEnergy.per_pair(transforms, moments), expected)
    counts = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    torch.testing.assert_close(JointEnergy()(transforms, moments, counts), (counts * expected).sum())


def test_it_vanishes_when_all_bones_move_alike():
    grid, weights = grid_and_weights()
    moments = joint_moments(grid, weights)
    together = se3_exp(draw(1, 6)).expand(3, 4, 4)
    assert float(JointEnergy()(together, moments)) == 0
    hinge = torch.stack([together[0], together[0], se3_exp(draw(6, seed=7))])
    assert float(JointEnergy()(hinge, moments)) > 0


def test_it_ignores_what_moves_everything_and_scales_with_the_square():
    grid, weights = grid_and_weights()
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
    grid, weights = grid_and_weights()
    moments, transforms = joint_moments(grid, weights), se3_exp(draw(2, 4, 3, 6))
    found = JointEnergy()(transforms, moments)
    assert found.shape == (2, 4)
    torch.testing.assert_close(found[1, 2], JointEnergy()(transforms[1, 2], moments))


def test_joint_gradients_in_motions_and_weights():
    grid, weights = grid_and_weights(3, 2)
    pairs = joint_moments(grid, weights).pairs

    def energy(transforms, weights):
        return JointEnergy()(transforms, joint_moments(grid, weights, pairs=pairs))

    alike = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    for transforms in (se3_exp(draw(3, 6)), alike):
        assert torch.autograd.gradcheck(energy, (transforms.clone().requires_grad_(), weights.clone().requires_grad_()))


def test_weight_terms_are_those_of_their_definitions():
    grid, weights = grid_and_weights()
    edges = grid.edges()
    raw = 1.3 * weights
    smooth = sum(float((raw[c] - raw[d]).square().sum()) for c, d in edges.tolist())
    assert float(WeightSmoothness()(raw, edges)) == pytest.approx(smooth)
    normal = sum((1 - float(row.sum())) ** 2 for row in raw)
    assert float(WeightNormalization()(raw)) == pytest.approx(normal)
    labels = torch.nn.functional.one_hot(weights.argmax(-1), 3).double()
    close = sum(float((v - s).square().sum()) for v, s in zip(raw, labels, strict=True))
    assert float(WeightCloseness()(raw, labels)) == pytest.approx(close)
    per_edge = torch.arange(len(edges)).double()
    some = float(WeightSmoothness()(raw, edges[3:4]))
    only = torch.zeros(len(edges), dtype=torch.float64)
    only[3] = 2
    assert float(WeightSmoothness()(raw, edges, only)) == pytest.approx(2 * some)
    assert float(WeightSmoothness()(torch.ones_like(raw), edges, per_edge)) == 0


def test_weight_terms_have_batches_and_gradients():
    grid, weights = grid_and_weights(2, 1)
    edges = grid.edges()
    labels = torch.nn.functional.one_hot(weights.argmax(-1), 2).double()
    batch = torch.stack([weights, 2 * weights, weights + 0.1])
    terms = (
        lambda w: WeightSmoothness()(
            w, edges, torch.rand(len(edges), generator=torch.Generator().manual_seed(0)).double()
        ),
        WeightNormalization(),
        lambda w: WeightCloseness()(w, labels),
    )
    for term in terms:
        found = term(batch)
        assert found.shape == (3,)
        torch.testing.assert_close(found[1], term(batch[1]))
        assert torch.autograd.gradcheck(term, (batch.clone().requires_grad_(),))


def test_bad_input_is_named():
    grid, weights = grid_and_weights()
    moments, transforms = joint_moments(grid, weights), se3_exp(draw(3, 6))
    with pytest.raises(InputError, match="transforms must have shape"):
        JointEnergy()(transforms[:, :3], moments)
    with pytest.raises(InputTypeError, match="moments is"):
        JointEnergy()(transforms.float(), moments)
    with pytest.raises(InputError, match="pair_weights must have shape"):
        JointEnergy()(transforms, moments, torch.ones(2))
    with pytest.raises(InputError, match="edges must have shape"):
        WeightSmoothness()(weights, grid.edges()[:, :1])
    with pytest.raises(InputError, match="edge_weights must have shape"):
        WeightSmoothness()(weights, grid.edges(), torch.ones(2))
    with pytest.raises(InputError, match="weights must have shape"):
        WeightNormalization()(weights[0])
    with pytest.raises(InputError, match="label_weights must have shape"):
        WeightCloseness()(weights, weights[1:])
