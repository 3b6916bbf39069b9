"""Normals of scanned surfaces: estimated from neighbors or faces, and turned to one side."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.graphs import minimum_spanning_forest
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import distinct_positions, k_nearest, k_nearest_others


@dataclass(frozen=True)
class NormalSettings:
    """Numbers by which normals are fitted and given a side."""

    # Neighbors that a normal is fitted to; more of them smooth noise, and edges too.
    num_neighbors: int = 16
    # Weight of the farthest neighbors: next to nothing, so that the choice between two equally far ones hardly counts.
    least_weight: float = 1e-3
    # Points of the coarse copy that distinguishes convex from concave sides, and their neighbors.
    num_coarse: int = 2000
    coarse_neighbors: int = 12
    # Share of normals on one side from which a scan counts as taken from there.
    one_sided: float = 0.97
    # Cosine to the direction of the camera below which a normal is flipped; nearer to 90 degrees it may be noise.
    flipped_cosine: float = -0.25
    # Length of the sum of normals, as a share of all their lengths, from which it points to a camera.
    least_mean: float = 0.2
    # Relative spread of normals, and distance of a plane from the origin, below which a part is flat.
    flat: float = 5e-3
    # Share of neighbors with opposed normals from which given normals count as unoriented; at random it is a half.
    unoriented: float = 0.25
    # Share of a component's area whose winding decides about the rest.
    majority: float = 0.75


NORMALS = NormalSettings()


def estimate_normals(points: Tensor, *, viewpoint: Tensor | None = None) -> Tensor:
    """Return the unit normals (N, 3) of a surface sampled by points, with the signs of `orient_normals`."""
    positions, which = distinct_positions(points)
    index, _ = k_nearest_others(positions, NORMALS.num_neighbors)
    return orient_along_graph(positions, fit_normals(positions, index), index, viewpoint)[which].to(points)


def orient_normals(points: Tensor, normals: Tensor, *, viewpoint: Tensor | None = None) -> Tensor:
    """Return normals (N, 3) with signs that agree between neighbors and face the camera (Hoppe et al. 1992)."""
    positions, which = distinct_positions(points)
    first = torch.full((len(positions),), len(points)).scatter_reduce(0, which, torch.arange(len(points)), "amin")
    exact = normals.detach().cpu().double()
    index, _ = k_nearest_others(positions, NORMALS.num_neighbors)
    oriented = orient_along_graph(positions, exact[first], index, viewpoint)
    flip = (oriented[which] * exact).sum(-1, keepdim=True) < 0
    return torch.where(flip.to(points.device), -normals, normals)


def fit_normals(points: Tensor, index: Tensor) -> Tensor:
    """Return unit normals (N, 3) of either sign: the directions of least spread of each point's neighbors (N, K)."""
    return _least_spread(torch.cat((points[:, None], points[index]), dim=1))


def _least_spread(around: Tensor) -> Tensor:
    """Return unit normals (N, 3) of neighborhoods (N, K, 3), each with the point that its normal belongs to first."""
    around = around - around[:, :1]
    # Squares of tiny lengths underflow.
    around = around / around.abs().amax(dim=(1, 2), keepdim=True)
    square = around.square().sum(dim=-1)
    weight = (1 - square / square.amax(dim=-1, keepdim=True) + NORMALS.least_weight)[..., None]
    around = around - (weight * around).sum(dim=1, keepdim=True) / weight.sum(dim=1, keepdim=True)
    return torch.linalg.eigh(around.mT @ (weight * around)).eigenvectors[..., 0]


def fit_normals_at(points: Tensor, index: Tensor) -> Tensor:
    """Return unit normals (M, 3) of either sign at those of the points (N, 3) with the given indices (M,)."""
    positions, which = distinct_positions(points)
    near, _ = k_nearest(positions[which[index.cpu()]], positions, min(NORMALS.num_neighbors + 1, len(positions)))
    return _least_spread(positions[near]).to(points)


def face_vertex_normals(points: Tensor, faces: Tensor, viewpoint: Tensor | None = None) -> Tensor:
    """Return unit normals (N, 3) at the points of a surface of triangles, zero where no face has an area."""
    pairs, agree = _adjacent_faces(faces, len(points))
    if viewpoint is None and bool(agree.all()):
        return TriangleMesh(points, faces).vertex_normals()
    key, which, shared = (pairs @ pairs.new_tensor([len(faces), 1])).unique(return_inverse=True, return_counts=True)
    pairs = torch.stack((key // len(faces), key % len(faces)), dim=-1)
    opposed = _label_sums((~agree).double(), which, len(pairs)) > 0
    parents, edge, label = minimum_spanning_forest(pairs, shared, len(faces))
    steps = torch.where((parents >= 0) & opposed[edge], -1.0, 1.0).double()
    sign = _products_to_root(parents, steps)
    areas = TriangleMesh(points, faces).face_areas()
    areas = areas / areas.mean().clamp(min=torch.finfo(areas.dtype).tiny)
    side = _label_sums(areas * sign, label)
    undecided = torch.ones_like(side) > 0
    if viewpoint is None:
        undecided = side.abs() < (2 * NORMALS.majority - 1) * _label_sums(areas, label)
    if bool(undecided.any()):
        normals = TriangleMesh(points, faces).face_normals() * (sign * areas)[:, None]
        side = torch.where(undecided, _sides(points[faces].mean(dim=1), normals, label, viewpoint), side)
    oriented = torch.where((sign * side[label] < 0)[:, None], faces.flip(-1), faces)
    return TriangleMesh(points, oriented).vertex_normals()


def _adjacent_faces(faces: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return pairs (E, 2) of faces across edges of two faces, and a mask (E,) of those whose windings agree."""
    start, end = faces.reshape(-1), faces.roll(-1, dims=1).reshape(-1)
    key, order = (torch.minimum(start, end) * count + torch.maximum(start, end)).sort(stable=True)
    same = torch.cat((key.new_zeros(1), (key[1:] == key[:-1]).long(), key.new_zeros(1)))
    first = ((same[:-1] == 0) & (same[1:] == 1)).nonzero()[:, 0]
    # Edges of three faces or more leave open which of them belong together.
    first = first[torch.cat((same, same.new_zeros(1)))[first + 2] == 0]
    side, next_side = order[first], order[first + 1]
    return torch.stack((side // 3, next_side // 3), dim=-1), start[side] != start[next_side]


def neighbors_disagree(normals: Tensor, index: Tensor) -> float:
    """Return the share of points whose normal opposes that of their nearest neighbor; 0.5 for signs at random."""
    return float(((normals * normals[index[:, 0]]).sum(-1) < 0).double().mean())


def orient_along_graph(points: Tensor, normals: Tensor, index: Tensor, viewpoint: Tensor | None) -> Tensor:
    """Return normals (N, 3) oriented along the spanning tree of neighbors (N, K), and to the camera; on the CPU."""
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
        if facing < NORMALS.one_sided:
            return normals
    else:
        view = torch.nn.functional.normalize(viewpoint - points, dim=-1)
    turned_away = (normals * view).sum(-1) < NORMALS.flipped_cosine
    return torch.where(turned_away[:, None], -normals, normals)


def _products_to_root(parents: Tensor, steps: Tensor) -> Tensor:
    """Return the product of the steps on each node's path up to its root, whose own step is 1."""
    above = torch.where(parents < 0, torch.arange(len(parents)), parents)
    product = steps.clone()
    while True:
        product = product * product[above]
        higher = above[above]
        if torch.equal(higher, above):
            return product
        above = higher


def _sides(points: Tensor, normals: Tensor, label: Tensor, viewpoint: Tensor | None) -> Tensor:
    """Return the sign (C,) of each component that turns its normals to the viewpoint or the likely camera."""
    if viewpoint is not None:
        return _signs(_label_sums((normals * (viewpoint - points)).sum(-1), label))
    total = torch.stack([_label_sums(part, label) for part in normals.unbind(-1)], dim=-1)
    convex = _convex_sides(points, normals, label)
    size = _label_sums(normals.norm(dim=-1), label)
    largest = int(size.argmax())
    camera = total[largest] * convex[largest]
    strength = camera.norm()
    if not float(strength) > NORMALS.least_mean * float(size[largest]):
        return convex
    seen = total @ (camera / strength)
    return torch.where(seen.abs() > NORMALS.least_mean * size, _signs(seen), convex)


def _convex_sides(points: Tensor, normals: Tensor, label: Tensor) -> Tensor:
    """Return the sign (C,) of each component with which its normals diverge, as they do outside of a body."""
    generator = torch.Generator().manual_seed(0)
    sample = torch.randperm(len(points), generator=generator)[: NORMALS.num_coarse]
    near, _ = k_nearest(points[sample], points[sample], min(NORMALS.coarse_neighbors + 1, len(sample)))
    first, second = sample.repeat_interleave(near.shape[1]), sample[near.flatten()]
    kept = (label[first] == label[second]) & (first != second)
    first, second = first[kept], second[kept]
    apart = torch.nn.functional.normalize(points[first] - points[second], dim=-1, eps=torch.finfo(points.dtype).tiny)
    divergence = _label_sums((apart * (normals[first] - normals[second])).sum(-1), label[first], int(label.max()) + 1)
    weight = _label_sums(normals[first].norm(dim=-1) + normals[second].norm(dim=-1), label[first], len(divergence))
    flat = divergence.abs() <= NORMALS.flat * weight
    total = torch.stack([_label_sums(part, label) for part in normals.unbind(-1)], dim=-1)
    to_origin = -_label_sums((normals * points).sum(-1), label)
    # A plane through the origin: any rule that does not depend on the given signs.
    largest = total.gather(-1, total.abs().argmax(dim=-1, keepdim=True))[:, 0]
    reach = float(points.norm(dim=-1).max()) * _label_sums(normals.norm(dim=-1), label)
    to_origin = torch.where(to_origin.abs() > NORMALS.flat * reach, to_origin, largest)
    return _signs(torch.where(flat, to_origin, divergence))


def _signs(values: Tensor) -> Tensor:
    return torch.where(values < 0, -1.0, 1.0).to(values.dtype)


def _label_sums(values: Tensor, label: Tensor, count: int | None = None) -> Tensor:
    """Return the sum (C,) of the values (N,) of each label."""
    count = int(label.max()) + 1 if count is None else count
    return values.new_zeros(count).index_add(0, label, values)
