"""Argument checks: what passes, what is refused, and that the message names the argument and what came."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchreg import _checks as checks
from torchreg.errors import InputError, InputTypeError


def test_tensors_pass_and_arrays_keep_their_dtype():
    value = torch.zeros(2, dtype=torch.bool)
    assert checks.as_tensor(value, "labels", "integers") is value
    assert checks.as_tensor(np.arange(3), "labels", "integers").dtype == torch.int64
    with pytest.raises(InputTypeError, match="labels must be a tensor or an array of integers, got str"):
        checks.as_tensor("text", "labels", "integers")


def test_floating_tensors_pass_unchanged():
    value = torch.zeros(2, 3, dtype=torch.float64)
    assert checks.as_float_tensor(value, "points") is value


def test_arrays_and_lists_become_tensors():
    assert torch.equal(checks.as_float_tensor([[1, 2]], "points"), torch.tensor([[1.0, 2.0]]))
    assert checks.as_float_tensor(np.zeros(3), "points").dtype == torch.float64
    assert checks.as_float_tensor(np.arange(3), "points").dtype == torch.get_default_dtype()
    assert checks.as_float_tensor(torch.arange(3), "points").dtype == torch.get_default_dtype()


def test_the_kind_of_another_tensor_is_taken_over():
    like = torch.zeros(1, dtype=torch.float16)
    assert checks.as_float_tensor([1.0], "points", like=like).dtype == torch.float16


@pytest.mark.parametrize("value", [0.1, [0.1, 1 / 3]])
def test_numbers_of_python_keep_their_digits(value):
    found = checks.as_float_tensor(value, "points", like=torch.zeros(1, dtype=torch.float64))
    assert found.tolist() == value


def test_conversion_keeps_the_graph():
    value = torch.zeros(2, requires_grad=True)
    like = torch.zeros(1, dtype=torch.float64)
    assert checks.as_float_tensor(value, "points", like=like).requires_grad


@pytest.mark.parametrize(
    ("value", "came"),
    [
        ("text", "got str"),
        (None, "got NoneType"),
        ([[1.0], [1.0, 2.0]], "got list"),
        (torch.zeros(1, dtype=torch.complex64), "complex64"),
        ([1j], "complex64"),
        (torch.ones(2, dtype=torch.bool), "torch.bool"),
    ],
)
def test_what_is_no_real_tensor_is_refused(value, came):
    with pytest.raises(InputTypeError, match=rf"^points must .*{came}"):
        checks.as_float_tensor(value, "points")


@given(
    lead=st.lists(st.integers(1, 3), max_size=3),
    trailing=st.lists(st.integers(0, 4), min_size=1, max_size=3),
)
def test_the_right_shape_passes_with_and_without_batch(lead, trailing):
    checks.check_shape(torch.zeros(trailing), "x", trailing)
    checks.check_shape(torch.zeros(*lead, *trailing), "x", trailing, batch=True)
    checks.check_shape(torch.zeros(*lead, *trailing), "x", [None] * (len(trailing) - 1) + [trailing[-1]], batch=True)


@pytest.mark.parametrize(
    ("shape", "expected", "batch", "message"),
    [
        ((3,), ("N", 3), False, r"points must have shape \(N, 3\), got \(3,\)"),
        ((5, 2), ("N", 3), False, r"points must have shape \(N, 3\), got \(5, 2\)"),
        ((2, 5, 3), ("N", 3), False, r"points must have shape \(N, 3\), got \(2, 5, 3\)"),
        ((2, 5, 2), (None, 3), True, r"points must have shape \(\.\.\., \*, 3\), got \(2, 5, 2\)"),
        ((), ("N",), True, r"points must have shape \(\.\.\., N\), got \(\)"),
    ],
)
def test_the_wrong_shape_is_refused(shape, expected, batch, message):
    with pytest.raises(InputError, match=message):
        checks.check_shape(torch.zeros(shape), "points", expected, batch=batch)


def test_non_finite_numbers_are_counted():
    value = torch.tensor([1.0, float("nan"), float("inf"), -float("inf")])
    with pytest.raises(InputError, match=r"pose must be finite, got 3 non-finite of 4 numbers$"):
        checks.check_finite(value, "pose")
    with pytest.raises(InputError, match=r"numbers; drop them$"):
        checks.check_finite(value, "pose", "drop them")
    checks.check_finite(value[:1], "pose")
    checks.check_finite(value[:0], "pose")


def test_points():
    checks.check_points(torch.zeros(1, 3), "data")
    checks.check_points(torch.zeros(4, 2, 3), "data")
    with pytest.raises(InputError, match=r"data must have shape \(N, 3\)"):
        checks.check_points(torch.zeros(4, 2, 3), "data", batch=False)
    with pytest.raises(InputError, match=r"data must hold at least 3 point\(s\), got 2"):
        checks.check_points(torch.zeros(2, 3), "data", min_count=3)
    with pytest.raises(InputError, match=r"data must hold at least 1 point\(s\), got 0"):
        checks.check_points(torch.zeros(0, 3), "data")
    with pytest.raises(InputError, match="data must be finite, got 6"):
        checks.check_points(torch.full((2, 3), torch.nan), "data")


def test_positive_numbers():
    checks.check_positive(1e-300, "sigma")
    checks.check_positive(2, "sigma")
    checks.check_positive(np.float64(0.5), "sigma")
    checks.check_positive(0.0, "sigma", allow_zero=True)


@pytest.mark.parametrize("value", [-1, 0, 0.0, float("nan"), float("inf")])
def test_numbers_that_are_not_positive_are_refused(value):
    with pytest.raises(InputError, match="sigma must be positive and finite, got"):
        checks.check_positive(value, "sigma")


def test_a_negative_number_is_refused_where_zero_is_allowed():
    with pytest.raises(InputError, match="sigma must be zero or positive and finite, got -1"):
        checks.check_positive(-1, "sigma", allow_zero=True)


@pytest.mark.parametrize("value", [True, "1", None, 1j])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(InputTypeError, match=f"sigma must be a number, got {type(value).__name__}"):
        checks.check_positive(value, "sigma")


def test_counts():
    checks.check_count(3, "num_starts", 1)
    checks.check_count(0, "num_starts", 0)


@pytest.mark.parametrize(("value", "least"), [(0, 1), (-2, 0), (4, 5)])
def test_counts_that_are_too_low_are_refused(value, least):
    with pytest.raises(InputError, match=f"^num_starts must be at least {least}, got {value}$"):
        checks.check_count(value, "num_starts", least)


@pytest.mark.parametrize("value", [True, 2.0, "3", None, torch.tensor(2)])
def test_what_is_no_integer_is_no_count(value):
    with pytest.raises(InputTypeError, match=f"^num_starts must be an integer, got {type(value).__name__}$"):
        checks.check_count(value, "num_starts", 1)


def test_choices():
    checks.check_choice("mean", "reduction", ("mean", "sum"))
    with pytest.raises(InputError, match="reduction must be one of mean, sum; got 'max'"):
        checks.check_choice("max", "reduction", ("mean", "sum"))


def test_same_kind():
    single, double = torch.zeros(1), torch.zeros(1, dtype=torch.float64)
    checks.check_same_kind(single, "a", single, "b")
    with pytest.raises(InputTypeError, match=r"a is torch\.float32 on cpu but b is torch\.float64 on cpu"):
        checks.check_same_kind(single, "a", double, "b")
    with pytest.raises(InputTypeError, match=r"b is torch\.float32 on meta"):
        checks.check_same_kind(single, "a", single.to("meta"), "b")
