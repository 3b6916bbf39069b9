"""Reading rigged glTF files (.glb, .gltf): skeleton, skinned meshes and skin weights as one plain record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchreg.errors import ModelError
from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.file_format import naming, warn
from torchreg.io.gltf_file.document import GltfDocument
from torchreg.io.gltf_file.parts import read_parts
from torchreg.io.gltf_file.placement import place_skins
from torchreg.io.gltf_file.primitives import Surface, VertexBudget, read_surface
from torchreg.io.gltf_file.skins import Skeleton, ancestors, read_skeleton, shown_nodes
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes


@dataclass(frozen=True)
class RigRecord:
    """A skinned mesh and the skeleton that moves it, all in the coordinates of the file's scene, metres, y up.

    The file's own deformation is ``x = sum_j w_j T_world_joint_j joint_transforms_j^-1 v``; with
    ``rest_transforms`` it gives the pose that a viewer shows before an animation plays.
    """

    name: str  # name of the skin, or of the file
    joint_names: tuple[str, ...]  # J different names, in the file's order; a repeated name gets ``#`` and its index
    parents: tuple[int, ...]  # J indices of parent joints, -1 for roots; parents may come after their children
    joint_transforms: Tensor  # (J, 4, 4) float64 rigid ``T_world_joint`` of the pose that ``vertices`` are in
    rest_transforms: Tensor  # (J, 4, 4) float64 rigid ``T_world_joint`` of the node hierarchy
    vertices: Tensor  # (V, 3) float64, also those no face uses; of one skin after the other, rigid meshes last
    faces: Tensor  # (F, 3) int64
    normals: Tensor | None  # (V, 3) float64, or None when a part of the mesh has none
    weights: Tensor  # (V, J) float64, rows sum to one
    is_rigid: bool = False  # whether nothing is skinned: every mesh moves with its node
    slides: tuple[str, ...] = ()  # names of the joints that a clip slides
    fixed: tuple[str, ...] = ()  # names of the joints that nothing turns


def load_rig(
    path: str | Path,
    *,
    mesh: str | int | None = None,
    skin: str | int | None = None,
    parents: Mapping[str, str | None] | None = None,
    limits: FileLimits = DEFAULT_LIMITS,
) -> RigRecord:
    """Return the skeleton, the meshes and the skin weights of a glTF file.

    The joints of all skins are one skeleton, whose bind pose stands in the scene as the nodes have it. Meshes without a
    skin that hang on a joint are rigid parts of it; without any skin, the nodes that a clip moves are the joints.
    ``parents`` names the parent of joints that a file lists side by side. What is left out or repaired is warned of.
    """
    source = local_path(path)
    content = read_bytes(source, limits)
    with naming(source):
        document = GltfDocument(content, source, limits)
        read = read_skeleton(document, mesh, skin, parents or {}, limits)
        if read is None:
            return _record_of_parts(document, source.stem, mesh, parents or {}, limits)
        skeleton, budget = read
        _warn_about_several_skeletons(skeleton)
        place_skins(document, skeleton)
        surfaces = [skeleton.placed_surface(skin) for skin in skeleton.skins]
        if mesh is None and skin is None:
            surfaces += _rigid_meshes(document, skeleton, budget)
        skins = {skin.index for skin in skeleton.skins}
        own_name = document.item("skins", min(skins)).get("name") if len(skins) == 1 else None
        return _record(str(own_name or source.stem), skeleton, surfaces)


def _warn_about_several_skeletons(skeleton: Skeleton) -> None:
    """Warn if skins share no root, as those of two characters: one shape holds both."""
    tops: dict[int, list[str]] = {}
    for skin in skeleton.skins:
        joint = int(skin.joints[0])
        top = ([joint, *ancestors(joint, skeleton.parents)])[-1]
        tops.setdefault(top, []).append(str(skin.index))
    if len(tops) > 1:
        groups = " and ".join(", ".join(numbers) for numbers in tops.values())
        warn(f"skins {groups} have skeletons of their own, and are read as one shape; skin= reads one of them")


def _record(name: str, skeleton: Skeleton, surfaces: list[Surface]) -> RigRecord:
    """Return what was read as one rig."""
    begins = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    normals = [surface.normals for surface in surfaces if surface.normals is not None]
    faces = [surface.faces + begin for surface, begin in zip(surfaces, begins, strict=False)]
    return RigRecord(
        name=name,
        joint_names=tuple(skeleton.names),
        parents=skeleton.parents,
        joint_transforms=torch.from_numpy(without_scale(skeleton.places)),
        rest_transforms=torch.from_numpy(without_scale(skeleton.world)),
        vertices=torch.from_numpy(np.concatenate([surface.vertices for surface in surfaces])),
        faces=torch.from_numpy(np.ascontiguousarray(np.concatenate(faces))),
        normals=torch.from_numpy(np.concatenate(normals)) if len(normals) == len(surfaces) else None,
        weights=torch.from_numpy(np.concatenate([surface.weights for surface in surfaces])),
    )


def without_scale(matrices: Array) -> Array:
    """Return the rigid motions (J, 4, 4) nearest to affine ones."""
    result = np.tile(np.eye(4), (len(matrices), 1, 1))
    size = np.abs(matrices[:, :3, :3]).max((1, 2))[:, None, None]
    u, _, vt = np.linalg.svd(matrices[:, :3, :3] / np.where(size > 0, size, 1.0))
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
    result[:, :3, :3], result[:, :3, 3] = u @ vt, matrices[:, :3, 3]
    return result


def _rigid_meshes(document: GltfDocument, skeleton: Skeleton, budget: VertexBudget) -> list[Surface]:
    """Return the meshes without a skin that hang on joints, as rigid parts of these; others are named."""
    parents = document.node_parents()
    world = document.node_globals(parents)
    surfaces, kept, left = list[Surface](), list[str](), list[str]()
    for node in sorted(shown_nodes(document)):
        entry = document.item("nodes", node)
        if entry.get("mesh") is None or entry.get("skin") is not None:
            continue
        chain = (node, *ancestors(node, parents))
        joint = next((skeleton.number[above] for above in chain if above in skeleton.number), -1)
        if joint < 0 or abs(np.linalg.det(skeleton.world[joint])) < 1e-30:
            left.append(document.node_label(node))
            continue
        stored = read_surface(budget, [document.index("meshes", entry["mesh"], f"the mesh of node {node}")], 0)
        if stored is None:
            continue
        motion = skeleton.places[joint] @ np.linalg.solve(skeleton.world[joint], world[node])
        surfaces.append(stored.on_joint(joint, len(skeleton.nodes), motion))
        kept.append(f"{document.node_label(node)} on {skeleton.names[joint]!r}")
    if kept:
        listed = ", ".join(kept[:5])
        warn(
            f"{len(kept)} meshes without a skin are rigid parts of the joints they hang on: {listed}; "
            f"skin= leaves them out"
        )
    if left:
        warn(f"{len(left)} meshes without a skin hang on no joint and are left out: {', '.join(left[:5])}")
    return surfaces


def _record_of_parts(
    document: GltfDocument, name: str, mesh: str | int | None, parents: Mapping[str, str | None], limits: FileLimits
) -> RigRecord:
    """Return the rig of a file without skins, whose meshes move rigidly."""
    if mesh is not None or parents:
        raise ModelError("no node carries both a mesh and a skin: there is no rig for mesh= or parents=")
    parts = read_parts(document, name, limits)
    return replace(_record(name, parts.skeleton, parts.surfaces), is_rigid=True, slides=parts.slides, fixed=parts.fixed)
