"""Metrics against brute force, closed forms and hand-computed tables."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

import torchreg as tr

adjusted_rand, chamfer, endpoint_error = tr.metrics.adjusted_rand, tr.metrics.chamfer, tr.metrics.endpoint_error
keypoint_error, pck = tr.metrics.keypoint_error, tr.metrics.pck
InputError, InputTypeError = tr.errors.InputError, tr.errors.InputTypeError
DTYPES = [torch.float32, torch.float64]


def cloud(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def gradcheck(function, *inputs):
    return torch.autograd.gradcheck(function, [x.requires_grad_() for x in inputs])


# endpoint_error


@pytest.mark.parametrize("dtype", DTYPES)
def test_endpoint_error_of_a_known_shift(dtype):
    points = cloud(4, 7, dtype=dtype)
    error = endpoint_error(points, points + torch.tensor([3.0, 0.0, 4.0], dtype=dtype))
    assert error.shape == (4,)
    assert error.dtype == dtype
    torch.testing.assert_close(error, torch.full((4,), 5.0, dtype=dtype))


def test_endpoint_error_counts_masked_points_only():
    predicted, target = cloud(2, 5), cloud(2, 5, seed=1)
    mask = torch.tensor([[True, False, True, False, False], [False, False, False, False, True]])
    by_hand = [
        np.mean([math.dist(predicted[b, i].tolist(), target[b, i].tolist()) for i in range(5) if mask[b, i]])
        for b in range(2)
    ]
    torch.testing.assert_close(endpoint_error(predicted, target, mask), torch.tensor(by_hand, dtype=torch.float64))


def test_values_outside_the_mask_may_be_nan_and_leave_the_gradient_alone():
    predicted, target = cloud(3), cloud(3, seed=1)
    target[1] = torch.nan
    mask = torch.tensor([True, False, True])
    predicted.requires_grad_()
    endpoint_error(predicted, target, mask).backward()
    unit = (predicted - target).detach()[mask]
    torch.testing.assert_close(predicted.grad[mask], unit / unit.norm(dim=-1, keepdim=True) / 2)
    assert predicted.grad[1].tolist() == [0.0, 0.0, 0.0]


def test_endpoint_error_gradient():
    assert gradcheck(endpoint_error, cloud(2, 3), cloud(2, 3, seed=1))
    same = cloud(2).requires_grad_()
    endpoint_error(same, same.detach()).backward()
    assert torch.equal(same.grad, torch.zeros_like(same))


def test_arrays_follow_the_tensor_beside_them():
    points = cloud(3, dtype=torch.float32)
    shifted = points.double().numpy() + 1.0
    for pair in ((points, shifted), (shifted, points)):
        assert endpoint_error(*pair).dtype == torch.float32
    assert float(endpoint_error(shifted, shifted + 1.0)) == pytest.approx(math.sqrt(3))


POINTS = cloud(2, 4)
HIDDEN = torch.where(torch.arange(8).view(2, 4, 1) == 5, torch.nan, POINTS)


@pytest.mark.parametrize("metric", [endpoint_error, keypoint_error, lambda *args: pck(*args[:2], 0.1, *args[2:])])
@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ((POINTS[..., :2], POINTS), InputError, r"predicted must have shape \(\.\.\., N, 3\), got \(2, 4, 2\)"),
        ((POINTS, POINTS[0]), InputError, r"the same shape, got \(2, 4, 3\) and \(4, 3\)"),
        ((POINTS[:, :0], POINTS[:, :0]), InputError, "predicted must hold at least 1 point, got 0"),
        ((POINTS, HIDDEN), InputError, "target must be finite, got 3 non-finite of 24 numbers; leave those points out"),
        ((POINTS, POINTS, torch.ones(4) > 0), InputError, r"mask must have shape \(2, 4\), got \(4,\)"),
        ((POINTS, POINTS, torch.ones(2, 4).long()), InputTypeError, r"mask must be a bool tensor, got dtype"),
        ((POINTS, POINTS, [True]), InputTypeError, "mask must be a bool tensor, got list"),
        ((POINTS, POINTS.float()), InputTypeError, r"predicted is torch\.float64 .* but target is torch\.float32"),
        (("points", POINTS), InputTypeError, "predicted must be a tensor or an array"),
    ],
)
def test_paired_metrics_refuse_what_does_not_fit(metric, arguments, error, words):
    with pytest.raises(error, match=words):
        metric(*arguments)


def test_an_average_of_nothing_is_refused():
    points = cloud(2, 4)
    mask = torch.tensor([[True] * 4, [False] * 4])
    with pytest.raises(InputError, match="mask leaves no point to average in 1 of 2 batch entries"):
        endpoint_error(points, points, mask)
    with pytest.raises(InputError, match="mask leaves no keypoint to count in 1 of 2 batch entries"):
        pck(points, points, 0.1, mask)


# chamfer


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("chunk_size", [1, 7, 4096])
def test_chamfer_against_a_tree_search(dtype, chunk_size):
    a, b = cloud(40, dtype=dtype), cloud(23, seed=1, dtype=dtype)
    to_b = cKDTree(b.numpy()).query(a.numpy())[0].mean()
    to_a = cKDTree(a.numpy()).query(b.numpy())[0].mean()
    assert float(chamfer(a, b, chunk_size=chunk_size)) == pytest.approx((to_a + to_b) / 2, rel=1e-5)


def test_chamfer_is_plain_symmetric_and_batched():
    a, b = cloud(3, 2, 30), cloud(3, 2, 20, seed=1)
    batched = chamfer(a, b)
    assert batched.shape == (3, 2)
    torch.testing.assert_close(batched, chamfer(b, a))
    torch.testing.assert_close(batched[1, 0], chamfer(a[1, 0], b[1, 0]))
    torch.testing.assert_close(2 * batched, chamfer(2 * a, 2 * b))  # squared distances would give four times
    grid = torch.tensor(list(itertools.product(range(4), repeat=3)), dtype=torch.float64)
    torch.testing.assert_close(chamfer(grid, grid + torch.tensor([0.0, 0.0, 0.1])), torch.tensor(0.1).double())


def test_chamfer_keeps_its_digits_far_from_the_origin():
    a = cloud(50, dtype=torch.float32) + 1000
    moved = a + torch.tensor([1 / 1024, 0.0, 0.0])  # exact in float32 at this magnitude
    assert float(chamfer(a, moved)) == pytest.approx(1 / 1024, rel=1e-3)


def test_chamfer_gradient():
    assert gradcheck(chamfer, cloud(2, 4), cloud(2, 3, seed=1))
    same = cloud(3).requires_grad_()
    chamfer(same, same.detach()).backward()
    assert torch.equal(same.grad, torch.zeros_like(same))


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ((POINTS[:, :0], POINTS), InputError, r"a must hold at least 1 point\(s\), got 0"),
        ((POINTS, POINTS + torch.inf), InputError, "b must be finite"),
        ((POINTS, POINTS[0]), InputError, r"same batch dimensions, got \(2, 4, 3\) and \(4, 3\)"),
        ((POINTS, POINTS.float()), InputTypeError, r"a is torch\.float64 .* but b is torch\.float32"),
    ],
)
def test_chamfer_refuses_what_does_not_fit(arguments, error, words):
    with pytest.raises(error, match=words):
        chamfer(*arguments)
    with pytest.raises(InputError, match="chunk_size must be positive"):
        chamfer(POINTS, POINTS, chunk_size=0)


# keypoint_error and pck


def test_keypoint_error_averages_each_keypoint_over_frames():
    target = cloud(2, 3, 4)
    shift = torch.arange(4.0).double().view(4, 1) * torch.tensor([0.0, 1.0, 0.0])
    torch.testing.assert_close(keypoint_error(target + shift, target), torch.arange(4.0).double())
    torch.testing.assert_close(keypoint_error((target + shift)[0, 0], target[0, 0]), torch.arange(4.0).double())


def test_keypoint_error_of_seen_keypoints():
    target = torch.zeros(3, 2, 3)
    predicted = target.clone()
    predicted[:, 0, 0] = torch.tensor([1.0, 3.0, 100.0])
    mask = torch.tensor([[True, False], [True, False], [False, False]])
    error = keypoint_error(predicted, target, mask)
    assert float(error[0]) == 2.0
    assert math.isnan(error[1])
    assert torch.isnan(keypoint_error(predicted[0], target[0], mask[0])).tolist() == [False, True]
    assert gradcheck(keypoint_error, cloud(3, 2), cloud(3, 2, seed=1))


def test_pck_counts():
    target = torch.zeros(2, 4, 3, dtype=torch.float64)
    predicted = target.clone()
    predicted[0, :, 2] = torch.tensor([0.0, 0.5, 1.0, 1.5])
    torch.testing.assert_close(pck(predicted, target, 1.0), torch.tensor([0.75, 1.0]).double())
    mask = torch.tensor([[False, False, True, True], [False, False, False, True]])
    torch.testing.assert_close(pck(predicted, target, 1.0, mask), torch.tensor([0.5, 1.0]).double())
    with pytest.raises(InputError, match="threshold must be positive"):
        pck(predicted, target, 0.0)


# adjusted_rand


def test_adjusted_rand_of_a_table_computed_by_hand():
    # Contingency [[3, 1], [1, 2], [0, 3]]: sum C(n_ij) = 3 + 0 + 0 + 1 + 0 + 3 = 7; rows 4, 3, 3: 6 + 3 + 3 = 12;
    # columns 4, 6: 6 + 15 = 21; C(10) = 45; E = 12 * 21 / 45 = 5.6; (7 - 5.6) / (16.5 - 5.6) = 1.4 / 10.9.
    a = torch.tensor([0] * 4 + [1] * 3 + [2] * 3)
    b = torch.tensor([0, 0, 0, 1, 0, 1, 1, 1, 1, 1])
    assert adjusted_rand(a, b) == pytest.approx(1.4 / 10.9, rel=1e-12)
    assert isinstance(adjusted_rand(a, b), float)


labelings = st.integers(1, 12).flatmap(
    lambda n: st.tuples(*[st.lists(st.integers(-2, 3), min_size=n, max_size=n) for _ in range(2)])
)


@given(labelings)
def test_adjusted_rand_against_counted_pairs(pair):
    """The pair-counting form of the index: 2 (ad - bc) / ((a + b)(b + d) + (a + c)(c + d))."""
    first, second = pair
    both = only_first = only_second = neither = 0
    for i, j in itertools.combinations(range(len(first)), 2):
        same_first, same_second = first[i] == first[j], second[i] == second[j]
        both += same_first and same_second
        only_first += same_first and not same_second
        only_second += same_second and not same_first
        neither += not same_first and not same_second
    below = (both + only_first) * (only_first + neither) + (both + only_second) * (only_second + neither)
    expected = 2 * (both * neither - only_first * only_second) / below if below else 1.0
    assert adjusted_rand(torch.tensor(first), torch.tensor(second)) == pytest.approx(expected, abs=1e-12)


@given(labelings)
def test_adjusted_rand_is_symmetric_and_blind_to_names(pair):
    first, second = map(torch.tensor, pair)
    value = adjusted_rand(first, second)
    assert value == pytest.approx(adjusted_rand(second, first), abs=1e-12)
    assert value == pytest.approx(adjusted_rand(7 - 3 * first, second), abs=1e-12)
    assert adjusted_rand(first, 5 * first) == 1.0


def test_adjusted_rand_takes_lists_and_masks():
    assert adjusted_rand([0, 0, 1], np.array([5, 5, 2])) == 1.0
    assert adjusted_rand(torch.tensor([True, False]), torch.tensor([0, 1])) == 1.0


def test_adjusted_rand_refuses_what_does_not_fit():
    with pytest.raises(InputError, match="labels_a and labels_b must have the same length, got 3 and 2"):
        adjusted_rand([0, 1, 1], [0, 1])
    with pytest.raises(InputError, match="labels_a must hold at least 1 label, got 0"):
        adjusted_rand(torch.zeros(0, dtype=torch.int64), [0])
    with pytest.raises(InputError, match=r"labels_b must have shape \(N\), got \(1, 2\)"):
        adjusted_rand([0, 1], [[0, 1]])
    with pytest.raises(InputTypeError, match=r"labels_a must hold integer labels, got dtype torch\.float32"):
        adjusted_rand([0.5, 1.0], [0, 1])
    with pytest.raises(InputTypeError, match="labels_b must be a tensor or an array of integers, got str"):
        adjusted_rand([0], "a")
