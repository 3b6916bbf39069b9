"""Samples of a scan joined along its surface: what is near on the skin, not in space."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import (
    as_float_tensor,
    as_tensor,
    check_count,
    check_finite,
    check_points,
    check_positive,
    check_shape,
)
from torchreg.errors import InputError
from torchreg.geometry.graphs import Graph, component_links, connected_components
from torchreg.geometry.neighbors import NeighborTree, distinct_positions, k_nearest_others

# A step leads across a valley where both normals lean over it by this much, in the mean: the sine of an angle.
_VALLEY = 0.2
# With a larger share of such steps between them, surroundings do not meet.
_MOST_VALLEYS = 0.3


def sample_graph(
    points: Tensor,
    samples: Tensor,
    faces: Tensor | None = None,
    *,
    normals: Tensor | None = None,
    normal_scale: float = 0.0,
    num_neighbors: int = 8,
    bridge: float | None = 3.0,
) -> Graph:
    """Return the graph of samples of a surface, joined where their surroundings meet.

    The surroundings of a sample are the points that are nearer to it than to any other sample; they meet where an edge
    leads from one to the other. Edges are those of the triangles, or without faces those between points and their
    nearest neighbors; limbs that touch in space alone are not joined by triangles. With normals, surroundings do not
    meet across a valley around which some way leads: a hand on a hip hangs on its arm alone. What does not hang
    together is bridged where it is nearest, by few and costly links.

    ``normals``: (N, 3) unit vectors that point outwards, or None: valleys do not matter. ``normal_scale``: what
    opposite normals count as when the nearest sample is looked for, in the unit of the points: it keeps apart two
    surfaces that face each other. ``bridge``: lengths of the links between parts are multiplied by this; None leaves
    the parts apart.

    References: Hoffman and Richards 1984 for parts that end in valleys, the minima rule.
    """
    check_points(points, "points", batch=False)
    samples = as_tensor(samples, "samples", "integers")
    if samples.ndim != 1 or len(samples) == 0:
        raise InputError(f"samples must be a list of at least one index, got shape {tuple(samples.shape)}")
    check_count(num_neighbors, "num_neighbors", 1)
    check_positive(normal_scale, "normal_scale", allow_zero=True)
    if bridge is not None:
        check_positive(bridge, "bridge")
    facing = None if normals is None else _checked(normals, points)
    places = points.detach().cpu().double().numpy()
    samples = samples.cpu()
    centers = places[samples.numpy()]
    if len(centers) == 1:
        return Graph.from_edges(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0), 1)
    steps = _steps_of_points(points, num_neighbors) if faces is None else _steps_of_faces(faces)
    told_apart = torch.from_numpy(
        places if facing is None else np.concatenate((places, 0.5 * normal_scale * facing), axis=1)
    )
    owner = NeighborTree(told_apart[samples]).nearest(told_apart)[0].numpy()
    valley = np.zeros(len(steps), dtype=bool) if facing is None else _across_valleys(places, facing, steps)
    edges = _around_valleys(owner[steps], len(centers), valley)
    lengths = _lengths(centers, edges)
    if bridge is not None:
        edges, lengths = _bridged(centers, edges, lengths, bridge)
    return Graph.from_edges(torch.from_numpy(edges), torch.from_numpy(lengths), len(centers))


def _steps_of_faces(faces: Tensor) -> np.ndarray:
    corners = faces.cpu().numpy()
    return np.concatenate((corners[:, :2], corners[:, 1:], corners[:, ::2]))


def _steps_of_points(points: Tensor, num_neighbors: int) -> np.ndarray:
    places, place = distinct_positions(points)
    index, _ = k_nearest_others(places, num_neighbors)
    # One point of each place, and all others of it through that one.
    one = np.zeros(len(places), dtype=np.int64)
    one[place.numpy()] = np.arange(len(place))
    start = np.repeat(one, index.shape[1])
    return np.stack((start, one[index.numpy().reshape(-1)]), axis=1)


def _checked(normals: Tensor, points: Tensor) -> np.ndarray:
    """Return unit vectors (N, 3); raise unless they fit the points."""
    normals = as_float_tensor(normals, "normals")
    check_shape(normals, "normals", tuple(points.shape))
    check_finite(normals, "normals")
    return normals.detach().cpu().double().numpy()


def _across_valleys(places: np.ndarray, normals: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return which steps (S, 2) lead across a valley, (S,)."""
    start, end = steps.T
    way = places[end] - places[start]
    lean = ((normals[start] - normals[end]) * way).sum(axis=1)
    return lean > 2 * _VALLEY * np.linalg.norm(way, axis=1)


def _around_valleys(steps: np.ndarray, count: int, valley: np.ndarray) -> np.ndarray:
    """Return the distinct edges (E, 2) that steps (S, 2) make, the smaller index first, without loops.

    Those are left out whose steps often (S,) lead across a valley, if some way leads around it.
    """
    low, high = steps.min(axis=1).astype(np.int64), steps.max(axis=1).astype(np.int64)
    apart = low != high
    key, which = np.unique((low * count + high)[apart], return_inverse=True)
    edges = np.stack((key // count, key % count), axis=1)
    across = np.bincount(which, weights=valley[apart]) > _MOST_VALLEYS * np.bincount(which)
    part = connected_components(torch.from_numpy(edges[~across]), count).numpy()
    return edges[~across | (part[edges[:, 0]] != part[edges[:, 1]])]


def _lengths(places: np.ndarray, edges: np.ndarray) -> np.ndarray:
    length: np.ndarray = np.linalg.norm(places[edges[:, 0]] - places[edges[:, 1]], axis=1)
    return length


def _bridged(places: np.ndarray, edges: np.ndarray, lengths: np.ndarray, cost: float) -> tuple[np.ndarray, np.ndarray]:
    """Return edges and lengths with each part linked to what has grown from the largest, the nearest part first."""
    part = connected_components(torch.from_numpy(edges), len(places))
    links, apart = component_links(torch.from_numpy(places), part)
    return np.concatenate((edges, links.numpy())), np.concatenate((lengths, cost * apart.numpy()))
