"""The nearest of a set of points: by a tree on a CPU, by exact distances elsewhere."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchreg._checks import check_shape
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
    sources = points.detach().double().numpy()
    found = [
        cKDTree(some).query(source)[1] for source, some in zip(sources, targets.detach().double().numpy(), strict=True)
    ]
    return torch.from_numpy(np.stack(found) if found else np.zeros(points.shape[:2], dtype=np.int64))


def _by_table(points: Tensor, targets: Tensor) -> Tensor:
    """Return indices (B, N), from differences of coordinates: an expanded square would round, and swap neighbors."""
    size = max(1, _CHUNK_ENTRIES // max(1, len(targets) * targets.shape[-2]))
    parts = [
        torch.cdist(part, targets, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)
        for part in points.split(size, dim=-2)
    ]
    return torch.cat(parts, dim=-1)


def nearest_few(points: Tensor, targets: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the ``count`` targets nearest to each point, nearest first, in any number of dimensions.

    Args:
        points: (N, D) finite.
        targets: (K, D) finite, at least ``count``.
        count: how many.

    Returns:
        index (N, count) int64, and distance (N, count) float64, both on the CPU.

    Raises:
        InputError: if a shape does not fit or there are too few targets.

    Differentiable: no.

    Cost: O((N + K) log K) where D is small or targets are near.
    """
    check_shape(targets, "targets", ("K", points.shape[-1]))
    if not 1 <= count <= len(targets):
        raise InputError(f"count must be between 1 and the number of targets {len(targets)}, got {count}")
    tree = cKDTree(targets.detach().cpu().double().numpy())
    distance, index = tree.query(points.detach().cpu().double().numpy(), list(range(1, count + 1)))
    return torch.from_numpy(index.astype(np.int64)), torch.from_numpy(distance)
