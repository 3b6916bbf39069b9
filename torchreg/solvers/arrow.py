"""Least squares with unknowns of each row and unknowns that all rows share: an arrow-shaped Hessian."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.solvers.levenberg_marquardt import Linearization


def join_shared(rows: Linearization, own: int) -> Linearization:
    """Return the problem (S, R own + K) of groups of R rows from those of the rows (S, R, own + K), K shared."""
    gradient, hessian = rows.gradient, rows.hessian
    count = gradient.shape[1]
    index = torch.arange(count, device=hessian.device)
    blocks = hessian.new_zeros(len(hessian), count, own, count, own)
    blocks[:, index, :, index] = hessian[..., :own, :own].transpose(0, 1)
    across = hessian[..., :own, own:].flatten(1, 2)
    top = torch.cat([blocks.flatten(3, 4).flatten(1, 2), across], dim=-1)
    return Linearization(
        cost=rows.cost.sum(-1),
        gradient=torch.cat([gradient[..., :own].flatten(1), gradient[..., own:].sum(1)], dim=-1),
        hessian=torch.cat([top, torch.cat([across.mT, hessian[..., own:, own:].sum(1)], dim=-1)], dim=1),
    )


def shared_information(hessian: Tensor, own: int) -> Tensor:
    """Return what rows tell of the shared unknowns alone (..., K, K): the Schur complement of (..., own + K)."""
    across = hessian[..., :own, own:]
    found = hessian[..., own:, own:] - across.mT @ torch.linalg.solve(hessian[..., :own, :own], across)
    return 0.5 * (found + found.mT)
