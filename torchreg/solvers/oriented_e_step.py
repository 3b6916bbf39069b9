"""The E-step of oriented points: soft correspondences by position and normal, with an outlier class."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.solvers.e_step import EStep

# Concentration kappa of the law of normals: they differ by 35 degrees or so, as those of points of one limb do.
CONCENTRATION = 3.0


def oriented_expectation(
    model: Tensor, data: Tensor, sigma: Tensor, outlier: Tensor | float, *, mask: Tensor | None = None
) -> EStep:
    """Return the E-step of positions and unit normals, (B, N, 6) of the model and (B, M, 6) of data, in O(N M) memory.

    ``alpha_ij ~ exp(-|Y_j - X_i|^2 / 2 sigma^2 + kappa (m_j . n_i - |m_j|))``: normals differ by a von Mises-Fisher law
    (Mardia and Jupp 2000), so that a wide kernel ignores the far side of a limb. Unknown normals m are zero.
    """
    model, model_normals = model.split(3, dim=-1)
    data, data_normals = data.split(3, dim=-1)
    with torch.no_grad():
        center = data.mean(-2, keepdim=True)
        scale = sigma.reciprocal()[:, None, None]
        x, y = (model - center) * scale, (data - center) * scale
        squares = x.square().sum(-1).unsqueeze(-1) + y.square().sum(-1).unsqueeze(-2) - 2 * x @ y.mT
        unlike = data_normals.norm(dim=-1).unsqueeze(-2) - model_normals @ data_normals.mT
        kernel = (-0.5 * squares.clamp_min(0) - CONCENTRATION * unlike).exp()
        if mask is not None:
            kernel = torch.where(mask.unsqueeze(-2), kernel, 0.0)
        constant = torch.as_tensor(outlier, dtype=model.dtype, device=model.device).reshape(-1, 1, 1)
        alpha = kernel / (kernel.sum(-2, keepdim=True) + constant)
        weights = alpha.sum(-1)
        mass = weights.unsqueeze(-1).clamp_min(torch.finfo(model.dtype).tiny)
        offset = (alpha @ y - weights.unsqueeze(-1) * x) / mass
        targets = model + offset / scale
        squared_error = (alpha * squares.clamp_min(0)).sum((-2, -1)) * sigma.square()
    return EStep(
        weights=weights, targets=targets, inlier_posterior=alpha.sum(-2), squared_error=squared_error
    )  # fmt: skip
