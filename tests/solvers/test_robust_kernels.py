import math
from itertools import pairwise
from typing import NamedTuple

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from tests.geometry.draws import rand, randn
from torchreg.solvers import robust


class Kernel(NamedTuple):
    """A kernel, Barron's (shape, c / s) for it, and the residual, in scales, at which its pull is largest."""

    weight: object
    loss: object
    shape: float
    width: float
    turning_point: float


KERNELS = {
    "welsch": Kernel(robust.welsch_weight, robust.welsch_loss, -math.inf, 2**-0.5, 2**-0.5),
    "geman_mcclure": Kernel(robust.geman_mcclure_weight, robust.geman_mcclure_loss, -2.0, 0.5, 3**-0.5),
    "cauchy": Kernel(robust.cauchy_weight, robust.cauchy_loss, 0.0, 2**-0.5, 1.0),
}
RESIDUALS = torch.linspace(-6, 6, 121, dtype=torch.float64)

every_kernel = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)


def barron(residual, shape, width):
    """Return the general loss of Barron 2019, eq. 8, of which slopes at small residuals are those of (r / c)^2 / 2."""
    square = (residual / width).square()
    if shape == -math.inf:
        return 1 - (-0.5 * square).exp()
    if shape == 0:
        return (0.5 * square + 1).log()
    around = abs(shape - 2)
    return around / shape * ((square / around + 1) ** (shape / 2) - 1)


@every_kernel
def test_losses_are_members_of_the_general_family(kernel):
    # Scaled to r^2 / 2 near zero, both are one function.
    expected = kernel.width**2 * barron(RESIDUALS, kernel.shape, kernel.width)
    torch.testing.assert_close(0.5 * kernel.loss(RESIDUALS.square()), expected, rtol=1e-12, atol=1e-15)


@every_kernel
def test_weights_fall_and_pulls_turn_back_where_the_papers_say(kernel):
    residual = torch.linspace(0, 6, 60_001, dtype=torch.float64)
    weight = kernel.weight(residual.square())
    assert (weight.diff() < 0).all()
    assert (kernel.loss(residual.square()).diff() >= 0).all()
    assert float(residual[(weight * residual).argmax()]) == pytest.approx(kernel.turning_point, abs=1e-4)


@every_kernel
@pytest.mark.parametrize("name", ["weight", "loss"])
def test_derivatives_are_right_up_to_the_second_at_zero_too(kernel, name):
    function = getattr(kernel, name)
    residual = torch.tensor([-2.0, -0.3, 0.0, 1e-9, 0.7, 3.0], dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda r: function((r / 0.8).square()), residual)
    assert gradgradcheck(lambda r: function((r / 0.8).square()), residual)
    assert gradcheck(function, torch.tensor([1e-3, 0.5, 4.0], dtype=torch.float64, requires_grad=True))


def reweighted_mean(data, kernel, scale, steps=60):
    """Return the location of data by iteratively reweighted least squares from the median, and the cost per step."""
    place, costs = data.median(), []
    for _ in range(steps):
        ratio = ((data - place) / scale).square()
        costs.append(float(0.5 * scale**2 * kernel.loss(ratio).sum()))
        weight = kernel.weight(ratio)
        place = (weight * data).sum() / weight.sum()
    return place, costs


@every_kernel
def test_reweighting_finds_the_inliers_never_raises_the_cost_and_knows_no_unit(kernel):
    inliers = 0.1 * randn(300) + 2.0
    data = torch.cat([inliers, 5 + 4 * rand(100)])
    place, costs = reweighted_mean(data, kernel, 0.3)
    assert all(after <= before + 1e-12 for before, after in pairwise(costs))
    assert float(place) == pytest.approx(float(inliers.mean()), abs=0.01)
    assert float(data.mean()) > 3
    leaf = place.clone().requires_grad_()
    (slope,) = torch.autograd.grad(kernel.loss(((data - leaf) / 0.3).square()).sum(), leaf)
    assert abs(float(slope)) < 1e-8
    in_millimeters, costs_mm = reweighted_mean(1000 * data, kernel, 300.0)
    assert float(in_millimeters) == pytest.approx(1000 * float(place), rel=1e-12)
    assert costs_mm == pytest.approx([1e6 * cost for cost in costs], rel=1e-10)
