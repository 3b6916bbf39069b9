"""Reading rigged glTF files (.glb, .gltf): skeleton, skinned mesh and skin weights as one plain record."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchreg.errors import FileWarning, FormatError, ModelError
from torchreg.io.file_format import naming
from torchreg.io.gltf_document import GltfDocument, Mode, parents_first, triangles
from torchreg.io.limits import DEFAULT_LIMITS, FILE_BUDGET, FileLimits, local_path, read_bytes
from torchreg.io.raw_cloud import Array


@dataclass(frozen=True)
class _RigLimits:
    """Largest rigs that are read."""

    max_scale: float = 1e6  # of the skeleton on the skin, and its inverse
    identity: float = 1e-6  # a matrix that differs less from the identity is it
    scale_tolerance: float = 1e-3  # relative differences of scales below this are rounding


_LIMITS = _RigLimits()


@dataclass(frozen=True)
class RigRecord:
    """A skinned mesh and the skeleton that moves it, all in one coordinate system, metres.

    The file's own deformation is ``x = sum_j w_j T_world_joint_j joint_transforms_j^-1 v``; with
    ``rest_transforms`` it gives the pose that a viewer shows before an animation plays.

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
        scale: factor from stored lengths to the scene's metres (1 unless the skeleton scales).
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


@dataclass(frozen=True)
class RigPrimitive:
    """A primitive of a skinned mesh.

    Args:
        entry: of the document.
        attributes: of the entry.
        mode: see `Mode`.
        what: it is, for messages.
    """

    entry: dict[str, Any]
    attributes: dict[str, Any]
    mode: int
    what: str

    @property
    def key(self) -> str:
        """The same for primitives that share their vertices and differ in indices and material only, as many do."""
        return repr(sorted(self.attributes.items(), key=str))


def load_rig(
    path: str | Path,
    *,
    mesh: str | int | None = None,
    skin: str | int | None = None,
    parents: Mapping[str, str | None] | None = None,
    limits: FileLimits = DEFAULT_LIMITS,
) -> RigRecord:
    """Return the skeleton, the mesh and the skin weights of a glTF file.

    All triangle primitives of all meshes that the skin moves are concatenated. Uniform scale on joints is removed, as
    it does not change the effect of rotations on the skin; the transform of the mesh's node is ignored, as glTF
    demands.

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

    Warns:
        FileWarning: if something was left out or put right: primitives without positions or skin, vertices without
            weight (they follow the nearest vertex that has some), joints that move nothing and were stored without a
            place (they stand where their node does).
    """
    source = local_path(path)
    content = read_bytes(source, limits)
    with naming(source):
        return _read_rig(GltfDocument(content, source, limits), source.stem, mesh, skin, parents or {}, limits)


def _read_rig(
    document: GltfDocument,
    name: str,
    mesh: str | int | None,
    skin: str | int | None,
    parents: Mapping[str, str | None],
    limits: FileLimits,
) -> RigRecord:
    nodes = document.items("nodes")
    skin_index, meshes = choose_skin(document, mesh, skin)
    chosen = document.item("skins", skin_index)
    listed = document.entry(chosen, "joints", list)
    joints = [document.index("nodes", joint, f"a joint of skin {skin_index}") for joint in listed]
    if not 0 < len(joints) <= FILE_BUDGET.joints or len(set(joints)) < len(joints):
        raise ModelError(
            f"skin {skin_index} must list 1 to {FILE_BUDGET.joints} different joints, got {len(joints)} "
            f"({len(set(joints))} different)"
        )
    names = _unique_names([nodes[joint].get("name") for joint in joints])
    node_parents = document.node_parents()
    world = document.node_globals(node_parents)[joints]
    vertices, faces, normals, weights = _read_meshes(document, meshes, len(joints), limits)
    weights = _normalized_rows(_weighted_rows(weights, vertices))
    all_parents = _joint_parents(joints, node_parents, names, parents)
    inverse_bind = chosen.get("inverseBindMatrices")
    bind = (
        world if inverse_bind is None else bind_transforms(document, inverse_bind, names, weights, world, all_parents)
    )
    joint_transforms = _strip_scale(bind, names, "bind")
    rest_transforms = _strip_scale(world, names, "rest")
    scale = _skin_scale(world, bind, names)
    joint_transforms[:, :3, 3] *= scale
    return RigRecord(
        name=str(chosen.get("name") or name),
        joint_names=tuple(names),
        parents=all_parents,
        joint_transforms=torch.from_numpy(joint_transforms),
        rest_transforms=torch.from_numpy(rest_transforms),
        vertices=torch.from_numpy(vertices * scale),
        faces=torch.from_numpy(faces),
        normals=None if normals is None else torch.from_numpy(normals),
        weights=torch.from_numpy(weights),
        scale=scale,
    )


def _numbers(document: GltfDocument, index: Any, what: str, shape: str) -> Array:
    """Return the (count, width) numbers of an accessor: float64, or int64 where they are not normalized."""
    values = document.accessor(index, what, (shape,))
    if len(values) == 0:
        raise FormatError(f"{what} has 0 elements, at least one is needed")
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    if not np.isfinite(values).all():
        raise ModelError(f"{what} holds non-finite numbers")
    return values.astype(np.float64)


def choose_skin(document: GltfDocument, mesh: str | int | None, skin: str | int | None) -> tuple[int, list[int]]:
    """Return the index of the requested skin, and those of the requested meshes that it moves."""
    wanted_mesh = None if mesh is None else _find(document.items("meshes"), mesh, "mesh")
    wanted_skin = None if skin is None else _find(document.items("skins"), skin, "skin")
    pairs = set()
    for number, node in enumerate(document.items("nodes")):
        if node.get("mesh") is not None and node.get("skin") is not None:
            mesh_index = document.index("meshes", node["mesh"], f"the mesh of node {number}")
            skin_index = document.index("skins", node["skin"], f"the skin of node {number}")
            if wanted_mesh in (None, mesh_index) and wanted_skin in (None, skin_index):
                pairs.add((skin_index, mesh_index))
    skins = sorted({skin_index for skin_index, _ in pairs})
    if not skins:
        asked = f" with mesh={mesh!r}, skin={skin!r}" if pairs or mesh is not None or skin is not None else ""
        raise ModelError(f"no node carries both a mesh and a skin{asked}: there is no rig to read")
    if len(skins) > 1:
        known = ", ".join(f"{index} ({document.item('skins', index).get('name')!r})" for index in skins[:10])
        raise ModelError(f"several skins move meshes, choose one with skin=NAME: {known}")
    return skins[0], sorted(mesh_index for _, mesh_index in pairs)


def _find(items: Sequence[dict[str, Any]], wanted: str | int, what: str) -> int:
    for index, item in enumerate(items):
        if wanted == (item.get("name") if isinstance(wanted, str) else index):
            return index
    known = ", ".join(f"{index} ({item.get('name')!r})" for index, item in enumerate(items[:20])) or "none"
    raise ModelError(f"there is no {what} {wanted!r}; known: {known}")


def _unique_names(names: Sequence[Any]) -> list[str]:
    unique: list[str] = []
    for index, name in enumerate(names):
        text = str(name) if name else f"joint_{index}"
        unique.append(f"{text}#{index}" if text in unique else text)
    return unique


def bind_transforms(
    document: GltfDocument,
    inverse_bind: Any,
    names: Sequence[str],
    weights: Array,
    world: Array,
    parents: Sequence[int],
) -> Array:
    """Return the joints' transforms (J, 4, 4) in the bind pose.

    Exporters write the identity, or zeros, for joints that move nothing: those stand to their parent as nodes do.
    """
    stored = _numbers(document, inverse_bind, "inverseBindMatrices", "MAT4").astype(np.float64)
    if len(stored) < len(names):
        raise FormatError(f"{len(names)} joints but {len(stored)} inverse bind matrices")
    matrices = np.swapaxes(stored[: len(names)].reshape(-1, 4, 4), 1, 2)
    with np.errstate(all="ignore"):
        determinants = np.stack([np.abs(np.linalg.det(m)) for m in (matrices[:, :3, :3], matrices)])
    flat = ~((determinants > 1e-30) & (determinants < np.inf)).all(0)
    identity = np.abs(matrices - np.eye(4)).max((1, 2)) < _LIMITS.identity
    elsewhere = np.abs(world - np.eye(4)).max((1, 2)) > _LIMITS.identity
    empty = (weights.max(0) == 0) & (np.array(parents) >= 0) & (flat | (identity & elsewhere))
    if (flat & ~empty).any():
        raise ModelError(f"the inverse bind matrix of joint {names[int((flat & ~empty).argmax())]!r} is singular")
    bind = np.linalg.inv(np.where(empty[:, None, None], np.eye(4), matrices))
    for index in parents_first(parents):
        if empty[index]:
            above = parents[index]
            bind[index] = bind[above] @ np.linalg.solve(world[above], world[index])
    if empty.any():
        listed = ", ".join(names[index] for index in np.flatnonzero(empty)[:5])
        _warn(f"{int(empty.sum())} joints that move nothing have no bind pose and stand where their nodes do: {listed}")
    return bind


def _strip_scale(matrices: Array, names: Sequence[str], pose: str) -> Array:
    """Return rigid motions (J, 4, 4) without the uniform scale of matrices; ModelError if one has another scale."""
    result = np.tile(np.eye(4), (len(matrices), 1, 1))
    result[:, :3, 3] = matrices[:, :3, 3]
    for index, matrix in enumerate(matrices):
        if not np.isfinite(matrix).all():
            raise ModelError(f"the {pose} transform of joint {names[index]!r} is not finite")
        u, stretch, vt = np.linalg.svd(matrix[:3, :3])
        spread = np.inf if stretch[0] <= 0 else (stretch[0] - stretch[2]) / stretch[0]
        bottom = np.abs(matrix[3] - np.array([0.0, 0.0, 0.0, 1.0])).max()
        if spread > _LIMITS.scale_tolerance or bottom > 1e-4 or np.linalg.det(u @ vt) < 0:
            raise ModelError(
                f"the {pose} transform of joint {names[index]!r} is not a rotation, a translation and a "
                f"uniform scale (stretches {', '.join(f'{s:.4g}' for s in stretch)}); apply scale and shear in the "
                f"program that made the rig"
            )
        result[index, :3, :3] = u @ vt
    return result


def _skin_scale(world: Array, bind: Array, names: Sequence[str]) -> float:
    """Return the factor by which the skeleton at rest scales the stored mesh: 0.01 for many rigs in centimetres."""
    stretch = [np.linalg.svd(matrices[:, :3, :3], compute_uv=False).mean(1) for matrices in (world, bind)]
    ratio = stretch[0] / stretch[1]
    common = float(np.median(ratio))
    if not 1 / _LIMITS.max_scale < common < _LIMITS.max_scale:
        raise ModelError(f"the skeleton scales the skin by {common:.4g}, which no rig does; check its nodes")
    off = np.abs(ratio / common - 1)
    if off.max() > _LIMITS.scale_tolerance:
        raise ModelError(
            f"joint {names[int(off.argmax())]!r} scales its part of the skin by "
            f"{ratio[off.argmax()]:.4g}, others by {common:.4g}; apply scale in the program that made the rig"
        )
    return common if abs(common - 1) > _LIMITS.scale_tolerance else 1.0


def _joint_parents(
    joints: Sequence[int],
    node_parents: Sequence[int],
    names: Sequence[str],
    given: Mapping[str, str | None],
) -> tuple[int, ...]:
    index_of = {node: index for index, node in enumerate(joints)}
    parents = []
    for node in joints:
        above = node_parents[node]
        while above >= 0 and above not in index_of:
            above = node_parents[above]
        parents.append(index_of.get(above, -1))
    unknown = sorted({name for pair in given.items() for name in pair if name is not None and name not in names})
    if unknown:
        raise ModelError(f"parents names unknown joints {', '.join(unknown[:5])}; known: {', '.join(names)}")
    for name, parent in given.items():
        parents[names.index(name)] = -1 if parent is None else names.index(parent)
    stuck = sorted(set(range(len(names))) - set(parents_first(parents)))
    if stuck:
        raise ModelError(f"parents are cyclic at joints {', '.join(names[index] for index in stuck[:5])}")
    return tuple(parents)


def _read_meshes(
    document: GltfDocument, meshes: Sequence[int], num_joints: int, limits: FileLimits
) -> tuple[Array, Array, Array | None, Array]:
    """Return vertices, faces, normals and raw weights of all triangle primitives."""
    blocks: list[tuple[Array, Array | None, Array]] = []
    faces: list[Array] = []
    begins: dict[str, tuple[int, int]] = {}
    primitives, left_out = rig_primitives(document, meshes)
    total = 0
    for primitive in primitives:
        if primitive.key not in begins:
            blocks.append(_read_vertices(document, primitive.attributes, primitive.what, num_joints, total, limits))
            size = len(blocks[-1][0])
            begins[primitive.key], total = (total, size), total + size
        begin, size = begins[primitive.key]
        faces.append(_read_faces(document, primitive.entry, primitive.mode, primitive.what, size) + begin)
    if not faces:
        reason = f": {left_out[0]}" if left_out else ""
        raise ModelError(f"the skinned mesh has no triangles that a skin moves{reason}")
    if left_out:
        _warn(f"{len(left_out)} primitives are left out: {'; '.join(left_out[:3])}")
    vertices, normals, weights = zip(*blocks, strict=True)
    known = [block for block in normals if block is not None]
    all_normals = np.concatenate(known) if len(known) == len(blocks) else None
    return np.concatenate(vertices), np.concatenate(faces), all_normals, np.concatenate(weights)


def rig_primitives(document: GltfDocument, meshes: Sequence[int]) -> tuple[list[RigPrimitive], list[str]]:
    """Return the triangle primitives of meshes that a skin moves, and what others lack."""
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
            missing = _missing(document, entry, attributes)
            if missing:
                left_out.append(f"{what} has no {missing}")
            else:
                primitives.append(RigPrimitive(entry, attributes=attributes, mode=mode, what=what))
    return primitives, left_out


def _missing(document: GltfDocument, primitive: dict[str, Any], attributes: dict[str, Any]) -> str:
    """Return what a primitive lacks to be part of a rig; empty if nothing."""
    if attributes.get("POSITION") is None or document.accessor_count(attributes["POSITION"], "POSITION") == 0:
        return "positions"
    if attributes.get("JOINTS_0") is None:
        return "JOINTS_0 and WEIGHTS_0: it is not skinned"
    corners = primitive.get("indices")
    return "triangles" if corners is not None and document.accessor_count(corners, "the indices") == 0 else ""


def _warn(message: str) -> None:
    warnings.warn(message, FileWarning, stacklevel=2)


def _read_vertices(
    document: GltfDocument, attributes: dict[str, Any], what: str, num_joints: int, before: int, limits: FileLimits
) -> tuple[Array, Array | None, Array]:
    total = before + document.accessor_count(attributes.get("POSITION"), f"POSITION of {what}")
    max_weights = max(FILE_BUDGET.weights, FILE_BUDGET.weights_per_byte * document.size)
    if total > limits.max_points or total * num_joints > max_weights:
        raise FormatError(
            f"{total} vertices with {num_joints} joints; at most {limits.max_points} vertices "
            f"(FileLimits.max_points) and {max_weights} weights are read"
        )
    points = _numbers(document, attributes.get("POSITION"), f"POSITION of {what}", "VEC3").astype(np.float64)
    normals = None
    if attributes.get("NORMAL") is not None:
        normals = document.accessor(attributes["NORMAL"], f"NORMAL of {what}", ("VEC3",)).astype(np.float64)
        if len(normals) != len(points):
            raise FormatError(f"{what} has {len(points)} positions but {len(normals)} normals")
        if not np.isfinite(normals).all():
            _warn(f"the normals of {what} are left out: some are not finite")
            normals = None
    weights = np.zeros((len(points), num_joints))
    number = 0
    while attributes.get(f"JOINTS_{number}") is not None:
        joints = _numbers(document, attributes[f"JOINTS_{number}"], f"JOINTS_{number} of {what}", "VEC4")
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
        corners = _numbers(document, primitive["indices"], f"the indices of {what}", "SCALAR")[:, 0]
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
    _warn(
        f"{int(empty.sum())} of {len(weights)} vertices have no skin weight and follow the nearest vertex that has some"
    )
    from torchreg.geometry.neighbors import NeighborTree  # scipy is slow to load, and few rigs need it

    weighted = np.flatnonzero(~empty)
    nearest, _ = NeighborTree(torch.from_numpy(vertices[weighted])).nearest(torch.from_numpy(vertices[empty]))
    weights[empty] = weights[weighted[nearest.numpy()]]
    return weights


def _normalized_rows(weights: Array) -> Array:
    return weights / weights.sum(1, keepdims=True)
