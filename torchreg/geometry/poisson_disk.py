"""Poisson-disk subsets: few of many points, as evenly spread as their surface allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchreg.geometry.neighbors import k_nearest_others, pairs_within, weld


@dataclass(frozen=True)
class _Thinning:
    """How points are thinned."""

    # Factor between the radii of successive thinnings: more neighbors in reach cost more than they save.
    growth: float = 3.0
    # Largest ratio of a subset to the wanted count at which its radius is accepted and the surplus dropped.
    surplus: float = 1.03
    # Radii tried for a count.
    max_tries: int = 10


_THINNING = _Thinning()


def poisson_disk(points: Tensor, radius: float, generator: torch.Generator | None = None) -> Tensor:
    """Return the indices (M,), ascending, of points more than ``radius`` apart that cover all points (Cook 1986)."""
    positions, index = _shuffled_positions(points, generator)
    kept = _thin(positions, np.arange(len(positions)), radius, _median_spacing(positions))
    return torch.from_numpy(np.sort(index[kept])).to(points.device)


def poisson_disk_count(points: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Return the indices (min(count, N),), ascending, of points that lie about as far apart as that many can."""
    positions, index = _shuffled_positions(points, generator)
    if count >= len(points):
        return torch.arange(len(points), device=points.device)
    if count >= len(positions):
        copies = np.setdiff1d(np.arange(len(points)), index)
        return torch.from_numpy(np.sort(np.concatenate((index, copies[: count - len(positions)])))).to(points.device)
    kept = _thin_to_count(positions, count)
    kept = _drop_surplus(positions, kept, len(kept) - count)
    return torch.from_numpy(np.sort(index[kept])).to(points.device)


def _shuffled_positions(points: Tensor, generator: torch.Generator | None) -> tuple[Tensor, np.ndarray]:
    """Return the distinct positions of points in random order, and the index of a point at each of them."""
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(points), generator=generator, device=generator.device).cpu()
    _, first = np.unique(weld(points)[order].numpy(), return_index=True)
    index = order.numpy()[np.sort(first)]
    return points.detach().cpu().double()[index], index


def _median_spacing(positions: Tensor) -> float:
    """Return the median distance of a position to its nearest neighbor, the mean of the two middle ones."""
    return float(np.median(k_nearest_others(positions, 1)[1].numpy())) if len(positions) > 1 else np.inf


def _thin(positions: Tensor, subset: np.ndarray, radius: float, spacing: float) -> np.ndarray:
    """Return those of the indices ``subset``, ascending, that thinning by radii growing from their spacing keeps."""
    steps = int(np.log(max(radius / spacing, 1.0)) / np.log(_THINNING.growth))
    for power in range(steps, -1, -1):
        subset = subset[_greedy_mask(positions[subset], radius / _THINNING.growth**power)]
    return subset


def _greedy_mask(positions: Tensor, radius: float) -> np.ndarray:
    """Return a mask of the positions kept in their order, each beyond the radius from all kept before it."""
    pairs = pairs_within(positions, radius).numpy()
    first, second = np.concatenate((pairs, pairs[:, ::-1])).T
    kept, undecided = np.zeros(len(positions), dtype=bool), np.ones(len(positions), dtype=bool)
    while undecided.any():
        best = np.full(len(positions), len(positions))
        np.minimum.at(best, first, second)
        chosen = undecided & (np.arange(len(positions)) < best)
        kept |= chosen
        undecided[chosen] = False
        undecided[first[chosen[second]]] = False
        alive = undecided[first] & undecided[second]
        first, second = first[alive], second[alive]
    return kept


def _thin_to_count(positions: Tensor, count: int) -> np.ndarray:
    """Return a thinned subset of ``count`` positions or more, hardly more if a radius is found that keeps as many."""
    spacing = _median_spacing(positions)
    radius = spacing * np.sqrt(len(positions) / count)
    start = best = np.arange(len(positions))
    lower, upper = 0.0, np.inf
    if radius > _THINNING.growth * spacing:
        # Shared by all tries below.
        thinned = _thin(positions, start, radius / _THINNING.growth, spacing)
        if len(thinned) >= count:
            start, spacing = thinned, _median_spacing(positions[thinned])
    for _ in range(_THINNING.max_tries):
        subset = _thin(positions, start, radius, spacing)
        if count <= len(subset) < len(best):
            best = subset
        if count <= len(subset) <= _THINNING.surplus * count + 1:
            break
        lower, upper = (radius, upper) if len(subset) > count else (lower, radius)
        guess = radius * np.sqrt(len(subset) / (0.5 * (1 + _THINNING.surplus) * count))
        radius = guess if lower < guess < upper else 0.5 * (lower + upper)
    return best


def _drop_surplus(positions: Tensor, subset: np.ndarray, surplus: int) -> np.ndarray:
    """Return the indices without those with the nearest neighbors, one of a pair at a time."""
    while surplus > 0:
        near, distance = (found[:, 0].numpy() for found in k_nearest_others(positions[subset], 1))
        loser = np.maximum(np.arange(len(subset)), near)
        order = loser[np.argsort(distance, kind="stable")]
        dropped = order[np.sort(np.unique(order, return_index=True)[1])]
        dropped = dropped[: min(surplus, 1 + len(subset) // 8)]
        subset = np.delete(subset, dropped)
        surplus -= len(dropped)
    return subset
