"""Nodes of a skeleton carried along while the surface around them moves and bends: rigid fits around each node."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_points, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.rigid import rigid_matrix, transform_points
from torchreg.geometry.skeleton import nearest_rotation

# Every fit feels the whole with this weight: a few points in a line do not make a rigid motion.
_WHOLE = 1e-3


def carry_nodes(
    nodes: Tensor,
    radii: Tensor,
    apart: Tensor,
    source: Tensor,
    source_normals: Tensor,
    target: Tensor,
    target_normals: Tensor,
    widths: Sequence[float],
    *,
    known: Tensor | None = None,
    places: Tensor | None = None,
    known_weight: float = 10.0,
    num_rounds: int = 4,
    max_angle: float = math.radians(60),
) -> Tensor:
    """Return where nodes of a skeleton are after the surface around them moved from source to target.

    Each surface point x_i hangs on the node n(i) whose ball it is nearest to. Node p moves rigidly with what hangs
    near it on the skeleton: ``T_p = argmin sum_i w_i(p) |T x_i - y_i|^2``, ``w_i(p) = exp(-apart(p, n(i))^2 / 2
    width^2)``, where y_i is the target point nearest to ``T_n(i) x_i``, if their normals agree. Widths that shrink let
    the whole move first, then its limbs bend; an arm does not hold what it only touches.

    Args:
        nodes: (N, 3) before.
        radii: (N,) of the balls around them.
        apart: (N, N) lengths along the skeleton.
        source: (V, 3) on the surface before.
        source_normals: (V, 3) unit normals.
        target: (W, 3) on the surface after; unrelated to ``source``.
        target_normals: (W, 3) unit normals.
        widths: of the neighborhoods, one after the other, in the unit of the nodes.
        known: (N,) bool, nodes whose places after are known.
        places: (N, 3) of those.
        known_weight: of one known node against one surface point.
        num_rounds: of nearest points and fits, at each width.
        max_angle: between normals that agree, radians.

    Returns:
        (N, 3) places after, also of the known nodes.

    Raises:
        InputError: if sizes do not fit, a number is not finite or out of range.

    Differentiable: no.

    Cost: 0.3 s for 150 nodes and 1,000 surface points on one CPU core.

    References: Besl and McKay 1992; Sumner, Schmid and Pauly 2007 for deformations held by nodes.
    """
    nodes = as_float_tensor(nodes, "nodes").detach()
    check_points(nodes, "nodes", batch=False)
    count = len(nodes)
    given = {"source": source, "source_normals": source_normals, "target": target, "target_normals": target_normals}
    rows = {name: as_float_tensor(value, name, like=nodes).detach() for name, value in given.items()}
    for name, value in rows.items():
        check_points(value, name, batch=False)
    for name in ("source", "target"):
        check_shape(rows[f"{name}_normals"], f"{name}_normals", tuple(rows[name].shape))
    check_shape(radii, "radii", (count,))
    check_shape(apart, "apart", (count, count))
    if not widths:
        raise InputError("widths must hold at least one width, got none")
    for width in widths:
        check_positive(width, "widths")
    check_count(num_rounds, "num_rounds", 1)
    known = torch.zeros(count, dtype=torch.bool) if known is None else known
    check_shape(known, "known", (count,))
    places = nodes if places is None else as_float_tensor(places, "places", like=nodes)
    check_shape(places, "places", (count, 3))
    with torch.no_grad():
        holder = (torch.cdist(rows["source"], nodes) - radii.to(nodes)).argmin(-1)
        owner = torch.cat((holder, known.nonzero()[:, 0]))
        share = torch.cat((torch.ones(len(holder)), torch.full((int(known.sum()),), known_weight))).to(nodes)
        start = torch.cat((rows["source"], nodes[known]))
        motion = torch.eye(4).to(nodes).expand(count, 4, 4)
        for width in widths:
            weights = (torch.exp(-0.5 * (apart.to(nodes)[:, owner] / width).square()) + _WHOLE) * share
            for _ in range(num_rounds):
                there, agree = _matched(rows, motion[holder], math.cos(max_angle))
                use = torch.cat((agree.to(nodes), torch.ones_like(share[len(holder) :])))
                goal = torch.cat((there, places[known]))
                motion = _fitted(start, goal, weights * use)
        return transform_points(motion, nodes.unsqueeze(1)).squeeze(1)


def _matched(rows: dict[str, Tensor], motion: Tensor, min_cosine: float) -> tuple[Tensor, Tensor]:
    """Return the target points (V, 3) nearest to where source points are now, and whether their normals agree."""
    moved = transform_points(motion, rows["source"].unsqueeze(1)).squeeze(1)
    turned = (motion[:, :3, :3] @ rows["source_normals"].unsqueeze(-1)).squeeze(-1)
    index, _ = nearest_neighbor(moved, rows["target"])
    return rows["target"][index], (turned * rows["target_normals"][index]).sum(-1) > min_cosine


def _fitted(start: Tensor, goal: Tensor, weights: Tensor) -> Tensor:
    """Return the rigid motions (N, 4, 4) that fit all points (V, 3) with weights (N, V); by moments, not by copies."""
    total = weights.sum(-1, keepdim=True)
    middle, goal_middle = weights @ start / total, weights @ goal / total
    outer = (goal.unsqueeze(-1) * start.unsqueeze(-2)).flatten(1)
    moment = (weights @ outer / total).reshape(-1, 3, 3) - goal_middle.unsqueeze(-1) * middle.unsqueeze(-2)
    rotation = nearest_rotation(moment)
    return rigid_matrix(rotation, goal_middle - (rotation @ middle.unsqueeze(-1)).squeeze(-1))
