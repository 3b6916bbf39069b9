"""Writing animated glTF (.glb): a skinned mesh on a moving skeleton, or rigid parts that move as nodes."""

from __future__ import annotations

import os
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh

_TYPES = {1: pygltflib.SCALAR, 2: pygltflib.VEC2, 3: pygltflib.VEC3, 4: pygltflib.VEC4, 16: pygltflib.MAT4}
_COMPONENTS = {
    np.dtype(np.uint8): pygltflib.UNSIGNED_BYTE,
    np.dtype(np.uint16): pygltflib.UNSIGNED_SHORT,
    np.dtype(np.uint32): pygltflib.UNSIGNED_INT,
    np.dtype(np.float32): pygltflib.FLOAT,
}
_WEIGHTS_PER_SET = 4
_SMALLEST_WEIGHT = 1e-4
_LARGEST_UINT16 = 65535
_RIGID_TOLERANCE = 1e-4
_DEFAULT_COLOR = (0.8, 0.62, 0.52, 1.0)

Array = NDArray[Any]


def save_animated_skin(
    path: str | Path,
    vertices: Tensor,
    faces: Tensor,
    weights: Tensor,
    joint_names: Sequence[str],
    parents: Sequence[int],
    rest_transforms: Tensor,
    joint_transforms: Tensor,
    times: Tensor,
    normals: Tensor | None = None,
    colors: Tensor | None = None,
    *,
    most_weights: int | None = None,
) -> Path:
    """Return the path of a .glb file with a mesh that linear blend skinning moves over time.

    The file plays ``x(t) = sum_j w_j T_world_joint_j(t) T_world_joint_j(rest)^-1 x`` in any glTF viewer. glTF stores
    weights by fours: the four largest are kept and renormalized, eight where any vertex has a fifth above 1e-4 unless
    ``most_weights`` is 4, all that many viewers look at.

    Convention: ``T_world_joint`` maps joint to world coordinates; between frames, translations are interpolated
    linearly and rotations along the shorter arc, each relative to the parent joint.

    Args:
        path: where to write; the suffix must be .glb. An existing file is replaced once the new one is complete.
        vertices: (V, 3) in the rest pose, metres.
        faces: (F, 3) integers.
        weights: (V, J), not negative, rows that sum to more than zero.
        joint_names: J different names.
        parents: J indices of parent joints, -1 for roots, in any order.
        rest_transforms: (J, 4, 4) rigid ``T_world_joint`` of the pose that ``vertices`` are in.
        joint_transforms: (T, J, 4, 4) rigid ``T_world_joint`` per frame.
        times: (T,) seconds, not negative, strictly increasing.
        normals: (V, 3) at the vertices; zero rows become +z, which viewers need to be of unit length.
        colors: (V, 3) or (V, 4) in [0, 1].
        most_weights: 4 or 8, or None to decide by the weights.

    Returns:
        The path written.

    Raises:
        InputError: if shapes, ranges or values do not fit, or a transform is not rigid.
        InputTypeError: if an argument does not hold numbers of the right kind.
    """
    target = _checked_path(path)
    if most_weights not in (None, 4, 8):
        raise InputError(f"most_weights must be 4, 8 or None, got {most_weights}")
    points = _numbers(vertices, "vertices", ("V", 3))
    triangles = _triangles(faces, "faces", len(points))
    count = _checked_names(joint_names, "joint_names")
    order = _checked_parents(parents, count, joint_names)
    weight = _numbers(weights, "weights", (len(points), count))
    rest = _rigid(rest_transforms, "rest_transforms", (count, 4, 4))
    seconds = _checked_times(times)
    moving = _rigid(joint_transforms, "joint_transforms", (len(seconds), count, 4, 4))

    document = _Document()
    attributes = document.mesh_attributes(points, normals, colors)
    for number, (joints, values) in enumerate(_weight_sets(weight, most_weights)):
        setattr(attributes, f"JOINTS_{number}", document.add(joints, target=pygltflib.ARRAY_BUFFER))
        setattr(attributes, f"WEIGHTS_{number}", document.add(values, target=pygltflib.ARRAY_BUFFER))
    mesh = document.add_mesh("skin", attributes, triangles, None if colors is not None else _DEFAULT_COLOR)
    if colors is not None and tuple(colors.shape[1:]) == (4,) and bool((colors[:, 3] < 1).any()):
        document.gltf.materials[-1].alphaMode = pygltflib.BLEND
    inverse_bind = np.linalg.inv(rest)
    inverse_bind[:, 3] = (0.0, 0.0, 0.0, 1.0)
    local_rest = _local(rest, parents)
    joints_at = [document.add_node(name, local_rest[index]) for index, name in enumerate(joint_names)]
    for index in order:
        if parents[index] >= 0:
            document.gltf.nodes[joints_at[parents[index]]].children.append(joints_at[index])
    # Skins with several roots need one common ancestor, and a skinned mesh is placed by its joints alone.
    armature = document.add_node("armature", None)
    document.gltf.nodes[armature].children = [joints_at[index] for index in order if parents[index] < 0]
    skin = pygltflib.Skin(name="skin", joints=joints_at, skeleton=armature)
    skin.inverseBindMatrices = document.add(_column_major(inverse_bind))
    document.gltf.skins.append(skin)
    holder = document.add_node("mesh", None)
    document.gltf.nodes[holder].mesh, document.gltf.nodes[holder].skin = mesh, 0
    document.animate("motion", seconds, joints_at, _local(moving, parents))
    return document.write(target, [armature, holder])


def save_animated_parts(
    path: str | Path,
    part_meshes: Sequence[TriangleMesh | None],
    part_transforms: Tensor,
    times: Tensor,
    part_names: Sequence[str] | None = None,
    colors: Tensor | None = None,
) -> Path:
    """Return the path of a .glb file in which each rigid part moves as a node of its own.

    Args:
        path: where to write; the suffix must be .glb. An existing file is replaced once the new one is complete.
        part_meshes: P meshes in part coordinates, metres; None for a part without a shape.
        part_transforms: (T, P, 4, 4) rigid ``T_world_part`` per frame.
        times: (T,) seconds, not negative, strictly increasing.
        part_names: P different names; part_0, part_1, ... by default.
        colors: (P, 3) or (P, 4) in [0, 1].

    Returns:
        The path written.

    Raises:
        InputError: if shapes, ranges or values do not fit, or a transform is not rigid.
        InputTypeError: if an argument does not hold numbers of the right kind.
    """
    target = _checked_path(path)
    names = [f"part_{index}" for index in range(len(part_meshes))] if part_names is None else list(part_names)
    count = _checked_names(names, "part_names")
    if len(part_meshes) != count:
        raise InputError(f"part_meshes must hold one mesh per part name ({count}), got {len(part_meshes)}")
    seconds = _checked_times(times)
    moving = _rigid(part_transforms, "part_transforms", (len(seconds), count, 4, 4))
    paint = np.tile(_DEFAULT_COLOR, (count, 1)) if colors is None else _rgba(colors, "colors", count)

    document = _Document()
    nodes = []
    for index, (name, mesh) in enumerate(zip(names, part_meshes, strict=True)):
        node = document.add_node(name, moving[0, index])
        nodes.append(node)
        if mesh is not None:
            points = _numbers(mesh.vertices, f"part_meshes[{index}].vertices", ("V", 3))
            triangles = _triangles(mesh.faces, f"part_meshes[{index}].faces", len(points))
            attributes = document.mesh_attributes(points, None, None)
            document.gltf.nodes[node].mesh = document.add_mesh(name, attributes, triangles, tuple(paint[index]))
    document.animate("motion", seconds, nodes, moving)
    return document.write(target, nodes)


class _Document:
    """A glTF document under construction: the JSON part and the bytes it points into."""

    def __init__(self) -> None:
        self.gltf = pygltflib.GLTF2(asset=pygltflib.Asset(version="2.0", generator="torchreg"))
        self.blob = bytearray()

    def add(self, values: Array, *, target: int | None = None, bounds: bool = False) -> int:
        """Return the index of a new accessor over ``values``, one element per row."""
        self.blob.extend(b"\0" * (-len(self.blob) % 4))
        data = np.ascontiguousarray(values).tobytes()
        view = pygltflib.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=len(data), target=target)
        self.blob.extend(data)
        self.gltf.bufferViews.append(view)
        width = 1 if values.ndim == 1 else values.shape[1]
        accessor = pygltflib.Accessor(
            bufferView=len(self.gltf.bufferViews) - 1,
            byteOffset=0,
            componentType=_COMPONENTS[values.dtype],
            count=len(values),
            type=_TYPES[width],
        )
        if bounds:
            rows = values.reshape(len(values), width)
            accessor.min, accessor.max = rows.min(0).tolist(), rows.max(0).tolist()
        self.gltf.accessors.append(accessor)
        return len(self.gltf.accessors) - 1

    def mesh_attributes(self, points: Array, normals: Tensor | None, colors: Tensor | None) -> pygltflib.Attributes:
        """Return the vertex attributes that every mesh shares: position, normal, color."""
        attributes = pygltflib.Attributes(
            POSITION=self.add(points.astype(np.float32), target=pygltflib.ARRAY_BUFFER, bounds=True)
        )
        if normals is not None:
            unit = _unit_rows(_numbers(normals, "normals", (len(points), 3)))
            attributes.NORMAL = self.add(unit.astype(np.float32), target=pygltflib.ARRAY_BUFFER)
        if colors is not None:
            rgba = _rgba(colors, "colors", len(points)).astype(np.float32)
            attributes.COLOR_0 = self.add(rgba, target=pygltflib.ARRAY_BUFFER)
        return attributes

    def add_mesh(
        self, name: str, attributes: pygltflib.Attributes, triangles: Array, color: Sequence[float] | None
    ) -> int:
        """Return the index of a new mesh with a matte material of its own."""
        # The largest index of each type means "restart" in glTF and must not occur.
        small = int(triangles.max()) < _LARGEST_UINT16
        indices = self.add(
            triangles.reshape(-1).astype(np.uint16 if small else np.uint32), target=pygltflib.ELEMENT_ARRAY_BUFFER
        )
        surface = pygltflib.PbrMetallicRoughness(
            baseColorFactor=[float(c) for c in color or (1.0, 1.0, 1.0, 1.0)], metallicFactor=0.0, roughnessFactor=0.8
        )
        material = pygltflib.Material(name=name, pbrMetallicRoughness=surface, doubleSided=True, alphaCutoff=None)
        self.gltf.materials.append(material)
        primitive = pygltflib.Primitive(
            attributes=attributes, indices=indices, material=len(self.gltf.materials) - 1, mode=pygltflib.TRIANGLES
        )
        self.gltf.meshes.append(pygltflib.Mesh(name=name, primitives=[primitive]))
        return len(self.gltf.meshes) - 1

    def add_node(self, name: str, transform: Array | None) -> int:
        """Return the index of a new node at the rigid ``transform`` (4, 4) relative to its parent."""
        node = pygltflib.Node(name=name)
        if transform is not None:
            node.translation = transform[:3, 3].astype(np.float32).tolist()
            node.rotation = _quaternions(transform[None, :3, :3])[0].astype(np.float32).tolist()
        self.gltf.nodes.append(node)
        return len(self.gltf.nodes) - 1

    def animate(self, name: str, seconds: Array, nodes: Sequence[int], local: Array) -> None:
        """Add one animation that moves every node through ``local`` (T, len(nodes), 4, 4)."""
        animation = pygltflib.Animation(name=name)
        time = self.add(seconds, bounds=True)
        for index, node in enumerate(nodes):
            quaternions = _continuous(_quaternions(local[:, index, :3, :3]))
            for track, values in (("translation", local[:, index, :3, 3]), ("rotation", quaternions)):
                output = self.add(values.astype(np.float32))
                animation.samplers.append(
                    pygltflib.AnimationSampler(input=time, output=output, interpolation=pygltflib.ANIM_LINEAR)
                )
                animation.channels.append(
                    pygltflib.AnimationChannel(
                        sampler=len(animation.samplers) - 1,
                        target=pygltflib.AnimationChannelTarget(node=node, path=track),
                    )
                )
        self.gltf.animations.append(animation)

    def write(self, path: Path, roots: list[int]) -> Path:
        """Return ``path`` after writing the document there in one step, so that no reader sees half a file."""
        self.gltf.scenes.append(pygltflib.Scene(nodes=roots))
        self.gltf.scene = 0
        self.gltf.buffers.append(pygltflib.Buffer(byteLength=len(self.blob)))
        self.gltf.set_binary_blob(bytes(self.blob))
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
        try:
            with temporary.open("xb") as file:
                for chunk in self.gltf.save_to_bytes():
                    file.write(chunk)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        return path


def _checked_path(path: str | Path) -> Path:
    target = Path(path)
    if target.suffix.lower() != ".glb":
        raise InputError(f"path must end in .glb, got {target.name!r}; rename the output file")
    if not target.parent.is_dir():
        raise InputError(
            f"path must lie in an existing folder, got {str(target)!r}; create {str(target.parent)!r} first"
        )
    return target


def _numbers(value: Tensor, name: str, shape: Sequence[int | str]) -> Array:
    tensor = as_float_tensor(value, name)
    check_shape(tensor, name, shape)
    check_finite(tensor, name)
    if 0 in tensor.shape:
        raise InputError(f"{name} must not be empty, got shape {tuple(tensor.shape)}")
    return tensor.detach().cpu().double().numpy()


def _triangles(faces: Tensor, name: str, num_vertices: int) -> Array:
    tensor = torch.as_tensor(faces)
    if tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool:
        raise InputTypeError(f"{name} must hold integers, got dtype {tensor.dtype}; convert with .long()")
    check_shape(tensor, name, ("F", 3))
    if not len(tensor):
        raise InputError(f"{name} must hold at least one triangle, got none")
    if int(tensor.min()) < 0 or int(tensor.max()) >= num_vertices:
        raise InputError(
            f"{name} must hold indices from 0 to {num_vertices - 1}, got {int(tensor.min())} to {int(tensor.max())}"
        )
    return tensor.detach().cpu().long().numpy()


def _checked_names(names: Sequence[str], argument: str) -> int:
    if not len(names):
        raise InputError(f"{argument} must hold at least one name, got none")
    doubled = sorted({name for name in names if list(names).count(name) > 1})
    if doubled:
        raise InputError(f"{argument} must hold different names, these occur more than once: {', '.join(doubled[:5])}")
    return len(names)


def _checked_parents(parents: Sequence[int], count: int, names: Sequence[str]) -> list[int]:
    """Return the joint indices with every parent before its children."""
    if len(parents) != count:
        raise InputError(f"parents must hold one index per joint ({count}), got {len(parents)}")
    children: dict[int, list[int]] = {}
    for index, parent in enumerate(parents):
        if not -1 <= parent < count:
            raise InputError(f"parents of joint {names[index]!r} must be -1 to {count - 1}, got {parent}")
        children.setdefault(int(parent), []).append(index)
    order = list(children.get(-1, []))
    for index in order:
        order.extend(children.get(index, []))
    if len(order) < count:
        stuck = [names[index] for index in range(count) if index not in set(order)]
        raise InputError(f"parents must form trees, but these joints hang in a cycle: {', '.join(stuck[:5])}")
    return order


def _checked_times(times: Tensor) -> Array:
    seconds = _numbers(times, "times", ("T",)).astype(np.float32)
    if seconds[0] < 0 or not (np.diff(seconds) > 0).all():
        raise InputError(
            "times must be in seconds, not negative and strictly increasing, also when rounded to float32; "
            f"got {len(seconds)} from {seconds[0]} to {seconds[-1]}"
        )
    return seconds


def _rigid(value: Tensor, name: str, shape: Sequence[int]) -> Array:
    matrices = _numbers(value, name, shape)
    rotation = matrices[..., :3, :3]
    error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max()
    bottom = np.abs(matrices[..., 3, :] - np.array([0.0, 0.0, 0.0, 1.0])).max()
    if error > _RIGID_TOLERANCE or bottom > _RIGID_TOLERANCE or np.linalg.det(rotation).min() < 0:
        raise InputError(
            f"{name} must hold rigid motions, got one with scale, shear, mirror or a last row other than 0 0 0 1 "
            f"(off by {max(error, bottom):.2g})"
        )
    return matrices


def _rgba(colors: Tensor, name: str, count: int) -> Array:
    tensor = as_float_tensor(colors, name)
    check_shape(tensor, name, (count, 4 if tensor.ndim == 2 and tensor.shape[1] == 4 else 3))
    values = _numbers(tensor, name, tuple(tensor.shape))
    if values.min() < 0 or values.max() > 1:
        raise InputError(f"{name} must lie in [0, 1], got {values.min()} to {values.max()}; divide 8-bit colors by 255")
    return values if values.shape[1] == 4 else np.concatenate([values, np.ones((count, 1))], axis=1)


def _weight_sets(weights: Array, most: int | None) -> list[tuple[Array, Array]]:
    """Return (joint indices, weights) of the four or eight largest weights per vertex, in sets of four."""
    if weights.min() < 0:
        raise InputError(f"weights must not be negative, got {weights.min()}")
    total = weights.sum(1, keepdims=True)
    if total.min() <= 0:
        raise InputError(f"weights must have a positive entry in every row, got {int((total <= 0).sum())} zero row(s)")
    weights = weights / total
    count = weights.shape[1]
    fifth = count > _WEIGHTS_PER_SET and np.sort(weights, axis=1)[:, -_WEIGHTS_PER_SET - 1].max() > _SMALLEST_WEIGHT
    slots = _WEIGHTS_PER_SET * (2 if fifth and most != _WEIGHTS_PER_SET else 1)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :slots]
    largest = np.take_along_axis(weights, order, axis=1)
    pad = ((0, 0), (0, slots - order.shape[1]))
    order, largest = np.pad(order, pad), np.pad(largest, pad)
    stored = (largest / largest.sum(1, keepdims=True)).astype(np.float32)
    # The validator adds the float32 values as stored: the largest takes up their rounding.
    stored[:, 0] += (1.0 - stored.sum(1, dtype=np.float64)).astype(np.float32)
    order = np.where(stored > 0, order, 0).astype(np.uint8 if count <= 256 else np.uint16)
    split = range(0, slots, _WEIGHTS_PER_SET)
    return [(order[:, at : at + _WEIGHTS_PER_SET], stored[:, at : at + _WEIGHTS_PER_SET]) for at in split]


def _unit_rows(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), np.array([0.0, 0.0, 1.0]))


def _column_major(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2).reshape(len(matrices), 16).astype(np.float32)


def _local(world: Array, parents: Sequence[int]) -> Array:
    """Return ``T_parent_joint`` of (..., J, 4, 4) ``T_world_joint``."""
    local = world.copy()
    for index, parent in enumerate(parents):
        if parent >= 0:
            local[..., index, :, :] = np.linalg.solve(world[..., parent, :, :], world[..., index, :, :])
    return local


def _quaternions(rotations: Array) -> Array:
    """Return (T, 4) unit quaternions (x, y, z, w) of (T, 3, 3) rotations.

    The symmetric matrix K = 4 q q^T of each rotation is filled in and its row with the largest diagonal normalized, so
    that no angle loses digits.
    """
    r = np.moveaxis(rotations, 0, -1)
    outer = np.empty((len(rotations), 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[:, i, i] = 1 + r[i, i] - r[j, j] - r[k, k]
        outer[:, i, j] = outer[:, j, i] = r[i, j] + r[j, i]
        outer[:, i, 3] = outer[:, 3, i] = r[k, j] - r[j, k]
    outer[:, 3, 3] = 1 + r[0, 0] + r[1, 1] + r[2, 2]
    best = np.einsum("tii->ti", outer).argmax(1)
    rows = outer[np.arange(len(outer)), best]
    quaternions = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)


def _continuous(quaternions: Array) -> Array:
    """Return the same rotations with neighbors in time on the same side, so that viewers turn the short way."""
    dots = np.einsum("ti,ti->t", quaternions[1:], quaternions[:-1])
    signs = np.concatenate([[1.0], np.cumprod(np.where(dots < 0, -1.0, 1.0))])
    return quaternions * signs[:, None]
