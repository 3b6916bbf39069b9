"""glTF 2.0 surfaces (.glb, and .gltf with its buffers beside it): the default scene as viewers show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchreg.errors import FormatError, ModelError
from torchreg.io.clouds.raw_cloud import Array, RawCloud, as_indices
from torchreg.io.gltf_file.clip import pose_nodes
from torchreg.io.gltf_file.document import GltfDocument, Mode, rotation_matrices, triangles
from torchreg.io.gltf_file.primitives import turned_normals
from torchreg.io.limits import FileLimits, check_allowed


@dataclass(frozen=True)
class _Instance:
    """A mesh where it is shown."""

    mesh: dict[str, Any]  # entry of the document
    transform: Array  # (4, 4) of its node to the scene, unused where a skin moves it
    skin: Array | None = None  # matrices (J, 4, 4) of the joints, from the mesh to the scene; None for plain meshes
    weights: list[float] | None = None  # of the morph targets; None for those of the mesh


def read_gltf(
    content: bytes, path: Path, limits: FileLimits, *, time: float | None = None, frame: int | None = None
) -> RawCloud:
    """Return the triangles (or the points, if there are no triangles) of the default scene in world coordinates.

    Everything stands as viewers show it: node transforms, skins in the pose of their joints, morph targets at their
    weights, instances. Meshes appear in the order of the node tree, vertices in the order of the file. Lines and
    materials are ignored.
    """
    document = GltfDocument(content, path, limits)
    if not str(document.entry(document.json, "asset", dict).get("version")).startswith("2"):
        raise FormatError("must be glTF of version 2")
    try:
        pose_nodes(document, time, frame)
        instances = _instances(document)
    except ModelError as error:  # a defect of the node tree is one of the file, as nothing is a model here
        raise FormatError(str(error)) from error
    parts, total, corners = list[RawCloud](), 0, 0
    for instance in instances:
        primitives = [p for p in document.entry(instance.mesh, "primitives", list) if isinstance(p, dict)]
        shared = dict[str, tuple[int, bool]]()
        for primitive in primitives:
            attributes = document.entry(primitive, "attributes", dict)
            if attributes.get("POSITION") is None:
                continue
            count = document.accessor_count(attributes["POSITION"])
            # Primitives of one mesh often split the faces, not the vertices.
            key = repr((sorted(attributes.items(), key=str), primitive.get("targets")))
            if key not in shared:
                begin, total = total, total + count
                check_allowed(total, "points", limits)
                cloud, mirrored = _vertices(document, primitive, instance)
                shared[key] = begin, mirrored
                parts.append(cloud)
            begin, mirrored = shared[key]
            corners += count if primitive.get("indices") is None else document.accessor_count(primitive["indices"])
            check_allowed(corners // 3, "faces", limits)
            faces = _faces(document, primitive, count)
            parts.append(RawCloud(np.zeros((0, 3)), faces=(faces[:, ::-1] if mirrored else faces) + begin))
    return _join(parts)


def _join(parts: list[RawCloud]) -> RawCloud:
    """Return one cloud of clouds without faces, and of the faces over them."""
    clouds = [part for part in parts if part.faces is None]
    faces = [part.faces for part in parts if part.faces is not None]
    if not clouds:
        raise FormatError("holds no surface in its default scene")
    normals = [cloud.normals for cloud in clouds if cloud.normals is not None]
    colors = [cloud.colors for cloud in clouds if cloud.colors is not None]
    return RawCloud(
        np.concatenate([cloud.points for cloud in clouds]),
        np.concatenate(normals) if len(normals) == len(clouds) else None,
        np.concatenate(colors) if len(colors) == len(clouds) else None,
        np.concatenate(faces) if sum(map(len, faces)) else None,
    )


def _instances(document: GltfDocument) -> list[_Instance]:
    """Return each mesh where it is shown, walking the node tree of the default scene."""
    parents = document.node_parents()
    if "scenes" in document.json:
        roots = document.entry(document.item("scenes", document.json.get("scene", 0)), "nodes", list)
    else:
        roots = [index for index, parent in enumerate(parents) if parent < 0]
    local = document.node_transforms()
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    found, seen = list[_Instance](), set[int]()
    joints = _Joints(document, parents)
    while pending:
        index, parent = pending.pop()
        node = document.item("nodes", index)
        if index in seen:
            raise FormatError(f"reaches nodes[{index}] on two paths: the node tree is cyclic or shared")
        seen.add(index)
        transform = parent @ local[index]
        if "mesh" in node:
            mesh, weights = document.item("meshes", node["mesh"]), document.entry(node, "weights", list) or None
            skin = joints.matrices(node["skin"]) if "skin" in node else None
            for place in [np.eye(4)] if skin is not None else _copies(document, node):
                found.append(_Instance(mesh, transform @ place, skin, weights))
        pending += [(child, transform) for child in reversed(document.entry(node, "children", list))]
    return found


def _copies(document: GltfDocument, node: Mapping[str, Any]) -> list[Array]:
    """Return the transforms (4, 4) of the copies of a node's mesh, the identity where it stands alone."""
    extension = document.entry(document.entry(dict(node), "extensions", dict), "EXT_mesh_gpu_instancing", dict)
    attributes = document.entry(extension, "attributes", dict)
    names = [name for name in ("TRANSLATION", "ROTATION", "SCALE") if name in attributes]
    if not names:
        return [np.eye(4)]
    values = {name: document.accessor(attributes[name], name).astype(np.float64) for name in names}
    places = np.tile(np.eye(4), (len(values[names[0]]), 1, 1))
    if any(len(rows) != len(places) or rows.shape[1] != (4 if n == "ROTATION" else 3) for n, rows in values.items()):
        raise FormatError("EXT_mesh_gpu_instancing must have equally many translations, rotations and scales")
    if "ROTATION" in values:
        places[:, :3, :3] = rotation_matrices(values["ROTATION"])
    if "SCALE" in values:
        places[:, :3, :3] *= values["SCALE"][:, None, :]
    if "TRANSLATION" in values:
        places[:, :3, 3] = values["TRANSLATION"]
    return list(places)


class _Joints:
    """The matrices of skins, each computed once."""

    def __init__(self, document: GltfDocument, parents: Sequence[int]) -> None:
        self._document, self._parents = document, parents
        self._world: Array | None = None
        self._found: dict[int, Array] = {}

    def matrices(self, skin: Any) -> Array:
        """Return (J, 4, 4) from a mesh to the scene: joint transforms times inverse bind matrices; J may be zero."""
        document = self._document
        if not document.items("skins"):
            return np.zeros((0, 4, 4))
        index = document.index("skins", skin, "the skin of a node")
        if index not in self._found:
            if self._world is None:
                self._world = document.node_globals(self._parents)
            entry = document.item("skins", index)
            joints = [document.index("nodes", joint, "a joint") for joint in document.entry(entry, "joints", list)]
            matrices = self._world[joints].reshape(-1, 4, 4)
            if entry.get("inverseBindMatrices") is not None:
                stored = document.accessor(entry["inverseBindMatrices"], "inverseBindMatrices", ("MAT4",))
                if len(stored) < len(joints):
                    raise FormatError(f"{len(joints)} joints but {len(stored)} inverse bind matrices")
                inverse = np.swapaxes(stored[: len(joints)].astype(np.float64).reshape(-1, 4, 4), 1, 2)
                matrices = matrices @ inverse
            self._found[index] = matrices
        return self._found[index]


def _vertices(document: GltfDocument, primitive: dict[str, Any], instance: _Instance) -> tuple[RawCloud, bool]:
    """Return the vertices of a primitive in the scene, and whether they are mirrored."""
    attributes = document.entry(primitive, "attributes", dict)
    position = document.accessor(attributes["POSITION"])
    normal, color = (
        None if attributes.get(n) is None else document.accessor(attributes[n]) for n in ("NORMAL", "COLOR_0")
    )
    if position.shape[1] != 3:
        raise FormatError("a POSITION must hold 3 numbers per vertex")
    for name, values in (("NORMAL", normal), ("COLOR_0", color)):
        if values is not None and (len(values) != len(position) or values.shape[1] not in (3, 4)):
            raise FormatError(f"a {name} does not fit its {len(position)} vertices")
    points = position.astype(np.float64) + _morphed(document, primitive, instance, "POSITION", len(position))
    if normal is not None:
        normal = normal[:, :3].astype(np.float64) + _morphed(document, primitive, instance, "NORMAL", len(position))
    moved = _blended(document, attributes, instance.skin, len(points)) if instance.skin is not None else None
    matrices = instance.transform[None] if moved is None else moved
    if instance.skin is not None and moved is None:
        matrices = np.eye(4)[None]  # says that a skin moves it, but not how
    linear = matrices[:, :3, :3]
    points = (linear @ points[..., None])[..., 0] + matrices[:, :3, 3]
    determinants = np.linalg.det(linear)
    if normal is not None:
        normal = turned_normals(normal, linear, determinants)
    colors = None if color is None else color[:, :3].astype(np.float64)
    return RawCloud(points, normal, colors), bool(np.mean(determinants < 0) > 0.5)


def _blended(document: GltfDocument, attributes: Mapping[str, Any], skin: Array, count: int) -> Array | None:
    """Return the matrix (V, 4, 4) of every vertex under a skin (J, 4, 4); without weights the first joint moves it."""
    blend, total, number = np.zeros((count, 4, 4)), np.zeros(count), 0
    first = np.zeros(count, np.int64)
    while attributes.get(f"JOINTS_{number}") is not None and len(skin):
        joints, weights = (
            document.accessor(attributes.get(f"{name}_{number}"), f"{name}_{number}", ("VEC4",))
            for name in ("JOINTS", "WEIGHTS")
        )
        if len(joints) != count or len(weights) != count or joints.dtype.kind not in "iu":
            raise FormatError(f"JOINTS_{number} and WEIGHTS_{number} do not fit their {count} vertices")
        weights = np.where(np.isfinite(weights), weights, 0.0).astype(np.float64)
        joints = np.where(weights != 0, joints.astype(np.int64), 0)
        if count and (joints.min() < 0 or joints.max() >= len(skin)):
            raise FormatError(f"a vertex names joint {joints.max()} of a skin with {len(skin)}")
        first = joints[:, 0] if number == 0 else first
        for k in range(4):
            blend += weights[:, k, None, None] * skin[joints[:, k]]
        total, number = total + weights.sum(1), number + 1
    if number == 0:
        return None
    blend[total == 0] = skin[first[total == 0]]
    blend /= np.where(total == 0, 1.0, total)[:, None, None]
    return blend


def _morphed(document: GltfDocument, primitive: dict[str, Any], instance: _Instance, name: str, count: int) -> Array:
    """Return the displacement (V, 3) of an attribute by morph targets at their weights."""
    targets = document.entry(primitive, "targets", list)
    weights = instance.weights or document.entry(instance.mesh, "weights", list)
    total = np.zeros((count, 3))
    for target, weight in zip(targets, weights, strict=False):
        if isinstance(weight, (int, float)) and weight and isinstance(target, dict) and target.get(name) is not None:
            offset = document.accessor(target[name], f"{name} of a morph target", ("VEC3",))
            if len(offset) != count:
                raise FormatError(f"a morph target has {len(offset)} vertices, its mesh {count}")
            total += weight * offset.astype(np.float64)
    return total


def _faces(document: GltfDocument, primitive: dict[str, Any], count: int) -> Array:
    document.check_use(0 if primitive.get("indices") is not None else 8 * count, "a primitive without indices")
    indices = np.arange(count)
    if primitive.get("indices") is not None:
        indices = as_indices(document.accessor(primitive["indices"])[:, 0], "vertex indices")
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        raise FormatError(f"a face names a vertex outside 0 to {count - 1}: the file is damaged")
    return triangles(document.entry(primitive, "mode", int, Mode.TRIANGLES), indices, "a primitive")
