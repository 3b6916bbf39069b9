"""Writing animated glTF (.glb): a skinned mesh on a moving skeleton, or rigid parts as moving nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pygltflib
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.upright import Direction, to_y_up
from torchreg.io.gltf_file.builder import (
    DEFAULT_COLOR,
    Array,
    GltfBuilder,
    checked_numbers,
    checked_path,
    checked_rgba,
    checked_times,
    checked_triangles,
)
from torchreg.io.gltf_file.document import parents_first


@dataclass(frozen=True)
class _SkinFormat:
    """Format of skins."""

    set_size: int = 4  # weights per vertex that an attribute holds, and that all viewers read
    min_weight: float = 1e-4  # a second set is written if any vertex has a fifth weight above this
    rigid_tolerance: float = 1e-4  # of entries of a transform, from those of a rigid motion


_FORMAT = _SkinFormat()


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
    up: Direction | None = None,
) -> Path:
    """Write a skinned mesh that moves as a .glb file; return its path.

    Vertices (V, 3), metres, with weights (V, J) are at rest in ``rest_transforms`` (J, 4, 4), and move with
    ``joint_transforms`` (T, J, 4, 4), all rigid ``T_world_joint``, at times (T,), seconds. Between frames translations
    are interpolated linearly and rotations along the shorter arc, relative to the parent joint. ``most_weights`` a
    vertex are 4 or 8, by default as many as needed; the root node turns ``up`` to glTF's y.
    """
    target = checked_path(path)
    if most_weights not in (None, 4, 8):
        raise InputError(f"most_weights must be 4, 8 or None, got {most_weights}")
    points = checked_numbers(vertices, "vertices", ("V", 3))
    triangles = checked_triangles(faces, "faces", len(points))
    count = _checked_names(joint_names, "joint_names")
    order = _checked_parents(parents, count, joint_names)
    weight = checked_numbers(weights, "weights", (len(points), count))
    rest = _rigid(rest_transforms, "rest_transforms", (count, 4, 4))
    seconds = checked_times(times)
    moving = _rigid(joint_transforms, "joint_transforms", (len(seconds), count, 4, 4))

    document = GltfBuilder()
    attributes = document.mesh_attributes(points, normals, colors)
    for number, (joints, values) in enumerate(_weight_sets(weight, most_weights)):
        setattr(attributes, f"JOINTS_{number}", document.add(joints, target=pygltflib.ARRAY_BUFFER))
        setattr(attributes, f"WEIGHTS_{number}", document.add(values, target=pygltflib.ARRAY_BUFFER))
    mesh = document.add_mesh("skin", attributes, triangles, None if colors is not None else DEFAULT_COLOR)
    if colors is not None and tuple(colors.shape[1:]) == (4,) and bool((colors[:, 3] < 1).any()):
        document.gltf.materials[-1].alphaMode = pygltflib.BLEND
    inverse_bind = np.linalg.inv(rest)
    inverse_bind[:, 3] = (0.0, 0.0, 0.0, 1.0)
    local_rest = _local(rest, parents)
    joint_nodes = [document.add_node(name, local_rest[index]) for index, name in enumerate(joint_names)]
    for index in order:
        if parents[index] >= 0:
            document.gltf.nodes[joint_nodes[parents[index]]].children.append(joint_nodes[index])
    # Skins with several roots need one common ancestor; the position of a skinned mesh is that of its joints alone.
    armature = document.add_node("armature", None if up is None else to_y_up(up).numpy())
    document.gltf.nodes[armature].children = [joint_nodes[index] for index in order if parents[index] < 0]
    skin = pygltflib.Skin(name="skin", joints=joint_nodes, skeleton=armature)
    skin.inverseBindMatrices = document.add(_column_major(inverse_bind))
    document.gltf.skins.append(skin)
    holder = document.add_node("mesh", None)
    document.gltf.nodes[holder].mesh, document.gltf.nodes[holder].skin = mesh, 0
    document.animate("motion", seconds, joint_nodes, _local(moving, parents))
    return document.write(target, [armature, holder])


def save_animated_parts(
    path: str | Path,
    part_meshes: Sequence[TriangleMesh | None],
    part_transforms: Tensor,
    times: Tensor,
    part_names: Sequence[str] | None = None,
    colors: Tensor | None = None,
    *,
    part_normals: Sequence[Tensor | None] | None = None,
    parents: Sequence[int] | None = None,
    up: Direction | None = None,
) -> Path:
    """Write rigid parts that move as the nodes of a .glb file; return its path.

    Meshes are in part coordinates, metres, None for a part without; ``part_transforms`` (T, P, 4, 4) are rigid
    ``T_world_part`` at times (T,), seconds. Between frames parts move relative to their parents, see
    `save_animated_skin`.
    """
    target = checked_path(path)
    names = [f"part_{index}" for index in range(len(part_meshes))] if part_names is None else list(part_names)
    count = _checked_names(names, "part_names")
    if len(part_meshes) != count:
        raise InputError(f"part_meshes must hold one mesh per part name ({count}), got {len(part_meshes)}")
    seconds = checked_times(times)
    moving = _rigid(part_transforms, "part_transforms", (len(seconds), count, 4, 4))
    paint = np.tile(DEFAULT_COLOR, (count, 1)) if colors is None else checked_rgba(colors, "colors", count)

    above = [-1] * count if parents is None else list(parents)
    order, normals = _checked_parents(above, count, names), part_normals or [None] * count
    local = _local(moving, above)

    document = GltfBuilder()
    nodes = [document.add_node(name, local[0, index]) for index, name in enumerate(names)]
    for index, mesh in enumerate(part_meshes):
        if mesh is not None:
            points = checked_numbers(mesh.vertices, f"part_meshes[{index}].vertices", ("V", 3))
            triangles = checked_triangles(mesh.faces, f"part_meshes[{index}].faces", len(points))
            attributes = document.mesh_attributes(points, normals[index], None)
            color = tuple(paint[index])
            document.gltf.nodes[nodes[index]].mesh = document.add_mesh(names[index], attributes, triangles, color)
    for index in order:
        if above[index] >= 0:
            document.gltf.nodes[nodes[above[index]]].children.append(nodes[index])
    roots = [nodes[index] for index in order if above[index] < 0]
    if up is not None:
        root = document.add_node("upright", to_y_up(up).numpy())
        document.gltf.nodes[root].children, roots = roots, [root]
    document.animate("motion", seconds, nodes, local)
    return document.write(target, roots)


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
    for index, parent in enumerate(parents):
        if not -1 <= parent < count:
            raise InputError(f"parents of joint {names[index]!r} must be -1 to {count - 1}, got {parent}")
    order = parents_first(parents)
    if len(order) < count:
        stuck = [names[index] for index in range(count) if index not in set(order)]
        raise InputError(f"parents must form trees, but these joints hang in a cycle: {', '.join(stuck[:5])}")
    return order


def _rigid(value: Tensor, name: str, shape: Sequence[int]) -> Array:
    matrices = checked_numbers(value, name, shape)
    rotation = matrices[..., :3, :3]
    error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max()
    bottom = np.abs(matrices[..., 3, :] - np.array([0.0, 0.0, 0.0, 1.0])).max()
    if max(error, bottom) > _FORMAT.rigid_tolerance or np.linalg.det(rotation).min() < 0:
        raise InputError(
            f"{name} must hold rigid motions, got one with scale, shear, mirror or a last row other than 0 0 0 1 "
            f"(off by {max(error, bottom):.2g})"
        )
    return matrices


def _weight_sets(weights: Array, most: int | None) -> list[tuple[Array, Array]]:
    """Return (joint indices, weights) of the four or eight largest weights per vertex, in sets of four."""
    if weights.min() < 0:
        raise InputError(f"weights must not be negative, got {weights.min()}")
    total = weights.sum(1, keepdims=True)
    if total.min() <= 0:
        raise InputError(f"weights must have a positive entry in every row, got {int((total <= 0).sum())} zero row(s)")
    weights = weights / total
    count, size = weights.shape[1], _FORMAT.set_size
    fifth = count > size and np.sort(weights, axis=1)[:, -size - 1].max() > _FORMAT.min_weight
    slots = size * (2 if fifth and most != size else 1)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :slots]
    largest = np.take_along_axis(weights, order, axis=1)
    pad = ((0, 0), (0, slots - order.shape[1]))
    order, largest = np.pad(order, pad), np.pad(largest, pad)
    stored = (largest / largest.sum(1, keepdims=True)).astype(np.float32)
    # The validator adds the float32 values as stored: the largest takes up their rounding.
    stored[:, 0] += (1.0 - stored.sum(1, dtype=np.float64)).astype(np.float32)
    order = np.where(stored > 0, order, 0).astype(np.uint8 if count <= 256 else np.uint16)
    sets = [slice(first, first + size) for first in range(0, slots, size)]
    return [(order[:, columns], stored[:, columns]) for columns in sets]


def _column_major(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2).reshape(len(matrices), 16).astype(np.float32)


def _local(world: Array, parents: Sequence[int]) -> Array:
    """Return ``T_parent_joint`` of (..., J, 4, 4) ``T_world_joint``."""
    local = world.copy()
    for index, parent in enumerate(parents):
        if parent >= 0:
            local[..., index, :, :] = np.linalg.solve(world[..., parent, :, :], world[..., index, :, :])
    return local
