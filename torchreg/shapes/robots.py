"""Specifications of shapes from robot descriptions and from chains of pytorch-kinematics."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchreg._checks import check_choice
from torchreg.errors import FileWarning, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh, concatenate, sample_surface
from torchreg.geometry.rigid import rigid_matrix, transform_points
from torchreg.geometry.rotation import rotation_between
from torchreg.io.urdf import load_urdf
from torchreg.io.urdf_file.record import UrdfPrimitive, UrdfRecord
from torchreg.shapes.kinematics import ForwardKinematics, new_name, read_chain
from torchreg.shapes.pose_algebra import BASE_DOF_NAMES
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.spec import SOLID_CHOICES, RigSurface, ShapeSpec, fitted_solid, fusion_length, with_long_axis

if TYPE_CHECKING:
    from torchreg.shapes.kinematics import Chain


@dataclass(frozen=True)
class _RobotFit:
    """Numbers by which solids and meshes of links are made."""

    # Fusion length in median half thicknesses of the links: rigid links meet at edges, with no flesh in between.
    nu_per_thickness: float = 0.08
    # Surface points to which a link's solid is fitted.
    samples_per_link: int = 1000
    # Exponents of the superquadric of a box, whose edges are slightly rounded.
    box_exponent: float = 0.1
    # Facets around the axis of round solids.
    segments: int = 24
    # Radius of the capsules that stand for links without geometry, in median distances between frames: a finger's.
    radius_per_bone: float = 0.1
    # Of links without a color in the file: bare metal.
    color: tuple[float, float, float] = (0.7, 0.7, 0.72)


_FIT = _RobotFit()


def spec_from_urdf(
    path: str | Path, *, package_dirs: Sequence[str | Path] = (), primitive: str = "auto", meshes: str = "warn"
) -> ShapeSpec:
    """Return the `ShapeSpec` of a URDF robot; see `ArticulatedShape.from_urdf`."""
    check_choice(primitive, "primitive", SOLID_CHOICES)
    record = load_urdf(path, package_dirs=[Path(folder) for folder in package_dirs], meshes=meshes)
    return _spec_of(record, primitive, f"{path}: no link has geometry that can be read: there is nothing to align")


def spec_from_chain(chain: Chain) -> ShapeSpec:
    """Return the `ShapeSpec` of a pytorch-kinematics chain; see `ArticulatedShape.from_chain`."""
    record, unread = read_chain(chain)
    bare = unread if unread or any(record.link_primitives) else range(len(record.link_names))
    bones = _bones(record.tree, bare)
    solids = tuple((*own, *bones.get(link, ())) for link, own in enumerate(record.link_primitives))
    empty = "chain has no link with geometry and no two frames apart: there is nothing to align"
    return _spec_of(replace(record, link_primitives=solids), "auto", empty)


def _bones(tree: KinematicTree, links: Collection[int]) -> dict[int, tuple[UrdfPrimitive, ...]]:
    """Return thin capsules from the links to the frames on them, and balls for links that carry no other."""
    ends: dict[int, list[Tensor]] = {link: [] for link in links}
    for joint in tree.joints:
        if joint.parent in ends:
            ends[joint.parent].append(joint.offset[:3, 3].double())
    lengths = torch.stack([joint.offset[:3, 3].norm() for joint in tree.joints[1:]] or [torch.zeros(())]).double()
    if not bool((lengths > 0).any()):
        return {}
    radius = _FIT.radius_per_bone * float(lengths[lengths > 0].median())
    ball = UrdfPrimitive("sphere", (radius,), torch.eye(4, dtype=torch.float64))
    return {
        link: tuple(_bone(end, radius) for end in rows if float(end.norm()) > 0) if rows else (ball,)
        for link, rows in ends.items()
    }


def _bone(end: Tensor, radius: float) -> UrdfPrimitive:
    """Return the capsule from the origin to a point (3,)."""
    length = end.norm()
    turn = rotation_between(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), end / length)
    return UrdfPrimitive("capsule", (radius, float(length)), rigid_matrix(turn, 0.5 * end))


def _spec_of(record: UrdfRecord, primitive: str, empty: str) -> ShapeSpec:
    """Return the `ShapeSpec` of a robot with solids of a kind; ``empty`` is the error's message if it has none."""
    surfaces = [_link_surface(record, link) for link in range(len(record.link_names))]
    joints, part_frames, part_names, links, solids = _own_names(record.tree.joints), [], [], [], []
    for link, surface in enumerate(surfaces):
        if surface is None:
            continue
        for number, solid in enumerate(_link_solids(record, link, surface, primitive)):
            frame = joints[link].name
            if number > 0:
                # A further solid of a link is carried by a fixed frame of its own.
                frame = new_name(f"{frame}_{number}", {joint.name for joint in joints})
                joints.append(Joint(frame, link, torch.eye(4, dtype=torch.float64)))
            part_frames.append(frame)
            name = record.link_names[link]
            part_names.append(new_name(f"{name}_{number}", {*record.link_names}) if number else name)
            links.append(link)
            solids.append(solid)
    if not solids:
        raise ModelError(empty)
    return ShapeSpec(
        tree=KinematicTree(tuple(joints)),
        part_frames=tuple(part_frames),
        primitives=tuple(solids),
        nu=fusion_length(solids, _FIT.nu_per_thickness),
        part_names=tuple(part_names),
        surface=_robot_surface(record, surfaces, links),
    )


def _own_names(joints: Sequence[Joint]) -> list[Joint]:
    """Return joints none of which is called like a degree of freedom of the base; warn about those that were."""
    found = list(joints)
    for index, joint in enumerate(joints):
        if joint.name in BASE_DOF_NAMES and joint.kind != "fixed" and joint.mimic is None:
            found[index] = replace(joint, name=new_name(f"{joint.name}_joint", {other.name for other in joints}))
            warnings.warn(
                f"joint {joint.name!r} is called {found[index].name!r} here, as {joint.name} moves the whole robot",
                FileWarning,
                stacklevel=2,
            )
    return found


def _link_surface(record: UrdfRecord, link: int) -> TriangleMesh | None:
    """Return the mesh of all geometry of a link, in its coordinates; None if it has no area."""
    mesh = record.link_meshes[link]
    pieces = [solid_mesh(solid) for solid in record.link_primitives[link]]
    pieces = pieces if mesh is None else [mesh, *pieces]
    surface = concatenate(pieces) if pieces else None
    return None if surface is None or not float(surface.face_areas().sum()) > 0 else surface


def _link_solids(record: UrdfRecord, link: int, surface: TriangleMesh, kind: str) -> list[Primitive]:
    """Return a link's solids in its frame: its own primitives and one for its mesh, or one of the given kind."""
    generator = torch.Generator().manual_seed(link)

    def fitted(mesh: TriangleMesh) -> Primitive:
        return with_long_axis(fitted_solid(sample_surface(mesh, _FIT.samples_per_link, generator)[0], kind))

    if kind != "auto":
        return [fitted(surface)]
    mesh = record.link_meshes[link]
    solids = [
        Primitive(*_GEOMETRY[solid.kind](solid.size).solid, solid.origin) for solid in record.link_primitives[link]
    ]
    return [fitted(mesh), *solids] if mesh is not None and float(mesh.face_areas().sum()) > 0 else solids


@dataclass(frozen=True)
class _LinkSolid:
    """A solid of a robot description: its kind and sizes among the solids of shapes, and its closed mesh."""

    solid: tuple[str, tuple[float, ...]]
    mesh: TriangleMesh


def _box(size: Sequence[float]) -> _LinkSolid:
    x, y, z = (0.5 * edge for edge in size)
    corners = torch.tensor([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]).double()
    faces = torch.tensor(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
         [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    mesh = TriangleMesh(corners * torch.tensor(size, dtype=torch.float64), faces)
    return _LinkSolid(("superquadric", (x, y, z, _FIT.box_exponent, _FIT.box_exponent)), mesh)


def _cylinder(size: Sequence[float]) -> _LinkSolid:
    radius, half = size[0], 0.5 * size[1]
    outline = torch.tensor([[0.0, -half], [radius, -half], [radius, half], [0.0, half]], dtype=torch.float64)
    return _LinkSolid(("cone", (half, radius, radius)), _revolved(outline))


def _capsule(size: Sequence[float]) -> _LinkSolid:
    return _LinkSolid(("capsule", (0.5 * size[1], size[0])), _revolved(_round_outline(size[0], 0.5 * size[1])))


def _sphere(size: Sequence[float]) -> _LinkSolid:
    return _LinkSolid(("ellipsoid", (*size, *size, *size)), _revolved(_round_outline(size[0], 0.0)))


# Kinds of geometry that a robot description may hold besides meshes; cylinders and capsules lie along z, centered.
_GEOMETRY: dict[str, Callable[[Sequence[float]], _LinkSolid]] = {
    "box": _box,
    "cylinder": _cylinder,
    "capsule": _capsule,
    "sphere": _sphere,
}


def _round_outline(radius: float, half: float) -> Tensor:
    """Return the outline (N, 2) of a capsule, or of a ball if its half length is zero, as (radius, z)."""
    turn = torch.linspace(0, torch.pi, _FIT.segments // 2 + 1, dtype=torch.float64)
    outline = torch.stack([radius * turn.sin(), -radius * turn.cos()], dim=-1)
    middle = len(outline) // 2
    shift = torch.tensor([0.0, half], dtype=torch.float64)
    return torch.cat([outline[: middle + 1] - shift, outline[middle if half > 0 else middle + 1 :] + shift])


def _revolved(outline: Tensor) -> TriangleMesh:
    """Return the closed mesh of an outline (N, 2), as (radius, z) from axis to axis, turned about the z axis."""
    segments = _FIT.segments
    angles = torch.arange(segments, dtype=torch.float64) * (2 * torch.pi / segments)
    around = torch.stack([angles.cos(), angles.sin()], dim=-1)
    vertices = torch.cat((outline[:, None, :1] * around, outline[:, None, 1:].expand(-1, segments, 1)), dim=-1)
    index = torch.arange(len(outline) * segments).reshape(len(outline), segments)
    low, high = index[:-1], index[1:]
    low, high, low_next, high_next = (grid.flatten() for grid in (low, high, low.roll(-1, 1), high.roll(-1, 1)))
    faces = torch.cat([torch.stack([low, low_next, high], -1), torch.stack([low_next, high_next, high], -1)])
    return TriangleMesh(vertices.flatten(0, 1), faces)


def solid_mesh(solid: UrdfPrimitive) -> TriangleMesh:
    """Return a closed mesh of a solid in the coordinates of its link; round ones get 24 facets around their axis."""
    mesh = _GEOMETRY[solid.kind](solid.size).mesh
    return TriangleMesh(transform_points(solid.origin, mesh.vertices), mesh.faces)


def _robot_surface(record: UrdfRecord, surfaces: Sequence[TriangleMesh | None], links: Sequence[int]) -> RigSurface:
    """Return the links' surfaces with every joint at zero, each vertex on the first part of its link."""
    kinematics = ForwardKinematics(record.tree)
    transforms = kinematics(torch.zeros(kinematics.num_dofs, dtype=torch.float64))
    part_of = {link: links.index(link) for link in dict.fromkeys(links)}
    found = [(part, transforms[link], mesh) for link, part in part_of.items() if (mesh := surfaces[link]) is not None]
    surface = concatenate(
        [TriangleMesh(transform_points(frame, mesh.vertices), mesh.faces) for _, frame, mesh in found]
    )
    owners = torch.cat([torch.full((mesh.num_vertices,), part) for part, _, mesh in found])
    # Robots' meshes are large and these weights zeros and ones, so that half the memory holds them exactly.
    weights = torch.zeros(len(owners), len(links), dtype=torch.float32)
    weights.scatter_(1, owners.unsqueeze(-1), 1.0)
    return RigSurface(surface.vertices, surface.faces, weights, is_rigid=True, colors=_part_colors(record, links))


def _part_colors(record: UrdfRecord, links: Sequence[int]) -> Tensor:
    """Return the colors (P, 3) of parts on links."""
    known = record.link_colors or [None] * len(record.link_names)
    return torch.tensor([known[link] or _FIT.color for link in links])
