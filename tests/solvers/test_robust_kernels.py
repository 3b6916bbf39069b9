import math
from itertools import pairwise
from typing import NamedTuple

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from torchreg.solvers.robust import (
    cauchy_loss,
    cauchy_weight,
    geman_mcclure_loss,
    geman_mcclure_weight,
    welsch_loss,
    welsch_weight,
)


class Kernel(NamedTuple):
    """A kernel, Barron's (shape, c / s) for it, and the residual, in scales, at which its pull is largest."""

    weight: object
    loss: object
    shape: float
    width: float
    turning_point: float


KERNELS = {
    "welsch": Kernel(welsch_weight, welsch_loss, -math.inf, 2**-0.5, 2**-0.5),
    "geman_mcclure": Kernel(geman_mcclure_weight, geman_mcclure_loss, -2.0, 0.5, 3**-0.5),
    "cauchy": Kernel(cauchy_weight, cauchy_loss, 0.0, 2**-0.5, 1.0),
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
@pytest.mark.parametrize("scale", [1.0, 0.02, 30.0])
def test_weight_times_residual_is_the_slope_of_the_cost(kernel, scale):
    residual = (scale * RESIDUALS).requires_grad_()
    cost = 0.5 * scale**2 * kernel.loss((residual / scale).square())
    (slope,) = torch.autograd.grad(cost.sum(), residual)
    weight = kernel.weight((residual / scale).square())
    torch.testing.assert_close(weight * residual, slope, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    ("function", "at_scale", "at_three"),
    [
        (welsch_weight, math.exp(-1), math.exp(-9)),
        (welsch_loss, 1 - math.exp(-1), 1 - math.exp(-9)),
        (geman_mcclure_weight, 1 / 4, 1 / 100),
        (geman_mcclure_loss, 1 / 2, 9 / 10),
        (cauchy_weight, 1 / 2, 1 / 10),
        (cauchy_loss, math.log(2), math.log(10)),
    ],
)
def test_values_of_the_papers(function, at_scale, at_three):
    found = function(torch.tensor([1.0, 9.0], dtype=torch.float64)).tolist()
    assert found == pytest.approx([at_scale, at_three], rel=1e-14)


@every_kernel
def test_small_residuals_count_as_squares(kernel):
    square = torch.logspace(-6, -4, 9, dtype=torch.float64)
    torch.testing.assert_close(kernel.loss(square), square, rtol=1e-4, atol=0)
    torch.testing.assert_close(kernel.weight(square), torch.ones_like(square), rtol=1e-3, atol=0)
    assert kernel.loss(torch.zeros(3)).eq(0).all()
    assert kernel.weight(torch.zeros(3)).eq(1).all()


@pytest.mark.parametrize("name", ["welsch", "geman_mcclure"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_large_residuals_cost_one_at_most_and_count_nothing(name, dtype):
    far = torch.tensor([1e6, 1e12, 1e30], dtype=dtype)
    loss, weight = KERNELS[name].loss(far), KERNELS[name].weight(far)
    assert (loss <= 1).all()
    torch.testing.assert_close(loss, torch.ones_like(far), rtol=0, atol=2e-6)
    assert (weight >= 0).all()
    assert weight.max() < 1e-11


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


@every_kernel
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_type_and_shape_are_kept_and_the_argument_too(kernel, dtype):
    square = torch.rand(2, 3, 4, dtype=dtype)
    before = square.clone()
    for function in (kernel.weight, kernel.loss):
        found = function(square)
        assert found.dtype == dtype
        assert found.shape == (2, 3, 4)
        torch.testing.assert_close(found.double(), function(square.double()), rtol=1e-6, atol=1e-7)
    assert square.equal(before)


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
    generator = torch.Generator().manual_seed(0)
    inliers = 0.1 * torch.randn(300, dtype=torch.float64, generator=generator) + 2.0
    data = torch.cat([inliers, 5 + 4 * torch.rand(100, dtype=torch.float64, generator=generator)])
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
