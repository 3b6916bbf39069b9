"""Reading rigged glTF files (.glb, .gltf): skeleton, skinned mesh and skin weights as one plain record."""

from __future__ import annotations

import base64
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pygltflib
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchreg.errors import FormatError, ModelError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes

Array = NDArray[Any]

_DTYPES: dict[int, np.dtype[Any]] = {
    5120: np.dtype("<i1"),
    5121: np.dtype("<u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MAX_JOINTS = 1000
_MAX_NODES = 100_000
_MAX_WEIGHTS = 100_000_000
_SCALE_TOLERANCE = 1e-3
_LARGEST_SCALE = 1e6


@dataclass(frozen=True)
class RigRecord:
    """A skinned mesh and the skeleton that moves it, all in one coordinate system, metres.

    The file's own deformation is ``x = sum_j w_j T_world_joint_j joint_transforms_j^-1 v``; with
    ``rest_transforms`` it gives the pose that a viewer shows before any animation runs.

    Args:
        name: name of the skin, or of the file.
        joint_names: J different names, in the file's order; a repeated name gets ``#`` and its index.
        parents: J indices of parent joints, -1 for roots; parents may come after their children.
        joint_transforms: (J, 4, 4) float64 rigid ``T_world_joint`` of the pose that ``vertices`` are in.
        rest_transforms: (J, 4, 4) float64 rigid ``T_world_joint`` of the node hierarchy.
        vertices: (V, 3) float64 as stored (times ``scale``), also those no face uses.
        faces: (F, 3) int64.
        normals: (V, 3) float64, or None when a part of the mesh has none.
        weights: (V, J) float64, rows sum to one.
        scale: what stored lengths were multiplied with to become the scene's metres (1 unless the skeleton scales).
    """

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    joint_transforms: Tensor
    rest_transforms: Tensor
    vertices: Tensor
    faces: Tensor
    normals: Tensor | None
    weights: Tensor
    scale: float = 1.0


def load_rig(
    path: str | Path,
    *,
    mesh: str | int | None = None,
    skin: str | int | None = None,
    parents: Mapping[str, str | None] | None = None,
    limits: FileLimits = DEFAULT_LIMITS,
) -> RigRecord:
    """Return the skeleton, the mesh and the skin weights of a glTF file.

    All triangle primitives of all meshes that the skin moves are concatenated. Uniform scale on joints is stripped
    (it does not show in what a rotation does to the skin); the mesh node's own transform is ignored, as glTF demands.

    Args:
        path: a .glb or .gltf file; buffers may be embedded or lie in the same folder or below.
        mesh: name or index of the one mesh to read; all that the skin moves by default.
        skin: name or index of the skin, needed when the file has several.
        parents: parent joint by joint name, None for a root: replaces the file's hierarchy for the joints it names.
            For files that list all joints side by side.
        limits: largest sizes accepted.

    Returns:
        The rig; without inverse bind matrices, the node hierarchy gives ``joint_transforms``.

    Raises:
        FormatError: if the file is damaged, oversized, compressed or refers outside its folder.
        ModelError: if there is no rig in it, or the rig is cyclic, non-finite, sheared or without weights.
    """
    source = local_path(path)
    reader = _Reader(source, limits)
    skin_index, mesh_indices = _choose(reader, mesh, skin)
    chosen = reader.gltf.skins[skin_index]
    joints = [reader.index(j, reader.gltf.nodes, f"a joint of skin {skin_index}") for j in chosen.joints or []]
    if not 0 < len(joints) <= _MAX_JOINTS or len(set(joints)) < len(joints):
        raise ModelError(
            f"{source}: skin {skin_index} must list 1 to {_MAX_JOINTS} different joints, got {len(joints)} "
            f"({len(set(joints))} different)"
        )
    names = _unique_names([reader.gltf.nodes[j].name for j in joints])
    node_parents = _node_parents(reader)
    world = _node_globals(reader, node_parents)[joints]
    bind = world if chosen.inverseBindMatrices is None else _bind_transforms(reader, chosen, names)
    joint_transforms = _strip_scale(source, bind, names, "bind")
    rest_transforms = _strip_scale(source, world, names, "rest")
    scale = _skin_scale(source, world, bind, names)
    vertices, faces, normals, weights = _read_meshes(reader, mesh_indices, len(joints))
    joint_transforms[:, :3, 3] *= scale
    return RigRecord(
        name=str(chosen.name or source.stem),
        joint_names=tuple(names),
        parents=_joint_parents(source, joints, node_parents, names, parents or {}),
        joint_transforms=torch.from_numpy(joint_transforms),
        rest_transforms=torch.from_numpy(rest_transforms),
        vertices=torch.from_numpy(vertices * scale),
        faces=torch.from_numpy(faces),
        normals=None if normals is None else torch.from_numpy(normals),
        weights=torch.from_numpy(_normalized_rows(source, weights)),
        scale=scale,
    )


class _Reader:
    """The decoded document and checked access to the numbers in its buffers."""

    def __init__(self, path: Path, limits: FileLimits) -> None:
        self.path = path
        self.limits = limits
        content = read_bytes(path, limits)
        text, self._blob = _split_binary(path, content) if content[:4] == b"glTF" else (content, None)
        try:
            self.gltf = pygltflib.GLTF2.from_json(text.decode("utf-8-sig"), infer_missing=True)
        except (ValueError, TypeError, KeyError, AttributeError, IndexError, RecursionError) as error:
            raise FormatError(f"{path}: not a readable glTF document ({type(error).__name__}: {error})") from error
        for name in ("nodes", "meshes", "skins", "accessors", "bufferViews", "buffers"):
            items = getattr(self.gltf, name) or []
            if not isinstance(items, list) or any(item is None for item in items):
                raise FormatError(f"{path}: {name} must be a list of objects")
            setattr(self.gltf, name, items)
        if len(self.gltf.nodes) > _MAX_NODES:
            raise FormatError(f"{path}: {len(self.gltf.nodes)} nodes, at most {_MAX_NODES} are read")
        compressed = [name for name in self.gltf.extensionsRequired or [] if name in _COMPRESSED]
        if compressed:
            raise FormatError(f"{path}: compressed with {compressed[0]}; save it again without mesh compression")
        self._buffers: dict[int, bytes] = {}

    def index(self, value: Any, items: Sequence[Any], what: str) -> int:
        """Return ``value`` if it is an index into ``items``."""
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < len(items):
            raise FormatError(f"{self.path}: {what} must be an index below {len(items)}, got {value!r}")
        return value

    def count(self, value: Any, what: str, default: int | None = None) -> int:
        """Return a whole number that is not negative."""
        value = default if value is None else value
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise FormatError(f"{self.path}: {what} must be a whole number of at least 0, got {value!r}")
        return value

    def floats(self, value: Any, length: int, default: Sequence[float], what: str) -> Array:
        """Return a JSON list of ``length`` finite numbers."""
        value = default if value is None else value
        if not isinstance(value, (list, tuple)) or len(value) != length:
            raise FormatError(f"{self.path}: {what} must hold {length} numbers, got {value!r}"[:300])
        numbers = np.array([float(number) if abs(number) < 1e300 else np.nan for number in value])
        if not np.isfinite(numbers).all():
            raise ModelError(f"{self.path}: {what} is not finite: {value!r}"[:300])
        return numbers

    def accessor(self, value: Any, what: str, types: Sequence[str]) -> Array:
        """Return the (count, width) numbers of an accessor: float64, or integers that are not normalized."""
        accessor = self.gltf.accessors[self.index(value, self.gltf.accessors, f"the accessor of {what}")]
        dtype = _DTYPES.get(self.count(accessor.componentType, f"the componentType of {what}"))
        if dtype is None or accessor.type not in types:
            raise FormatError(
                f"{self.path}: {what} must be {' or '.join(types)} of a known component type, got "
                f"{accessor.type!r} of {accessor.componentType!r}"
            )
        width = _WIDTHS[accessor.type]
        count = self.count(accessor.count, f"the count of {what}")
        if count == 0 or count * width * dtype.itemsize > self.limits.max_bytes:
            raise FormatError(f"{self.path}: {what} has {count} elements; 1 to what fits the size limit are read")
        offset = self.count(accessor.byteOffset, f"the byteOffset of {what}", 0)
        if accessor.bufferView is None and accessor.sparse is None:
            raise FormatError(f"{self.path}: {what} has no data; save the file again without mesh compression")
        if accessor.bufferView is None:
            values = np.zeros((count, width), dtype)
        else:
            values = self._elements(accessor.bufferView, offset, count, width, dtype, what).copy()
        if accessor.sparse is not None:
            self._fill_sparse(values, accessor.sparse, what)
        if dtype.kind == "f":
            if not np.isfinite(values).all():
                raise ModelError(f"{self.path}: {what} holds non-finite numbers")
            return values.astype(np.float64)
        if accessor.normalized:
            return np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        return values.astype(np.int64)

    def _fill_sparse(self, values: Array, sparse: Any, what: str) -> None:
        if sparse.indices is None or sparse.values is None:
            raise FormatError(f"{self.path}: the sparse part of {what} lacks indices or values")
        count = self.count(sparse.count, f"the sparse count of {what}")
        dtype = _DTYPES.get(self.count(sparse.indices.componentType, f"the componentType of {what}"))
        if dtype is None or dtype.kind != "u" or not 0 < count <= len(values):
            raise FormatError(f"{self.path}: the sparse part of {what} has {count} entries of unusable type or number")
        at = self.count(sparse.indices.byteOffset, f"the sparse byteOffset of {what}", 0)
        rows = self._elements(sparse.indices.bufferView, at, count, 1, dtype, what)[:, 0]
        if int(rows.max()) >= len(values):
            raise FormatError(f"{self.path}: the sparse part of {what} points at element {rows.max()} of {len(values)}")
        at = self.count(sparse.values.byteOffset, f"the sparse byteOffset of {what}", 0)
        values[rows] = self._elements(sparse.values.bufferView, at, count, values.shape[1], values.dtype, what)

    def _elements(self, view: Any, offset: int, count: int, width: int, dtype: np.dtype[Any], what: str) -> Array:
        """Return a read-only (count, width) window into a buffer, after checking that it lies inside."""
        view = self.gltf.bufferViews[self.index(view, self.gltf.bufferViews, f"the bufferView of {what}")]
        data = self._buffer(self.index(view.buffer, self.gltf.buffers, f"the buffer of {what}"))
        start = self.count(view.byteOffset, f"the view offset of {what}", 0)
        length = self.count(view.byteLength, f"the view length of {what}")
        size = width * dtype.itemsize
        stride = self.count(view.byteStride, f"the byteStride of {what}", 0) or size
        if start + length > len(data) or offset + stride * (count - 1) + size > length:
            raise FormatError(
                f"{self.path}: {what} reaches beyond its buffer ({count} elements of {size} bytes, view of {length} "
                f"bytes at {start}, buffer of {len(data)} bytes); the file is cut short or damaged"
            )
        return np.ndarray((count, width), dtype, data, start + offset, (stride, dtype.itemsize))

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            declared = self.gltf.buffers[index]
            data = self._buffer_bytes(index, declared.uri)
            length = self.count(declared.byteLength, f"the byteLength of buffer {index}")
            if length > len(data):
                raise FormatError(f"{self.path}: buffer {index} should have {length} bytes, got {len(data)}")
            self._buffers[index] = data[:length]
        return self._buffers[index]

    def _buffer_bytes(self, index: int, uri: Any) -> bytes:
        if uri is None:
            if index != 0 or self._blob is None:
                raise FormatError(f"{self.path}: buffer {index} has neither an address nor a binary chunk")
            return self._blob
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            if not head.endswith(";base64"):
                raise FormatError(f"{self.path}: the data of buffer {index} must be base64, got {head[:60]!r}")
            try:
                return base64.b64decode(body, validate=True)
            except ValueError as error:
                raise FormatError(f"{self.path}: buffer {index} is not valid base64 ({error})") from error
        folder = self.path.parent.resolve()
        local = (folder / unquote(uri)).resolve() if ":" not in uri and "\0" not in unquote(uri) else None
        if local is None or not local.is_relative_to(folder):
            raise FormatError(f"{self.path}: buffer {index} must lie in the file's folder, got address {uri[:100]!r}")
        if not local.is_file():
            raise FormatError(f"{self.path}: buffer {index} should be in {str(local)!r}, which is not there")
        return read_bytes(local, self.limits)


def _split_binary(path: Path, content: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a .glb file."""
    if len(content) < 20:
        raise FormatError(f"{path}: a .glb file has at least 20 bytes, got {len(content)}")
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2 or length > len(content):
        raise FormatError(f"{path}: expected glTF 2 of {length} bytes, got version {version}, {len(content)} bytes")
    chunks: dict[bytes, bytes] = {}
    position = 12
    while position + 8 <= length:
        size = struct.unpack_from("<I", content, position)[0]
        if position + 8 + size > length:
            raise FormatError(f"{path}: the chunk at byte {position} reaches beyond the end of the file")
        chunks.setdefault(content[position + 4 : position + 8], content[position + 8 : position + 8 + size])
        position += 8 + size
    if b"JSON" not in chunks:
        raise FormatError(f"{path}: the .glb file has no JSON chunk")
    return chunks[b"JSON"], chunks.get(b"BIN\0")


def _choose(reader: _Reader, mesh: str | int | None, skin: str | int | None) -> tuple[int, list[int]]:
    """Return the skin and the meshes it moves, of those asked for."""
    gltf, path = reader.gltf, reader.path
    wanted_mesh = None if mesh is None else _find(path, gltf.meshes, mesh, "mesh")
    wanted_skin = None if skin is None else _find(path, gltf.skins, skin, "skin")
    pairs = set()
    for number, node in enumerate(gltf.nodes):
        if node.mesh is not None and node.skin is not None:
            mesh_index = reader.index(node.mesh, gltf.meshes, f"the mesh of node {number}")
            skin_index = reader.index(node.skin, gltf.skins, f"the skin of node {number}")
            if wanted_mesh in (None, mesh_index) and wanted_skin in (None, skin_index):
                pairs.add((skin_index, mesh_index))
    skins = sorted({skin_index for skin_index, _ in pairs})
    if not skins:
        asked = f" with mesh={mesh!r}, skin={skin!r}" if pairs or mesh is not None or skin is not None else ""
        raise ModelError(f"{path}: no node carries both a mesh and a skin{asked}: there is no rig to read")
    if len(skins) > 1:
        known = ", ".join(f"{index} ({gltf.skins[index].name!r})" for index in skins[:10])
        raise ModelError(f"{path}: several skins move meshes, choose one with skin=: {known}")
    return skins[0], sorted(mesh_index for _, mesh_index in pairs)


def _find(path: Path, items: Sequence[Any], wanted: str | int, what: str) -> int:
    for index, item in enumerate(items):
        if wanted == (item.name if isinstance(wanted, str) else index):
            return index
    known = ", ".join(f"{index} ({item.name!r})" for index, item in enumerate(items[:20])) or "none"
    raise ModelError(f"{path}: there is no {what} {wanted!r}; known: {known}")


def _unique_names(names: Sequence[Any]) -> list[str]:
    unique: list[str] = []
    for index, name in enumerate(names):
        text = str(name) if name else f"joint_{index}"
        unique.append(f"{text}#{index}" if text in unique else text)
    return unique


def _node_parents(reader: _Reader) -> list[int]:
    nodes = reader.gltf.nodes
    parents = [-1] * len(nodes)
    for number, node in enumerate(nodes):
        for value in node.children or []:
            child = reader.index(value, nodes, f"a child of node {number}")
            if parents[child] >= 0:
                raise ModelError(f"{reader.path}: node {_label(nodes, child)} has two parents; glTF allows one")
            parents[child] = number
    return parents


def _label(nodes: Sequence[Any], index: int) -> str:
    return repr(nodes[index].name) if nodes[index].name else str(index)


def _parents_first(parents: Sequence[int]) -> list[int]:
    """Return indices with every parent before its children; those in a cycle are left out."""
    children: dict[int, list[int]] = {}
    for index, parent in enumerate(parents):
        children.setdefault(parent, []).append(index)
    order = list(children.get(-1, []))
    for index in order:
        order.extend(children.get(index, []))
    return order


def _node_globals(reader: _Reader, parents: Sequence[int]) -> Array:
    """Return the (nodes, 4, 4) transforms of all nodes in the scene."""
    nodes = reader.gltf.nodes
    order = _parents_first(parents)
    if len(order) < len(nodes):
        stuck = sorted(set(range(len(nodes))) - set(order))
        raise ModelError(
            f"{reader.path}: the node hierarchy is cyclic at {', '.join(_label(nodes, n) for n in stuck[:5])}"
        )
    result = np.empty((len(nodes), 4, 4))
    with np.errstate(over="ignore", invalid="ignore"):
        for index in order:
            local = _node_local(reader, index)
            result[index] = local if parents[index] < 0 else result[parents[index]] @ local
    return result


def _node_local(reader: _Reader, index: int) -> Array:
    node = reader.gltf.nodes[index]
    what = f"of node {_label(reader.gltf.nodes, index)}"
    if node.matrix is not None:
        return reader.floats(node.matrix, 16, (), f"the matrix {what}").reshape(4, 4).T
    quaternion = reader.floats(node.rotation, 4, (0.0, 0.0, 0.0, 1.0), f"the rotation {what}")
    length = np.linalg.norm(quaternion)
    if not length > 0:
        raise ModelError(f"{reader.path}: the rotation {what} is a zero quaternion")
    axis, w = quaternion[:3] / length, quaternion[3] / length
    cross = np.cross(np.eye(3), axis)
    local = np.eye(4)
    local[:3, :3] = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    local[:3, :3] *= reader.floats(node.scale, 3, (1.0, 1.0, 1.0), f"the scale {what}")
    local[:3, 3] = reader.floats(node.translation, 3, (0.0, 0.0, 0.0), f"the translation {what}")
    return local


def _bind_transforms(reader: _Reader, skin: Any, names: Sequence[str]) -> Array:
    stored = reader.accessor(skin.inverseBindMatrices, "inverseBindMatrices", ("MAT4",)).astype(np.float64)
    if len(stored) < len(names):
        raise FormatError(f"{reader.path}: {len(names)} joints but {len(stored)} inverse bind matrices")
    matrices = np.swapaxes(stored[: len(names)].reshape(-1, 4, 4), 1, 2)
    flat = np.abs(np.linalg.det(matrices[:, :3, :3])) < 1e-30
    if flat.any():
        raise ModelError(f"{reader.path}: the inverse bind matrix of joint {names[int(flat.argmax())]!r} is singular")
    return np.linalg.inv(matrices)


def _strip_scale(path: Path, matrices: Array, names: Sequence[str], pose: str) -> Array:
    """Return rigid motions at the same places; ModelError where more than a uniform scale would be lost."""
    result = np.tile(np.eye(4), (len(matrices), 1, 1))
    result[:, :3, 3] = matrices[:, :3, 3]
    for index, matrix in enumerate(matrices):
        if not np.isfinite(matrix).all():
            raise ModelError(f"{path}: the {pose} transform of joint {names[index]!r} is not finite")
        u, stretch, vt = np.linalg.svd(matrix[:3, :3])
        spread = np.inf if stretch[0] <= 0 else (stretch[0] - stretch[2]) / stretch[0]
        bottom = np.abs(matrix[3] - np.array([0.0, 0.0, 0.0, 1.0])).max()
        if spread > _SCALE_TOLERANCE or bottom > 1e-4 or np.linalg.det(u @ vt) < 0:
            raise ModelError(
                f"{path}: the {pose} transform of joint {names[index]!r} is not a rotation, a translation and a "
                f"uniform scale (stretches {', '.join(f'{s:.4g}' for s in stretch)}); apply scale and shear in the "
                f"program that made the rig"
            )
        result[index, :3, :3] = u @ vt
    return result


def _skin_scale(path: Path, world: Array, bind: Array, names: Sequence[str]) -> float:
    """Return by how much the skeleton at rest enlarges what is stored: 0.01 for many rigs drawn in centimetres."""
    stretch = [np.linalg.svd(matrices[:, :3, :3], compute_uv=False).mean(1) for matrices in (world, bind)]
    ratio = stretch[0] / stretch[1]
    common = float(np.median(ratio))
    if not 1 / _LARGEST_SCALE < common < _LARGEST_SCALE:
        raise ModelError(f"{path}: the skeleton scales the skin by {common:.4g}, which no rig does; check its nodes")
    off = np.abs(ratio / common - 1)
    if off.max() > _SCALE_TOLERANCE:
        raise ModelError(
            f"{path}: joint {names[int(off.argmax())]!r} scales its part of the skin by "
            f"{ratio[off.argmax()]:.4g}, others by {common:.4g}; apply scale in the program that made the rig"
        )
    return common if abs(common - 1) > _SCALE_TOLERANCE else 1.0


def _joint_parents(
    path: Path,
    joints: Sequence[int],
    node_parents: Sequence[int],
    names: Sequence[str],
    given: Mapping[str, str | None],
) -> tuple[int, ...]:
    place = {node: index for index, node in enumerate(joints)}
    parents = []
    for node in joints:
        above = node_parents[node]
        while above >= 0 and above not in place:
            above = node_parents[above]
        parents.append(place.get(above, -1))
    unknown = sorted({name for pair in given.items() for name in pair if name is not None and name not in names})
    if unknown:
        raise ModelError(f"{path}: parents names unknown joints {', '.join(unknown[:5])}; known: {', '.join(names)}")
    for name, parent in given.items():
        parents[names.index(name)] = -1 if parent is None else names.index(parent)
    stuck = sorted(set(range(len(names))) - set(_parents_first(parents)))
    if stuck:
        raise ModelError(f"{path}: parents are cyclic at joints {', '.join(names[index] for index in stuck[:5])}")
    return tuple(parents)


def _read_meshes(reader: _Reader, meshes: Sequence[int], num_joints: int) -> tuple[Array, Array, Array | None, Array]:
    """Return vertices, faces, normals and raw weights of all triangle primitives."""
    vertices: list[Array] = []
    faces: list[Array] = []
    normals: list[Array | None] = []
    weights: list[Array] = []
    begins: dict[str, int] = {}
    total = 0
    for index in meshes:
        for number, primitive in enumerate(reader.gltf.meshes[index].primitives or []):
            if (_TRIANGLES if primitive.mode is None else primitive.mode) not in (_TRIANGLES, _STRIP, _FAN):
                continue
            what = f"primitive {number} of mesh {reader.gltf.meshes[index].name or index!r}"
            attributes = primitive.attributes
            # Primitives often share their vertices and differ in indices and material only.
            key = repr(sorted(vars(attributes).items(), key=str)) if attributes else ""
            if key not in begins:
                points, normal, weight = _read_vertices(reader, attributes, what, num_joints, total)
                begins[key] = total
                vertices.append(points)
                normals.append(normal)
                weights.append(weight)
                total += len(points)
                size = len(points)
            else:
                size = len(vertices[list(begins).index(key)])
            faces.append(_read_faces(reader, primitive, what, size) + begins[key])
    if not faces:
        raise ModelError(f"{reader.path}: the skinned mesh has no triangles")
    whole = None if any(n is None for n in normals) else np.concatenate([n for n in normals if n is not None])
    return np.concatenate(vertices), np.concatenate(faces), whole, np.concatenate(weights)


def _read_vertices(
    reader: _Reader, attributes: Any, what: str, num_joints: int, before: int
) -> tuple[Array, Array | None, Array]:
    points = reader.accessor(getattr(attributes, "POSITION", None), f"POSITION of {what}", ("VEC3",)).astype(np.float64)
    total = before + len(points)
    if total > reader.limits.max_points or total * num_joints > _MAX_WEIGHTS:
        raise FormatError(
            f"{reader.path}: {total} vertices with {num_joints} joints; at most {reader.limits.max_points} vertices "
            f"(FileLimits.max_points) and {_MAX_WEIGHTS} weights are read"
        )
    normals = None
    if getattr(attributes, "NORMAL", None) is not None:
        normals = reader.accessor(attributes.NORMAL, f"NORMAL of {what}", ("VEC3",)).astype(np.float64)
        if len(normals) != len(points):
            raise FormatError(f"{reader.path}: {what} has {len(points)} positions but {len(normals)} normals")
    weights = np.zeros((len(points), num_joints))
    number = 0
    while getattr(attributes, f"JOINTS_{number}", None) is not None:
        joints = reader.accessor(getattr(attributes, f"JOINTS_{number}"), f"JOINTS_{number} of {what}", ("VEC4",))
        values = reader.accessor(
            getattr(attributes, f"WEIGHTS_{number}", None), f"WEIGHTS_{number} of {what}", ("VEC4",)
        )
        _add_weights(reader, weights, joints, values, what)
        number += 1
    if number == 0:
        raise ModelError(f"{reader.path}: {what} has no JOINTS_0 and WEIGHTS_0: it is not skinned")
    return points, normals, weights


def _add_weights(reader: _Reader, weights: Array, joints: Array, values: Array, what: str) -> None:
    if (
        joints.dtype.kind != "i"
        or values.dtype.kind != "f"
        or len(joints) != len(weights)
        or len(values) != len(weights)
    ):
        raise FormatError(
            f"{reader.path}: {what} must have integer joints and float or normalized weights for each of its "
            f"{len(weights)} vertices, got {joints.dtype} x {len(joints)} and {values.dtype} x {len(values)}"
        )
    if values.min() < 0:
        raise ModelError(f"{reader.path}: {what} has negative skin weights ({values.min():.4g})")
    used = values > 0
    joints = np.where(used, joints, 0)
    if joints.min() < 0 or joints.max() >= weights.shape[1]:
        raise FormatError(f"{reader.path}: {what} refers to joint {joints.max()} of a skin with {weights.shape[1]}")
    # One vertex may name a joint twice: add.at sums, plain assignment would keep the last.
    np.add.at(weights, (np.arange(len(weights))[:, None], joints), values)


def _read_faces(reader: _Reader, primitive: Any, what: str, num_vertices: int) -> Array:
    if primitive.indices is None:
        corners = np.arange(num_vertices)
    else:
        corners = reader.accessor(primitive.indices, f"the indices of {what}", ("SCALAR",))[:, 0]
    if corners.dtype.kind != "i" or len(corners) < 3 or corners.min() < 0 or corners.max() >= num_vertices:
        raise FormatError(
            f"{reader.path}: the indices of {what} must be at least three integers from 0 to {num_vertices - 1}, got "
            f"{len(corners)} from {corners.min()} to {corners.max()}"
        )
    corners = corners.astype(np.int64)
    if primitive.mode == _STRIP:
        strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        strip[1::2] = strip[1::2][:, [1, 0, 2]]
        return strip
    if primitive.mode == _FAN:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    if len(corners) % 3:
        raise FormatError(f"{reader.path}: {what} has {len(corners)} triangle corners, not a multiple of three")
    return corners.reshape(-1, 3)


def _normalized_rows(path: Path, weights: Array) -> Array:
    total = weights.sum(1, keepdims=True)
    empty = int((total <= 0).sum())
    if empty:
        raise ModelError(
            f"{path}: {empty} of {len(weights)} vertices have no skin weight; assign every vertex to a joint"
        )
    return weights / total
