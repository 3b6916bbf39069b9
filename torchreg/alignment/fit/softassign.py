"""One-to-one soft correspondences: SoftAssign, the symmetric rival of the E-step, with an outlier row and column."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchreg.solvers.e_step import OUTLIER_CONSTANT, EStep, chunks, gaussian_kernel

# Scaled model points stay below this, so that a datum at ten times as much coincides with none of them.
_MAX_RATIO = 1e15
# Far below any scale of points, and its reciprocal is finite.
_MIN_SIGMA = 1e-30
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
    """Return lambda_i, G_i and the total match of every datum under one-to-one soft assignment, as an E-step.

    ``m_ij = u_i exp(-|Y_j - X_i|^2 / 2 sigma^2) v_j`` is normalized in turn along rows and columns (Sinkhorn), each
    with an entry for "no partner": ``sum_j m_ij + b u_i = 1`` (b is ``model_outlier``), ``sum_i m_ij + c v_j = 1`` (c
    is ``outlier``); only b c matters. They bound u by 1 / b and v by 1 / c at any sigma. At most ``sweeps``, until a
    row's factor changes by less than ``tolerance``. Gold et al. 1998, Rangarajan et al. 1997; Dewaele et al. 2006,
    section 4.
    """
    sigma = torch.as_tensor(sigma, dtype=model.dtype, device=model.device)
    outlier = torch.as_tensor(outlier, dtype=model.dtype, device=model.device)
    offset, data_offset, center = _centered(model, data, mask)
    scaled_model, scaled_data, scale = _scaled(offset, data_offset, sigma)
    kernel = _kernel(scaled_model, scaled_data)
    rows, columns = _balanced(kernel, outlier.unsqueeze(-1), model_outlier, mask, sweeps, tolerance)
    weights = rows * _apply(kernel, columns)
    inlier = columns * _apply(kernel.mT, rows)
    moments = rows.unsqueeze(-1) * (kernel @ (columns.unsqueeze(-1) * data_offset))
    matched = (weights > torch.finfo(weights.dtype).tiny).unsqueeze(-1)
    means = torch.where(matched, moments / torch.where(matched, weights.unsqueeze(-1), 1.0), offset)
    # Where nothing matches the very point comes back, without rounding.
    targets = torch.where(matched, means + center, model)
    # sum_j m |Y - X|^2 splits into the spread of the matched data and their offset from the model point.
    squares = (inlier * scaled_data.square().sum(-1)).sum(-1) - (weights * (means * scale).square().sum(-1)).sum(-1)
    offsets = (weights * ((means - offset) * scale).square().sum(-1)).sum(-1)
    return EStep(
        weights=weights,
        targets=targets,
        inlier_posterior=inlier,
        squared_error=(squares.clamp_min(0) + offsets) / scale[..., 0, 0].square(),
    )


def _centered(model: Tensor, data: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return model and data with the origin moved to the model's mean, padding at the origin, and the mean."""
    center = model.sum(-2, keepdim=True) / max(model.shape[-2], 1)
    offset = data - center
    return model - center, offset if mask is None else torch.where(mask.unsqueeze(-1), offset, 0.0), center


def _scaled(model: Tensor, data: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the points in units of sqrt(2) sigma, and one over that unit (..., 1, 1)."""
    if model.numel() > 0:
        sigma = torch.maximum(sigma, model.detach().abs().amax((-2, -1)) / _MAX_RATIO)
    scale = (2**-0.5 / sigma.clamp_min(_MIN_SIGMA))[..., None, None]
    return model * scale, (data * scale).clamp(-10 * _MAX_RATIO, 10 * _MAX_RATIO), scale


def _kernel(model: Tensor, data: Tensor) -> Tensor:
    if torch.is_grad_enabled():
        return (model.unsqueeze(-2) - data.unsqueeze(-3)).square().sum(-1).neg().exp()
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


# A datum farther than this many sigmas from every model point is an outlier; on hands this did best of 0.75 to 4.
TRIM = 1.5


def closest_point(
    model: Tensor,
    data: Tensor,
    sigma: Tensor,
    outlier: Tensor | float = OUTLIER_CONSTANT,
    *,
    mask: Tensor | None = None,
) -> EStep:
    """Return the matches of an articulated ICP as an E-step: each datum votes for its closest model point or for none.

    It is an outlier beyond 1.5 sigma; ``outlier`` is not used, as all E-steps are called alike. Model (..., N, 3), data
    (..., M, 3) and sigma (...) in metres, mask (..., M). Besl and McKay 1992; Zhang 1994.
    """
    batch = torch.broadcast_shapes(model.shape[:-2], data.shape[:-2])
    flat, num_model, num_data = math.prod(batch), model.shape[-2], data.shape[-2]
    if num_model == 0:
        return EStep(
            weights=model.new_zeros(*batch, 0),
            targets=model.new_zeros(*batch, 0, 3),
            inlier_posterior=data.new_zeros(*batch, num_data),
            squared_error=model.new_zeros(batch),
        )
    with torch.no_grad():
        sigma = torch.as_tensor(sigma, dtype=model.dtype, device=model.device).expand(batch).reshape(flat, 1)
        model = model.expand(*batch, num_model, 3).reshape(flat, num_model, 3)
        data = data.expand(*batch, num_data, 3).reshape(flat, num_data, 3)
        # Near the origin float32 tells close points apart.
        center = model.mean(-2, keepdim=True)
        local_model, local_data = model - center, data - center
        if mask is not None:
            valid = mask.expand(*batch, num_data).reshape(flat, num_data)
            local_data = torch.where(valid.unsqueeze(-1), local_data, 0.0)
        index, distance = _closest(local_model, local_data)
        votes = (distance <= TRIM * sigma).to(model.dtype)
        if mask is not None:
            votes = votes * valid
        weights = torch.zeros_like(local_model[..., 0]).scatter_add_(-1, index, votes)
        voters = torch.where(votes.unsqueeze(-1) > 0, local_data, 0.0)
        moments = torch.zeros_like(local_model).scatter_add_(-2, index.unsqueeze(-1).expand_as(voters), voters)
        means = moments / weights.unsqueeze(-1).clamp_min(1) + center
        targets = torch.where(weights.unsqueeze(-1) > 0, means, model)
        squares = torch.where(votes > 0, distance, 0.0).square().sum(-1)
    return EStep(
        weights=weights.reshape(*batch, num_model),
        targets=targets.reshape(*batch, num_model, 3),
        inlier_posterior=votes.reshape(*batch, num_data),
        squared_error=squares.reshape(batch),
    )


def _closest(model: Tensor, data: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index of, and the distance to, the model point closest to every datum, (B, M) each."""
    index = torch.zeros_like(data[..., 0], dtype=torch.long)
    half = 0.5 * model.square().sum(-1, keepdim=True)
    for rows, columns in chunks(model.shape[0], model.shape[1], data.shape[1]):
        # |x - y|^2 without |y|^2, which is the same for all x.
        index[rows, columns] = torch.baddbmm(half[rows], model[rows], data[rows, columns].mT, alpha=-1).argmin(-2)
    nearest = model.gather(-2, index.unsqueeze(-1).expand_as(data))
    return index, torch.linalg.vector_norm(data - nearest, dim=-1)
