"""Who matches whom, softly: the E-step with an outlier class, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

# c of eq. 18 when the matched volume is negligible beside the working volume.
OUTLIER_CONSTANT = 3 * math.sqrt(math.pi / 2)
# The bracket of eq. 18 may turn negative while n v exceeds V; it is kept from there.
_MIN_FREE_SHARE = 0.05
# Entries of the kernel matrix held at a time: in cache on a CPU, and far below 2 GB anywhere.
_CHUNK_ENTRIES = 2_000_000
# Below this ratio of extent to sigma the expanded square |x|^2 - 2 xy + |y|^2 is exact enough in float32.
_MAX_EXPANDED_RATIO = 200.0


@dataclass(frozen=True)
class EStep:
    """What the M-step needs of the posterior.

    Args:
        weights: (..., N) lambda_i, the data each model point holds.
        targets: (..., N, 3) G_i, the mean of the data it holds; the model point itself where it holds none.
        inlier_posterior: (..., M) probability that a datum belongs to any model point.
        squared_error: (...) sum over i and j of alpha_ij |Y_j - X_i|^2.
    """

    weights: Tensor
    targets: Tensor
    inlier_posterior: Tensor
    squared_error: Tensor


def outlier_constant(num_points: int, sigma: Tensor, volume: Tensor) -> Tensor:
    """Return c of eq. 18, ``3 sqrt(pi / 2) (1 - n v / V)`` with ``v = 4 pi sigma^3 / 3``.

    The bracket is kept at 0.05 or above.

    Args:
        num_points: n, the number of model points.
        sigma: (...) metres.
        volume: (...) V, the working volume, cubic metres.

    Returns:
        (...).

    References: Dewaele et al. 2006, eq. 18.
    """
    matched = num_points * 4 / 3 * math.pi * sigma**3
    return OUTLIER_CONSTANT * (1 - matched / volume).clamp_min(_MIN_FREE_SHARE)


def expectation(
    model: Tensor, data: Tensor, sigma: Tensor, outlier: Tensor | float = OUTLIER_CONSTANT, *, mask: Tensor | None = None
) -> EStep:
    """Return lambda_i, G_i and the total posterior of every datum, without storing the N x M posterior.

    ``alpha_ij = exp(-|Y_j - X_i|^2 / 2 sigma^2) / (sum_k exp(-|Y_j - X_k|^2 / 2 sigma^2) + c)``,
    ``lambda_i = sum_j alpha_ij``, ``G_i = sum_j alpha_ij Y_j / lambda_i``. All exponents are at most zero and c is
    positive, so nothing overflows, and a far outlier gets posterior 0.

    Args:
        model: (..., N, 3) posed model points, metres.
        data: (..., M, 3), metres, with batch dimensions that broadcast with the model's.
        sigma: (...) metres.
        outlier: (...) c.
        mask: (..., M) False where a datum is padding.

    Returns:
        an `EStep`.

    Differentiable: no (see `EMLoss`).

    Cost: O(N M) time, bounded memory.

    References: Dewaele et al. 2006, eqs. 17, 18, 20.
    """
    batch = torch.broadcast_shapes(model.shape[:-2], data.shape[:-2])
    model = model.expand(*batch, *model.shape[-2:]).reshape(-1, *model.shape[-2:])
    data = data.expand(*batch, *data.shape[-2:]).reshape(-1, *data.shape[-2:])
    flat = model.shape[0]
    sigma = _flat(sigma, batch, model)
    outlier = _flat(outlier, batch, model)
    valid = None if mask is None else mask.expand(*batch, mask.shape[-1]).reshape(flat, -1)
    with torch.no_grad():
        scale = (2**-0.5 / sigma)[:, None, None]
        center = data.mean(-2, keepdim=True)
        scaled_model, scaled_data = (model - center) * scale, (data - center) * scale
        weights, moments = torch.zeros_like(model[..., 0]), torch.zeros_like(model)
        inlier = torch.zeros_like(data[..., 0])
        for rows, columns in _chunks(flat, model.shape[1], data.shape[1]):
            kernel = _kernel(scaled_model[rows], scaled_data[rows, columns])
            total = kernel.sum(-2)
            share = (total + outlier[rows, None]).reciprocal()
            if valid is not None:
                share = share * valid[rows, columns]
            inlier[rows, columns] = total * share
            payload = torch.cat([torch.ones_like(total).unsqueeze(-1), scaled_data[rows, columns]], dim=-1)
            gathered = kernel @ (payload * share.unsqueeze(-1))
            weights[rows] += gathered[..., 0]
            moments[rows] += gathered[..., 1:]
        held = weights.unsqueeze(-1).clamp_min(torch.finfo(weights.dtype).tiny)
        scaled_targets = torch.where(weights.unsqueeze(-1) > 0, moments / held, scaled_model)
        targets = scaled_targets / scale + center
        # sum_j alpha |Y - X|^2 splits into the spread of the held data and their offset from the model point.
        squares = _squared_error(scaled_model, scaled_data, scaled_targets, weights, inlier) / scale[:, 0, 0].square()
    shape = (*batch,)
    return EStep(
        weights.reshape(*shape, -1), targets.reshape(*shape, -1, 3), inlier.reshape(*shape, -1), squares.reshape(shape)
    )


def posterior(
    model: Tensor, data: Tensor, sigma: Tensor, outlier: Tensor | float = OUTLIER_CONSTANT, *, mask: Tensor | None = None
) -> Tensor:
    """Return the full posterior alpha, for looking at or small problems.

    Args:
        model: (..., N, 3), metres.
        data: (..., M, 3), metres.
        sigma: (...) metres.
        outlier: (...) c.
        mask: (..., M) False where a datum is padding (its column is zero).

    Returns:
        (..., N, M); columns sum to the probability that the datum is an inlier.

    Differentiable: in ``model``, ``data`` and ``sigma``.

    Cost: O(N M) memory.

    References: Dewaele et al. 2006, eq. 17.
    """
    sigma = torch.as_tensor(sigma, dtype=model.dtype, device=model.device)
    exponent = -(model.unsqueeze(-2) - data.unsqueeze(-3)).square().sum(-1) / (2 * sigma.square())[..., None, None]
    level = torch.as_tensor(outlier, dtype=model.dtype, device=model.device).log()[..., None]
    alpha = (exponent - torch.logaddexp(exponent.logsumexp(-2), level).unsqueeze(-2)).exp()
    return alpha if mask is None else alpha * mask.unsqueeze(-2)


def _flat(value: Tensor | float, batch: torch.Size, like: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(batch).reshape(like.shape[0])


def _chunks(batch: int, num_model: int, num_data: int) -> Iterator[tuple[slice, slice]]:
    """Yield slices over batch and data that keep the kernel matrix within the chunk size."""
    per_problem = num_model * num_data
    rows = max(1, _CHUNK_ENTRIES // max(per_problem, 1))
    columns = num_data if per_problem <= _CHUNK_ENTRIES else max(1, _CHUNK_ENTRIES // num_model)
    for row in range(0, batch, rows):
        for column in range(0, num_data, columns):
            yield slice(row, row + rows), slice(column, column + columns)


def _kernel(model: Tensor, data: Tensor) -> Tensor:
    """Return ``exp(-|x - y|^2)`` (B, N, M) of scaled points."""
    if model.dtype == torch.float64 or _extent(model, data) < _MAX_EXPANDED_RATIO:
        squares = torch.baddbmm(
            model.square().sum(-1, keepdim=True) + data.square().sum(-1).unsqueeze(-2), model, data.mT, alpha=-2.0
        )
        return squares.clamp_min_(0).neg_().exp_()
    squares = (model[..., 0:1] - data[..., 0].unsqueeze(-2)).square_()
    for axis in (1, 2):
        difference = model[..., axis : axis + 1] - data[..., axis].unsqueeze(-2)
        squares.addcmul_(difference, difference)
    return squares.neg_().exp_()


def _extent(model: Tensor, data: Tensor) -> float:
    return float(torch.maximum(model.abs().max(), data.abs().max()))


def _squared_error(model: Tensor, data: Tensor, targets: Tensor, weights: Tensor, inlier: Tensor) -> Tensor:
    held_square = (inlier * data.square().sum(-1)).sum(-1)
    mean_square = (weights * targets.square().sum(-1)).sum(-1)
    offset = (weights * (targets - model).square().sum(-1)).sum(-1)
    return (held_square - mean_square).clamp_min(0) + offset
