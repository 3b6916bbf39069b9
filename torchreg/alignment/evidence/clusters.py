"""Unexplained clusters: data off the surface as dense as those on it, as of a misplaced limb; outliers are thin."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.surface_fit import surface_noise
from torchreg.geometry.budget import BUDGET


@dataclass(frozen=True)
class OffSurface:
    """Distance from which the surface does not explain data."""

    noises: float = 3.0  # standard deviations of the noise
    share: float = 0.012  # of the model's size, at least: solids and skins are not exact

    def distance(self, noise: Tensor, size: float) -> Tensor:
        """Return the distance (...), metres, for noise (...) and a model's size in metres."""
        return (self.noises * noise).clamp_min(self.share * size)


@dataclass(frozen=True)
class ClusterThresholds:
    """Thresholds of clusters, and of the number of data in them that is worth a search."""

    neighbors: int = 5  # off the surface within the radius, at least
    radius: float = 4.0  # as a multiple of the median distance of nearest neighbors on the surface
    max_radius: float = 0.1  # as a share of the model's size
    share: float = 0.015  # of the data on the surface: more are worth a search
    min_count: int = 5  # but so many or fewer are not
    max_data: int = 2000  # per cloud, of which all pairs are compared; more are thinned


OFF_SURFACE = OffSurface()
CLUSTERS = ClusterThresholds()


def leaves_clusters(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return a mask (B,) of poses that leave unexplained clusters worth a search."""
    clustered, near = clustered_data(problem, pose)
    return clustered > (CLUSTERS.share * near).clamp_min(CLUSTERS.min_count)


def clustered_data(problem: AlignProblem, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Return the numbers of data (B,) in unexplained clusters, and on the surface."""
    return clusters_beside(problem, problem.surface.distance(problem.data, pose))


def clusters_beside(problem: AlignProblem, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the same for data at distances (B, M) from the surface."""
    stride = -(-problem.data.shape[-2] // CLUSTERS.max_data)
    if stride > 1:
        problem = problem.with_data(problem.data[:, ::stride], problem.valid[:, ::stride])
    distance = distance[:, ::stride].abs()
    limit = OFF_SURFACE.distance(surface_noise(distance, problem.valid, problem.size), problem.size)
    far = (distance > limit.unsqueeze(-1)) & problem.valid
    near = ~far & problem.valid
    clustered = far & (_far_neighbors(problem, near, far) >= CLUSTERS.neighbors)
    return clustered.sum(-1), near.sum(-1)


@torch.no_grad()
def _far_neighbors(problem: AlignProblem, near: Tensor, far: Tensor) -> Tensor:
    """Return the number of data (B, M) off the surface within the radius of clusters about each datum."""
    data, counts = problem.data, torch.zeros_like(problem.data[..., 0])
    rows = max(1, BUDGET.table_entries // data.shape[1] ** 2)
    for start in range(0, len(data), rows):
        part = slice(start, start + rows)
        squares = _squared_distances(data[part], problem.valid[part])
        squares.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
        spacing = torch.where(near[part], squares.amin(-1), torch.nan).nanmedian(-1).values.clamp_min(0).sqrt()
        radius = torch.nan_to_num(CLUSTERS.radius * spacing, nan=0.0).clamp_max(CLUSTERS.max_radius * problem.size)
        within = squares.lt_(radius.square()[:, None, None])
        torch.matmul(within, far[part].to(data).unsqueeze(-1), out=counts[part].unsqueeze(-1))
    return counts


def _squared_distances(data: Tensor, valid: Tensor) -> Tensor:
    """Return the squared distances (B, M, M) of data by one product, infinite from padding."""
    norms = data.square().sum(-1).masked_fill(~valid, torch.inf).unsqueeze(-1)
    ones = torch.ones_like(norms)
    return torch.cat([data, norms, ones], dim=-1) @ torch.cat([-2 * data, ones, norms], dim=-1).mT
