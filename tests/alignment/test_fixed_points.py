"""Fixed points of a surface fit: their energy is the one that the fit descends."""

import torch

from tests.alignment.made import D, finger
from torchreg.alignment.fit.implicit_gradient import FixedPoint
from torchreg.alignment.fit.objectives import GaussianPosePrior, distance_objective
from torchreg.shapes.surface import FusedSurface


def test_the_energy_and_its_gradient_are_those_of_the_surface_fit():
    shape, generator = finger(), torch.Generator().manual_seed(0)
    data = 0.05 * torch.randn(2, 40, 3, generator=generator, dtype=D)
    pose, start = (0.2 * torch.randn(2, 2, 7, generator=generator, dtype=D)).unbind()
    valid = torch.arange(40).expand(2, -1) < torch.tensor([[40], [30]])
    sigma, noise = torch.tensor([[0.01, 0.02], [0.004, 0.004]], dtype=D)
    precision = torch.tensor([10.0] * 3 + [1.0] * 3 + [11.0], dtype=D)
    fixed = FixedPoint(
        shape=shape, surface=FusedSurface(shape), valid=valid, sigma=sigma, noise=noise, precision=precision,
        lower=shape.lower, upper=shape.upper,
    )  # fmt: skip
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
