"""Which points are near which: nearest neighbors, pairs within a radius, sampling distances, points at one place."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchreg._checks import check_count, check_points, check_shape
from torchreg.errors import InputError

# Entries of the table of distances held at a time.
_CHUNK_ENTRIES = 16_000_000


def nearest_neighbor(points: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Return which of ``targets`` is nearest to each of ``points``, and how far it is.

    Args:
        points: (..., N, 3).
        targets: (..., K, 3) of the same dtype and device, at least one, with batch dimensions that broadcast with the
            points'.

    Returns:
        index (..., N) int64 into the targets, and distance (..., N).

    Raises:
        InputError: if a shape, dtype or device does not fit, or there are no targets.

    Differentiable: the distance, in both, away from zero. Not under `torch.func` on a CPU.

    Cost: O((N + K) log K) per problem on a CPU with finite coordinates; O(N K) in bounded memory otherwise.

    References: Maneewongvatana and Mount 1999, the tree of `scipy.spatial.cKDTree`.
    """
    check_shape(points, "points", ("N", 3), batch=True)
    check_shape(targets, "targets", ("K", 3), batch=True)
    if targets.shape[-2] == 0:
        raise InputError("targets must hold at least one point, got none")
    if points.dtype != targets.dtype or points.device != targets.device:
        raise InputError(
            f"points are {points.dtype} on {points.device} but targets are {targets.dtype} on {targets.device}; "
            f"convert one of them with .to()"
        )
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
    size = max(1, _CHUNK_ENTRIES // max(1, len(targets) * targets.shape[-2]))
    parts = [
        torch.cdist(part, targets, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)
        for part in points.split(size, dim=-2)
    ]
    return torch.cat(parts, dim=-1)


class NeighborTree:
    """Points in any number of dimensions, to be searched again and again for those nearest to others.

    Args:
        targets: (K, D) finite, at least one.

    Raises:
        InputError: if the shape does not fit or there are none.

    Differentiable: no.

    Cost: O(K log K) to make, O(log K) per neighbor where D is small or targets are near; always on the CPU.

    References: Maneewongvatana and Mount 1999, the tree of `scipy.spatial.cKDTree`.
    """

    def __init__(self, targets: Tensor) -> None:
        check_shape(targets, "targets", ("K", "D"))
        if len(targets) == 0:
            raise InputError("targets must hold at least one point, got none")
        self._tree = cKDTree(_coordinates(targets))

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the index (N,) int64 of the target nearest to each of points (N, D), and the distance (N,) float64."""
        check_shape(points, "points", ("N", self._tree.m))
        distance, index = self._tree.query(_coordinates(points))
        return torch.from_numpy(index).to(points.device), torch.from_numpy(distance).to(points.device)

    def k_nearest(self, points: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return the ``count`` targets nearest to each point, nearest first.

        Args:
            points: (N, D) finite.
            count: how many.

        Returns:
            index (N, count) int64, and distance (N, count) float64, both on the points' device.

        Raises:
            InputError: if the shape does not fit or there are too few targets.
        """
        check_shape(points, "points", ("N", self._tree.m))
        if not 1 <= count <= self._tree.n:
            raise InputError(f"count must be between 1 and the number of targets {self._tree.n}, got {count}")
        distance, index = self._tree.query(_coordinates(points), list(range(1, count + 1)))
        return torch.from_numpy(index).to(points.device), torch.from_numpy(distance).to(points.device)


def k_nearest(points: Tensor, targets: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the ``count`` targets (K, D) nearest to each of points (N, D); see `NeighborTree.k_nearest`."""
    return NeighborTree(targets).k_nearest(points, count)


def k_nearest_others(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the nearest other points of each point, nearest first.

    Args:
        points: (N, D) finite, at least two; points at one place are zero apart.
        count: how many; N - 1 at most are returned.

    Returns:
        index (N, K) int64 and distance (N, K) float64, both on the points' device.

    Raises:
        InputError: if there are fewer than two points or ``count`` is below one.
    """
    check_shape(points, "points", ("N", "D"))
    check_count(count, "count", 1)
    if len(points) < 2:
        raise InputError(f"points must hold at least 2 point(s), got {len(points)}")
    index, distance = k_nearest(points, points, min(count + 1, len(points)))
    own = index == torch.arange(len(points), device=points.device).unsqueeze(1)
    if bool(own[:, 0].all()):
        return index[:, 1:].contiguous(), distance[:, 1:].contiguous()
    # Copies may come before a point itself, or in its stead.
    own[:, -1] |= ~own.any(1)
    return index[~own].view(len(points), -1), distance[~own].view(len(points), -1)


def pairs_within(points: Tensor, radius: float) -> Tensor:
    """Return the pairs (P, 2) int64 of points (N, D) no farther than ``radius`` apart, the lower index first."""
    check_shape(points, "points", ("N", "D"))
    pairs = cKDTree(_coordinates(points)).query_pairs(radius, output_type="ndarray")
    return torch.from_numpy(pairs).to(points.device)


def sampling_distance(points: Tensor, at: Tensor | None = None) -> float:
    """Return the median distance of a point to the nearest other one; infinite where there are no two.

    Args:
        points: (N, D) finite; points at one place are zero apart.
        at: (M, D) some of the points, the only ones that count; all by default.

    Differentiable: no.
    """
    if len(points) < 2:
        return math.inf
    return float(k_nearest(points if at is None else at, points, 2)[1][:, 1].median())


def weld(points: Tensor) -> Tensor:
    """Return a number (N,) int64 per point from 0 upward, the same for points at exactly one place."""
    values = _coordinates(points) + 0.0  # -0 is 0
    order = np.lexsort(values.T)
    changes = (np.diff(values[order], axis=0) != 0).any(axis=-1)
    if changes.all():
        return torch.arange(len(values))
    which = np.empty(len(values), dtype=np.int64)
    which[order] = np.concatenate(([0], np.cumsum(changes)))
    return torch.from_numpy(which)


def distinct_places(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the different places (M, 3), float64 on the CPU, and which (N,) of them each point is at.

    Raises:
        InputError: if a number is not finite, or there are fewer than three places.
    """
    check_points(points, "points", min_count=3, batch=False)
    places = points.detach().cpu().double()
    which = weld(places)
    count = int(which.max()) + 1
    if count < 3:
        raise InputError(f"points must lie at 3 places or more, got {len(points)} points at {count}")
    if count < len(points):
        places = places.new_zeros(count, 3).index_copy(0, which, places)
    return places, which


def _coordinates(points: Tensor) -> np.ndarray:
    values: np.ndarray = points.detach().cpu().double().numpy()
    return values
