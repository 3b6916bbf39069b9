"""Normals of scanned surfaces: estimated from neighbors or faces, and turned to one side."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_shape
from torchreg.errors import InputError
from torchreg.geometry.graphs import minimum_spanning_forest
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import distinct_places, k_nearest, k_nearest_others

_LEAST_WEIGHT = 1e-3
# Points of the coarse copy that tells bulges from hollows, and their neighbors.
_COARSE_POINTS, _COARSE_NEIGHBORS = 2000, 12
# A scan counts as taken from one side when this share of its normals looks there.
_ONE_SIDED = 0.97
# Cosine beyond which a normal that looks away from a known camera is turned; nearer to 90 degrees it may be noise.
_AWAY = -0.25
# Share of the length of all normals that their sum must have to point to a camera.
_LOOKING = 0.2
# Least spread of normals, and distance of a plane from the origin, that tell the outside from the inside.
_FLAT = 5e-3
# Share of a component's area whose winding decides about the rest.
_MAJORITY = 0.75


def estimate_normals(points: Tensor, *, viewpoint: Tensor | None = None, num_neighbors: int = 16) -> Tensor:
    """Return the unit normals of a surface known by points alone, turned to one side.

    Each normal is the direction in which the point's nearest neighbors spread least, the nearer weighing more; the
    sides are told as by `orient_normals`.

    Args:
        points: (N, 3), any unit; points at one place share a normal.
        viewpoint: (3,) where the camera was; None if that is not known.
        num_neighbors: that a normal is fitted to; more of them smooth noise, and edges too.

    Returns:
        (N, 3), of the dtype and device of the points.

    Raises:
        InputError: if there are fewer than three different places, or a number is not finite.

    Differentiable: no.

    Cost: 0.15 s for 20,000 points.

    References: Hoppe et al., "Surface reconstruction from unorganized points", 1992.
    """
    points = as_float_tensor(points, "points")
    places, which = distinct_places(points)
    index, _ = k_nearest_others(places, num_neighbors)
    normals = orient_along_graph(places, fit_normals(places, index), index, check_viewpoint(viewpoint))
    return normals[which].to(points)


def orient_normals(
    points: Tensor, normals: Tensor, *, viewpoint: Tensor | None = None, num_neighbors: int = 16
) -> Tensor:
    """Return the normals with signs that agree from neighbor to neighbor and look to where the scan was taken from.

    Signs spread along the minimum spanning tree of the neighbor graph, which crosses sharp edges last. Each connected
    part then turns to the viewpoint; if that is not known, the largest part turns such that it bulges, as what a camera
    sees of a body does, and the others look to the same side. What is as flat as a plane turns to the origin.

    Args:
        points: (N, 3), any unit.
        normals: (N, 3) of any sign.
        viewpoint: (3,) where the camera was; None if that is not known.
        num_neighbors: edges of each point in the graph.

    Returns:
        (N, 3), each the given normal or its opposite; at one place all follow the first.

    Raises:
        InputError: if there are fewer than three different places, or a number is not finite.

    Differentiable: no.

    References: Hoppe et al., "Surface reconstruction from unorganized points", 1992, section 3.3.
    """
    points = as_float_tensor(points, "points")
    normals = as_float_tensor(normals, "normals", like=points)
    check_shape(normals, "normals", tuple(points.shape))
    places, which = distinct_places(points)
    first = torch.full((len(places),), len(points)).scatter_reduce(0, which, torch.arange(len(points)), "amin")
    guide = normals.detach().cpu().double()[first]
    index, _ = k_nearest_others(places, num_neighbors)
    turned = orient_along_graph(places, guide, index, check_viewpoint(viewpoint))
    turn = (turned[which] * normals.detach().cpu().double()).sum(-1, keepdim=True) < 0
    return torch.where(turn.to(points.device), -normals, normals)


def fit_normals(points: Tensor, index: Tensor) -> Tensor:
    """Return unit normals (N, 3) of either sign: the direction in which each point's neighbors (N, K) spread least."""
    return _least_spread(torch.cat((points[:, None], points[index]), dim=1))


def _least_spread(around: Tensor) -> Tensor:
    """Return unit normals (N, 3) to points (N, K, 3), of which the first is the one that the normal is at."""
    around = around - around[:, :1]
    # Squares of tiny lengths underflow.
    around = around / around.abs().amax(dim=(1, 2), keepdim=True)
    # The farthest weigh next to nothing, so that it does not matter which of two equally far ones was found.
    square = around.square().sum(dim=-1)
    weight = (1 - square / square.amax(dim=-1, keepdim=True) + _LEAST_WEIGHT)[..., None]
    around = around - (weight * around).sum(dim=1, keepdim=True) / weight.sum(dim=1, keepdim=True)
    return torch.linalg.eigh(around.mT @ (weight * around)).eigenvectors[..., 0]


def check_viewpoint(viewpoint: Any) -> Tensor | None:
    """Return a viewpoint (3,) as float64 on the CPU, or None; InputError unless it is three finite numbers."""
    if viewpoint is None:
        return None
    viewpoint = as_float_tensor(viewpoint, "viewpoint").detach().cpu().double()
    check_shape(viewpoint, "viewpoint", (3,))
    if not bool(viewpoint.isfinite().all()):
        raise InputError(f"viewpoint must be finite, got {viewpoint.tolist()}; pass None if it is not known")
    return viewpoint


def fit_normals_at(points: Tensor, at: Tensor, num_neighbors: int = 16) -> Tensor:
    """Return unit normals (M, 3) of either sign at a few of the points (N, 3), given by their indices (M,)."""
    places, which = distinct_places(points)
    near, _ = k_nearest(places[which[at.cpu()]], places, min(num_neighbors + 1, len(places)))
    return _least_spread(places[near]).to(points)


def face_vertex_normals(points: Tensor, faces: Tensor, viewpoint: Tensor | None = None) -> Tensor:
    """Return unit normals (N, 3) at the points of a surface of triangles, zero where no face has an area.

    Triangles wound against their neighbors count as turned. A connected part keeps the winding of three quarters of its
    area or more; where there is none, or a viewpoint is known, it turns to the camera as points do.

    Args:
        points: (N, 3) float64, no two at one place.
        faces: (F, 3) indices, no two equal in a row.
        viewpoint: (3,) float64 or None.
    """
    pairs, agree = _adjacent_faces(faces, len(points))
    if viewpoint is None and bool(agree.all()):
        return TriangleMesh(points, faces).vertex_normals()
    key, which, shared = (pairs @ pairs.new_tensor([len(faces), 1])).unique(return_inverse=True, return_counts=True)
    pairs = torch.stack((key // len(faces), key % len(faces)), dim=-1)
    opposed = _sums((~agree).double(), which, len(pairs)) > 0
    parents, edge, label = minimum_spanning_forest(pairs, shared, len(faces))
    steps = torch.where((parents >= 0) & opposed[edge], -1.0, 1.0).double()
    sign = _products_to_root(parents, steps)
    areas = TriangleMesh(points, faces).face_areas()
    areas = areas / areas.mean().clamp(min=torch.finfo(areas.dtype).tiny)
    side = _sums(areas * sign, label)
    weak = side.abs() < (2 * _MAJORITY - 1) * _sums(areas, label) if viewpoint is None else torch.ones_like(side) > 0
    if bool(weak.any()):
        normals = TriangleMesh(points, faces).face_normals() * (sign * areas)[:, None]
        side = torch.where(weak, _sides(points[faces].mean(dim=1), normals, label, viewpoint), side)
    turned = torch.where((sign * side[label] < 0)[:, None], faces.flip(-1), faces)
    return TriangleMesh(points, turned).vertex_normals()


def _adjacent_faces(faces: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return pairs (E, 2) of faces across the edges that two faces share, and whether their windings agree (E,)."""
    start, end = faces.reshape(-1), faces.roll(-1, dims=1).reshape(-1)
    key, order = (torch.minimum(start, end) * count + torch.maximum(start, end)).sort(stable=True)
    same = torch.cat((key.new_zeros(1), (key[1:] == key[:-1]).long(), key.new_zeros(1)))
    first = ((same[:-1] == 0) & (same[1:] == 1)).nonzero()[:, 0]
    # Edges of three faces or more do not tell which of them belong together.
    first = first[torch.cat((same, same.new_zeros(1)))[first + 2] == 0]
    left, right = order[first], order[first + 1]
    return torch.stack((left // 3, right // 3), dim=-1), start[left] != start[right]


def neighbors_disagree(normals: Tensor, index: Tensor) -> float:
    """Return the share of points whose normal opposes that of their nearest neighbor; 0.5 for signs at random."""
    return float(((normals * normals[index[:, 0]]).sum(-1) < 0).double().mean())


def orient_along_graph(points: Tensor, normals: Tensor, index: Tensor, viewpoint: Tensor | None) -> Tensor:
    """Return normals with signs by spanning tree and camera; points (N, 3), normals, neighbors (N, K), on the CPU."""
    count, width = index.shape
    edges = torch.stack((torch.arange(count).repeat_interleave(width), index.flatten()), dim=-1)
    cost = 1 - (normals[:, None] * normals[index]).sum(-1).abs().clamp(max=1)
    parents, _, label = minimum_spanning_forest(edges, cost.flatten(), count)
    agree = (normals * normals[parents]).sum(-1)
    steps = torch.where((parents >= 0) & (agree < 0), -1.0, 1.0).to(normals)
    normals = normals * _products_to_root(parents, steps)[:, None]
    normals = normals * _sides(points, normals, label, viewpoint)[label][:, None]
    if viewpoint is None:
        view = torch.nn.functional.normalize(normals.mean(dim=0), dim=0).expand_as(normals)
        facing = float(((normals * view).sum(-1) > 0).double().mean())
        if facing < _ONE_SIDED:
            return normals
    else:
        view = torch.nn.functional.normalize(viewpoint - points, dim=-1)
    away = (normals * view).sum(-1) < _AWAY
    return torch.where(away[:, None], -normals, normals)


def _products_to_root(parents: Tensor, steps: Tensor) -> Tensor:
    """Return for each node the product of the steps from it up to its root, whose own step is 1."""
    above = torch.where(parents < 0, torch.arange(len(parents)), parents)
    product = steps.clone()
    while True:
        product = product * product[above]
        higher = above[above]
        if torch.equal(higher, above):
            return product
        above = higher


def _sides(points: Tensor, normals: Tensor, label: Tensor, viewpoint: Tensor | None) -> Tensor:
    """Return +1 or -1 per label (C,): the sign that turns its normals to the viewpoint or the likely camera."""
    if viewpoint is not None:
        return _signs(_sums((normals * (viewpoint - points)).sum(-1), label))
    total = torch.stack([_sums(part, label) for part in normals.unbind(-1)], dim=-1)
    own = _bulging(points, normals, label)
    size = _sums(normals.norm(dim=-1), label)
    main = int(size.argmax())
    camera = total[main] * own[main]
    strength = camera.norm()
    if not float(strength) > _LOOKING * float(size[main]):
        return own
    seen = total @ (camera / strength)
    return torch.where(seen.abs() > _LOOKING * size, _signs(seen), own)


def _bulging(points: Tensor, normals: Tensor, label: Tensor) -> Tensor:
    """Return +1 or -1 per label: the sign with which normals spread apart, as they do outside of a body."""
    generator = torch.Generator().manual_seed(0)
    few = torch.randperm(len(points), generator=generator)[:_COARSE_POINTS]
    near, _ = k_nearest(points[few], points[few], min(_COARSE_NEIGHBORS + 1, len(few)))
    first, second = few.repeat_interleave(near.shape[1]), few[near.flatten()]
    kept = (label[first] == label[second]) & (first != second)
    first, second = first[kept], second[kept]
    apart = torch.nn.functional.normalize(points[first] - points[second], dim=-1, eps=torch.finfo(points.dtype).tiny)
    spread = _sums((apart * (normals[first] - normals[second])).sum(-1), label[first], int(label.max()) + 1)
    weight = _sums(normals[first].norm(dim=-1) + normals[second].norm(dim=-1), label[first], len(spread))
    flat = spread.abs() <= _FLAT * weight
    total = torch.stack([_sums(part, label) for part in normals.unbind(-1)], dim=-1)
    back = -_sums((normals * points).sum(-1), label)
    # A plane through the origin: any rule that does not depend on the signs that came.
    largest = total.gather(-1, total.abs().argmax(dim=-1, keepdim=True))[:, 0]
    reach = float(points.norm(dim=-1).max()) * _sums(normals.norm(dim=-1), label)
    back = torch.where(back.abs() > _FLAT * reach, back, largest)
    return _signs(torch.where(flat, back, spread))


def _signs(values: Tensor) -> Tensor:
    return torch.where(values < 0, -1.0, 1.0).to(values.dtype)


def _sums(values: Tensor, label: Tensor, count: int | None = None) -> Tensor:
    """Return the sums of values (N,) that carry the same label."""
    count = int(label.max()) + 1 if count is None else count
    return values.new_zeros(count).index_add(0, label, values)
