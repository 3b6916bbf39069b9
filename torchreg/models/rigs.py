"""From rigs and robot descriptions to what an articulated shape is built from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_finite, check_shape
from torchreg.errors import InputError, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh, sample_surface
from torchreg.geometry.primitive_fit import fit_primitive
from torchreg.geometry.primitives import PRIMITIVE_KINDS
from torchreg.geometry.rigid import invert_rigid, rigid_matrix, transform_points
from torchreg.io.gltf import load_rig
from torchreg.io.urdf import UrdfRecord, load_urdf
from torchreg.models.primitives import Primitive

Axes = Mapping[str, Sequence[str | Sequence[float]]]
Limits = Mapping[str, Sequence[tuple[float, float]]]

_UNIT_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# SMPL files mark the root's parent with the largest unsigned 32-bit number.
_UNSIGNED_ROOT = 2**32 - 1
# The fusion length is this share of the median thickness of the parts.
_NU_PER_THICKNESS = 0.25
_SAMPLES_PER_LINK = 1000


@dataclass(frozen=True)
class RigSurface:
    """The surface a file brings along, in the rest pose.

    Args:
        vertices: (V, 3), metres.
        faces: (F, 3) int64.
        weights: (V, P) over the parts, rows sum to one.
    """

    vertices: Tensor
    faces: Tensor
    weights: Tensor


@dataclass(frozen=True)
class ShapeSpec:
    """What an articulated shape is built from: tree, parts, solids, fusion length, surface."""

    tree: KinematicTree
    part_frames: tuple[str, ...]
    primitives: tuple[Primitive, ...]
    nu: float
    surface: RigSurface | None = None


def spec_from_gltf(
    path: str | Path,
    *,
    parents: Mapping[str, str | None] | None = None,
    axes: Axes | None = None,
    limits: Limits | None = None,
    primitive: str = "ellipsoid",
) -> ShapeSpec:
    """Return the `ShapeSpec` of a rigged glTF file; see `ArticulatedShape.from_gltf`."""
    rig = load_rig(path, parents=parents)
    return spec_from_arrays(
        rig.vertices, rig.faces, rig.weights, rig.joint_transforms, rig.parents,
        joint_names=rig.joint_names, axes=axes, limits=limits, primitive=primitive,
    )  # fmt: skip


def spec_from_arrays(
    vertices: Tensor,
    faces: Tensor,
    weights: Tensor,
    joints: Tensor,
    parents: Sequence[int],
    *,
    joint_names: Sequence[str] | None = None,
    axes: Axes | None = None,
    limits: Limits | None = None,
    primitive: str = "ellipsoid",
) -> ShapeSpec:
    """Return the `ShapeSpec` of a skinned mesh; see `ArticulatedShape.from_skinned_mesh`."""
    check_choice(primitive, "primitive", ("auto", *PRIMITIVE_KINDS))
    vertices = as_float_tensor(vertices, "vertices").double()
    weights = as_float_tensor(weights, "weights").double()
    frames = _joint_frames(as_float_tensor(joints, "joints").double())
    mesh = TriangleMesh(vertices, torch.as_tensor(faces).long())
    count = len(frames)
    check_shape(weights, "weights", (len(vertices), count))
    check_finite(weights, "weights")
    names = tuple(joint_names) if joint_names is not None else tuple(f"joint_{index}" for index in range(count))
    parent_list = [-1 if int(parent) in (-1, _UNSIGNED_ROOT) else int(parent) for parent in parents]
    if len(names) != count or len(parent_list) != count:
        raise InputError(f"{count} joints need {count} names and parents, got {len(names)} and {len(parent_list)}")
    order = topological_order(parent_list, names)
    used = _carries_skin(parent_list, order, weights)
    joints_of_tree, last_frame = _ball_joint_tree(order, parent_list, names, frames, used, axes or {}, limits or {})
    parts = [index for index in order if bool(weights[:, index].max() > 0)]
    primitives = [_fit_to_owned(vertices, weights, index, invert_rigid(frames[index]), primitive) for index in parts]
    surface = RigSurface(vertices, mesh.faces, weights[:, parts])
    tree = KinematicTree(tuple(joints_of_tree))
    return ShapeSpec(tree, tuple(last_frame[i] for i in parts), tuple(primitives), _default_nu(primitives), surface)


def topological_order(parents: Sequence[int], names: Sequence[str]) -> list[int]:
    """Return joint indices with every parent before its children.

    Raises:
        ModelError: if the hierarchy is cyclic, has several roots, or names a joint that is not there.
    """
    for name, parent in zip(names, parents, strict=True):
        if not -1 <= parent < len(parents):
            raise ModelError(f"joint {name!r} has parent index {parent}, but there are {len(parents)} joints")
    roots = [name for name, parent in zip(names, parents, strict=True) if parent == -1]
    if len(roots) > 1:
        raise ModelError(
            f"the skeleton has {len(roots)} roots ({', '.join(roots[:6])}): it is disconnected; "
            f"for a flat hierarchy name each joint's parent with parents="
        )
    children: list[list[int]] = [[] for _ in parents]
    for index, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(index)
    order = [index for index, parent in enumerate(parents) if parent == -1]
    for index in order:
        order.extend(children[index])
    if len(order) < len(parents):
        lost = [names[index] for index in range(len(parents)) if index not in set(order)]
        raise ModelError(f"the skeleton is cyclic: these joints never reach a root: {', '.join(lost[:6])}")
    return order


def _joint_frames(joints: Tensor) -> Tensor:
    check_finite(joints, "joints")
    if joints.ndim == 2:
        check_shape(joints, "joints", ("J", 3))
        return rigid_matrix(torch.eye(3, dtype=joints.dtype).expand(len(joints), 3, 3), joints)
    check_shape(joints, "joints", ("J", 4, 4))
    return joints


def _carries_skin(parents: Sequence[int], order: Sequence[int], weights: Tensor) -> list[bool]:
    """Return which joints move any of the skin, themselves or through their descendants."""
    used = [bool(column.max() > 0) for column in weights.T]
    for index in reversed(order):
        if parents[index] >= 0 and used[index]:
            used[parents[index]] = True
    return used


def _ball_joint_tree(
    order: Sequence[int],
    parents: Sequence[int],
    names: Sequence[str],
    frames: Tensor,
    used: Sequence[bool],
    axes: Axes,
    limits: Limits,
) -> tuple[list[Joint], dict[int, str]]:
    """Return the tree's joints, several stacked frames per rig joint, and each rig joint's last frame."""
    unknown = sorted((set(axes) | set(limits)) - set(names))
    if unknown:
        raise ModelError(
            f"axes or limits name joints that are not there: {', '.join(unknown)}; known: {', '.join(names)}"
        )
    joints: list[Joint] = []
    last: dict[int, str] = {}
    index_of: dict[str, int] = {}
    for index in order:
        parent = parents[index]
        offset = frames[index] if parent < 0 else invert_rigid(frames[parent]) @ frames[index]
        parent_frame = -1 if parent < 0 else index_of[last[parent]]
        name = names[index]
        chosen = axes.get(name, ("x", "y", "z") if parent >= 0 and used[index] else ())
        bounds = limits.get(name, [(-torch.pi, torch.pi)] * len(chosen))
        if len(bounds) != len(chosen):
            raise ModelError(f"joint {name!r} has {len(chosen)} axes but {len(bounds)} pairs of limits")
        identity = torch.eye(4, dtype=torch.float64)
        stack = [Joint(name, parent_frame, offset)]
        stack += [
            Joint(
                f"{name}_{axis if isinstance(axis, str) else number}",
                0,
                identity,
                "revolute",
                _unit_axis(axis, name),
                float(low),
                float(high),
            )
            for number, (axis, (low, high)) in enumerate(zip(chosen, bounds, strict=True))
        ]
        for depth, joint in enumerate(stack):
            index_of[joint.name] = len(joints)
            above = parent_frame if depth == 0 else len(joints) - 1
            joints.append(Joint(joint.name, above, joint.offset, joint.kind, joint.axis, joint.lower, joint.upper))
        last[index] = stack[-1].name
    return joints, last


def _unit_axis(axis: str | Sequence[float], name: str) -> tuple[float, float, float]:
    if isinstance(axis, str):
        if axis not in _UNIT_AXES:
            raise ModelError(f"joint {name!r} has axis {axis!r}; give x, y, z or a vector of three numbers")
        return _UNIT_AXES[axis]
    length = sum(float(a) ** 2 for a in axis) ** 0.5
    if len(axis) != 3 or not 0 < length < float("inf"):
        raise ModelError(f"joint {name!r} has axis {tuple(axis)}; three finite numbers, not all zero, are needed")
    x, y, z = (float(a) / length for a in axis)
    return (x, y, z)


def _fit_to_owned(vertices: Tensor, weights: Tensor, joint: int, to_joint: Tensor, kind: str) -> Primitive:
    """Return the solid fitted to the vertices that follow a joint most, in the joint's frame."""
    owned = vertices[weights.argmax(-1) == joint]
    if len(owned) < 8:
        owned = vertices[weights[:, joint].topk(min(8, len(vertices))).indices]
    fitted = fit_primitive(transform_points(to_joint, owned), kind)
    return Primitive(fitted.kind, fitted.sizes, fitted.pose)


def _default_nu(primitives: Sequence[Primitive]) -> float:
    lengths = [min(_lengths(primitive)) for primitive in primitives]
    return _NU_PER_THICKNESS * float(torch.tensor(lengths).median())


def _lengths(primitive: Primitive) -> list[float]:
    kind = PRIMITIVE_KINDS[primitive.kind]
    return [size for size, scalable in zip(primitive.sizes, kind.scalable, strict=True) if scalable]


def spec_from_urdf(path: str | Path, *, package_dirs: Sequence[str | Path] = (), primitive: str = "auto") -> ShapeSpec:
    """Return the `ShapeSpec` of a URDF robot; see `ArticulatedShape.from_urdf`."""
    check_choice(primitive, "primitive", ("auto", *PRIMITIVE_KINDS))
    record = load_urdf(path, package_dirs=[Path(folder) for folder in package_dirs])
    parts = [index for index, mesh in enumerate(record.link_meshes) if mesh is not None and len(mesh.faces)]
    if not parts:
        raise ModelError(f"no link of {path} has geometry: there is nothing to align")
    primitives = [_fit_to_link(record, index, primitive) for index in parts]
    frames = tuple(record.tree.joints[index].name for index in parts)
    return ShapeSpec(record.tree, frames, tuple(primitives), _default_nu(primitives), _link_surface(record, parts))


def _fit_to_link(record: UrdfRecord, link: int, kind: str) -> Primitive:
    """Return the solid fitted to a link's geometry, in the link's frame."""
    mesh = record.link_meshes[link]
    if mesh is None:
        raise ModelError(f"link {record.link_names[link]!r} has no geometry to fit a solid to")
    generator = torch.Generator().manual_seed(link)
    points, _, _ = sample_surface(mesh.to(torch.float64), _SAMPLES_PER_LINK, generator=generator)
    fitted = fit_primitive(points, kind)
    return Primitive(fitted.kind, fitted.sizes, fitted.pose)


def _link_surface(record: UrdfRecord, parts: Sequence[int]) -> RigSurface:
    """Return the links' meshes at the rest pose (every joint at zero), each vertex on its own link."""
    transforms: list[Tensor] = []
    for joint in record.tree.joints:
        transforms.append(joint.offset if joint.parent < 0 else transforms[joint.parent] @ joint.offset)
    vertices, faces, owners, count = [], [], [], 0
    for part, link in enumerate(parts):
        mesh = record.link_meshes[link]
        if mesh is None:
            continue
        vertices.append(transform_points(transforms[link], mesh.vertices.double()))
        faces.append(mesh.faces + count)
        owners += [part] * len(mesh.vertices)
        count += len(mesh.vertices)
    weights = torch.nn.functional.one_hot(torch.tensor(owners), len(parts)).double()
    return RigSurface(torch.cat(vertices), torch.cat(faces), weights)
