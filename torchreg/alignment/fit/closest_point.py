"""All-or-nothing correspondences, as in ICP: every datum votes for its closest model point."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchreg.solvers.e_step import OUTLIER_CONSTANT, EStep, chunks

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
