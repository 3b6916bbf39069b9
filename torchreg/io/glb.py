"""glTF 2.0 surfaces (.glb, and .gltf with its buffers beside it): the posed triangles of the default scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchreg.errors import FormatError, ModelError
from torchreg.io.gltf_document import GltfDocument, Mode, triangles
from torchreg.io.limits import FileLimits, check_allowed
from torchreg.io.raw_cloud import Array, RawCloud, as_indices


def read_gltf(content: bytes, path: Path, limits: FileLimits) -> RawCloud:
    """Return the triangles (or the points, if there are no triangles) of the default scene in world coordinates.

    Meshes appear in the order of the node tree, vertices in the order of the file. Skinned meshes come in their bind
    pose, without their node's transform, as the standard says. Lines, morph targets and materials are ignored.
    """
    document = GltfDocument(content, path, limits)
    if not str(document.entry(document.json, "asset", dict).get("version")).startswith("2"):
        raise FormatError("must be glTF of version 2")
    try:
        instances = _instances(document)
    except ModelError as error:  # a defect of the node tree is one of the file, as nothing is a model here
        raise FormatError(str(error)) from error
    parts, total, corners = list[RawCloud](), 0, 0
    for mesh, transform in instances:
        primitives = [p for p in document.entry(mesh, "primitives", list) if isinstance(p, dict)]
        shared = dict[tuple[Any, ...], int]()
        for primitive in primitives:
            attributes = document.entry(primitive, "attributes", dict)
            if attributes.get("POSITION") is None:
                continue
            key = tuple(attributes.get(name) for name in ("POSITION", "NORMAL", "COLOR_0"))
            if key not in shared:  # primitives of one mesh often split the faces, not the vertices
                shared[key], total = total, total + document.accessor_count(key[0])
                check_allowed(total, "points", limits)
                parts.append(_vertices(document, key, transform))
            corners += document.accessor_count(key[0] if primitive.get("indices") is None else primitive["indices"])
            check_allowed(corners // 3, "faces", limits)
            faces = _faces(document, primitive, document.accessor_count(key[0]))
            if np.linalg.det(transform[:3, :3]) < 0:
                faces = faces[:, ::-1]
            parts.append(RawCloud(np.zeros((0, 3)), faces=faces + shared[key]))
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


def _instances(document: GltfDocument) -> list[tuple[dict[str, Any], Array]]:
    """Return each mesh with its world transform, walking the node tree of the default scene."""
    if "scenes" in document.json:
        roots = document.entry(document.item("scenes", document.json.get("scene", 0)), "nodes", list)
    else:
        roots = [index for index, parent in enumerate(document.node_parents()) if parent < 0]
    local = document.node_transforms()
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    found, seen = list[tuple[dict[str, Any], Array]](), set[int]()
    while pending:
        index, parent = pending.pop()
        node = document.item("nodes", index)
        if index in seen:
            raise FormatError(f"reaches nodes[{index}] on two paths: the node tree is cyclic or shared")
        seen.add(index)
        transform = parent @ local[index]
        if "mesh" in node:
            found.append((document.item("meshes", node["mesh"]), np.eye(4) if "skin" in node else transform))
        pending += [(child, transform) for child in reversed(document.entry(node, "children", list))]
    return found


def _vertices(document: GltfDocument, key: tuple[Any, ...], transform: Array) -> RawCloud:
    position, normal, color = (None if k is None else document.accessor(k) for k in key)
    if position is None or position.shape[1] != 3:
        raise FormatError("a POSITION must hold 3 numbers per vertex")
    for name, values in (("NORMAL", normal), ("COLOR_0", color)):
        if values is not None and (len(values) != len(position) or values.shape[1] not in (3, 4)):
            raise FormatError(f"a {name} does not fit its {len(position)} vertices")
    linear = transform[:3, :3]
    points = position.astype(np.float64) @ linear.T + transform[:3, 3]
    if normal is not None:
        cofactors = np.stack([np.cross(linear[k - 2], linear[k - 1]) for k in range(3)]) * np.sign(
            np.linalg.det(linear)
        )
        normal = normal[:, :3].astype(np.float64) @ cofactors.T
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normal = normal / np.where(length > 0, length, 1.0)
    return RawCloud(points, normal, None if color is None else color[:, :3].astype(np.float64))


def _faces(document: GltfDocument, primitive: dict[str, Any], count: int) -> Array:
    document.check_use(0 if primitive.get("indices") is not None else 8 * count, "a primitive without indices")
    indices = np.arange(count)
    if primitive.get("indices") is not None:
        indices = as_indices(document.accessor(primitive["indices"])[:, 0], "vertex indices")
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        raise FormatError(f"a face names a vertex outside 0 to {count - 1}: the file is damaged")
    return triangles(document.entry(primitive, "mode", int, Mode.TRIANGLES), indices, "a primitive")
