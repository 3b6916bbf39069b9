"""A glTF 2.0 document (.glb, or .gltf and its buffers): its entries, numbers and nodes, checked when they are used."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from torchreg.errors import FormatError, ModelError
from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.gltf_file.draco import DracoGeometry
from torchreg.io.limits import FILE_BUDGET, FileLimits, check_budget, read_bytes


class Mode(IntEnum):
    """Modes of primitives that draw triangles."""

    TRIANGLES = 4
    STRIP = 5
    FAN = 6


_COMPONENTS = {
    number: np.dtype(name)
    for number, name in {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}.items()
}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_NODE_DEFAULTS: dict[str, list[float]] = {
    "matrix": [0.0] * 16,
    "rotation": [0.0, 0.0, 0.0, 1.0],
    "scale": [1.0, 1.0, 1.0],
    "translation": [0.0, 0.0, 0.0],
}
_COMPRESSED = ("EXT_meshopt_compression", "KHR_meshopt_compression")


class GltfDocument:
    """The JSON and the buffers of a glTF file, checked where they are used; callers add the file's name to errors."""

    def __init__(self, content: bytes, path: Path, limits: FileLimits) -> None:
        text, self._binary = _open_container(content) if content[:4] == b"glTF" else (content, None)
        self._path, self._limits = path, limits
        self._buffers: dict[int, bytes] = {}
        self._external_bytes, self._used = 0, 0
        self._own_bytes = len(content)
        try:
            self.json = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise FormatError(f"not a readable glTF document ({type(error).__name__}: {error})") from error
        if not isinstance(self.json, dict):
            raise FormatError(f"must be glTF of version 2, whose JSON is an object; got {type(self.json).__name__}")
        compressed = [name for name in self.entry(self.json, "extensionsRequired", list) if name in _COMPRESSED]
        if compressed:
            hint = "save it again without mesh compression, as `npx @gltf-transform/cli copy in.glb out.glb` does"
            raise FormatError(f"needs the extension {compressed[0]}, which is not read; {hint}")
        self._draco = DracoGeometry(self)

    @property
    def size(self) -> int:
        """Bytes of the file and of the buffers that were read beside it."""
        return self._own_bytes + self._external_bytes

    @staticmethod
    def entry(owner: dict[str, Any], key: str, kind: type, default: Any = None) -> Any:
        """Return ``owner[key]`` of type ``kind``; ``default`` (or an empty ``kind``) if it is missing or null."""
        value = owner.get(key)
        if value is None:
            return kind() if default is None else default
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise FormatError(
                f"not a readable glTF document: the entry {key!r} must be of type {kind.__name__}, "
                f"got {type(value).__name__}"
            )
        return value

    def items(self, collection: str) -> list[dict[str, Any]]:
        """Return a top-level list such as "meshes", empty where it is missing; FormatError unless it holds objects."""
        items = self.entry(self.json, collection, list)
        for number, item in enumerate(items):
            if not isinstance(item, dict):
                raise FormatError(f"{collection}[{number}] must be an object: {collection} must be a list of objects")
        return items

    def index(self, collection: str, value: Any, what: str | None = None) -> int:
        """Return ``value`` if it is an index into a top-level list; FormatError, which names ``what``, if it is not."""
        count = len(self.entry(self.json, collection, list))
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < count:
            raise FormatError(
                f"{what or 'an entry'} must be an index below {count}: it refers to {collection}[{value!r}], but there "
                f"are {count}"
            )
        return value

    def item(self, collection: str, index: Any, what: str | None = None) -> dict[str, Any]:
        """Return element ``index`` of a top-level list; FormatError, naming ``what`` refers to it, if there is none."""
        found = self.entry(self.json, collection, list)[self.index(collection, index, what)]
        if not isinstance(found, dict):
            raise FormatError(f"{collection}[{index}] must be an object")
        return found

    def accessor_count(self, index: Any, what: str | None = None) -> int:
        """Return the number of elements that an accessor claims, at least zero."""
        item = self.item("accessors", index, what and f"the accessor of {what}")
        count = self.entry(item, "count", int)
        if count < 0:
            raise FormatError(f"accessors[{index}] claims {count} elements")
        return count

    def accessor(self, index: Any, what: str | None = None, types: Sequence[str] = tuple(_WIDTHS)) -> Array:
        """Return an accessor of one of ``types`` as (count, width), normalized integers as float64."""
        count = self.accessor_count(index, what)
        item = self.item("accessors", index)
        what = what or f"accessors[{index}] of {count} elements"
        dtype, shape = self._component(item, what), item.get("type")
        if not isinstance(shape, str) or shape not in types:
            raise FormatError(f"{what} must be {' or '.join(types)}, got {shape!r}")
        width, sparse = _WIDTHS[shape], item.get("sparse")
        if count * width * dtype.itemsize > self._limits.max_bytes:
            raise FormatError(f"{what} has {count} elements, more than the size limit allows")
        if item.get("bufferView") is not None:
            self._buffer_of(item, what)
        self.check_use(count * width * dtype.itemsize, what)
        packed = self._draco.numbers(index, what, (count, width)) if item.get("bufferView") is None else None
        if item.get("bufferView") is None and sparse is None and packed is None:
            raise FormatError(f"{what} has no data; save the file again without mesh compression")
        if packed is not None:
            values: Array = packed.astype(dtype)
        elif item.get("bufferView") is None:
            values = np.zeros((count, width), dtype)
        else:
            values = self._elements(item, count, width, dtype, what)
        if sparse is not None:
            values = self._with_sparse(values, self.entry(item, "sparse", dict), what)
        if item.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def view(self, owner: dict[str, Any], what: str) -> memoryview:
        """Return the bytes of the buffer view of an entry, of what messages call ``what``."""
        index = owner.get("bufferView")
        view = self.item("bufferViews", index, f"the bufferView of {what}")
        data = self._buffer_of(owner, what)
        start, length = (self._size(view, key, f"bufferViews[{index}]") for key in ("byteOffset", "byteLength"))
        if start + length > len(data):
            raise FormatError(
                f"bufferViews[{index}] reaches beyond its buffer of {len(data)} bytes; the file is cut short or damaged"
            )
        return memoryview(data)[start : start + length]

    def _buffer_of(self, owner: dict[str, Any], what: str) -> bytes:
        """Return the buffer that the buffer view of an entry is part of."""
        view = self.item("bufferViews", owner.get("bufferView"), f"the bufferView of {what}")
        return self.buffer(self.index("buffers", view.get("buffer"), f"the buffer of {what}"))

    def check_use(self, size: int, what: str) -> None:
        """Raise FormatError if all accessors that were read ask for far more bytes than the document holds."""
        self._used += size
        allowed = FILE_BUDGET.expanded_bytes + FILE_BUDGET.uses * self.size
        if self._used > allowed:
            raise FormatError(
                f"{what} and what was read before it ask for {self._used} bytes, a document of {self.size} bytes for "
                f"at most {allowed}"
            )

    def _component(self, owner: dict[str, Any], what: str) -> np.dtype[Any]:
        component = owner.get("componentType")
        if not isinstance(component, int) or component not in _COMPONENTS:
            raise FormatError(f"{what} has the unknown type {component!r}, not a known component type such as 5126")
        return _COMPONENTS[component]

    def _with_sparse(self, values: Array, sparse: dict[str, Any], what: str) -> Array:
        """Return a copy of values in which those that a sparse accessor lists are replaced."""
        indices, replacements = self.entry(sparse, "indices", dict), self.entry(sparse, "values", dict)
        if not indices or not replacements:
            raise FormatError(f"{what} is sparse, but lacks indices or values")
        count, dtype = self.entry(sparse, "count", int), self._component(indices, f"the sparse part of {what}")
        if dtype.kind != "u" or not 0 < count <= len(values):
            raise FormatError(f"the sparse part of {what} has {count} entries of unusable type or number")
        rows = self._elements(indices, count, 1, dtype, what)[:, 0]
        if int(rows.max()) >= len(values):
            raise FormatError(f"the sparse part of {what} points at element {rows.max()} of {len(values)}")
        values = values.copy()
        values[rows] = self._elements(replacements, count, values.shape[1], values.dtype, what)
        return values

    def _elements(self, owner: dict[str, Any], count: int, width: int, dtype: np.dtype[Any], what: str) -> Array:
        """Return a read-only (count, width) window into the buffer view of ``owner``, checked to lie inside."""
        view, data = self.item("bufferViews", owner.get("bufferView")), self.view(owner, what)
        if count == 0:
            return np.zeros((0, width), dtype)
        offset, size = self._size(owner, "byteOffset", what), width * dtype.itemsize
        stride = self._size(view, "byteStride", what) or size
        if offset + stride * (count - 1) + size > len(data):
            raise FormatError(
                f"{what} reaches beyond its buffer ({count} elements of {size} bytes, view of {len(data)} bytes); "
                f"the file is cut short or damaged"
            )
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))

    def _size(self, owner: dict[str, Any], key: str, what: str) -> int:
        value: int = self.entry(owner, key, int)
        if not 0 <= value <= self._limits.max_bytes:
            raise FormatError(f"the {key} of {what} is {value}: it reaches beyond its buffer")
        return value

    def buffer(self, index: int) -> bytes:
        """Return the bytes of a buffer, from the file or beside it."""
        if index not in self._buffers:
            item = self.item("buffers", index)
            uri = item.get("uri")
            data = self._binary if uri is None else self.external(f"buffer {index}", self.entry(item, "uri", str))
            if data is None:
                raise FormatError(f"buffer {index} has neither an address nor a binary chunk")
            length = self._size(item, "byteLength", f"buffer {index}")
            if length > len(data):
                raise FormatError(
                    f"buffer {index} should have {length} bytes, got {len(data)}: it is shorter than its byteLength"
                )
            self._buffers[index] = data
        return self._buffers[index]

    def external(self, what: str, uri: str) -> bytes:
        """Return the bytes at an address, of what messages call ``what``."""
        if uri.startswith("data:"):
            head, _, packed = uri.partition(",")
            if not head.endswith(";base64"):
                raise FormatError(f"{what} is not base64, as data inside a file must be base64: {head[:60]!r}")
            try:
                return base64.b64decode(packed, validate=True)
            except ValueError as error:
                raise FormatError(f"{what} is damaged base64, not valid base64 ({error})") from error
        name, folder = unquote(uri), self._path.parent.resolve()
        # A lone surrogate, which JSON may hold, is in no file's name.
        plain = not {":", "\0", "\\"} & set(name) and name.isprintable()
        file = (folder / name).resolve() if plain else None
        if file is None or not file.is_relative_to(folder):
            raise FormatError(f"refers to the buffer {uri[:100]!a}, which must lie in the file's folder or below")
        try:
            data = read_bytes(file, self._limits)
            self._external_bytes += len(data)
            return data
        except FileNotFoundError as error:
            raise FormatError(f"its buffer {uri[:100]!a} cannot be read: it is not there") from error
        except OSError as error:
            raise FormatError(f"its buffer {uri[:100]!a} cannot be read ({error})") from error

    def node_label(self, index: int) -> str:
        """Return the name of a node for messages, or its number if it has none."""
        name = self.item("nodes", index).get("name")
        return repr(name) if name else str(index)

    def node_parents(self) -> list[int]:
        """Return the parent of each node, -1 for roots."""
        nodes = self.items("nodes")
        parents = [-1] * len(nodes)
        for number, node in enumerate(nodes):
            for value in self.entry(node, "children", list):
                child = self.index("nodes", value, f"a child of node {number}")
                if parents[child] >= 0:
                    raise ModelError(f"node {self.node_label(child)} has two parents; glTF allows one")
                parents[child] = number
        return parents

    def node_transforms(self) -> Array:
        """Return the (nodes, 4, 4) transforms of all nodes in their parents."""
        nodes = self.items("nodes")
        check_budget(len(nodes), FILE_BUDGET.nodes, "nodes")
        result = np.tile(np.eye(4), (len(nodes), 1, 1))
        columns = {key: self._node_numbers(nodes, key, default) for key, default in _NODE_DEFAULTS.items()}
        quaternion = columns["rotation"]
        length = np.linalg.norm(quaternion, axis=1)
        has_matrix = np.array([node.get("matrix") is not None for node in nodes], dtype=bool)
        if not (length > 0)[~has_matrix].all():
            stuck = int((~(length > 0) & ~has_matrix).argmax())
            raise ModelError(f"the rotation of node {self.node_label(stuck)} is a zero quaternion")
        result[:, :3, :3] = rotation_matrices(quaternion) * columns["scale"][:, None]
        result[:, :3, 3] = columns["translation"]
        result[has_matrix] = columns["matrix"].reshape(-1, 4, 4).swapaxes(1, 2)[has_matrix]
        return result

    def node_globals(self, parents: Sequence[int]) -> Array:
        """Return the (nodes, 4, 4) transforms of all nodes in the scene, infinite where they overflow."""
        order = parents_first(parents)
        if len(order) < len(parents):
            stuck = sorted(set(range(len(parents))) - set(order))
            raise ModelError(f"the node hierarchy is cyclic at {', '.join(map(self.node_label, stuck[:5]))}")
        result = np.empty((len(parents), 4, 4))
        local = self.node_transforms()
        with np.errstate(over="ignore", invalid="ignore"):
            for index in order:
                parent = parents[index]
                result[index] = local[index] if parent < 0 else result[parent] @ local[index]
        return result

    def _node_numbers(self, nodes: list[dict[str, Any]], key: str, default: list[float]) -> Array:
        """Return the (nodes, ...) numbers of all nodes under a key."""
        rows = [
            default if node.get(key) is None else self._numbers(node, key, default, number)
            for number, node in enumerate(nodes)
        ]
        return np.array(rows, dtype=np.float64).reshape(len(nodes), len(default))

    def _numbers(self, node: dict[str, Any], key: str, default: list[float], number: int) -> list[float]:
        values: list[float] = self.entry(node, key, list)
        if len(values) == len(default) and all(type(v) in (int, float) and abs(v) < 1e300 for v in values):
            return values
        what = f"of node {self.node_label(number)}"
        if len(values) != len(default) or any(type(value) not in (int, float) for value in values):
            raise FormatError(
                f"not a readable glTF document: the {key} {what} must hold {len(default)} numbers, got {values!r:.100}"
            )
        # Products of larger numbers overflow.
        raise ModelError(f"the {key} {what} is not finite: {values!r:.100}")


def _open_container(content: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a .glb file."""
    if len(content) < 20:
        raise FormatError(f"is cut off in its header: a .glb file has at least 20 bytes, got {len(content)}")
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2 or length != len(content):
        raise FormatError(
            f"expected glTF 2 of {len(content)} bytes; the header says version {version} and {length} bytes: it is cut "
            f"off or damaged"
        )
    chunks, offset = list[tuple[bytes, bytes]](), 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", content, offset)
        if offset + 8 + size > length:
            raise FormatError(f"the chunk at byte {offset} reaches beyond the end of the file: it is damaged")
        chunks.append((kind, content[offset + 8 : offset + 8 + size]))
        offset += 8 + size
    if chunks[0][0] != b"JSON":
        raise FormatError(f"must begin with a JSON chunk, got {chunks[0][0]!r}")
    return chunks[0][1], next((data for kind, data in chunks[1:] if kind == b"BIN\0"), None)


def parents_first(parents: Sequence[int]) -> list[int]:
    """Return indices with every parent before its children, without those in cycles."""
    children: dict[int, list[int]] = {}
    for index, parent in enumerate(parents):
        children.setdefault(parent, []).append(index)
    order = list(children.get(-1, []))
    for index in order:
        order.extend(children.get(index, []))
    return order


def rotation_matrices(quaternions: Array) -> Array:
    """Return the rotations (N, 3, 3) of quaternions (N, 4), x y z w, of any length but zero."""
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    unit = quaternions / np.where(length > 0, length, 1.0)
    cross = np.cross(np.eye(3), unit[:, None, :3])
    return np.eye(3) + 2 * unit[:, 3, None, None] * cross + 2 * cross @ cross


def triangles(mode: int, corners: Array, what: str) -> Array:
    """Return the (F, 3) triangles of vertices ``corners`` (C,), none where ``mode`` draws points or lines."""
    if mode == Mode.TRIANGLES:
        if len(corners) % 3:
            raise FormatError(f"{what} has {len(corners)} triangle corners, not a multiple of three: it is damaged")
        return corners.reshape(-1, 3)
    if mode not in (Mode.STRIP, Mode.FAN) or len(corners) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    first = np.full(len(corners) - 2, corners[0]) if mode == Mode.FAN else corners[:-2]
    faces = np.stack((first, corners[1:-1], corners[2:]), axis=-1)
    if mode == Mode.STRIP:
        faces[1::2, :2] = faces[1::2, 1::-1]  # every second triangle of a strip is turned over
    return faces
