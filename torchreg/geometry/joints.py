"""Joints of bones that move separately: where two motions agree, and the tree that the strongest joints make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.geometry.joint_moments import JointMoments


@dataclass(frozen=True)
class Joints:
    """Where pairs of bones meet.

    Args:
        pairs: (P, 2) int64 bones, the lower first.
        centers: (P, 3) the points that both bones of a pair move alike, in the space that the motions start from.
        mass: (P,) how much the bones of a pair share, see `JointMoments`.
        gaps: (..., P) how far apart the two motions take each center.
    """

    pairs: Tensor
    centers: Tensor
    mass: Tensor
    gaps: Tensor


@dataclass(frozen=True)
class BoneTree:
    """A skeleton of bones.

    Args:
        parents: B indices, -1 for the root of each tree.
        origins: (B, 3) the joint of each bone with its parent; of a root, its middle.
    """

    parents: tuple[int, ...]
    origins: Tensor


def find_joints(moments: JointMoments, transforms: Tensor, *, regularization: float = 0.01) -> Joints:
    """Return the points that pairs of bones move alike, as nearly as there is one.

    ``argmin_c mean |(R_i - R_j) c + t_i - t_j|^2 + lambda |c - m|^2`` with m the center of what the two bones share: it
    decides where the motions do not, along the axis of a hinge, or everywhere where the bones turn alike. The root of
    lambda is the angle between the bones, in radians, at which either counts the same.

    Args:
        moments: of the bones that meet.
        transforms: (..., B, 4, 4); all poses of a batch count alike.
        regularization: lambda.

    Returns:
        `Joints`.

    Raises:
        InputError: if ``regularization`` is not positive or a shape does not fit.

    Differentiable: in ``transforms`` and the moments.

    References: Schaefer and Yuksel 2007, section 5, for the regularized least squares.
    """
    check_positive(regularization, "regularization")
    check_shape(transforms, "transforms", ("B", 4, 4), batch=True)
    first, second = moments.pairs.unbind(-1)
    difference = transforms[..., first, :3, :] - transforms[..., second, :3, :]
    turn = difference[..., :3]
    apart = (turn @ moments.center.unsqueeze(-1)).squeeze(-1) + difference[..., 3]
    normal, right = turn.mT @ turn, (turn.mT @ apart.unsqueeze(-1)).squeeze(-1)
    normal, right = (
        normal.flatten(0, -4).mean(0) if normal.ndim > 3 else normal,
        (right.flatten(0, -3).mean(0) if right.ndim > 2 else right),
    )
    identity = torch.eye(3, dtype=normal.dtype, device=normal.device)
    centers = moments.center - torch.linalg.solve(normal + regularization * identity, right)
    gaps = torch.linalg.vector_norm((turn @ centers.unsqueeze(-1)).squeeze(-1) + difference[..., 3], dim=-1)
    return Joints(moments.pairs, centers, moments.mass, gaps)


def bone_tree(joints: Joints, middles: Tensor, sizes: Sequence[float] | Tensor) -> BoneTree:
    """Return the trees of the strongest joints: those of greatest mass that close no circle.

    Args:
        joints: of B bones.
        middles: (B, 3) of the bones, where a root has its origin.
        sizes: (B,) of the bones; the largest of each tree is its root.

    Returns:
        a `BoneTree`.

    Differentiable: the origins, in the joints' centers and the middles.
    """
    count = len(middles)
    pairs, mass = joints.pairs.cpu().numpy(), joints.mass.detach().cpu().double().numpy()
    # A minimum spanning tree of lengths that fall with the mass is the maximum one; zero would mean no edge.
    length = 1.0 + mass.max(initial=0.0) - mass
    if len(mass):
        length = 1.0 + np.argsort(np.argsort(-mass, kind="stable"), kind="stable")
    graph = coo_matrix((length, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    tree = minimum_spanning_tree(graph)
    joint_of = {(int(i), int(j)): k for k, (i, j) in enumerate(pairs)}
    order = np.argsort(-torch.as_tensor(sizes).detach().cpu().double().numpy(), kind="stable")
    parents, origins = [-1] * count, list(middles)
    reached: set[int] = set()
    for root in order.tolist():
        if root in reached:
            continue
        walk, before = breadth_first_order(tree, root, directed=False)
        reached.update(walk.tolist())
        for bone in walk[1:].tolist():
            parent = int(before[bone])
            parents[bone] = parent
            origins[bone] = joints.centers[joint_of[min(bone, parent), max(bone, parent)]]
    return BoneTree(tuple(parents), torch.stack(origins))
