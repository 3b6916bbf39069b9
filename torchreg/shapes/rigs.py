"""Specifications of shapes from rigs: skinned meshes whose skeletons have ball joints."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_finite, check_shape
from torchreg._threads import one_thread
from torchreg.errors import FileWarning, InputError, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import RIGID_TOLERANCE, invert_rigid, rigid_matrix, transform_points
from torchreg.geometry.upright import Y_UP, Direction
from torchreg.io.file_format import naming
from torchreg.io.gltf import load_rig
from torchreg.io.gltf_file.document import parents_first
from torchreg.shapes.kinematics import neighbor_matrix, part_parents
from torchreg.shapes.primitive_refinement import refine_primitives
from torchreg.shapes.primitives import DeferredSolids, Primitive
from torchreg.shapes.spec import SOLID_CHOICES, RigSurface, ShapeSpec, fitted_solid, fusion_length, with_long_axis

Axes = Mapping[str, Sequence[str | Sequence[float]]]
Limits = Mapping[str, Sequence[tuple[float, float]]]

_UNIT_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class _RigFit:
    """Numbers by which solids are fitted to a rig."""

    # Fusion length in median half thicknesses of the parts: flesh fuses smoothly.
    nu_per_thickness: float = 0.25
    # Vertices of a solid; joints that own fewer get the vertices that follow them most.
    min_owned: int = 8
    # Roots of a hierarchy that is not taken for a flat one, whatever the number of joints.
    most_roots: int = 2
    # Vertices, spread over the mesh, on which solids are refined together.
    refined_points: int = 4000


_FIT = _RigFit()


def spec_from_gltf(
    path: str | Path,
    *,
    parents: Mapping[str, str | None] | None = None,
    axes: Axes | None = None,
    limits: Limits | None = None,
    primitive: str = "ellipsoid",
    skin: str | int | None = None,
) -> ShapeSpec:
    """Return the `ShapeSpec` of a rigged glTF file; see `ArticulatedShape.from_gltf`."""
    rig = load_rig(path, parents=parents, skin=skin)
    with naming(path):
        spec = spec_from_arrays(
            rig.vertices, rig.faces, rig.weights, rig.joint_transforms, _one_tree(rig.parents, rig.joint_names),
            joint_names=rig.joint_names, axes={**dict.fromkeys(rig.fixed, ()), **(axes or {})}, limits=limits,
            primitive=primitive, slides=rig.slides,
        )  # fmt: skip
    if not rig.is_rigid or spec.surface is None:
        return spec
    return replace(spec, surface=replace(spec.surface, is_rigid=True))


def _one_tree(parents: Sequence[int], names: Sequence[str]) -> list[int]:
    """Return parents in which every tree of joints hangs on the root of the largest; a flat hierarchy stays flat."""
    joined, roots = list(parents), [index for index, parent in enumerate(parents) if parent == -1]
    if len(roots) < 2 or len(roots) > max(_FIT.most_roots, len(parents) // 2):
        return joined
    tops = list(range(len(parents)))
    for index in parents_first(parents):
        tops[index] = index if parents[index] < 0 else tops[parents[index]]
    main = max(roots, key=tops.count)
    for root in roots:
        joined[root] = -1 if root == main else main
    others = ", ".join(repr(names[root]) for root in roots[:6] if root != main)
    warnings.warn(
        f"the skeleton has {len(roots)} roots: {others} hang on {names[main]!r}, the root of most joints; "
        f"parents= says otherwise",
        FileWarning,
        stacklevel=2,
    )
    return joined


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
    solids: Sequence[Primitive] | None = None,
    slides: Sequence[str] = (),
    up: Direction = Y_UP,
) -> ShapeSpec:
    """Return the `ShapeSpec` of a skinned mesh, as `from_skinned_mesh`; joints in ``slides`` slide as well."""
    check_choice(primitive, "primitive", SOLID_CHOICES)
    vertices = as_float_tensor(vertices, "vertices").double()
    frames = _joint_frames(as_float_tensor(joints, "joints").double())
    mesh = TriangleMesh(vertices, torch.as_tensor(faces).long())
    count = len(frames)
    weights = _skin_weights(weights, (len(vertices), count))
    names = tuple(joint_names) if joint_names is not None else tuple(f"joint_{index}" for index in range(count))
    # SMPL files mark the root's parent with the largest unsigned 32-bit number.
    parent_list = [-1 if int(parent) in (-1, 2**32 - 1) else int(parent) for parent in parents]
    if len(names) != count or len(parent_list) != count:
        raise InputError(f"{count} joints need {count} names and parents, got {len(names)} and {len(parent_list)}")
    order = topological_order(parent_list, names)
    used = _carries_skin(parent_list, order, weights)
    reach = float((vertices.amax(0) - vertices.amin(0)).norm())
    tree, last_frame = _ball_joint_tree(
        order, parent_list, names, frames, used, axes=axes or {}, limits=limits or {},
        slides=dict.fromkeys(slides, reach),
    )  # fmt: skip
    parts = [index for index in order if bool(weights[:, index].max() > 0)]
    part_frames = tuple(last_frame[index] for index in parts)
    found: tuple[Primitive, ...] | DeferredSolids
    if solids is None:
        neighbors = neighbor_matrix(part_parents(tree, [tree.index(name) for name in part_frames]))
        in_frames = partial(_in_joint_frames, joints=parts, frames=frames, parents=parent_list)
        found, nu = _fitted_solids(vertices, weights, parts, neighbors, primitive, in_frames)
    else:
        found, nu = tuple(solids), fusion_length(solids, _FIT.nu_per_thickness)
    return ShapeSpec(
        tree=tree,
        part_frames=part_frames,
        primitives=found,
        nu=nu,
        part_names=tuple(names[index] for index in parts),
        surface=RigSurface(vertices, mesh.faces, weights[:, parts]),
        up=up,
    )


def _fitted_solids(
    vertices: Tensor,
    weights: Tensor,
    parts: Sequence[int],
    neighbors: Tensor,
    primitive: str,
    in_frames: Callable[[Sequence[Primitive]], list[Primitive]],
) -> tuple[DeferredSolids, float]:
    """Return solids (one per part) fitted to the vertices of the parts, refined when needed, and a fusion length."""
    owners = weights.argmax(-1)
    with one_thread():
        guess = [fitted_solid(_owned_vertices(vertices, weights[:, part], owners == part), primitive) for part in parts]
    nu = fusion_length(guess, _FIT.nu_per_thickness)
    spread = torch.linspace(0, len(vertices) - 1, min(len(vertices), _FIT.refined_points)).long()
    data = vertices[spread], weights[spread][:, parts].argmax(-1)
    return DeferredSolids(in_frames(guess), partial(_refined_solids, guess, neighbors, nu, *data, in_frames)), nu


def _refined_solids(
    guess: Sequence[Primitive],
    neighbors: Tensor,
    nu: float,
    points: Tensor,
    owners: Tensor,
    in_frames: Callable[[Sequence[Primitive]], list[Primitive]],
) -> list[Primitive]:
    """Return solids refined together, see `refine_primitives`, in their joints' frames."""
    return in_frames(refine_primitives(guess, neighbors, nu, points, owners))


def _skin_weights(weights: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return checked weights (V, J), float64, whose rows sum to exactly one."""
    weights = as_float_tensor(weights, "weights").double()
    check_shape(weights, "weights", shape)
    check_finite(weights, "weights")
    if bool((weights < 0).any()) or not torch.allclose(weights.sum(-1), weights.new_ones(()), atol=1e-3):
        raise InputError("weights must not be negative and every row must sum to one")
    return weights / weights.sum(-1, keepdim=True)


def topological_order(parents: Sequence[int], names: Sequence[str]) -> list[int]:
    """Return joint indices with every parent before its children; ModelError where there is no such order."""
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
    """Return checked joint frames (J, 4, 4) of positions (J, 3) or frames."""
    check_finite(joints, "joints")
    if joints.ndim == 2:
        check_shape(joints, "joints", ("J", 3))
        return rigid_matrix(torch.eye(3, dtype=joints.dtype).expand(len(joints), 3, 3), joints)
    check_shape(joints, "joints", ("J", 4, 4))
    # Files in single precision have rotations that are off by rounding; inverting them rigidly needs better.
    u, _, vh = torch.linalg.svd(joints[:, :3, :3])
    rotations = u @ vh
    is_bad = (joints[:, :3, :3] - rotations).abs().amax((-2, -1)) > RIGID_TOLERANCE.rounded
    is_bad |= (torch.linalg.det(rotations) < 0) | (joints[:, 3] != joints.new_tensor([0.0, 0.0, 0.0, 1.0])).any(-1)
    if bool(is_bad.any()):
        raise InputError(
            f"joints[{int(is_bad.nonzero()[0])}] is not a rigid frame (scale, shear, mirror or a last row other than "
            f"0, 0, 0, 1); pass T_world_joint without scale"
        )
    return rigid_matrix(rotations, joints[:, :3, 3])


def _carries_skin(parents: Sequence[int], order: Sequence[int], weights: Tensor) -> list[bool]:
    """Return, for each joint, whether it moves any of the skin, itself or through its descendants."""
    used = [bool(column.max() > 0) for column in weights.T]
    for index in reversed(order):
        if parents[index] >= 0 and used[index]:
            used[parents[index]] = True
    return used


@dataclass(frozen=True)
class _Move:
    """A degree of freedom of a rig's joint: the suffix of its name, its axis in the joint's frame, kind and limits."""

    suffix: str
    axis: str | Sequence[float]
    kind: str
    limits: tuple[float, float]


def _ball_joint_tree(
    order: Sequence[int],
    parents: Sequence[int],
    names: Sequence[str],
    frames: Tensor,
    used: Sequence[bool],
    *,
    axes: Axes,
    limits: Limits,
    slides: Mapping[str, float],
) -> tuple[KinematicTree, dict[int, str]]:
    """Return the tree, with several stacked frames per rig joint, and the name of each rig joint's last frame."""
    unknown = sorted((set(axes) | set(limits)) - set(names))
    if unknown:
        raise ModelError(
            f"axes or limits name joints that are not there: {', '.join(unknown)}; known: {', '.join(names)}"
        )
    joints: list[Joint] = []
    last: dict[int, int] = {}
    taken = set(names)
    if len(taken) < len(names):
        repeated = ", ".join(sorted({name for name in names if names.count(name) > 1})[:5])
        raise ModelError(f"frame names must be unique, these occur more than once: {repeated}")
    for index in order:
        parent, name = parents[index], names[index]
        offset = frames[index] if parent < 0 else invert_rigid(frames[parent]) @ frames[index]
        joints.append(Joint(name, last.get(parent, -1), offset))
        chosen = axes.get(name, ("x", "y", "z") if parent >= 0 and used[index] else ())
        bounds = limits.get(name, [(-torch.pi, torch.pi)] * len(chosen))
        if len(bounds) != len(chosen):
            raise ModelError(f"joint {name!r} has {len(chosen)} axes but {len(bounds)} pairs of limits")
        far = slides.get(name, 0.0) if parent >= 0 else 0.0
        moves = [_Move(f"slide_{axis}", axis, "prismatic", (-far, far)) for axis in _UNIT_AXES if far]
        for number, (axis, bound) in enumerate(zip(chosen, bounds, strict=True)):
            moves.append(_Move(axis if isinstance(axis, str) else str(number), axis, "revolute", bound))
        for move in moves:
            joints.append(
                Joint(
                    name=_free_name(f"{name}_{move.suffix}", taken),
                    parent=len(joints) - 1,
                    offset=torch.eye(4, dtype=torch.float64),
                    kind=move.kind,
                    axis=_as_unit_axis(move.axis, name),
                    lower=float(move.limits[0]),
                    upper=float(move.limits[1]),
                )
            )
        last[index] = len(joints) - 1
    return KinematicTree(tuple(joints)), {index: joints[frame].name for index, frame in last.items()}


def _free_name(name: str, taken: set[str]) -> str:
    """Return a name, with ``#`` behind it as often as another frame is called so, and take it."""
    free = name
    while free in taken:
        free += "#"
    if free != name:
        warnings.warn(
            f"a degree of freedom is called {free!r}, as a joint is called {name!r}", FileWarning, stacklevel=2
        )
    taken.add(free)
    return free


def _as_unit_axis(axis: str | Sequence[float], name: str) -> tuple[float, float, float]:
    if isinstance(axis, str):
        if axis not in _UNIT_AXES:
            raise ModelError(f"joint {name!r} has axis {axis!r}; give x, y, z or a vector of three numbers")
        return _UNIT_AXES[axis]
    length = sum(float(a) ** 2 for a in axis) ** 0.5
    if len(axis) != 3 or not 0 < length < float("inf"):
        raise ModelError(f"joint {name!r} has axis {tuple(axis)}; three finite numbers, not all zero, are needed")
    x, y, z = (float(a) / length for a in axis)
    return (x, y, z)


def _owned_vertices(vertices: Tensor, weights: Tensor, owned: Tensor) -> Tensor:
    """Return the vertices (N, 3) that follow a joint most; if they are few, those with the largest weights (V,)."""
    if int(owned.sum()) < _FIT.min_owned:
        return vertices[weights.topk(min(_FIT.min_owned, len(vertices))).indices]
    return vertices[owned]


def _in_joint_frames(
    solids: Sequence[Primitive], *, joints: Sequence[int], frames: Tensor, parents: Sequence[int]
) -> list[Primitive]:
    """Return solids in their joints' frames, the long axis along the bone: to the next joints, or to their center."""
    placed = []
    for solid, joint in zip(solids, joints, strict=True):
        to_joint = invert_rigid(frames[joint])
        pose = to_joint @ solid.pose
        children = [index for index, parent in enumerate(parents) if parent == joint]
        end = transform_points(to_joint, frames[children, :3, 3]).mean(0) if children else pose[:3, 3]
        placed.append(with_long_axis(Primitive(solid.kind, solid.sizes, pose), end))
    return placed
