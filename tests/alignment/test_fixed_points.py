"""Fixed points of a surface fit: their energy is the one that the fit descends, their systems are solved exactly."""

import pytest
import torch

from tests.alignment.made import D, finger
from torchreg.alignment.fit.implicit_gradient import FixedPoint, solve_symmetric
from torchreg.alignment.fit.objectives import GaussianPosePrior, distance_objective
from torchreg.shapes.surface import FusedSurface


@pytest.fixture(scope="module")
def shape():
    return finger()


@pytest.fixture(scope="module")
def given():
    """Data, poses and starts of two clouds."""
    generator = torch.Generator().manual_seed(0)
    data = 0.05 * torch.randn(2, 40, 3, generator=generator, dtype=D)
    return data, *(0.2 * torch.randn(2, 2, 7, generator=generator, dtype=D)).unbind()


def fixed_point(shape, **options):
    values = {
        "valid": torch.arange(40).expand(2, -1) < torch.tensor([[40], [30]]),
        "sigma": torch.tensor([0.01, 0.02], dtype=D),
        "noise": torch.tensor([0.004, 0.004], dtype=D),
        "precision": torch.tensor([10.0] * 3 + [1.0] * 3 + [11.0], dtype=D),
        "lower": shape.lower,
        "upper": shape.upper,
    }
    return FixedPoint(shape=shape, surface=FusedSurface(shape), **{**values, **options})


def test_the_energy_and_its_gradient_are_those_of_the_surface_fit(shape, given):
    data, pose, start = given
    fixed = fixed_point(shape)
    prior = GaussianPosePrior(start, fixed.precision, holds_base=True)
    objective = distance_objective(fixed.surface, data, fixed.valid, fixed.sigma, fixed.noise, prior)
    around = objective(pose)
    torch.testing.assert_close(fixed.energy(torch.zeros_like(pose), pose, data, start), around.cost)
    gradient, hessian = fixed.derivatives(pose, data, start)
    torch.testing.assert_close(gradient.detach(), around.gradient, rtol=1e-7, atol=1e-7)
    step = 1e-6
    for k, unit in enumerate(torch.eye(7, dtype=D)):
        ahead, behind = (objective(shape.retract(pose, sign * step * unit.expand(2, 7))).gradient for sign in (1, -1))
        numeric = (ahead - behind) / (2 * step)
        # Turns do not commute: off the stationary point the two differ in the turns among themselves.
        rows = [0, 1, 2, 6]
        torch.testing.assert_close(hessian[:, rows, k], numeric[:, rows], rtol=1e-4, atol=1e-2)


def test_newton_steps_make_a_pose_stationary_and_never_worse(shape, given):
    data, _, start = given
    fixed = fixed_point(shape, sigma=torch.full((2,), 0.05, dtype=D))
    prior = GaussianPosePrior(start, fixed.precision, holds_base=True)
    before = start
    after = fixed.newton_steps(before, data, start, 6)
    objective = distance_objective(fixed.surface, data, fixed.valid, fixed.sigma, fixed.noise, prior)
    sizes = [
        (objective(pose).gradient * fixed.free(pose, objective(pose).gradient)).norm(dim=-1) for pose in (before, after)
    ]
    assert (sizes[1] <= sizes[0]).all()
    assert torch.equal(fixed.newton_steps(before, data, start, 0), before)


def test_symmetric_systems_are_solved_over_the_free_variables():
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(4, 6, 6, generator=generator, dtype=D)
    matrix, right = root @ root.mT, torch.randn(4, 6, generator=generator, dtype=D)
    free = torch.tensor([True, True, False, True, True, True]).expand(4, 6)
    keep = [0, 1, 3, 4, 5]
    expected = torch.linalg.solve(matrix[:, keep][:, :, keep], right[:, keep].unsqueeze(-1)).squeeze(-1)
    solved = solve_symmetric(matrix, right, free)
    torch.testing.assert_close(solved[:, keep], expected, rtol=1e-7, atol=1e-9)
    assert not solved[:, 2].any()
    matrix[:, 5] = matrix[:, :, 5] = 0
    assert not solve_symmetric(matrix, right, free)[:, 5].any()
