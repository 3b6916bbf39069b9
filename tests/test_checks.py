"""Argument checks: what passes, what is refused, and that the message names the argument and what came."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import torchreg as tr
from torchreg import _checks as checks

InputError, InputTypeError = tr.errors.InputError, tr.errors.InputTypeError
ONE = torch.zeros(1)
SHAPES = [
    ((3,), ("N", 3), False, r"points must have shape \(N, 3\), got \(3,\)"),
    ((5, 2), ("N", 3), False, r"points must have shape \(N, 3\), got \(5, 2\)"),
    ((2, 5, 3), ("N", 3), False, r"points must have shape \(N, 3\), got \(2, 5, 3\)"),
    ((2, 5, 2), (None, 3), True, r"points must have shape \(\.\.\., \*, 3\), got \(2, 5, 2\)"),
    ((), ("N",), True, r"points must have shape \(\.\.\., N\), got \(\)"),
]
NOT_REAL = [
    ("text", "got str"), (None, "got NoneType"), ([[1.0], [1.0, 2.0]], "got list"), ([1j], "complex64"),
    (torch.zeros(1, dtype=torch.complex64), "complex64"), (torch.ones(2, dtype=torch.bool), "torch.bool"),
]  # fmt: skip
REFUSED = [
    *((checks.as_float_tensor, (value, "points"), InputTypeError, f"^points must .*{came}")
      for value, came in NOT_REAL),
    *((partial(checks.check_shape, batch=batch), (torch.zeros(shape), "points", expected), InputError, words)
      for shape, expected, batch, words in SHAPES),
    *((checks.check_positive, (value, "sigma"), InputError, "sigma must be positive and finite, got")
      for value in (-1, 0, 0.0, math.nan, math.inf)),
    *((checks.check_positive, (value, "sigma"), InputTypeError, f"sigma must be a number, got {type(value).__name__}")
      for value in (True, "1", None, 1j)),
    *((checks.check_count, (value, "num", least), InputError, f"^num must be at least {least}, got {value}$")
      for value, least in ((0, 1), (-2, 0), (4, 5))),
    *((checks.check_count, (value, "num", 1), InputTypeError, f"^num must be an integer, got {type(value).__name__}$")
      for value in (True, 2.0, "3", None, torch.tensor(2))),
    (checks.as_tensor, ("text", "labels", "integers"), InputTypeError, "labels must be a tensor .* integers, got str"),
    (checks.check_finite, (torch.tensor([1.0, math.nan, -math.inf]), "pose"), InputError, "got 2 non-finite of 3"),
    (checks.check_finite, (ONE / 0, "pose", "drop them"), InputError, r"numbers; drop them$"),
    (partial(checks.check_points, batch=False), (torch.zeros(4, 2, 3), "data"), InputError, r"must have shape \(N, 3"),
    (partial(checks.check_points, min_count=3), (torch.zeros(2, 3), "data"), InputError, r"least 3 point\(s\), got 2"),
    (checks.check_points, (torch.zeros(0, 3), "data"), InputError, r"data must hold at least 1 point\(s\), got 0"),
    (checks.check_points, (torch.full((2, 3), math.nan), "data"), InputError, "data must be finite, got 6"),
    (partial(checks.check_positive, allow_zero=True), (-1, "sigma"), InputError, "must be zero or positive and finite"),
    (checks.check_choice, ("max", "way", ("mean", "sum")), InputError, "way must be one of mean, sum; got 'max'"),
    (checks.check_same_kind, (ONE, "a", ONE.double(), "b"), InputTypeError, "float32 .* but b is torch.float64"),
    (checks.check_same_kind, (ONE, "a", ONE.to("meta"), "b"), InputTypeError, r"b is torch\.float32 on meta"),
]  # fmt: skip


@pytest.mark.parametrize(("check", "arguments", "error", "words"), REFUSED)
def test_what_does_not_fit_is_refused_by_name(check, arguments, error, words):
    with pytest.raises(error, match=words):
        check(*arguments)


def test_what_fits_passes():
    checks.check_finite(ONE[:0], "pose")
    checks.check_points(torch.zeros(1, 3), "data")
    checks.check_points(torch.zeros(4, 2, 3), "data")
    for value in (1e-300, 2, np.float64(0.5)):
        checks.check_positive(value, "sigma")
    checks.check_positive(0.0, "sigma", allow_zero=True)
    checks.check_count(3, "num_starts", 1)
    checks.check_count(0, "num_starts", 0)
    checks.check_choice("mean", "reduction", ("mean", "sum"))
    checks.check_same_kind(ONE, "a", ONE, "b")


@given(lead=st.lists(st.integers(1, 3), max_size=3), trailing=st.lists(st.integers(0, 4), min_size=1, max_size=3))
def test_the_right_shape_passes_with_and_without_batch(lead, trailing):
    checks.check_shape(torch.zeros(trailing), "x", trailing)
    checks.check_shape(torch.zeros(*lead, *trailing), "x", trailing, batch=True)
    checks.check_shape(torch.zeros(*lead, *trailing), "x", [None] * (len(trailing) - 1) + [trailing[-1]], batch=True)


def test_tensors_pass_unchanged_and_arrays_lists_and_numbers_become_tensors():
    value, double = torch.zeros(2, dtype=torch.bool), torch.zeros(1, dtype=torch.float64)
    assert checks.as_tensor(value, "labels", "integers") is value
    assert checks.as_tensor(np.arange(3), "labels", "integers").dtype == torch.int64
    assert checks.as_float_tensor(double, "points") is double
    assert torch.equal(checks.as_float_tensor([[1, 2]], "points"), torch.tensor([[1.0, 2.0]]))
    assert checks.as_float_tensor(np.zeros(3), "points").dtype == torch.float64
    for integers in (np.arange(3), torch.arange(3)):
        assert checks.as_float_tensor(integers, "points").dtype == torch.get_default_dtype()
    assert checks.as_float_tensor([1.0], "points", like=torch.zeros(1, dtype=torch.float16)).dtype == torch.float16
    for number in (0.1, [0.1, 1 / 3]):  # numbers of Python keep their digits
        assert checks.as_float_tensor(number, "points", like=double).tolist() == number
    assert checks.as_float_tensor(torch.zeros(2, requires_grad=True), "points", like=double).requires_grad
