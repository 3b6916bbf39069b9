"""Links between the pieces of one thing that nothing connects, such as what an occlusion cut off."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

_Array = np.ndarray[Any, np.dtype[Any]]


def island_links(places: _Array, piece: _Array, count: int = 3) -> tuple[_Array, _Array]:
    """Return what links each piece to those that have grown from the largest, the nearest piece first.

    Args:
        places: (N, D) of points.
        piece: (N,) integers from 0 without gaps, the piece of each point.
        count: links of each piece, fewer if it has fewer points: from those of its points that are nearest.

    Returns:
        (L, 2) pairs of points, the smaller index first, and their distances (L,).

    Differentiable: no.

    Cost: O(N log N) for the largest piece, and what lies outside it once for every piece.
    """
    joined = piece == np.bincount(piece).argmax()
    apart, nearest = np.full(len(places), np.inf), np.zeros(len(places), dtype=np.int64)
    links, lengths, grown = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0)], np.flatnonzero(joined)
    while not joined.all():
        left = np.flatnonzero(~joined)
        distance, which = cKDTree(places[grown]).query(places[left])
        nearer = distance < apart[left]
        apart[left[nearer]], nearest[left[nearer]] = distance[nearer], grown[which[nearer]]
        grown = np.flatnonzero(piece == piece[left[apart[left].argmin()]])
        few = grown[np.argsort(apart[grown], kind="stable")[:count]]
        links.append(np.sort(np.stack((few, nearest[few]), axis=1), axis=1))
        lengths.append(apart[few])
        joined[grown] = True
    return np.concatenate(links), np.concatenate(lengths)
