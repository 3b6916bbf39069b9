"""Protrusions of a surface: where it is farthest, on average, from everywhere else on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.graphs import Graph, minimum_spanning_forest


@dataclass(frozen=True, eq=False)
class AverageDistance:
    """How far each place of a surface is from the others on average.

    Args:
        values: (V,) average geodesic distance, in the unit of the surface.
        size: largest distance between a base point and any place.
        base: (B,) base points that stand for all others.
    """

    values: Tensor
    size: float
    base: Tensor


@dataclass(frozen=True, eq=False)
class Protrusions:
    """Tips of protrusions, most salient first.

    Args:
        tips: (K,) places.
        heights: (K,) how far each stands out: what the average distance falls by on the way to a higher tip, or for the
            highest to the lowest place; in the unit of the surface.
        confidence: (K,) from 0.5 for a tip of just the least height towards 1.
    """

    tips: Tensor
    heights: Tensor
    confidence: Tensor


def average_geodesic_distance(graph: Graph, areas: Tensor, num_base: int = 40) -> AverageDistance:
    """Return the average geodesic distance of every place from all others, by base points spread evenly.

    Base points are farthest from one another, and count by the area of the places nearest to them, so that neither
    uneven vertices nor the choice of base points shows.

    Args:
        graph: of a surface in one piece.
        areas: (V,) of surface around each place, not negative; places with none do not count.
        num_base: number of base points.

    Raises:
        InputError: if the graph is not in one piece, or has no area.

    Cost: that of ``num_base`` sources.

    References: Hilaga et al. 2001; Brostow et al. 2004, section 4.1.
    """
    check_count(num_base, "num_base", 1)
    areas = as_float_tensor(areas, "areas", like=graph.lengths)
    check_shape(areas, "areas", (len(graph),))
    if not float(areas.sum()) > 0:
        raise InputError("areas must not all be zero")
    base, rows = [], []
    nearest = graph.distances([0])[0]
    if not bool(torch.isfinite(nearest).all()):
        raise InputError("graph must be in one piece; choose pieces='largest' or 'bridge'")
    for _ in range(min(num_base, len(graph))):
        base.append(int(nearest.argmax()))
        rows.append(graph.distances(base[-1:])[0])
        nearest = rows[0] if len(base) == 1 else torch.minimum(nearest, rows[-1])
    table = torch.stack(rows)
    weights = torch.bincount(table.argmin(0), areas, minlength=len(base))
    return AverageDistance(weights / weights.sum() @ table, float(table.max()), torch.tensor(base))


def find_protrusions(graph: Graph, values: Tensor, least_height: float) -> Protrusions:
    """Return the local maxima of a function that stand out from their surroundings by some height.

    A maximum's height is its topological persistence: the least fall on a way to a higher one. Noise of some amplitude
    makes maxima of no more than twice that height, however many there are, so a threshold tells them apart.

    Args:
        graph: in one piece.
        values: (V,) at the places.
        least_height: above 0, in the unit of the values.

    Returns:
        at least the highest place.

    Raises:
        InputError: if a size does not fit or the least height is not positive.

    References: Edelsbrunner, Letscher and Zomorodian 2002.
    """
    values = as_float_tensor(values, "values", like=graph.lengths)
    check_shape(values, "values", (len(graph),))
    check_positive(least_height, "least_height")
    peaks, basin = _basins(graph, values.numpy())
    heights = _persistence(values.numpy(), graph, peaks, basin)
    order = np.argsort(-heights, kind="stable")
    order = order[: max(1, int((heights > least_height).sum()))]
    found = torch.from_numpy(heights[order])
    share = found / least_height
    return Protrusions(torch.from_numpy(peaks[order]), found, share**2 / (1 + share**2))


def _basins(graph: Graph, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the local maxima and, for every place, the one that the steepest way up ends in."""
    count = len(graph)
    starts, ends = graph.starts.numpy(), graph.ends.numpy()
    from_ = np.repeat(np.arange(count), np.diff(starts))
    # Equal values are told apart by their number, so that a plateau has one maximum.
    rank = np.empty(count, dtype=np.int64)
    rank[np.lexsort((np.arange(count), values))] = np.arange(count)
    best = rank.copy()
    np.maximum.at(best, from_, rank[ends])
    up = np.argsort(rank)[best]
    while not np.array_equal(up[up], up):
        up = up[up]
    peaks = np.unique(up)
    return peaks, np.searchsorted(peaks, up)


def _persistence(values: np.ndarray, graph: Graph, peaks: np.ndarray, basin: np.ndarray) -> np.ndarray:
    """Return the height of each peak over the pass to a higher one."""
    starts, ends = graph.starts.numpy(), graph.ends.numpy()
    from_ = np.repeat(np.arange(len(graph)), np.diff(starts))
    cross = basin[from_] < basin[ends]
    first, second = basin[from_[cross]], basin[ends[cross]]
    passes = np.minimum(values[from_[cross]], values[ends[cross]])
    heights = values[peaks] - values.min()
    owner = np.arange(len(peaks))

    def top(peak: int) -> int:
        while owner[peak] != peak:
            owner[peak] = peak = owner[owner[peak]]
        return int(peak)

    for one, other, level in zip(*_highest_passes(first, second, passes, len(peaks)), strict=True):
        low, high = sorted((top(one), top(other)), key=lambda peak: (values[peaks[peak]], peaks[peak]))
        heights[low] = values[peaks[low]] - level
        owner[low] = high
    return heights


def _highest_passes(
    first: np.ndarray, second: np.ndarray, level: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the passes, highest first, that join all basins and are as high as can be."""
    if len(first) == 0:
        return first, second, level
    order = np.lexsort((-level, first * count + second))
    keep = order[np.unique((first * count + second)[order], return_index=True)[1]]
    first, second, level = first[keep], second[keep], level[keep]
    edges = torch.from_numpy(np.stack((first, second), axis=1))
    tree = minimum_spanning_forest(edges, torch.from_numpy(-level), count).chosen().numpy()
    first, second, level = first[tree], second[tree], level[tree]
    order = np.argsort(-level, kind="stable")
    return first[order], second[order], level[order]
