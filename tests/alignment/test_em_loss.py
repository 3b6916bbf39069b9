"""The EM loss: its value by plain loops, its gradient by the posterior, and its memory."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.func import grad, hessian, jacfwd, jacrev, vmap

import torchreg as tr
from torchreg.solvers import e_step

# torch's own forward mode compiles its decompositions with a deprecated call on first use.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

D = torch.float64
OUTLIER_CONSTANT = 3 * math.sqrt(math.pi / 2)


def cloud(*shape, seed=0, dtype=D):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=D).to(dtype)


def some_mask(*shape, seed=5):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) > 0.3


def by_loops(posed, data, sigma, c):
    return -sum(math.log(sum(math.exp(-(math.dist(x, y) ** 2) / (2 * sigma**2)) for x in posed) + c) for y in data)


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(e_step, "BUDGET", replace(e_step.BUDGET, table_entries=20))


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_the_loss_is_the_negative_log_likelihood(dtype):
    posed, data = cloud(6), cloud(9, seed=1)
    expected = by_loops(posed.tolist(), data.tolist(), 0.2, OUTLIER_CONSTANT)
    loss = tr.EMLoss(0.2)(posed.to(dtype), data.to(dtype))
    assert loss.dtype == dtype
    assert loss.shape == ()
    assert float(loss) == pytest.approx(expected, rel=1e-5 if dtype == torch.float32 else 1e-12)
    assert float(tr.EMLoss(0.2, outlier=0.5)(posed, data)) == pytest.approx(
        by_loops(posed.tolist(), data.tolist(), 0.2, 0.5), rel=1e-12
    )
    assert float(tr.EMLoss(0.2, reduction="mean")(posed, data)) == pytest.approx(expected / 9, rel=1e-12)


def test_the_volume_sets_the_outlier_constant():
    posed, data = cloud(6), cloud(9, seed=1)
    box = torch.cat([posed, data])
    volume = (box.amax(0) - box.amin(0) + 6 * 0.1).prod()
    c = OUTLIER_CONSTANT * (1 - 6 * 4 / 3 * math.pi * 0.1**3 / float(volume))
    assert c < 0.992 * OUTLIER_CONSTANT
    torch.testing.assert_close(tr.EMLoss(0.1, outlier="volume")(posed, data), tr.EMLoss(0.1, outlier=c)(posed, data))


@pytest.mark.parametrize("outlier", [OUTLIER_CONSTANT, 0.3, "volume"])
def test_the_gradient_is_that_of_eq_19_at_the_posterior(outlier):
    posed, data, mask = cloud(8).requires_grad_(), cloud(11, seed=1).requires_grad_(), some_mask(11)
    sigma = 0.15
    loss = tr.EMLoss(sigma, outlier=outlier)
    in_posed, in_data = torch.autograd.grad(loss(posed, data, mask), (posed, data))
    weights, targets = loss.virtual_observations(posed, data, mask)
    torch.testing.assert_close(in_posed, weights.unsqueeze(-1) * (posed - targets).detach() / sigma**2)
    # Eq. 19 with the posterior held fixed, differentiated by autograd.
    alpha = loss.posterior(posed, data, mask).detach()
    squares = (posed.unsqueeze(-2) - data.unsqueeze(-3)).square().sum(-1)
    expected = torch.autograd.grad((alpha * squares).sum() / (2 * sigma**2), (posed, data))
    torch.testing.assert_close(in_posed, expected[0])
    torch.testing.assert_close(in_data, expected[1])
    assert in_data[~mask].eq(0).all()


@pytest.mark.parametrize("reduction", ["sum", "mean"])
@pytest.mark.usefixtures("small_chunks")
def test_every_mode_of_differentiation(reduction):
    posed, data, mask = cloud(2, 4), cloud(2, 6, seed=1), some_mask(2, 6)
    loss = tr.EMLoss(0.3, reduction=reduction)
    inputs = (posed.clone().requires_grad_(), data.clone().requires_grad_())
    assert torch.autograd.gradcheck(
        lambda x, y: loss(x, y, mask), inputs, check_forward_ad=True, check_batched_grad=True, fast_mode=True
    )
    assert torch.autograd.gradgradcheck(lambda x, y: loss(x, y, mask), inputs, fast_mode=True)
    for argument in (0, 1):
        forward, reverse = (mode(loss, argnums=argument)(posed, data, mask) for mode in (jacfwd, jacrev))
        torch.testing.assert_close(forward, reverse)
    one_by_one = vmap(grad(loss))(posed, data, mask)
    torch.testing.assert_close(one_by_one, grad(lambda x: loss(x, data, mask).sum())(posed))
    second = hessian(lambda x: loss(x, data[0]))(posed[0])
    torch.testing.assert_close(second, jacrev(jacrev(lambda x: loss(x, data[0])))(posed[0]))
    sigma = torch.tensor([0.2, 0.5], dtype=D, requires_grad=True)  # may be learned
    assert torch.autograd.gradcheck(lambda s: tr.EMLoss(s)(posed, data), sigma, check_forward_ad=True)


@settings(max_examples=15, deadline=None)
@given(st.permutations(range(5)), st.permutations(range(7)), st.floats(-100, 100), st.floats(0.01, 100))
def test_order_place_and_scale_do_not_matter(rows, columns, shift, scale):
    posed, data = cloud(5), cloud(7, seed=1)
    plain = tr.EMLoss(0.2)(posed, data)
    torch.testing.assert_close(tr.EMLoss(0.2)(posed[rows], data[columns]), plain)
    torch.testing.assert_close(tr.EMLoss(0.2)(posed + shift, data + shift), plain)
    torch.testing.assert_close(tr.EMLoss(0.2 * scale)(scale * posed, scale * data), plain)


@pytest.mark.parametrize("reduction", ["sum", "mean"])
@pytest.mark.parametrize("outlier", [OUTLIER_CONSTANT, "volume"])
@pytest.mark.parametrize("padding", [0.0, math.nan, math.inf])
def test_masking_is_removing(reduction, outlier, padding):
    posed, data, mask = cloud(5).requires_grad_(), cloud(9, seed=1), some_mask(9)
    loss = tr.EMLoss(0.2, reduction=reduction, outlier=outlier)
    padded = torch.where(mask.unsqueeze(-1), data, padding).requires_grad_()
    value, removed = loss(posed, padded, mask), loss(posed, data[mask])
    torch.testing.assert_close(value, removed)
    in_posed, in_data = torch.autograd.grad(value, (posed, padded))
    torch.testing.assert_close(in_posed, torch.autograd.grad(removed, posed)[0])
    assert in_data[~mask].eq(0).all()
    assert loss.posterior(posed, padded, mask)[:, ~mask].eq(0).all()
    nothing = loss(posed, padded, torch.zeros(9, dtype=torch.bool))
    assert nothing.item() == 0


@pytest.mark.parametrize("outlier", [OUTLIER_CONSTANT, "volume"])
def test_a_batch_is_a_loop_also_of_many_poses_on_one_cloud(outlier):
    posed, data, mask = cloud(2, 3, 5), cloud(2, 3, 7, seed=1), some_mask(2, 3, 7)
    sigma = torch.linspace(0.1, 0.5, 6, dtype=D).reshape(2, 3)
    loss = tr.EMLoss(sigma, outlier=outlier)
    functions = (lambda loss, *given: loss(*given), tr.EMLoss.posterior, tr.EMLoss.virtual_observations)
    for inputs in (
        (posed, data, mask),
        (posed, data[0, 0], mask),
        (posed[0, 0], data, mask),
        (posed, data[0], mask[0]),
    ):
        results = [function(loss, *inputs) for function in functions]
        assert results[0].shape == (2, 3)
        points, clouds, masks = (
            values.expand(2, 3, *values.shape[-rank:]) for values, rank in zip(inputs, (2, 2, 1), strict=True)
        )
        for b, k in itertools.product(range(2), range(3)):
            one = tr.EMLoss(float(sigma[b, k]), outlier=outlier)
            for result, function in zip(results, functions, strict=True):
                alone = function(one, points[b, k], clouds[b, k], masks[b, k])
                for whole, part in zip(*((x if isinstance(x, tuple) else (x,)) for x in (result, alone)), strict=True):
                    torch.testing.assert_close(whole[b, k], part)


def test_float32_is_right_far_from_the_origin():
    posed, data = (cloud(20) * 256).round() / 1024, (cloud(30, seed=1) * 256).round() / 1024
    exact = tr.EMLoss(0.01)(posed, data)
    shifted = tr.EMLoss(0.01)((posed + 1000).float(), (data + 1000).float())
    assert float(shifted) == pytest.approx(float(exact), rel=1e-4)


def test_backpropagation_keeps_no_table_of_all_pairs():
    posed, data, kept = cloud(600).requires_grad_(), cloud(600, seed=1), []
    with torch.autograd.graph.saved_tensors_hooks(
        lambda value: kept.append(value.numel()) or value, lambda value: value
    ):
        loss = tr.EMLoss(0.05)(posed, data)
    loss.backward()
    assert 0 < max(kept) < 600 * 60
    assert torch.isfinite(posed.grad).all()
