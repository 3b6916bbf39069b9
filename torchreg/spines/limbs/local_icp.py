"""Nodes of a skeleton transferred to a surface that moved and bent: rigid fits around each node."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.rigid import rigid_matrix, transform_points
from torchreg.geometry.skeleton import nearest_rotation


@dataclass(frozen=True)
class LocalFits:
    """How rigid motions are fitted around the nodes."""

    num_points: int = 1200  # of the source surface that are fitted, at most
    widths: tuple[float, ...] = (0.5, 0.25, 0.12, 0.06)  # of neighborhoods, in skeleton extents: limbs bend at last
    num_rounds: int = 4  # of correspondences and fits, at each width
    known_weight: float = 10.0  # of a node whose position is known, against one surface point
    background_weight: float = 1e-3  # of every point in every fit: a few in a line do not make a rigid motion
    max_angle: float = math.radians(60)  # between the normals of corresponding points, radians


LOCAL_FITS = LocalFits()


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points (V, 3) on a surface and their unit normals."""

    points: Tensor
    normals: Tensor


def transfer_nodes(
    nodes: Tensor,
    radii: Tensor,
    path_lengths: Tensor,
    source: SurfacePoints,
    target: SurfacePoints,
    known: Tensor,
    fits: LocalFits = LOCAL_FITS,
) -> Tensor:
    """Return the positions (N, 3) of a skeleton's nodes after the surface around them moved from source to target.

    Surface point x_i belongs to the node n(i) whose ball is nearest. ``T_p = argmin sum_i w_i(p) |T x_i - y_i|^2``,
    ``w_i(p) = exp(-d(p, n(i))^2 / 2 width^2)``, with path lengths d along the skeleton and y_i the target point nearest
    to ``T_n(i) x_i``, if normals agree. Known nodes (N, 3), NaN where unknown, are fitted, but not held (Besl and McKay
    1992; Sumner, Schmid and Pauly 2007 for deformations held by nodes).
    """
    holder = (torch.cdist(source.points, nodes) - radii).argmin(-1)
    fixed = (~known.isnan().any(-1)).nonzero()[:, 0]
    owner = torch.cat((holder, fixed))
    base_weights = torch.cat((nodes.new_ones(len(holder)), nodes.new_full((len(fixed),), fits.known_weight)))
    start = torch.cat((source.points, nodes[fixed]))
    motions = torch.eye(4).to(nodes).expand(len(nodes), 4, 4)
    extent, tree = float(path_lengths.max()), NeighborTree(target.points)
    for width in fits.widths:
        kernel = torch.exp(-0.5 * (path_lengths[:, owner] / (width * extent)).square())
        weights = (kernel + fits.background_weight) * base_weights
        for _ in range(fits.num_rounds):
            closest, compatible = _correspondences(source, target, tree, motions[holder], math.cos(fits.max_angle))
            valid = torch.cat((compatible.to(nodes), torch.ones_like(base_weights[len(holder) :])))
            goal = torch.cat((closest, known[fixed]))
            motions = _rigid_fits(start, goal, weights * valid)
    return transform_points(motions, nodes.unsqueeze(1)).squeeze(1)


def _correspondences(
    source: SurfacePoints, target: SurfacePoints, tree: NeighborTree, motions: Tensor, min_cosine: float
) -> tuple[Tensor, Tensor]:
    """Return the target points (V, 3) nearest to source points under motions, and whether normals agree."""
    moved = transform_points(motions, source.points.unsqueeze(1)).squeeze(1)
    normals = (motions[:, :3, :3] @ source.normals.unsqueeze(-1)).squeeze(-1)
    index, _ = tree.nearest(moved)
    return target.points[index], (normals * target.normals[index]).sum(-1) > min_cosine


def _rigid_fits(start: Tensor, goal: Tensor, weights: Tensor) -> Tensor:
    """Return the rigid motions (N, 4, 4) that fit all points (V, 3) with weights (N, V); by moments, not by copies."""
    total = weights.sum(-1, keepdim=True)
    center, goal_center = weights @ start / total, weights @ goal / total
    outer = (goal.unsqueeze(-1) * start.unsqueeze(-2)).flatten(1)
    moment = (weights @ outer / total).reshape(-1, 3, 3) - goal_center.unsqueeze(-1) * center.unsqueeze(-2)
    rotation = nearest_rotation(moment)
    return rigid_matrix(rotation, goal_center - (rotation @ center.unsqueeze(-1)).squeeze(-1))
