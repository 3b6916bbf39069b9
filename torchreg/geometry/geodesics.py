"""Shortest paths along meshes and point clouds, from many sources at once."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph, sorting_order
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import k_nearest_others

# First ends, second ends and lengths of segments along a surface.
_Segments = tuple[np.ndarray, np.ndarray, np.ndarray]


class GeodesicGraph(Graph):
    """A graph whose nodes are points of a surface and whose edges run along it; from a mesh or from points."""

    @classmethod
    def from_mesh(cls, mesh: TriangleMesh) -> GeodesicGraph:
        """Return the graph of a mesh's edges and of the chords between corners that cross one or two of them.

        Chords are straight in the plane into which their triangles unfold (Polthier and Schmies 1998). Shortest paths
        along edges alone are 4 to 7 % too long on average, with the chords 1 to 2 %.
        """
        vertices, faces = mesh.vertices.detach().cpu().double().numpy(), mesh.faces.cpu().numpy()
        columns = zip(*_edges_and_chords(vertices, faces), strict=True)
        first, second, lengths = (torch.from_numpy(np.concatenate(column)) for column in columns)
        return cls.from_edges(torch.stack((first, second), dim=1), lengths, len(vertices))

    @classmethod
    def from_points(cls, points: Tensor, num_neighbors: int = 16) -> GeodesicGraph:
        """Return the graph in which every point (V, 3) is joined to its nearest neighbors."""
        index, distance = k_nearest_others(points.detach().cpu(), num_neighbors)
        edges = torch.stack((torch.arange(len(points)).repeat_interleave(num_neighbors), index.flatten()), dim=1)
        return cls.from_edges(edges, distance.flatten(), len(points))


def _edges_and_chords(vertices: np.ndarray, faces: np.ndarray) -> list[_Segments]:
    """Return the edges of triangles, and the chords that cross one and two of them."""
    if len(faces) == 0:
        return [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))]
    # Side 3 f + k of triangle f runs from its corner k to the next.
    start, end, opposite = (np.roll(faces, -shift, axis=1).reshape(-1) for shift in range(3))
    low, high = np.minimum(start, end), np.maximum(start, end)
    key = low * len(vertices) + high
    order = sorting_order(high, len(vertices))[0]
    order = order[sorting_order(low[order], len(vertices))[0]]
    shared = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    first, second = order[shared], order[shared + 1]
    once = np.delete(order, shared + 1)
    edges = (low[once], high[once], np.linalg.norm(vertices[low[once]] - vertices[high[once]], axis=1))
    beyond = np.full(len(key), -1)
    beyond[first], beyond[second] = opposite[second], opposite[first]
    return [edges, _short_chords(vertices, low[first], high[first], opposite[first], opposite[second])] + [
        _long_chords(vertices, faces, beyond.reshape(-1, 3), corner) for corner in range(3)
    ]


def _unfolded(start: np.ndarray, end: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coordinates (n,) of points along and off the lines from start to end, and the lengths of these."""
    line, offset = end - start, points - start
    length = _norms(line)
    line = line / np.where(length > 0, length, 1.0)[:, None]
    along = np.einsum("nk,nk->n", offset, line)
    return along, _norms(offset - along[:, None] * line), length


def _norms(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("nk,nk->n", vectors, vectors))


def _short_chords(
    vertices: np.ndarray, low: np.ndarray, high: np.ndarray, left: np.ndarray, right: np.ndarray
) -> _Segments:
    """Return the chords from left to right corners that cross the edges between, from low to high."""
    left_along, left_off, length = _unfolded(vertices[low], vertices[high], vertices[left])
    right_along, right_off, _ = _unfolded(vertices[low], vertices[high], vertices[right])
    inside = _crosses(left_along, left_off, right_along, right_off, length) & (left != right)
    return left[inside], right[inside], np.hypot(right_along - left_along, left_off + right_off)[inside]


def _long_chords(vertices: np.ndarray, faces: np.ndarray, beyond: np.ndarray, corner: int) -> _Segments:
    """Return the chords that cross the two sides of triangles at a corner, between the corners beyond these sides."""
    left, right = beyond[:, corner], beyond[:, (corner + 2) % 3]
    kept = (left >= 0) & (right >= 0) & (left != right)
    left, right = left[kept], right[kept]
    tip, low, high = (vertices[faces[kept, (corner + step) % 3]] for step in range(3))
    left_along, left_off, low_length = _unfolded(tip, low, vertices[left])
    right_along, right_off, high_length = _unfolded(tip, high, vertices[right])
    along, off, _ = _unfolded(tip, low, high)
    # In the plane of the triangle with x along the lower side: the direction of the higher side, and the chord's ends.
    cosine, sine = (part / np.where(high_length > 0, high_length, 1.0) for part in (along, off))
    x, y = right_along * cosine - right_off * sine, right_along * sine + right_off * cosine
    height = left_along * sine + left_off * cosine
    inside = _crosses(left_along, left_off, x, y, low_length) & (y > 0) & (height > 0)
    inside &= _crosses(left_along * cosine - left_off * sine, height, right_along, right_off, high_length)
    return left[inside], right[inside], np.hypot(x - left_along, y + left_off)[inside]


def _crosses(
    left_along: np.ndarray, left_off: np.ndarray, right_along: np.ndarray, right_off: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """Return a mask of the lines between points left and right of an edge that pass between its ends."""
    width = left_off + right_off
    along = left_along + (right_along - left_along) * left_off / np.where(width > 0, width, 1.0)
    return (width > 0) & (along > 0) & (along < length)
