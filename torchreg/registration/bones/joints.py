"""Joints of bones that move separately: where two motions agree, also across gaps, and the tree of the strongest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.graphs import connected_components, minimum_spanning_forest, rooted
from torchreg.geometry.neighbors import NeighborTree
from torchreg.registration.bones.joint_moments import JointMoments, gaps_at, motion_differences


@dataclass(frozen=True)
class Regularization:
    """Lambda of `find_joints`, squared radians."""

    found: float = 0.01  # of joints found from motions that are given
    # of joints fitted with the motions: bones share weight at the surface, joints lie inside, and a firmer lambda draws
    # them out, by up to a limb's radius
    fitted: float = 0.001


REGULARIZATION = Regularization()


@dataclass(frozen=True)
class Joints:
    """Joints of pairs (P, 2) of bones."""

    pairs: Tensor
    centers: Tensor  # (P, 3), where the two motions of a pair agree, in the space that the motions start from
    mass: Tensor  # (P,) of what the bones of a pair share, see `JointMoments`; zero for those that only come near
    gaps: Tensor  # (..., P) distances between the images of each center under the two motions


@dataclass(frozen=True)
class BoneTree:
    """The parents of B bones, -1 for roots, and the joint (B, 3) of each with its parent, a root's being its middle."""

    parents: tuple[int, ...]
    origins: Tensor


def find_joints(moments: JointMoments, transforms: Tensor, *, regularization: float = REGULARIZATION.found) -> Joints:
    """Return the points that pairs of bones move alike in all poses (..., B, 4, 4), as nearly as there is one.

    ``argmin_c mean |(R_i - R_j) c + t_i - t_j|^2 + lambda |c - m|^2``, m the center of what the two share. The root of
    lambda is the angle between the bones, radians, at which both terms count alike (Schaefer and Yuksel 2007, section
    5).
    """
    differences = motion_differences(transforms, moments.pairs)
    turn, gaps = differences[..., :3], gaps_at(differences, moments.center)
    normal, right = turn.mT @ turn, (turn.mT @ gaps.unsqueeze(-1)).squeeze(-1)
    if normal.ndim > 3:
        normal, right = normal.flatten(0, -4).mean(0), right.flatten(0, -3).mean(0)
    identity = torch.eye(3, dtype=normal.dtype, device=normal.device)
    centers = moments.center - torch.linalg.solve(normal + regularization * identity, right)
    return Joints(moments.pairs, centers, moments.mass, torch.linalg.vector_norm(gaps_at(differences, centers), dim=-1))


@torch.no_grad()
def bridged(
    moments: JointMoments,
    corners: Tensor,
    weights: Tensor,
    transforms: Tensor,
    *,
    regularization: float = REGULARIZATION.found,
) -> JointMoments:
    """Return moments with pairs added, of no mass and spread, that join groups of bones which share no weight."""
    group, bone = connected_components(moments.pairs, weights.shape[1]), weights.argmax(1)
    if len(group[bone].unique()) < 2:
        return moments
    pairs, center, length = _nearest_pairs(corners, bone, group)
    added = JointMoments(pairs, center.new_zeros(len(pairs)), center, center.new_zeros(len(pairs), 3, 3))
    found = find_joints(added, transforms, regularization=regularization)
    gaps = found.gaps.reshape(-1, len(pairs)).mean(0)
    length = length + (found.centers - center).norm(dim=-1) + gaps
    added = added.select(minimum_spanning_forest(group[pairs], length, len(group)).chosen())
    pairs = torch.cat([moments.pairs, added.pairs])
    order = (pairs[:, 0] * weights.shape[1] + pairs[:, 1]).argsort()
    return JointMoments(
        pairs=pairs[order],
        mass=torch.cat([moments.mass, added.mass])[order],
        center=torch.cat([moments.center, added.center])[order],
        spread=torch.cat([moments.spread, added.spread])[order],
    )


def _nearest_pairs(corners: Tensor, bone: Tensor, group: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return pairs (P, 2) of each bone and the nearest bone of each later group, with middles and lengths between."""
    pairs, middles, lengths = [], [], []
    corner_group = group[bone]
    for number in corner_group.unique()[1:].tolist():
        inside, before = (corner_group == number).nonzero()[:, 0], (corner_group < number).nonzero()[:, 0]
        index, distance = NeighborTree(corners[inside]).nearest(corners[before])
        for earlier in bone[before].unique():
            candidates = (bone[before] == earlier).nonzero()[:, 0]
            best = candidates[distance[candidates].argmin()]
            ends = torch.stack((before[best], inside[index[best]]))
            pairs.append(bone[ends].sort().values)
            middles.append(corners[ends].mean(0))
            lengths.append(distance[best].to(corners))
    return torch.stack(pairs), torch.stack(middles), torch.stack(lengths)


def bone_tree(joints: Joints, middles: Tensor, sizes: Sequence[float] | Tensor) -> BoneTree:
    """Return the trees of the joints of greatest mass that close no circle; the root of each is its largest bone."""
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
