"""Nearest neighbors, pairs within a radius, sampling distances, and points at one position."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchreg.geometry.budget import BUDGET


def nearest_neighbor(points: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index (..., N) of the target (..., K, 3) nearest to each point (..., N, 3), and its distance."""
    batch = points.shape[:-2]
    if batch != targets.shape[:-2]:  # broadcast_shapes is slow, and imports sympy when first called
        batch = torch.broadcast_shapes(batch, targets.shape[:-2])
    wide = targets.expand(*batch, *targets.shape[-2:])
    with torch.no_grad():
        finite = points.device.type == "cpu" and bool(torch.isfinite(points).all() & torch.isfinite(targets).all())
        if finite and math.prod(targets.shape[:-2]) == 1:
            index = _by_tree(points.reshape(1, -1, 3), targets.reshape(1, -1, 3))
        else:
            flat = points.expand(*batch, *points.shape[-2:]).reshape(-1, *points.shape[-2:])
            index = (_by_tree if finite else _by_table)(flat, wide.reshape(-1, *targets.shape[-2:]))
        index = index.reshape(*batch, points.shape[-2])
    offset = points - wide.gather(-2, index.unsqueeze(-1).expand(*index.shape, 3))
    return index, torch.linalg.vector_norm(offset, dim=-1)


def _by_tree(points: Tensor, targets: Tensor) -> Tensor:
    """Return indices (B, N), from one tree per problem."""
    problems = zip(_coordinates(points), _coordinates(targets), strict=True)
    found = [cKDTree(ends).query(starts)[1] for starts, ends in problems]
    return torch.from_numpy(np.stack(found) if found else np.zeros(points.shape[:2], dtype=np.int64))


def _by_table(points: Tensor, targets: Tensor) -> Tensor:
    """Return indices (B, N), from differences of coordinates: an expanded square would round, and swap neighbors."""
    size = max(1, BUDGET.distance_entries // max(1, len(targets) * targets.shape[-2]))
    parts = [
        torch.cdist(part, targets, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)
        for part in points.split(size, dim=-2)
    ]
    return torch.cat(parts, dim=-1)


class NeighborTree:
    """A k-d tree of targets (K, D), always on the CPU (Maneewongvatana and Mount 1999)."""

    def __init__(self, targets: Tensor) -> None:
        self._tree = cKDTree(_coordinates(targets))

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the index (N,) int64 of the target nearest to each of points (N, D), and the distance (N,) float64."""
        distance, index = self._tree.query(_coordinates(points))
        return torch.from_numpy(index).to(points.device), torch.from_numpy(distance).to(points.device)

    def nearest_within(self, points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
        """Return the result of `nearest`, but index 0 and infinity without a target within the radius."""
        distance, index = self._tree.query(_coordinates(points), distance_upper_bound=radius)
        index = np.where(np.isfinite(distance), index, 0)
        return torch.from_numpy(index).to(points.device), torch.from_numpy(distance).to(points.device)

    def k_nearest(self, points: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return the indices and distances (N, count) float64 of the targets nearest to points, nearest first."""
        distance, index = self._tree.query(_coordinates(points), list(range(1, count + 1)))
        return torch.from_numpy(index).to(points.device), torch.from_numpy(distance).to(points.device)


def k_nearest(points: Tensor, targets: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the ``count`` targets (K, D) nearest to each of points (N, D); see `NeighborTree.k_nearest`."""
    return NeighborTree(targets).k_nearest(points, count)


def k_nearest_others(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the indices and distances (N, K) of each point's nearest others, nearest first; K is N - 1 at most."""
    index, distance = k_nearest(points, points, min(count + 1, len(points)))
    is_self = index == torch.arange(len(points), device=points.device).unsqueeze(1)
    if bool(is_self[:, 0].all()):
        return index[:, 1:].contiguous(), distance[:, 1:].contiguous()
    # Copies may come before a point itself, or instead of it.
    is_self[:, -1] |= ~is_self.any(1)
    return index[~is_self].view(len(points), -1), distance[~is_self].view(len(points), -1)


def pairs_within(points: Tensor, radius: float) -> Tensor:
    """Return the pairs (P, 2) int64 of points (N, D) no farther than ``radius`` apart, the lower index first."""
    pairs = cKDTree(_coordinates(points)).query_pairs(radius, output_type="ndarray")
    return torch.from_numpy(pairs).to(points.device)


def sampling_distance(points: Tensor, subset: Tensor | None = None) -> float:
    """Return the median distance of points, or of a subset of them, to the nearest neighbor; infinite below two."""
    if len(points) < 2:
        return math.inf
    if subset is None:
        subset = points[:: max(1, len(points) // BUDGET.spacings)]
    return float(k_nearest(subset, points, 2)[1][:, 1].median())


def weld(points: Tensor) -> Tensor:
    """Return the index (N,) int64 of each point's position among the sorted distinct ones; its own if all differ."""
    values = _coordinates(points) + 0.0  # -0 is 0
    if _all_differ(values):
        return torch.arange(len(values))
    order = np.lexsort(values.T)
    changes = (np.diff(values[order], axis=0) != 0).any(axis=-1)
    if changes.all():
        return torch.arange(len(values))
    index = np.empty(len(values), dtype=np.int64)
    index[order] = np.concatenate(([0], np.cumsum(changes)))
    return torch.from_numpy(index)


def _all_differ(values: np.ndarray) -> bool:
    """Return whether no two rows (N, D) have equal hashes, wrong once in 10^7 sets of a million rows."""
    bits = np.ascontiguousarray(values).view(np.uint64)
    hashes = np.zeros(len(bits), dtype=np.uint64)
    for column in bits.T:
        hashes = (hashes ^ column) * np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: Fibonacci hashing
        hashes ^= hashes >> np.uint64(29)
    hashes.sort()
    return not bool((hashes[1:] == hashes[:-1]).any())


def distinct_positions(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct positions (M, 3) of points (N, 3), float64 on the CPU, and the index (N,) of each point's."""
    positions = points.detach().cpu().double()
    index = weld(positions)
    count = int(index.max()) + 1
    if count < len(points):
        positions = positions.new_zeros(count, 3).index_copy(0, index, positions)
    return positions, index


def _coordinates(points: Tensor) -> np.ndarray:
    values: np.ndarray = points.detach().cpu().double().numpy()
    return values
