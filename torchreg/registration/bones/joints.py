"""Joints of bones that move separately: where two motions agree, also across gaps, and the tree of the strongest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.geometry.graphs import connected_components, minimum_spanning_forest, rooted
from torchreg.geometry.neighbors import NeighborTree
from torchreg.registration.bones.joint_moments import JointMoments


@dataclass(frozen=True)
class Joints:
    """Where pairs of bones meet.

    Args:
        pairs: (P, 2) int64 bones, the lower first.
        centers: (P, 3) the points that both bones of a pair move alike, in the space that the motions start from.
        mass: (P,) how much the bones of a pair share, see `JointMoments`; zero for those that only come near.
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


@torch.no_grad()
def bridged(
    moments: JointMoments, corners: Tensor, weights: Tensor, transforms: Tensor, *, regularization: float = 0.01
) -> JointMoments:
    """Return moments with those of pairs added that hold groups of bones together which share nothing.

    A scan falls apart where something nearer hides a joint. Between two groups, a pair of bones is a joint if little is
    left unexplained: the sum of how far apart their nearest corners are, how far from the middle of these the point is
    that both move alike, and how far apart they move it. The shortest pairs that make one group of all are added, with
    no mass and no spread, their centers in the middles.

    Args:
        moments: of the bones that meet.
        corners: (K, 3) of the grid.
        weights: (K, B) there.
        transforms: (..., B, 4, 4); all poses of a batch count alike.
        regularization: see `find_joints`.

    Returns:
        `JointMoments`, pairs in order; the same where the bones with weight are one group.

    Differentiable: no.

    Cost: O(K log K) per group; 9 ms for 5,000 corners in three groups.
    """
    group, owner = connected_components(moments.pairs, weights.shape[1]), weights.argmax(1)
    if len(group[owner].unique()) < 2:
        return moments
    pairs, center, apart = _nearest_pairs(corners, owner, group)
    added = JointMoments(pairs, center.new_zeros(len(pairs)), center, center.new_zeros(len(pairs), 3, 3))
    found = find_joints(added, transforms, regularization=regularization)
    gaps = found.gaps.reshape(-1, len(pairs)).mean(0)
    added = added.select(_joining(group[pairs], apart + (found.centers - center).norm(dim=-1) + gaps))
    both = [torch.cat(parts) for parts in zip(_fields(moments), _fields(added), strict=True)]
    order = (both[0][:, 0] * weights.shape[1] + both[0][:, 1]).argsort()
    return JointMoments(*(values[order] for values in both))


def _fields(moments: JointMoments) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return moments.pairs, moments.mass, moments.center, moments.spread


def _nearest_pairs(corners: Tensor, owner: Tensor, group: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return pairs (P, 2) of each bone and the nearest one of each later group, and the middles and lengths between."""
    pairs, middles, lengths = [], [], []
    there = group[owner]
    for number in there.unique()[1:].tolist():
        inside, others = (there == number).nonzero()[:, 0], (there < number).nonzero()[:, 0]
        index, apart = NeighborTree(corners[inside]).nearest(corners[others])
        for bone in owner[others].unique():
            own = (owner[others] == bone).nonzero()[:, 0]
            best = own[apart[own].argmin()]
            ends = torch.stack((others[best], inside[index[best]]))
            pairs.append(owner[ends].sort().values)
            middles.append(corners[ends].mean(0))
            lengths.append(apart[best].to(corners))
    return torch.stack(pairs), torch.stack(middles), torch.stack(lengths)


def _joining(groups: Tensor, lengths: Tensor) -> Tensor:
    """Return the shortest of links (P,) between groups (P, 2) that make one group of all."""
    kept, groups = [], groups.clone()
    for link in lengths.argsort(stable=True).tolist():
        one, other = groups[link].tolist()
        if one != other:
            kept.append(link)
            groups[groups == other] = one
    return torch.tensor(kept, device=groups.device)


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
    chosen = minimum_spanning_forest(joints.pairs, -joints.mass, count).chosen()
    pairs = joints.pairs[chosen]
    order = torch.as_tensor(sizes, device=pairs.device).detach().argsort(descending=True, stable=True)
    tree = connected_components(pairs, count)[order]
    rank = torch.arange(count, device=pairs.device)
    largest = torch.full_like(rank[: int(tree.max()) + 1], count).scatter_reduce(0, tree, rank, "amin")
    parents, _ = rooted(pairs, order[largest], count)
    first, second = pairs.unbind(-1)
    child = torch.where(parents[first] == second, first, second)
    return BoneTree(tuple(parents.tolist()), middles.index_copy(0, child, joints.centers[chosen].to(middles)))
