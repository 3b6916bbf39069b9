"""The E-step: soft correspondences with an outlier class, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.budget import BUDGET

# c of eq. 18 when the matched volume is negligible beside the working volume.
OUTLIER_CONSTANT = 3 * math.sqrt(math.pi / 2)


@dataclass(frozen=True)
class _Kernel:
    """Limits of the kernel's numbers."""

    # Least value of the bracket of eq. 18, which may turn negative while n v exceeds V.
    min_free_share: float = 0.05
    # Ratio of extent to sigma up to which |x|^2 - 2 xy + |y|^2 changes no exponent by more than 0.02, per precision.
    expanded_float32: float = 128.0
    expanded_float64: float = 3e6
    # Ratio of extent to sigma beyond which squares may overflow; a sigma that small holds coincident points only.
    max_ratio: float = 1e15
    # Kernel value that is negligible beside any outlier constant; smaller ones are zero.
    least: float = 1e-26


_KERNEL = _Kernel()


@dataclass(frozen=True)
class EStep:
    """Sufficient statistics of the posterior for the M-step."""

    weights: Tensor  # (..., N) lambda_i, the total posterior of the data of each model point
    targets: Tensor  # (..., N, 3) G_i, the weighted mean of its data; the model point itself if it has none
    inlier_posterior: Tensor  # (..., M) probability that a datum belongs to any model point
    squared_error: Tensor  # (...) sum over i and j of alpha_ij |Y_j - X_i|^2


def outlier_constant(num_points: int, sigma: Tensor, volume: Tensor) -> Tensor:
    """Return c of eq. 18, ``3 sqrt(pi / 2) (1 - n v / V)`` with ``v = 4 pi sigma^3 / 3``, the bracket at least 0.05."""
    matched = num_points * 4 / 3 * math.pi * sigma**3
    return OUTLIER_CONSTANT * (1 - matched / volume).clamp_min(_KERNEL.min_free_share)


def expectation(
    model: Tensor,
    data: Tensor,
    sigma: Tensor,
    outlier: Tensor | float = OUTLIER_CONSTANT,
    *,
    mask: Tensor | None = None,
) -> EStep:
    """Return the E-step of data (..., M, 3) and posed model points (..., N, 3), metres, without the N x M posterior.

    ``alpha_ij = exp(-|Y_j - X_i|^2 / 2 sigma^2) / (sum_k exp(-|Y_j - X_k|^2 / 2 sigma^2) + c)``, ``lambda_i = sum_j
    alpha_ij``, ``G_i = sum_j alpha_ij Y_j / lambda_i``. Data that the mask (..., M) excludes have posterior 0 (Dewaele
    et al. 2006, eqs. 17, 18, 20).
    """
    batch = model.shape[:-2]
    if batch != data.shape[:-2]:  # broadcast_shapes is slow, and imports sympy when first called
        batch = torch.broadcast_shapes(batch, data.shape[:-2])
    flat, num_model, num_data = math.prod(batch), model.shape[-2], data.shape[-2]
    with torch.no_grad():
        model = model.expand(*batch, num_model, 3).reshape(flat, num_model, 3)
        data = data.expand(*batch, num_data, 3).reshape(flat, num_data, 3)
        sigma, outlier = _flat(sigma, batch, model), _flat(outlier, batch, model)
        valid = None if mask is None else mask.expand(*batch, num_data).reshape(flat, num_data)
        data, center = _centered_data(data, valid)
        offset = model - center
        extent = _extent(offset, data)
        sigma = torch.maximum(sigma, extent / _KERNEL.max_ratio)
        limit = _KERNEL.expanded_float32 if model.dtype == torch.float32 else _KERNEL.expanded_float64
        expand = flat > 0 and float(extent) < limit * float(sigma.min())
        scale = (2**-0.5 / sigma)[:, None, None]
        scaled_model, scaled_data = offset * scale, _raised(data * scale)
        weights, moments, inlier = _accumulate(scaled_model, scaled_data, outlier, valid, expand)
        # G_i - X_i, zero for a model point without data.
        mass = weights.unsqueeze(-1)
        total_offset = torch.addcmul(moments, mass, scaled_model, value=-1)
        mean_offset = total_offset / mass.clamp_min(torch.finfo(model.dtype).tiny)
        targets = torch.addcdiv(model, mean_offset, scale)
        # sum_j alpha |Y - X|^2 splits into the spread of the data and their mean offset from the model point.
        spread = (inlier * scaled_data[..., 4]).sum(-1) - (moments * (scaled_model + mean_offset)).sum((-2, -1))
        squares = (spread.clamp_min(0) + (total_offset * mean_offset).sum((-2, -1))) / scale[:, 0, 0].square()
    return EStep(
        weights=weights.reshape(*batch, num_model),
        targets=targets.reshape(*batch, num_model, 3),
        inlier_posterior=inlier.reshape(*batch, num_data),
        squared_error=squares.reshape(batch),
    )


def posterior(
    model: Tensor,
    data: Tensor,
    sigma: Tensor,
    outlier: Tensor | float = OUTLIER_CONSTANT,
    *,
    mask: Tensor | None = None,
) -> Tensor:
    """Return the posterior alpha (..., N, M) of eq. 17, for small problems; columns sum to inlier probabilities."""
    sigma = torch.as_tensor(sigma, dtype=model.dtype, device=model.device)
    # Scaled before squaring: the square of a small sigma underflows.
    scale = (2**-0.5 / sigma)[..., None, None, None]
    exponent = -((model.unsqueeze(-2) - data.unsqueeze(-3)) * scale).square().sum(-1)
    level = torch.as_tensor(outlier, dtype=model.dtype, device=model.device)[..., None, None]
    alpha = responsibilities(exponent, level, dim=-2)
    return alpha if mask is None else torch.where(mask.unsqueeze(-2), alpha, 0.0)


def responsibilities(exponent: Tensor, outlier: Tensor | float, *, dim: int) -> Tensor:
    """Return ``exp(e_i) / (sum_k exp(e_k) + c)`` over the candidates of each datum along ``dim`` (eq. 17)."""
    level = torch.as_tensor(outlier, dtype=exponent.dtype, device=exponent.device).log()
    return (exponent - torch.logaddexp(exponent.logsumexp(dim, keepdim=True), level)).exp()


def working_volume(model: Tensor, data: Tensor, sigma: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return V of eq. 18 (...), the volume of the bounding box of data and model grown by 3 sigma, cubic metres."""
    low, high = data, data
    if mask is not None:
        low = torch.where(mask.unsqueeze(-1), data, torch.inf)
        high = torch.where(mask.unsqueeze(-1), data, -torch.inf)
    lowest = torch.minimum(low.amin(-2), model.amin(-2))
    highest = torch.maximum(high.amax(-2), model.amax(-2))
    return (highest - lowest + 6 * sigma.unsqueeze(-1)).prod(-1)


def _flat(value: Tensor | float, batch: torch.Size, like: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(batch).reshape(like.shape[0])


def _centered_data(data: Tensor, valid: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the data with the origin moved to their mean, padding at the origin, and the mean (B, 1, 3)."""
    if valid is None:
        center = data.sum(-2, keepdim=True) / max(data.shape[-2], 1)
        return data - center, center
    valid = valid.unsqueeze(-1)
    count = valid.sum(-2, keepdim=True).clamp_min(1)
    data = data.masked_fill(~valid, 0.0)
    center = data.sum(-2, keepdim=True) / count
    return (data - center) * valid, center


def _raised(data: Tensor) -> Tensor:
    """Return (B, M, 5): the data, one, and their squared norms, the right factor of kernel and moments."""
    return torch.cat([data, torch.ones_like(data[..., :1]), (data * data).sum(-1, keepdim=True)], dim=-1)


def _accumulate(
    model: Tensor, data: Tensor, outlier: Tensor, valid: Tensor | None, expand: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Return lambda (B, N), sum_j alpha_ij Y_j (B, N, 3) and the inlier posterior (B, M) of scaled, raised points."""
    gathered, inlier = model.new_zeros(model.shape[0], 4, model.shape[1]), torch.zeros_like(data[..., 0])
    for rows, columns in chunks(model.shape[0], model.shape[1], data.shape[1]):
        part = data[rows, columns]
        kernel = _expanded_kernel(model[rows], part) if expand else gaussian_kernel(model[rows], part[..., :3])
        total = kernel.sum(-2)
        share = (total + outlier[rows, None]).reciprocal()
        if valid is not None:
            share = share * valid[rows, columns]
        torch.mul(total, share, out=inlier[rows, columns])
        # With the data along the last dimension this product is five times as fast as with them along the first.
        payload = part[..., :4].mT * share.unsqueeze(-2)
        gathered[rows] += payload.contiguous() @ kernel.mT
    return gathered[:, 3], gathered[:, :3].mT, inlier


def chunks(batch: int, num_model: int, num_data: int) -> Iterator[tuple[slice, slice]]:
    """Yield slices over batch and data that keep the kernel matrix within the chunk size."""
    per_problem = num_model * num_data
    rows = max(1, BUDGET.table_entries // max(per_problem, 1))
    columns = max(1, num_data if per_problem <= BUDGET.table_entries else BUDGET.table_entries // num_model)
    for row in range(0, batch, rows):
        for column in range(0, num_data, columns):
            yield slice(row, row + rows), slice(column, column + columns)


def _expanded_kernel(model: Tensor, raised: Tensor) -> Tensor:
    """Return the kernel by one matrix product, ``2 xy - |x|^2 - |y|^2``: faster, and accurate near the origin only."""
    square = (model * model).sum(-1, keepdim=True)
    factor = torch.cat([2 * model, -square, -torch.ones_like(square)], dim=-1) * math.log2(math.e)
    return _power(factor @ raised.mT)


def gaussian_kernel(model: Tensor, data: Tensor) -> Tensor:
    """Return ``exp(-|x - y|^2)`` (B, N, M), zero up to 1e-26, of points (B, N or M, 3) in units of sqrt(2) sigma."""
    exponent = model[..., 0:1] - data[..., 0].unsqueeze(-2)
    exponent.mul_(exponent)
    for axis in (1, 2):
        difference = model[..., axis : axis + 1] - data[..., axis].unsqueeze(-2)
        exponent.add_(difference.mul_(difference))
    return _power(exponent.mul_(-math.log2(math.e)))


def _power(exponent: Tensor) -> Tensor:
    """Return powers of two, which cost a quarter of exp() on a CPU."""
    # A power that underflows takes many times as long, and so does arithmetic on its result.
    return torch.threshold_(exponent, math.log2(_KERNEL.least), -math.inf).exp2_()


def _extent(model: Tensor, data: Tensor) -> Tensor:
    extents = [points.abs().amax() for points in (model, data) if points.numel() > 0]
    return torch.stack(extents).amax() if extents else model.new_zeros(())
