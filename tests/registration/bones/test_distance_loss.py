"""The distance of matched scans against a loop, its weights, gradients and invariances."""

import math

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.distance_loss import ScanDistance


def matches(*batch, count=12, seed=0):
    generator = torch.Generator().manual_seed(seed)
    moved, targets, normals = torch.randn(3, *batch, count, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(*batch, count, generator=generator, dtype=torch.float64)
    weights = weights * (weights > 0.3)
    return moved, targets, torch.nn.functional.normalize(normals, dim=-1), weights


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_mean_is_that_of_its_definition(share):
    moved, targets, normals, weights = matches()
    total = 0.0
    for x, y, n, b in zip(moved, targets, normals, weights, strict=True):
        total += float(b) * ((1 - share) * float(n @ (x - y)) ** 2 + share * float((x - y) @ (x - y)))
    expected = total / float(weights.sum())
    assert float(ScanDistance(share)(moved, targets, normals, weights)) == pytest.approx(expected)
    plain = ScanDistance(share)(moved, targets, normals)
    assert float(plain) == pytest.approx(float(ScanDistance(share)(moved, targets, normals, torch.ones(12).double())))


def test_dropped_matches_are_never_looked_at():
    moved, targets, normals, weights = matches()
    expected = ScanDistance(0.2)(moved, targets, normals, weights)
    targets[weights == 0] = math.inf
    moved.requires_grad_()
    loss = ScanDistance(0.2)(moved, targets, normals, weights)
    assert float(loss.detach()) == pytest.approx(float(expected))
    loss.backward()
    assert bool((moved.grad[weights == 0] == 0).all())
    assert float(ScanDistance()(moved.detach(), targets, normals, torch.zeros(12).double())) == 0


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_gradients(share):
    *rest, weights = matches(2, count=3)
    inputs = tuple(value.requires_grad_() for value in (*rest, weights + 0.1))
    assert torch.autograd.gradcheck(ScanDistance(share), inputs)


def test_motions_orders_and_units():
    moved, targets, normals, weights = matches()
    loss = ScanDistance(0.1)
    expected = float(loss(moved, targets, normals, weights))
    motion = se3_exp(torch.tensor([1.0, -2, 0.3, 0.5, 1, 2], dtype=torch.float64))
    turned = normals @ motion[:3, :3].mT
    both = transform_points(motion, moved), transform_points(motion, targets)
    assert float(loss(*both, turned, weights)) == pytest.approx(expected)
    assert float(loss(10 * moved, 10 * targets, normals, weights)) == pytest.approx(100 * expected)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    assert float(loss(moved[order], targets[order], normals[order], weights[order])) == pytest.approx(expected)


def test_batches_equal_loops():
    moved, targets, normals, weights = matches(2, 3)
    found = ScanDistance(0.4)(moved, targets, normals, weights)
    assert found.shape == (2, 3)
    one = ScanDistance(0.4)(moved[1, 2], targets[1, 2], normals[1, 2], weights[1, 2])
    torch.testing.assert_close(found[1, 2], one)
    shared = ScanDistance(0.4)(moved, targets[0, 0], normals[0, 0])
    torch.testing.assert_close(shared[1, 1], ScanDistance(0.4)(moved[1, 1], targets[0, 0], normals[0, 0]))


def test_bad_input_is_named():
    moved, targets, normals, weights = matches()
    for share in (-0.1, 1.5):
        with pytest.raises(InputError, match="point_to_point must be"):
            ScanDistance(share)
    with pytest.raises(InputError, match="normals are needed"):
        ScanDistance()(moved, targets)
    with pytest.raises(InputError, match="targets must have shape"):
        ScanDistance()(moved, targets[1:], normals)
    with pytest.raises(InputError, match="match_weights must have shape"):
        ScanDistance()(moved, targets, normals, weights[1:])
    with pytest.raises(InputTypeError, match=r"moved is torch.float64 .* targets is torch.float32"):
        ScanDistance()(moved, targets.float(), normals)
    assert float(ScanDistance(1.0)(moved, moved)) == 0
    assert repr(ScanDistance(0.25)) == "ScanDistance(point_to_point=0.25)"
