"""The rigid parts of glTF files without skins: nodes that clips move, or meshes that hang on meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchreg.errors import ModelError
from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.file_format import warn
from torchreg.io.gltf_file.clip import moved_nodes
from torchreg.io.gltf_file.document import GltfDocument
from torchreg.io.gltf_file.primitives import Surface, VertexBudget, read_surface
from torchreg.io.gltf_file.skins import Skeleton, ancestors, shown_nodes, unique_names
from torchreg.io.limits import FILE_BUDGET, FileLimits, check_budget


@dataclass(frozen=True)
class RigidParts:
    """Rigid meshes on a tree of nodes."""

    skeleton: Skeleton  # of the joints
    surfaces: list[Surface]  # of the parts at rest, each vertex of weight one
    slides: tuple[str, ...]  # names of the joints that a clip slides
    fixed: tuple[str, ...]  # names of the joints that nothing turns


def read_parts(document: GltfDocument, name: str, limits: FileLimits) -> RigidParts:
    """Return the meshes of the default scene as rigid parts.

    The joints are the nodes that a clip moves, with all meshes below them; where no clip moves any mesh, all nodes with
    a mesh, if one hangs on another. What hangs on none of them is the base, as are those that move side by side.
    """
    parents = document.node_parents()
    shown = sorted(shown_nodes(document))
    meshes = {node: value for node in shown if (value := document.item("nodes", node).get("mesh")) is not None}
    moves = moved_nodes(document)
    carried = {above for node in meshes for above in (node, *ancestors(node, parents))}
    nodes = [node for node in shown if node in moves and node in carried]
    if not nodes:
        nodes = _nested(meshes, parents)
        moves = {node: {"rotation"} for node in nodes}
    check_budget(len(nodes), FILE_BUDGET.joints, "parts")
    number = {node: joint for joint, node in enumerate(nodes)}
    above = [next((number[up] for up in ancestors(node, parents) if up in number), -1) for node in nodes]
    owners = [next((number[up] for up in (node, *ancestors(node, parents)) if up in number), -1) for node in meshes]
    labels, world = [document.item("nodes", node).get("name") for node in nodes], document.node_globals(parents)
    if above.count(-1) > 1 or -1 in owners:  # a base in front of all others
        labels, nodes = [name, *labels], [-1, *nodes]
        above, owners = [-1, *(joint + 1 for joint in above)], [joint + 1 for joint in owners]
    names = unique_names(labels)
    surfaces = _placed(document, limits, list(meshes.items()), owners, world, len(nodes))
    rest = np.stack([np.eye(4) if node < 0 else world[node] for node in nodes])
    kinds = [moves.get(node, set[str]()) for node in nodes]
    return RigidParts(
        Skeleton(nodes, names, parents=tuple(above), number=number, world=rest, places=rest, skins=[]),
        surfaces,
        tuple(name for name, kind in zip(names, kinds, strict=True) if "translation" in kind),
        tuple(name for name, kind in zip(names, kinds, strict=True) if "rotation" not in kind),
    )


def _nested(meshes: dict[int, int], parents: list[int]) -> list[int]:
    """Return the nodes with a mesh, if one hangs on another; ModelError if none does."""
    if not any(set(ancestors(node, parents)) & set(meshes) for node in meshes):
        raise ModelError(
            "no node carries both a mesh and a skin, no clip moves a mesh and none hangs on another: there is no rig "
            "to read"
        )
    warn(f"no skin and no clip says what moves: each of {len(meshes)} nodes with a mesh is a rigid part")
    return list(meshes)


def _placed(
    document: GltfDocument,
    limits: FileLimits,
    meshes: list[tuple[int, int]],
    owners: list[int],
    world: Array,
    num_joints: int,
) -> list[Surface]:
    """Return all meshes of nodes in the scene, each with weight one for its joint."""
    budget, surfaces = VertexBudget(document, limits, num_joints), list[Surface]()
    for (node, mesh), owner in zip(meshes, owners, strict=True):
        if not np.isfinite(world[node]).all():
            raise ModelError(f"the transform of node {document.node_label(node)} is not finite")
        stored = read_surface(budget, [document.index("meshes", mesh, f"the mesh of node {node}")], 0)
        if stored is not None:
            surfaces.append(stored.on_joint(owner, num_joints, world[node]))
    if not surfaces:
        raise ModelError("no mesh has triangles: there is no rig to read")
    return surfaces
