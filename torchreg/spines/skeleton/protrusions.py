"""Protrusions of a surface: salient local maxima of the average geodesic distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph, minimum_spanning_forest


@dataclass(frozen=True, eq=False)
class Protrusions:
    """Tips (K,) of protrusions, most salient first, with the persistence and a confidence of 0.5 to 1 of each."""

    tips: Tensor
    heights: Tensor
    confidence: Tensor


def average_geodesic_distance(graph: Graph, areas: Tensor, num_base: int) -> tuple[Tensor, float]:
    """Return the average geodesic distances (V,) of nodes, and the largest from a base point (Hilaga et al. 2001)."""
    rows: list[Tensor] = []
    nearest = graph.distances([0])[0]
    for _ in range(min(num_base, len(graph))):
        rows.append(graph.distances([int(nearest.argmax())])[0])
        nearest = rows[0] if len(rows) == 1 else torch.minimum(nearest, rows[-1])
    distances = torch.stack(rows)
    weights = torch.bincount(distances.argmin(0), areas, minlength=len(rows))
    return weights / weights.sum() @ distances, float(distances.max())


def find_protrusions(graph: Graph, values: Tensor, least_height: float) -> Protrusions:
    """Return the local maxima of a function whose persistence exceeds a height, and at least the highest one."""
    edges = graph.edges()[0].numpy()
    peaks, basin = _basins(edges, values.numpy())
    heights = _persistence(values.numpy(), edges, peaks, basin)
    order = np.argsort(-heights, kind="stable")
    order = order[: max(1, int((heights > least_height).sum()))]
    salient = torch.from_numpy(heights[order])
    ratio = salient / least_height
    return Protrusions(torch.from_numpy(peaks[order]), salient, ratio**2 / (1 + ratio**2))


def _basins(edges: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the local maxima (P,) and, for every node (V,), the number of the one that its steepest ascent ends in."""
    count, (first, second) = len(values), edges.T
    # Equal values are ordered by their nodes' numbers, so that a plateau has one maximum.
    rank = np.empty(count, dtype=np.int64)
    rank[np.lexsort((np.arange(count), values))] = np.arange(count)
    best = rank.copy()
    np.maximum.at(best, first, rank[second])
    np.maximum.at(best, second, rank[first])
    ascent = np.argsort(rank)[best]
    while not np.array_equal(ascent[ascent], ascent):
        ascent = ascent[ascent]
    peaks = np.unique(ascent)
    return peaks, np.searchsorted(peaks, ascent)


def _persistence(values: np.ndarray, edges: np.ndarray, peaks: np.ndarray, basin: np.ndarray) -> np.ndarray:
    """Return the persistence (P,) of each peak."""
    first, second = np.sort(basin[edges], axis=1).T
    between = first < second
    passes = values[edges].min(1)
    heights = values[peaks] - values.min()
    parent = np.arange(len(peaks))

    def highest(peak: int) -> int:
        """Return the highest peak of those that are joined with a peak, by union-find with path halving."""
        while parent[peak] != peak:
            parent[peak] = peak = parent[parent[peak]]
        return int(peak)

    tree = _highest_passes(first[between], second[between], passes[between], len(peaks))
    for below, above, level in zip(*tree, strict=True):
        low, high = sorted((highest(below), highest(above)), key=lambda peak: (values[peaks[peak]], peaks[peak]))
        heights[low] = values[peaks[low]] - level
        parent[low] = high
    return heights


def _highest_passes(
    first: np.ndarray, second: np.ndarray, level: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the passes of the maximum spanning tree of the basins, highest first."""
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
