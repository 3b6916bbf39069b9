"""The surfaces of glTF meshes: vertices, triangles, normals and skin weights, checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from torchreg.errors import FormatError, ModelError
from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.file_format import warn
from torchreg.io.gltf_file.document import GltfDocument, Mode, triangles
from torchreg.io.limits import FILE_BUDGET, FileLimits


@dataclass(frozen=True)
class RigPrimitive:
    """A primitive of a mesh."""

    entry: dict[str, Any]  # of the document
    attributes: dict[str, Any]  # of the entry
    mode: int  # see `Mode`
    what: str  # it is, for messages

    @property
    def key(self) -> str:
        """The same for primitives that share their vertices and differ in indices and material only, as many do."""
        return repr(sorted(self.attributes.items(), key=str))


@dataclass(frozen=True)
class Surface:
    """Vertices (V, 3), triangles (F, 3), normals (V, 3) unless some are missing, and weights (V, J) of joints."""

    vertices: Array
    faces: Array
    normals: Array | None
    weights: Array

    def moved(self, motions: Array, weights: Array) -> Surface:
        """Return the surface under affine motions (1 or V, 4, 4), with other weights; mirrored faces turn over."""
        if len(motions) == 1 and np.array_equal(motions[0], np.eye(4)):
            return Surface(self.vertices, self.faces, self.normals, weights)
        linear = motions[:, :3, :3]
        turned = self.vertices @ linear[0].T if len(motions) == 1 else (linear @ self.vertices[..., None])[..., 0]
        vertices = turned + motions[:, :3, 3]
        determinants = np.linalg.det(linear)
        normals = None if self.normals is None else turned_normals(self.normals, linear, determinants)
        mirrored = np.broadcast_to(determinants < 0, len(vertices))[self.faces[:, :1]]
        return Surface(vertices, np.where(mirrored, self.faces[:, ::-1], self.faces), normals, weights)

    def on_joint(self, joint: int, num_joints: int, motion: Array) -> Surface:
        """Return the surface under one affine motion (4, 4), as a rigid part of one of some joints."""
        weights = np.zeros((len(self.vertices), num_joints))
        weights[:, joint] = 1.0
        return self.moved(motion[None], weights)


@dataclass
class VertexBudget:
    """How many vertices and weights of a rig are read, and have been read."""

    document: GltfDocument  # of the rig
    limits: FileLimits  # on files
    joints: int  # of the rig
    vertices: int = 0  # read so far
    left_out: list[str] = field(default_factory=list)  # primitives that lack something, so far

    def add(self, count: int) -> None:
        """Count vertices that are about to be read; FormatError if they are too many."""
        self.vertices += count
        most = max(FILE_BUDGET.weights, FILE_BUDGET.weights_per_byte * self.document.size)
        if self.vertices > self.limits.max_points or self.vertices * self.joints > most:
            raise FormatError(
                f"{self.vertices} vertices with {self.joints} joints; at most {self.limits.max_points} vertices "
                f"(FileLimits.max_points) and {most} weights are read"
            )


def numbers(document: GltfDocument, index: Any, what: str, shape: str) -> Array:
    """Return the (count, width) numbers of an accessor: float64, or int64 where they are not normalized."""
    values = document.accessor(index, what, (shape,))
    if len(values) == 0:
        raise FormatError(f"{what} has 0 elements, at least one is needed")
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    if not np.isfinite(values).all():
        raise ModelError(f"{what} holds non-finite numbers")
    return values.astype(np.float64)


def read_surface(budget: VertexBudget, meshes: Sequence[int], num_joints: int) -> Surface | None:
    """Return the triangles of meshes under a skin of 0 or more joints; None, with a warning, where there are none."""
    document = budget.document
    blocks: list[tuple[Array, Array | None, Array]] = []
    faces: list[Array] = []
    begins: dict[str, tuple[int, int]] = {}
    primitives, left_out = rig_primitives(document, meshes, is_skinned=num_joints > 0)
    budget.left_out += left_out
    if left_out:
        warn(f"{len(left_out)} primitives are left out: {'; '.join(left_out[:3])}")
    total = 0
    for primitive in primitives:
        if primitive.key not in begins:
            blocks.append(_read_vertices(budget, primitive.attributes, primitive.what, num_joints))
            size = len(blocks[-1][0])
            begins[primitive.key], total = (total, size), total + size
        begin, size = begins[primitive.key]
        faces.append(_read_faces(document, primitive.entry, primitive.mode, primitive.what, size) + begin)
    if not faces:
        return None
    vertices, normals, weights = zip(*blocks, strict=True)
    known = [block for block in normals if block is not None]
    all_normals = np.concatenate(known) if len(known) == len(blocks) else None
    points, rows = np.concatenate(vertices), np.concatenate(weights)
    if num_joints:
        rows = _weighted_rows(rows, points)
        rows /= rows.sum(1, keepdims=True)
    return Surface(points, np.concatenate(faces), all_normals, rows)


def rig_primitives(
    document: GltfDocument, meshes: Sequence[int], *, is_skinned: bool = True
) -> tuple[list[RigPrimitive], list[str]]:
    """Return the triangle primitives of meshes, those that a skin moves, and what others lack."""
    primitives, left_out = list[RigPrimitive](), list[str]()
    for index in meshes:
        mesh = document.item("meshes", index)
        for number, entry in enumerate(document.entry(mesh, "primitives", list)):
            what = f"primitive {number} of mesh {mesh.get('name') or index!r}"
            if not isinstance(entry, dict):
                raise FormatError(f"{what} must be an object")
            mode = document.entry(entry, "mode", int, Mode.TRIANGLES)
            if mode not in set(Mode):
                continue
            attributes = document.entry(entry, "attributes", dict)
            missing = _missing(document, entry, attributes, is_skinned)
            if missing:
                left_out.append(f"{what} has no {missing}")
            else:
                primitives.append(RigPrimitive(entry, attributes=attributes, mode=mode, what=what))
    return primitives, left_out


def _missing(document: GltfDocument, primitive: dict[str, Any], attributes: dict[str, Any], is_skinned: bool) -> str:
    """Return what a primitive lacks to be part of a rig; empty if nothing."""
    if attributes.get("POSITION") is None or document.accessor_count(attributes["POSITION"], "POSITION") == 0:
        return "positions"
    if is_skinned and attributes.get("JOINTS_0") is None:
        return "JOINTS_0 and WEIGHTS_0: it is not skinned"
    corners = primitive.get("indices")
    return "triangles" if corners is not None and document.accessor_count(corners, "the indices") == 0 else ""


def _read_vertices(
    budget: VertexBudget, attributes: dict[str, Any], what: str, num_joints: int
) -> tuple[Array, Array | None, Array]:
    document = budget.document
    budget.add(document.accessor_count(attributes.get("POSITION"), f"POSITION of {what}"))
    points = numbers(document, attributes.get("POSITION"), f"POSITION of {what}", "VEC3").astype(np.float64)
    normals = None
    if attributes.get("NORMAL") is not None:
        normals = document.accessor(attributes["NORMAL"], f"NORMAL of {what}", ("VEC3",)).astype(np.float64)
        if len(normals) != len(points):
            raise FormatError(f"{what} has {len(points)} positions but {len(normals)} normals")
        if not np.isfinite(normals).all():
            warn(f"the normals of {what} are left out: some are not finite")
            normals = None
    weights = np.zeros((len(points), num_joints))
    number = 0
    while num_joints and attributes.get(f"JOINTS_{number}") is not None:
        joints = numbers(document, attributes[f"JOINTS_{number}"], f"JOINTS_{number} of {what}", "VEC4")
        name = f"WEIGHTS_{number}"
        values = document.accessor(attributes.get(name), f"{name} of {what}", ("VEC4",))
        _add_weights(weights, joints, np.nan_to_num(values, posinf=0.0, neginf=0.0), what)
        number += 1
    return points, normals, weights


def _add_weights(weights: Array, joints: Array, values: Array, what: str) -> None:
    if (
        joints.dtype.kind != "i"
        or values.dtype.kind != "f"
        or len(joints) != len(weights)
        or len(values) != len(weights)
    ):
        raise FormatError(
            f"{what} must have integer joints and float or normalized weights for each of its "
            f"{len(weights)} vertices, got {joints.dtype} x {len(joints)} and {values.dtype} x {len(values)}"
        )
    if values.min() < 0:
        raise ModelError(f"{what} has negative skin weights ({values.min():.4g})")
    used = values > 0
    joints = np.where(used, joints, 0)
    if joints.min() < 0 or joints.max() >= weights.shape[1]:
        raise FormatError(f"{what} refers to joint {joints.max()} of a skin with {weights.shape[1]}")
    # One vertex may name a joint twice: add.at sums, plain assignment would keep the last.
    np.add.at(weights, (np.arange(len(weights))[:, None], joints), values)


def _read_faces(document: GltfDocument, primitive: dict[str, Any], mode: int, what: str, num_vertices: int) -> Array:
    if primitive.get("indices") is None:
        document.check_use(8 * num_vertices, f"the triangles of {what}")
        corners = np.arange(num_vertices)
    else:
        corners = numbers(document, primitive["indices"], f"the indices of {what}", "SCALAR")[:, 0]
    if corners.dtype.kind != "i" or len(corners) < 3 or corners.min() < 0 or corners.max() >= num_vertices:
        raise FormatError(
            f"the indices of {what} must be at least three integers from 0 to {num_vertices - 1}, got "
            f"{len(corners)} from {corners.min()} to {corners.max()}"
        )
    return triangles(mode, corners.astype(np.int64), what)


def _weighted_rows(weights: Array, vertices: Array) -> Array:
    """Return weights (V, J) in which vertices without any have those of the nearest vertex (V, 3) that has some."""
    empty = weights.sum(1) <= 0
    if not empty.any():
        return weights
    if empty.all():
        raise ModelError(f"none of {len(weights)} vertices has a skin weight; assign every vertex to a joint")
    warn(
        f"{int(empty.sum())} of {len(weights)} vertices have no skin weight and follow the nearest vertex that has some"
    )
    from torchreg.geometry.neighbors import NeighborTree  # scipy is slow to load, and few rigs need it

    weighted = np.flatnonzero(~empty)
    nearest, _ = NeighborTree(torch.from_numpy(vertices[weighted])).nearest(torch.from_numpy(vertices[empty]))
    weights[empty] = weights[weighted[nearest.numpy()]]
    return weights


def turned_normals(normals: Array, linear: Array, determinants: Array) -> Array:
    """Return unit normals (V, 3) moved by linear maps (1 or V, 3, 3) of given determinants."""
    cofactors = np.stack([np.cross(linear[:, k - 2], linear[:, k - 1]) for k in range(3)], axis=1)
    moved = (cofactors @ normals[..., None])[..., 0] * np.sign(determinants)[:, None]
    length = np.linalg.norm(moved, axis=-1, keepdims=True)
    return np.asarray(moved / np.where(length > 0, length, 1.0))
