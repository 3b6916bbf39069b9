"""The plane on which most points of a cloud lie, by random triples and least squares."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class PlaneSearch:
    """Numbers of the search."""

    num_triples: int = 200  # that are tried: of a plane with a fifth of the points, 4 in 5 searches find one
    num_refits: int = 2  # by least squares, of the points that are near


SEARCH = PlaneSearch()


def distance_to_plane(points: Tensor, counts: Tensor, band: float, generator: torch.Generator) -> Tensor:
    """Return distances (B, M) of points (B, M, 3) from the plane of most counted points (Fischler and Bolles 1981)."""
    odds = counts.cpu().double() + 1e-9
    index = torch.multinomial(odds, 3 * SEARCH.num_triples, replacement=True, generator=generator).to(points.device)
    corners = points.gather(1, index.unsqueeze(-1).expand(-1, -1, 3)).unflatten(1, (-1, 3))
    across = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normal = torch.nn.functional.normalize(across, dim=-1)
    away = points @ normal.mT - (corners[:, :, 0] * normal).sum(-1).unsqueeze(1)
    score = ((1 - (away / band).square()).clamp_min(0) * counts.unsqueeze(-1)).sum(1)
    best = (score * (across.norm(dim=-1) > band**2)).argmax(1)  # three points of one place are no plane
    away = away.gather(2, best[:, None, None].expand(-1, away.shape[1], 1))[..., 0]
    for _ in range(SEARCH.num_refits):
        near = (counts & (away.abs() < band)).to(points).unsqueeze(-1)
        local = points - (points * near).sum(1, keepdim=True) / near.sum(1, keepdim=True).clamp_min(1)
        spread = (local * near).mT @ (local * near)
        away = (local @ torch.linalg.eigh(spread).eigenvectors[..., :1])[..., 0]
    return away.abs()
