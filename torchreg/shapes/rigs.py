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
from torchreg.geometry.mesh import TriangleMesh, concatenate, sample_surface
from torchreg.geometry.primitive_fit import fit_primitive
from torchreg.geometry.primitives import PRIMITIVE_KINDS
from torchreg.geometry.rigid import invert_rigid, rigid_matrix, transform_points
from torchreg.io.gltf import load_rig
from torchreg.io.urdf import UrdfPrimitive, UrdfRecord, load_urdf
from torchreg.shapes.kinematics import KinematicChain, neighbor_matrix, part_parents
from torchreg.shapes.primitive_refinement import refine_primitives
from torchreg.shapes.primitives import Primitive

Axes = Mapping[str, Sequence[str | Sequence[float]]]
Limits = Mapping[str, Sequence[tuple[float, float]]]

_UNIT_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# SMPL files mark the root's parent with the largest unsigned 32-bit number.
_UNSIGNED_ROOT = 2**32 - 1
# The fusion length is this share of the median half thickness of the parts.
_NU_PER_THICKNESS = 0.25
# Rigid links meet at edges, with no flesh in between.
_ROBOT_NU_PER_THICKNESS = 0.08
_SAMPLES_PER_LINK = 1000
# A joint that owns fewer vertices gets a solid around those that follow it most.
_MIN_OWNED = 8
# A superquadric of these exponents is a box with slightly rounded edges.
_BOX_EXPONENT = 0.1
_SEGMENTS = 24
_RIGID_TOLERANCE = 1e-3
_MAX_REFINE_POINTS = 4000
_BOX_CORNERS = torch.tensor([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]).double()
_BOX_FACES = torch.tensor(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


@dataclass(frozen=True)
class RigSurface:
    """The surface a file brings along, in the pose of all zeros.

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
    """What an articulated shape is built from.

    Args:
        tree: the kinematic tree.
        part_frames: names of the frames that carry a solid.
        primitives: one solid per part.
        nu: fusion length, metres.
        part_names: names of the parts.
        surface: mesh and weights of the file, in the pose of all zeros.
    """

    tree: KinematicTree
    part_frames: tuple[str, ...]
    primitives: tuple[Primitive, ...]
    nu: float
    part_names: tuple[str, ...]
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
    if bool((weights < 0).any()) or not torch.allclose(weights.sum(-1), weights.new_ones(()), atol=1e-3):
        raise InputError("weights must not be negative and every row must sum to one")
    weights = weights / weights.sum(-1, keepdim=True)
    names = tuple(joint_names) if joint_names is not None else tuple(f"joint_{index}" for index in range(count))
    parent_list = [-1 if int(parent) in (-1, _UNSIGNED_ROOT) else int(parent) for parent in parents]
    if len(names) != count or len(parent_list) != count:
        raise InputError(f"{count} joints need {count} names and parents, got {len(names)} and {len(parent_list)}")
    order = topological_order(parent_list, names)
    used = _carries_skin(parent_list, order, weights)
    joints_of_tree, last_frame = _ball_joint_tree(order, parent_list, names, frames, used, axes or {}, limits or {})
    parts = [index for index in order if bool(weights[:, index].max() > 0)]
    tree = KinematicTree(tuple(joints_of_tree))
    part_frames = tuple(last_frame[index] for index in parts)
    fitted = [_fit_to_owned(vertices, weights, index, primitive) for index in parts]
    nu = _default_nu(fitted)
    neighbors = neighbor_matrix(part_parents(tree, [tree.index(name) for name in part_frames]))
    some = _spread_choice(len(vertices))
    fitted = refine_primitives(fitted, neighbors, nu, vertices[some], weights[some][:, parts].argmax(-1))
    primitives = tuple(
        _in_joint_frame(solid, frames, index, parent_list) for index, solid in zip(parts, fitted, strict=True)
    )
    surface = RigSurface(vertices, mesh.faces, weights[:, parts])
    return ShapeSpec(tree, part_frames, primitives, nu, tuple(names[index] for index in parts), surface)


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
    # Files in single precision have rotations that are off by rounding; inverting them rigidly needs better.
    u, _, vh = torch.linalg.svd(joints[:, :3, :3])
    rotations = u @ vh
    off = (joints[:, :3, :3] - rotations).abs().amax((-2, -1)) > _RIGID_TOLERANCE
    off |= (torch.linalg.det(rotations) < 0) | (joints[:, 3] != joints.new_tensor([0.0, 0.0, 0.0, 1.0])).any(-1)
    if bool(off.any()):
        raise InputError(
            f"joints[{int(off.nonzero()[0])}] is not a rigid frame (scale, shear, mirror or a last row other than "
            f"0, 0, 0, 1); pass T_world_joint without scale"
        )
    return rigid_matrix(rotations, joints[:, :3, 3])


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


def _fit_to_owned(vertices: Tensor, weights: Tensor, joint: int, kind: str) -> Primitive:
    """Return the solid fitted to the vertices that follow a joint most, in their coordinates."""
    owned = vertices[weights.argmax(-1) == joint]
    if len(owned) < _MIN_OWNED:
        owned = vertices[weights[:, joint].topk(min(_MIN_OWNED, len(vertices))).indices]
    return _fitted(owned, kind)


def _in_joint_frame(solid: Primitive, frames: Tensor, joint: int, parents: Sequence[int]) -> Primitive:
    """Return the solid in its joint's frame, its length along the bone: to the next joints, or to its own center."""
    to_joint = invert_rigid(frames[joint])
    pose = to_joint @ solid.pose
    children = [index for index, parent in enumerate(parents) if parent == joint]
    ends = transform_points(to_joint, frames[children, :3, 3]).mean(0) if children else pose[:3, 3]
    return _long_along(Primitive(solid.kind, solid.sizes, pose), ends)


def _fitted(points: Tensor, kind: str) -> Primitive:
    fitted = fit_primitive(points, kind)
    return Primitive(fitted.kind, fitted.sizes, fitted.pose)


def _long_along(solid: Primitive, direction: Tensor | None = None) -> Primitive:
    """Return the same ellipsoid with the axis nearest to a direction (by default its longest) as z, its length."""
    if solid.kind != "ellipsoid":
        return solid
    sizes = torch.tensor(solid.sizes, dtype=torch.float64)
    long = int((sizes if direction is None else (solid.pose[:3, :3].mT @ direction).abs()).argmax())
    order = [(long + 1) % 3, (long + 2) % 3, long]
    pose = solid.pose.clone()
    pose[:3, :3] = solid.pose[:3, order]
    return Primitive(solid.kind, tuple(sizes[order].tolist()), pose)


def _spread_choice(count: int) -> Tensor:
    """Return indices of at most `_MAX_REFINE_POINTS` of ``count`` points, spread over all."""
    return torch.linspace(0, count - 1, min(count, _MAX_REFINE_POINTS)).long()


def _default_nu(primitives: Sequence[Primitive], share: float = _NU_PER_THICKNESS) -> float:
    lengths = [min(_lengths(primitive)) for primitive in primitives]
    return share * float(torch.tensor(lengths, dtype=torch.float64).median())


def _lengths(primitive: Primitive) -> list[float]:
    kind = PRIMITIVE_KINDS[primitive.kind]
    return [value for value, size in zip(primitive.sizes, kind.sizes, strict=True) if size.is_length]


def spec_from_urdf(
    path: str | Path,
    *,
    package_dirs: Sequence[str | Path] = (),
    primitive: str = "auto",
    meshes: str = "require",
) -> ShapeSpec:
    """Return the `ShapeSpec` of a URDF robot; see `ArticulatedShape.from_urdf`."""
    check_choice(primitive, "primitive", ("auto", *PRIMITIVE_KINDS))
    record = load_urdf(path, package_dirs=[Path(folder) for folder in package_dirs], meshes=meshes)
    surfaces = [_link_surface(record, link) for link in range(len(record.link_names))]
    joints, part_frames, part_names, links, solids = list(record.tree.joints), [], [], [], []
    for link, surface in enumerate(surfaces):
        if surface is None:
            continue
        for number, solid in enumerate(_link_solids(record, link, surface, primitive)):
            frame = joints[link].name
            if number > 0:
                # A further solid of a link rides on a fixed frame of its own.
                frame = _new_name(f"{frame}_{number}", joints)
                joints.append(Joint(frame, link, torch.eye(4, dtype=torch.float64)))
            part_frames.append(frame)
            part_names.append(record.link_names[link] + (f"_{number}" if number else ""))
            links.append(link)
            solids.append(solid)
    if not solids:
        raise ModelError(f"no link of {path} has geometry: there is nothing to align")
    return ShapeSpec(
        tree=KinematicTree(tuple(joints)),
        part_frames=tuple(part_frames),
        primitives=tuple(solids),
        nu=_default_nu(solids, _ROBOT_NU_PER_THICKNESS),
        part_names=tuple(part_names),
        surface=_robot_surface(record.tree, surfaces, links),
    )


def _link_surface(record: UrdfRecord, link: int) -> TriangleMesh | None:
    """Return the mesh of all geometry of a link, in its coordinates; None if it has no area."""
    mesh = record.link_meshes[link]
    pieces = [solid_mesh(solid) for solid in record.link_primitives[link]]
    pieces = pieces if mesh is None else [mesh, *pieces]
    whole = concatenate(pieces) if pieces else None
    return None if whole is None or not float(whole.face_areas().sum()) > 0 else whole


def _link_solids(record: UrdfRecord, link: int, surface: TriangleMesh, kind: str) -> list[Primitive]:
    """Return a link's solids in its frame: its own primitives and one for its mesh, or one of the kind asked for."""
    generator = torch.Generator().manual_seed(link)
    mesh = record.link_meshes[link]
    if kind != "auto":
        return [_long_along(_fitted(sample_surface(surface, _SAMPLES_PER_LINK, generator)[0], kind))]
    solids = [_exact_solid(solid) for solid in record.link_primitives[link]]
    if mesh is not None and float(mesh.face_areas().sum()) > 0:
        solids.insert(0, _long_along(_fitted(sample_surface(mesh, _SAMPLES_PER_LINK, generator)[0], kind)))
    return solids


def _exact_solid(solid: UrdfPrimitive) -> Primitive:
    if solid.kind == "box":
        x, y, z = (0.5 * edge for edge in solid.size)
        return Primitive("superquadric", (x, y, z, _BOX_EXPONENT, _BOX_EXPONENT), solid.origin)
    if solid.kind == "sphere":
        return Primitive("ellipsoid", solid.size * 3, solid.origin)
    radius, length = solid.size
    if solid.kind == "cylinder":
        return Primitive("cone", (0.5 * length, radius, radius), solid.origin)
    return Primitive("capsule", (0.5 * length, radius), solid.origin)


def solid_mesh(solid: UrdfPrimitive) -> TriangleMesh:
    """Return a closed mesh of a box, cylinder, capsule or sphere, in the coordinates of its link.

    Args:
        solid: the solid; round ones get `_SEGMENTS` facets around their axis, with vertices on the surface.
    """
    if solid.kind == "box":
        return TriangleMesh(
            transform_points(solid.origin, _BOX_CORNERS * torch.tensor(solid.size, dtype=torch.float64)), _BOX_FACES
        )
    turn = torch.linspace(0, torch.pi, _SEGMENTS // 2 + 1, dtype=torch.float64)
    radius, half = solid.size[0], 0.5 * (solid.size[1] if len(solid.size) > 1 else 0.0)
    if solid.kind == "cylinder":
        profile = torch.tensor([[0.0, -half], [radius, -half], [radius, half], [0.0, half]], dtype=torch.float64)
    else:
        profile = torch.stack([radius * turn.sin(), -radius * turn.cos()], dim=-1)
        middle = len(profile) // 2
        shift = torch.tensor([0.0, half], dtype=torch.float64)
        profile = torch.cat([profile[: middle + 1] - shift, profile[middle if half > 0 else middle + 1 :] + shift])
    angles = torch.arange(_SEGMENTS, dtype=torch.float64) * (2 * torch.pi / _SEGMENTS)
    around = torch.stack([angles.cos(), angles.sin()], dim=-1)
    ring = (profile[:, None, :1] * around, profile[:, None, 1:].expand(-1, _SEGMENTS, 1))
    here = torch.arange(len(profile) * _SEGMENTS).reshape(len(profile), _SEGMENTS)
    low, high, low_next, high_next = (
        grid.flatten() for grid in (here[:-1], here[1:], here[:-1].roll(-1, 1), here[1:].roll(-1, 1))
    )
    faces = torch.cat([torch.stack([low, low_next, high], -1), torch.stack([low_next, high_next, high], -1)])
    return TriangleMesh(transform_points(solid.origin, torch.cat(ring, dim=-1).flatten(0, 1)), faces)


def _robot_surface(tree: KinematicTree, surfaces: Sequence[TriangleMesh | None], links: Sequence[int]) -> RigSurface:
    """Return the links' surfaces with every joint at zero, each vertex on the first part of its link."""
    chain = KinematicChain(tree)
    transforms = chain(torch.zeros(chain.num_dofs, dtype=torch.float64))
    part_of = {link: links.index(link) for link in dict.fromkeys(links)}
    placed = [(part, transforms[link], mesh) for link, part in part_of.items() if (mesh := surfaces[link]) is not None]
    whole = concatenate([TriangleMesh(transform_points(at, mesh.vertices), mesh.faces) for _, at, mesh in placed])
    owners = torch.cat([torch.full((mesh.num_vertices,), part) for part, _, mesh in placed])
    # Robots' meshes are large and these weights zeros and ones, so that half the memory holds them exactly.
    weights = torch.zeros(len(owners), len(links), dtype=torch.float32)
    return RigSurface(whole.vertices, whole.faces, weights.scatter_(1, owners.unsqueeze(-1), 1.0))


def _new_name(name: str, joints: Sequence[Joint]) -> str:
    taken = {joint.name for joint in joints}
    while name in taken:
        name += "_"
    return name
