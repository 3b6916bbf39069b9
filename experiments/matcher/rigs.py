"""Rigs of files as bodies that can be posed at random."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from torchreg.datasets.figures import Figure
from torchreg.datasets.matching_pairs import PosableBody
from torchreg.geometry.mesh import TriangleMesh
from torchreg.io.gltf import load_rig

# Joints of a rig turn by so much at most, degrees; those that carry nearly all of it a quarter of that.
_LIMIT = 60.0
_MOST = 0.9


def body_of_rig(path: Path) -> PosableBody:
    """Return a rig as a body; see `PosableBody`."""
    rig = load_rig(path)
    parents = [int(parent) for parent in rig.parents]
    # A figure has one root.
    first = parents.index(-1)
    parents = [first if parent < 0 and joint != first else parent for joint, parent in enumerate(parents)]
    order = _parents_first(parents)
    place = {joint: number for number, joint in enumerate(order)}
    weights = rig.weights.double()[:, order]
    carried = weights.sum(0)
    for number in reversed(range(len(order))):
        parent = parents[order[number]]
        if parent >= 0:
            carried[place[parent]] += carried[number]
    limits = torch.where(carried > _MOST * carried.max(), 0.25, 1.0) * math.radians(_LIMIT)
    figure = Figure(
        mesh=TriangleMesh(rig.vertices.double(), rig.faces),
        weights=weights,
        joints=rig.joint_transforms[order, :3, 3].double(),
        parents=tuple(-1 if parents[joint] < 0 else place[parents[joint]] for joint in order),
        part_names=tuple(f"joint {joint}" for joint in order),
    )
    return PosableBody(figure, limits.double())


def _parents_first(parents: list[int]) -> list[int]:
    """Return joints in an order in which parents come before children."""
    order: list[int] = []
    while len(order) < len(parents):
        order += [
            joint for joint, parent in enumerate(parents) if joint not in order and (parent < 0 or parent in order)
        ]
    return order
