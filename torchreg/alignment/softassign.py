"""Who matches whom, one to one: SoftAssign, the symmetric rival of the E-step, with an outlier row and column."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.errors import InputError, InputTypeError
from torchreg.solvers.e_step import OUTLIER_CONSTANT, EStep, gaussian_kernel

# Scaled model points stay below the first, so that a datum beyond the second coincides with none of them.
_MAX_MODEL_RATIO, _MAX_DATA_RATIO = 1e15, 1e16
_MIN_SIGMA = 1e-30
# exp() of it is zero in any precision, and its gradient is finite, unlike that of minus infinity.
_NEVER = -1e4
# "No partner" of a model point. No theory gives it; a hundredth did best on hands, at 0 to 60 % outliers.
MODEL_OUTLIER = 0.01


def softassign(
    model: Tensor,
    data: Tensor,
    sigma: Tensor,
    outlier: Tensor | float = OUTLIER_CONSTANT,
    *,
    mask: Tensor | None = None,
    model_outlier: float = MODEL_OUTLIER,
    sweeps: int = 100,
    tolerance: float = 1e-3,
) -> EStep:
    """Return lambda_i, G_i and the total match of every datum under one-to-one soft assignment.

    The matrix ``m_ij = u_i exp(-|Y_j - X_i|^2 / 2 sigma^2) v_j`` is normalized in turn along its rows and its columns
    (Sinkhorn), each with one more entry for "no partner": ``sum_j m_ij + b u_i = 1`` and ``sum_i m_ij + c v_j = 1``.
    The extra row and column themselves are not normalized, since many points may have no partner. Only the product of b
    and c matters. Unlike in `expectation` a model point holds one datum at most; before the first sweep the two are the
    same. The extra entries bound u by 1 / b and v by 1 / c, so that products of plain numbers neither overflow nor
    divide by zero, at any sigma.

    Args:
        model: (..., N, 3) posed model points, metres.
        data: (..., M, 3), metres, with batch dimensions that broadcast with the model's.
        sigma: (...) metres, positive.
        outlier: (...) c, positive: the weight of "no partner" against a pair at distance zero.
        mask: (..., M) False where a datum is padding, whose coordinates are never looked at.
        model_outlier: b, positive: the same for model points.
        sweeps: normalizations of rows and columns, at most; columns come last.
        tolerance: largest relative change of a row's factor at which they end.

    Returns:
        an `EStep`, whose weights are at most one, up to the tolerance.

    Raises:
        InputError: if ``model_outlier`` is not positive, or ``sweeps`` or ``tolerance`` is negative.
        InputTypeError: if ``sweeps`` is not an integer, or another option not a number.

    Differentiable: in ``model``, ``data``, ``sigma`` and ``outlier``, through the sweeps.

    Cost: O(N M) memory, and time for each sweep.

    References: Gold et al. 1998 and Rangarajan et al. 1997, as discussed by Dewaele et al. 2006, section 4.
    """
    _check(model_outlier, sweeps, tolerance)
    sigma = torch.as_tensor(sigma, dtype=model.dtype, device=model.device)
    outlier = torch.as_tensor(outlier, dtype=model.dtype, device=model.device)
    offset, data_offset, center = _centered(model, data, mask)
    scaled_model, scaled_data, scale = _scaled(offset, data_offset, sigma)
    kernel = _kernel(scaled_model, scaled_data)
    rows, columns = _balanced(kernel, outlier.unsqueeze(-1), model_outlier, mask, sweeps, tolerance)
    weights = rows * _apply(kernel, columns)
    inlier = columns * _apply(kernel.mT, rows)
    moments = rows.unsqueeze(-1) * (kernel @ (columns.unsqueeze(-1) * data_offset))
    held = (weights > torch.finfo(weights.dtype).tiny).unsqueeze(-1)
    means = torch.where(held, moments / torch.where(held, weights.unsqueeze(-1), 1.0), offset)
    # Where nothing is held the very point comes back, without rounding.
    targets = torch.where(held, means + center, model)
    # sum_j m |Y - X|^2 splits into the spread of the held data and their offset from the model point.
    squares = (inlier * scaled_data.square().sum(-1)).sum(-1) - (weights * (means * scale).square().sum(-1)).sum(-1)
    pull = (weights * ((means - offset) * scale).square().sum(-1)).sum(-1)
    return EStep(weights, targets, inlier, (squares.clamp_min(0) + pull) / scale[..., 0, 0].square())


def assignment(
    model: Tensor,
    data: Tensor,
    sigma: Tensor,
    outlier: Tensor | float = OUTLIER_CONSTANT,
    *,
    mask: Tensor | None = None,
    model_outlier: float = MODEL_OUTLIER,
    sweeps: int = 100,
    tolerance: float = 1e-3,
) -> Tensor:
    """Return the full matrix m of `softassign`, for looking at or small problems, worked out in logarithms.

    Args:
        model: (..., N, 3), metres.
        data: (..., M, 3), metres.
        sigma: (...) metres, positive.
        outlier: (...) c, positive, however small.
        mask: (..., M) False where a datum is padding (its column is zero).
        model_outlier: b, positive, however small.
        sweeps: normalizations of rows and columns, at most; columns come last.
        tolerance: largest change of the logarithm of a row's factor at which they end.

    Returns:
        (..., N, M); the sum of a row or a column is the probability that the point has a partner.

    Raises:
        InputError: if ``model_outlier`` is not positive, or ``sweeps`` or ``tolerance`` is negative.
        InputTypeError: if ``sweeps`` is not an integer, or another option not a number.

    Differentiable: in ``model``, ``data``, ``sigma`` and ``outlier``, through the sweeps.

    Cost: O(N M) memory, and an exponential of every entry for each sweep.
    """
    _check(model_outlier, sweeps, tolerance)
    sigma = torch.as_tensor(sigma, dtype=model.dtype, device=model.device)
    level = torch.as_tensor(outlier, dtype=model.dtype, device=model.device).log().unsqueeze(-1)
    scaled_model, scaled_data, _ = _scaled(*_centered(model, data, mask)[:2], sigma)
    exponent = -_squares(scaled_model, scaled_data)
    rows = exponent.new_zeros(exponent.shape[:-1])
    columns = _log_columns(exponent, rows, level, mask)
    for _ in range(sweeps):
        before = rows
        both = (exponent + columns.unsqueeze(-2)).logsumexp(-1)
        rows = -torch.logaddexp(both, torch.full_like(both, math.log(model_outlier)))
        columns = _log_columns(exponent, rows, level, mask)
        if rows.numel() == 0 or float((before - rows).detach().abs().max()) <= tolerance:
            break
    return (exponent + rows.unsqueeze(-1) + columns.unsqueeze(-2)).exp()


def _log_columns(exponent: Tensor, rows: Tensor, level: Tensor, mask: Tensor | None) -> Tensor:
    both = (exponent + rows.unsqueeze(-1)).logsumexp(-2)
    columns = -torch.logaddexp(both, level.expand_as(both))
    return columns if mask is None else torch.where(mask, columns, _NEVER)


def _centered(model: Tensor, data: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return model and data with the origin moved to the model's mean, padding at the origin, and the mean."""
    center = model.sum(-2, keepdim=True) / max(model.shape[-2], 1)
    offset = data - center
    return model - center, offset if mask is None else torch.where(mask.unsqueeze(-1), offset, 0.0), center


def _scaled(model: Tensor, data: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the points in units of sqrt(2) sigma, and one over that unit (..., 1, 1)."""
    if model.numel() > 0:
        sigma = torch.maximum(sigma, model.detach().abs().amax((-2, -1)) / _MAX_MODEL_RATIO)
    scale = (2**-0.5 / sigma.clamp_min(_MIN_SIGMA))[..., None, None]
    return model * scale, (data * scale).clamp(-_MAX_DATA_RATIO, _MAX_DATA_RATIO), scale


def _squares(model: Tensor, data: Tensor) -> Tensor:
    return (model.unsqueeze(-2) - data.unsqueeze(-3)).square().sum(-1)


def _kernel(model: Tensor, data: Tensor) -> Tensor:
    if torch.is_grad_enabled():
        return _squares(model, data).neg().exp()
    return gaussian_kernel(model, data)


def _balanced(
    kernel: Tensor, outlier: Tensor, model_outlier: float, mask: Tensor | None, sweeps: int, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Return the factors u (..., N) of the rows and v (..., M) of the columns."""
    rows = kernel.new_ones(kernel.shape[:-1])
    columns = _columns(kernel, rows, outlier, mask)
    for _ in range(sweeps):
        before = rows
        rows = (_apply(kernel, columns) + model_outlier).reciprocal()
        columns = _columns(kernel, rows, outlier, mask)
        if rows.numel() == 0 or float((before / rows - 1).detach().abs().max()) <= tolerance:
            break
    return rows, columns


def _columns(kernel: Tensor, rows: Tensor, outlier: Tensor, mask: Tensor | None) -> Tensor:
    columns = (_apply(kernel.mT, rows) + outlier).reciprocal()
    return columns if mask is None else torch.where(mask, columns, 0.0)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _check(model_outlier: float, sweeps: int, tolerance: float) -> None:
    if isinstance(sweeps, bool) or not isinstance(sweeps, int):
        raise InputTypeError(f"sweeps must be an integer, got {type(sweeps).__name__}")
    if sweeps < 0:
        raise InputError(f"sweeps must be zero or more, got {sweeps}")
    check_positive(model_outlier, "model_outlier")
    check_positive(tolerance, "tolerance", allow_zero=True)
