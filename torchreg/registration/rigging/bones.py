"""The tree of bones that a registered sequence shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchreg.geometry.rigid import transform_points
from torchreg.registration.results import SequenceRegistration
from torchreg.solvers.rigid_groups import merge_alike


@dataclass(frozen=True)
class _Format:
    """What files keep."""

    most_weights: int = 4  # of a vertex


_FORMAT = _Format()


@dataclass(frozen=True)
class BoneTree:
    """A tree of B bones: weights (V, B) of the template's vertices, motions (T, B, 4, 4), joints (B, 3), parents."""

    weights: Tensor
    motions: Tensor
    joints: Tensor
    parents: tuple[int, ...]
    names: tuple[str, ...]


def tree_of_bones(found: SequenceRegistration, vertices: Tensor, alike: float) -> BoneTree:
    """Return the bones that move vertices (V, 3) of the template, as one tree; ``alike`` is a share of the diagonal."""
    tree = found.model.skeleton(found.transforms)
    size = found.model.vertex_weights(found.points).double().sum(0)
    parents = _one_tree(tree.parents, size)
    part = _joined(found, parents, alike)
    tops = [bone for bone, parent in enumerate(parents) if parent < 0 or part[parent] != part[bone]]
    place = {part[bone]: number for number, bone in enumerate(tops)}
    member = torch.tensor([place[number] for number in part])
    weights = found.model.vertex_weights(vertices).double()
    weights = torch.zeros(len(weights), len(tops), dtype=weights.dtype).index_add(1, member, weights)
    return BoneTree(
        weights=_largest(weights),
        motions=found.transforms[:, [part[bone] for bone in tops]].double(),
        joints=tree.origins[tops].double(),
        parents=tuple(place[part[parents[bone]]] if parents[bone] >= 0 else -1 for bone in tops),
        names=tuple(f"bone_{number}" for number in range(len(tops))),
    )


def _one_tree(parents: Sequence[int], size: Tensor) -> list[int]:
    """Return parents in which all trees hang on the root of the largest bone of any."""
    joined = list(parents)
    roots = [bone for bone, parent in enumerate(joined) if parent < 0]
    main = max(roots, key=lambda root: float(size[root]))
    return [main if parent < 0 and bone != main else parent for bone, parent in enumerate(joined)]


def _joined(found: SequenceRegistration, parents: Sequence[int], alike: float) -> list[int]:
    """Return the part of each bone, the number of one of its bones: joints at which nothing turns join two bones."""
    points, moved = found.points.double(), found.deformed.double()
    size = float((points.amax(0) - points.amin(0)).norm())
    members = nn.functional.one_hot(found.labels, len(parents)).double()
    residuals = torch.stack([
        torch.stack([(transform_points(bone, points) - frame).norm(dim=-1) for bone in motions]) @ members / size
        for motions, frame in zip(found.transforms.double(), moved, strict=True)
    ])  # fmt: skip
    joints = torch.zeros(len(parents), len(parents), dtype=torch.bool)
    counts = members.sum(0)
    part = list(range(len(parents)))
    for bone, parent in enumerate(parents):
        if parent >= 0:
            joints[bone, parent] = joints[parent, bone] = True
    merged: list[int] = merge_alike(residuals, counts, joints, alike).tolist()
    # Bones that own no point move with their parents, parents first.
    for bone in _parents_first(parents):
        idle = float(counts[bone]) == 0 and parents[bone] >= 0
        part[bone] = part[parents[bone]] if idle else merged[bone]
    return part


def _parents_first(parents: Sequence[int]) -> list[int]:
    order = [bone for bone, parent in enumerate(parents) if parent < 0]
    for bone in order:
        order += [child for child, parent in enumerate(parents) if parent == bone]
    return order


def _largest(weights: Tensor) -> Tensor:
    """Return weights (V, B) with as many of the largest as files keep, rows summing to one."""
    values, index = weights.topk(min(_FORMAT.most_weights, weights.shape[1]), dim=1)
    kept = torch.zeros_like(weights).scatter(1, index, values)
    return kept / kept.sum(1, keepdim=True)
