"""glTF 2.0 surfaces (.glb, and .gltf with its buffers beside it): the posed triangles of the default scene."""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.limits import FileLimits, check_count, read_bytes
from torchreg.io.raw_cloud import Array, RawCloud, as_indices

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6


class GltfDocument:
    """The JSON and the buffers of a glTF file, with every index and size checked when it is used.

    Args:
        content: bytes of the .glb or .gltf file.
        path: where they came from; buffers in files of their own must lie in its folder or below.
        limits: ``max_bytes`` applies to each buffer.

    Raises:
        FormatError: if the container is damaged or refers to anything outside the folder.
    """

    def __init__(self, content: bytes, path: Path, limits: FileLimits) -> None:
        text, self._binary = _open_container(content) if content[:4] == b"glTF" else (content, None)
        self._path, self._limits = path, limits
        self.json = json.loads(text)
        if not isinstance(self.json, dict) or not str(self.entry(self.json, "asset", dict).get("version")).startswith(
            "2"
        ):
            raise FormatError("must be glTF of version 2")
        for name in self.entry(self.json, "extensionsRequired", list):
            if name in _PACKED:
                raise FormatError(f"needs the extension {name}, which is not read; export it without compression")
        self._buffers: dict[int, bytes] = {}

    @staticmethod
    def entry(owner: dict[str, Any], key: str, kind: type, default: Any = None) -> Any:
        """Return ``owner[key]``, an instance of ``kind``; ``default`` (or an empty ``kind``) if it is missing."""
        value = owner.get(key, kind() if default is None else default)
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise FormatError(f"the entry {key!r} must be of type {kind.__name__}, got {type(value).__name__}")
        return value

    def item(self, collection: str, index: Any) -> dict[str, Any]:
        """Return element ``index`` of a top-level list such as "meshes"; FormatError if there is none."""
        items = self.entry(self.json, collection, list)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(items):
            raise FormatError(f"refers to {collection}[{index!r}], but there are {len(items)}")
        if not isinstance(items[index], dict):
            raise FormatError(f"{collection}[{index}] must be an object")
        return items[index]

    def accessor_count(self, index: Any) -> int:
        """Return how many elements accessor ``index`` claims, at least zero."""
        count = self.entry(self.item("accessors", index), "count", int)
        if count < 0:
            raise FormatError(f"accessors[{index}] claims {count} elements")
        return count

    def accessor(self, index: Any) -> Array:
        """Return accessor ``index`` as (count, width) in its own type, normalized integers as float64.

        Raises:
            FormatError: if it is sparse, of unknown type or reaches beyond its buffer.
        """
        item, count = self.item("accessors", index), self.accessor_count(index)
        if "sparse" in item or "bufferView" not in item:
            raise FormatError(f"accessors[{index}] is sparse, which is not read; export it as a plain buffer")
        component, shape = item.get("componentType"), item.get("type")
        if not isinstance(component, int) or component not in _COMPONENTS or shape not in _WIDTHS:
            raise FormatError(f"accessors[{index}] has the unknown type {component!r}, {shape!r}")
        dtype, width = np.dtype(_COMPONENTS[component]), _WIDTHS[shape]
        view, stride = self._view(item["bufferView"])
        offset, stride = self.entry(item, "byteOffset", int), stride or dtype.itemsize * width
        needed = offset + (count - 1) * stride + dtype.itemsize * width if count else 0
        if offset < 0 or not 0 < stride <= 4096 or needed > len(view):
            raise FormatError(f"accessors[{index}] of {count} elements reaches beyond its buffer: it is damaged")
        if count == 0:
            return np.zeros((0, width), dtype)
        values: Array = np.ndarray((count, width), dtype, view, offset, (stride, dtype.itemsize))
        if item.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _view(self, index: Any) -> tuple[memoryview, int]:
        item = self.item("bufferViews", index)
        buffer = self._buffer(item.get("buffer"))
        offset, length = self.entry(item, "byteOffset", int), self.entry(item, "byteLength", int)
        if min(offset, length) < 0 or offset + length > len(buffer):
            raise FormatError(f"bufferViews[{index}] reaches beyond its buffer: the file is cut off or damaged")
        return memoryview(buffer)[offset : offset + length], self.entry(item, "byteStride", int)

    def _buffer(self, index: Any) -> bytes:
        item = self.item("buffers", index)
        if index not in self._buffers:
            content = self._external(self.entry(item, "uri", str)) if "uri" in item else self._binary
            if content is None or len(content) < self.entry(item, "byteLength", int):
                raise FormatError(f"buffers[{index}] is missing or shorter than its byteLength: the file is cut off")
            self._buffers[index] = content
        return self._buffers[index]

    def _external(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            head, _, packed = uri.partition(",")
            if not head.endswith(";base64"):
                raise FormatError("holds a buffer in a data URI that is not base64")
            try:
                return base64.b64decode(packed, validate=True)
            except binascii.Error as error:
                raise FormatError(f"holds a damaged base64 buffer ({error})") from error
        name, folder = unquote(uri), self._path.parent.resolve()
        place = (folder / name).resolve()
        if (
            "://" in name
            or name.startswith(("//", "\\"))
            or Path(name).is_absolute()
            or not place.is_relative_to(folder)
        ):
            raise FormatError(f"refers to the buffer {uri[:80]!r}; only files in its own folder are read")
        try:
            return read_bytes(place, self._limits)
        except OSError as error:
            raise FormatError(f"its buffer {uri[:80]!r} cannot be read ({error})") from error


def _open_container(content: bytes) -> tuple[bytes, bytes | None]:
    if len(content) < 20:
        raise FormatError("is cut off in its header")
    _, version, length = struct.unpack_from("<4sII", content)
    if version != 2 or length != len(content):
        raise FormatError(
            f"says version {version} and {length} bytes, the file holds {len(content)}: it is cut off or damaged"
        )
    chunks, place = list[tuple[bytes, bytes]](), 12
    while place + 8 <= length:
        size, kind = struct.unpack_from("<I4s", content, place)
        if place + 8 + size > length:
            raise FormatError("has a chunk that reaches beyond its end: it is damaged")
        chunks.append((kind, content[place + 8 : place + 8 + size]))
        place += 8 + size
    if not chunks or chunks[0][0] != b"JSON":
        raise FormatError("must begin with a JSON chunk")
    return chunks[0][1], next((data for kind, data in chunks[1:] if kind == b"BIN\0"), None)


def read_gltf(content: bytes, path: Path, limits: FileLimits) -> RawCloud:
    """Return the triangles (or the points, if there are no triangles) of the default scene in world coordinates.

    Meshes appear in the order of the node tree, vertices in the order of the file. Skinned meshes come in their bind
    pose, without their node's transform, as the standard says. Lines, morph targets and materials are not looked at.

    Raises:
        FormatError: if the file is damaged, cyclic, too large, compressed or refers to remote data.
    """
    document = GltfDocument(content, path, limits)
    parts, total, corners = list[RawCloud](), 0, 0
    for mesh, transform in _instances(document):
        primitives = [p for p in document.entry(mesh, "primitives", list) if isinstance(p, dict)]
        shared = dict[tuple[Any, ...], int]()
        for primitive in primitives:
            attributes = document.entry(primitive, "attributes", dict)
            if "POSITION" not in attributes:
                continue
            key = tuple(attributes.get(name) for name in ("POSITION", "NORMAL", "COLOR_0"))
            if key not in shared:  # primitives of one mesh often split the faces, not the vertices
                shared[key], total = total, total + document.accessor_count(key[0])
                check_count(total, "points", limits)
                parts.append(_vertices(document, key, transform))
            corners += document.accessor_count(primitive.get("indices", key[0]))
            check_count(corners // 3, "faces", limits)
            faces = _faces(document, primitive, document.accessor_count(key[0]))
            if np.linalg.det(transform[:3, :3]) < 0:
                faces = faces[:, ::-1]
            parts.append(RawCloud(np.zeros((0, 3)), faces=faces + shared[key]))
    return _join(parts)


def _join(parts: list[RawCloud]) -> RawCloud:
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
    nodes = document.entry(document.json, "nodes", list)
    if "scenes" in document.json:
        roots = document.entry(document.item("scenes", document.json.get("scene", 0)), "nodes", list)
    else:
        below = {
            child for k in range(len(nodes)) for child in document.entry(document.item("nodes", k), "children", list)
        }
        roots = [k for k in range(len(nodes)) if k not in below]
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    found, seen = list[tuple[dict[str, Any], Array]](), set[int]()
    while pending:
        index, parent = pending.pop()
        node = document.item("nodes", index)
        if index in seen:
            raise FormatError(f"reaches nodes[{index}] on two ways: the node tree is cyclic or shared")
        seen.add(index)
        transform = parent @ _local_transform(document, node, index)
        if "mesh" in node:
            found.append((document.item("meshes", node["mesh"]), np.eye(4) if "skin" in node else transform))
        pending += [(child, transform) for child in reversed(document.entry(node, "children", list))]
    return found


def _numbers(document: GltfDocument, node: dict[str, Any], key: str, default: list[float]) -> Array:
    values = document.entry(node, key, list, default)
    if len(values) != len(default) or not all(isinstance(v, (int, float)) and abs(v) < 1e30 for v in values):
        raise FormatError(f"a node's {key} must be {len(default)} finite numbers")
    return np.array(values, dtype=np.float64)


def _local_transform(document: GltfDocument, node: dict[str, Any], index: int) -> Array:
    if "matrix" in node:
        return _numbers(document, node, "matrix", [0.0] * 16).reshape(4, 4).T
    x, y, z, w = _numbers(document, node, "rotation", [0.0, 0.0, 0.0, 1.0])
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.5 < length < 2:
        raise FormatError(f"nodes[{index}] has a rotation of length {length:g}; a unit quaternion is needed")
    x, y, z, w = x / length, y / length, z / length, w / length
    transform = np.eye(4)
    transform[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    transform[:3, :3] *= _numbers(document, node, "scale", [1.0, 1.0, 1.0])
    transform[:3, 3] = _numbers(document, node, "translation", [0.0, 0.0, 0.0])
    return transform


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
    mode = primitive.get("mode", _TRIANGLES)
    indices = np.arange(count)
    if "indices" in primitive:
        indices = as_indices(document.accessor(primitive["indices"])[:, 0], "vertex indices")
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        raise FormatError(f"a face names a vertex outside 0 to {count - 1}: the file is damaged")
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise FormatError(f"has {len(indices)} triangle corners, not a multiple of 3: it is damaged")
        return indices.reshape(-1, 3)
    if mode not in (_STRIP, _FAN) or len(indices) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    first = np.full(len(indices) - 2, indices[0]) if mode == _FAN else indices[:-2]
    faces = np.stack((first, indices[1:-1], indices[2:]), axis=-1)
    if mode == _STRIP:
        faces[1::2, :2] = faces[1::2, 1::-1]  # every second triangle of a strip is turned over
    return faces
