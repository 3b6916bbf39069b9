"""Rigs of files and people of the body model anny, as bodies that can be posed at random and that play their clips."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchreg.datasets.figures import Figure
from torchreg.errors import MissingExtraError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.io.gltf import load_rig

from ..made_up.creature_parts import Draw
from ..made_up.matching_pairs import PosableBody
from ..matcher.clips import clip_rotations

# Joints turn by so much at most, degrees; those that carry most of the body, the root and the spine, a quarter of that.
_LIMIT = 60.0
_MOST = 0.5


# Kinds of rigs of a library that are never trained on.
HELD_OUT_RIGS = frozenset({"horse", "cattle", "shark", "frog", "insect", "hand", "vehicle", "monkey"})

# Draws a body and the name of its kind.
BodyDraw = Callable[[Draw], tuple[str, PosableBody]]


def drawn_bodies(rigs: Path | None, people: Sequence[PosableBody] = (), *, held_out: bool = False) -> BodyDraw | None:
    """Return what draws the rigs of a folder, and people, each kind by the square root of how many of it there are.

    Args:
        rigs: folder of .glb; an ``index.csv`` in it names the ``kind`` of each ``file``, else each is a kind of its
            own, and may say in ``torchreg`` that one is not "ok".
        people: further bodies, of one kind.
        held_out: of the kinds that are never trained on, instead of the others.
    """
    kinds: dict[str, list[Path | PosableBody]] = {} if rigs is None else dict(_files_by_kind(rigs, held_out))
    if people:
        kinds["person"] = list(people)
    if not kinds:
        return None
    names, shares = list(kinds), torch.tensor([math.sqrt(len(bodies)) for bodies in kinds.values()])

    def drawn(draw: Draw) -> tuple[str, PosableBody]:
        kind = names[int(torch.multinomial(shares, 1, generator=draw.generator))]
        body = kinds[kind][draw.count(0, len(kinds[kind]) - 1)]
        return kind, body_of_rig(body) if isinstance(body, Path) else body

    return drawn


def _files_by_kind(folder: Path, held_out: bool) -> dict[str, list[Path | PosableBody]]:
    index = folder / "index.csv"
    rows = [{"file": file.name, "kind": file.stem} for file in sorted(folder.glob("*.glb"))]
    if index.exists():
        with index.open(encoding="utf-8", newline="") as lines:
            rows = [row for row in csv.DictReader(lines) if row.get("torchreg", "ok") == "ok"]
    found: dict[str, list[Path | PosableBody]] = {}
    for row in rows:
        if (row["kind"] in HELD_OUT_RIGS) == held_out:
            found.setdefault(row["kind"], []).append(folder / row["file"])
    return found


@lru_cache(maxsize=400)
def body_of_rig(path: Path) -> PosableBody:
    """Return a rig, and the clips of its file, as a body; see `PosableBody`."""
    rig = load_rig(path)
    parents = [int(parent) for parent in rig.parents]
    return posable(
        TriangleMesh(rig.vertices.double(), rig.faces), rig.weights.double(), rig.joint_transforms[:, :3, 3].double(),
        parents, clip_rotations(path, rig.joint_transforms, parents),
    )  # fmt: skip


def people(draw: Draw, count: int) -> list[PosableBody]:
    """Return so many people of anny, each of another age, build and height.

    Raises:
        MissingExtraError: if anny is not installed.
    """
    model = _anny()
    indices, shares = model.vertex_bone_indices.long(), model.vertex_bone_weights.double()
    weights = torch.zeros(len(indices), len(model.bone_labels), dtype=torch.float64).scatter_add_(1, indices, shares)
    found = []
    for _ in range(count):
        lowest = {"age": 0.3}
        phenotype = {name: draw.uniform(lowest.get(name, 0.0), 1.0) for name in model.phenotype_labels}
        with torch.no_grad():
            body = model(phenotype_kwargs=phenotype)
        # anny's z is up.
        up = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
        mesh = TriangleMesh(body["rest_vertices"][0].double() @ up.mT, model.get_triangular_faces().long())
        joints = body["rest_bone_poses"][0, :, :3, 3].double() @ up.mT
        parents = [int(parent) for parent in model.bone_parents]
        found.append(posable(mesh, weights / weights.sum(1, keepdim=True), joints, parents))
    return found


@cache
def _anny() -> Any:
    try:
        import anny
    except ImportError as error:
        raise MissingExtraError(
            "people need anny; install it with: pip install 'torchreg-articulated[anny]'"
        ) from error
    return anny.Anny()


def posable(
    mesh: TriangleMesh, weights: Tensor, joints: Tensor, parents: list[int], clips: Sequence[Tensor] = ()
) -> PosableBody:
    """Return a skinned mesh as a body whose joints may come in any order.

    Args:
        mesh: V vertices at rest.
        weights: (V, J) of skinning.
        joints: (J, 3) at rest.
        parents: J numbers of joints, -1 for roots.
        clips: rotations (F, J, 3, 3) of joints against their parents.
    """
    # A figure has one root.
    first = parents.index(-1)
    parents = [first if parent < 0 and joint != first else parent for joint, parent in enumerate(parents)]
    order = _parents_first(parents)
    place = {joint: number for number, joint in enumerate(order)}
    weights = weights[:, order]
    carried = weights.sum(0)
    for number in reversed(range(len(order))):
        parent = parents[order[number]]
        if parent >= 0:
            carried[place[parent]] += carried[number]
    limits = torch.where(carried > _MOST * carried.max(), 0.25, 1.0) * math.radians(_LIMIT)
    figure = Figure(
        mesh=mesh,
        weights=weights,
        joints=joints[order],
        parents=tuple(-1 if parents[joint] < 0 else place[parents[joint]] for joint in order),
        part_names=tuple(f"joint {joint}" for joint in order),
    )
    return PosableBody(figure, limits.double(), clips=tuple(clip[:, order].double() for clip in clips))


def _parents_first(parents: list[int]) -> list[int]:
    """Return joints in an order in which parents come before children."""
    order: list[int] = []
    while len(order) < len(parents):
        order += [
            joint for joint, parent in enumerate(parents) if joint not in order and (parent < 0 or parent in order)
        ]
    return order
