"""A robot description as a plain record."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchreg.geometry.kinematic_tree import KinematicTree
from torchreg.geometry.mesh import TriangleMesh


@dataclass(frozen=True, eq=False)
class UrdfPrimitive:
    """A box, cylinder, capsule or sphere on a link."""

    kind: str  # "box", "cylinder", "capsule" or "sphere"; cylinders and capsules lie along z, centered
    # metres: three edge lengths of a box; radius and length (without the caps) of a cylinder or capsule; radius
    # of a sphere
    size: tuple[float, ...]
    origin: Tensor  # (4, 4) float64 ``T_link_primitive``


@dataclass(frozen=True, eq=False)
class UrdfRecord:
    """A robot description: one frame per link, metres and radians."""

    name: str  # name of the robot
    # one frame per link; a frame has the name of its joint with the parent, the root that of its link
    tree: KinematicTree
    link_names: tuple[str, ...]  # names of the links, in the order of ``tree.joints``
    # mesh in link coordinates, float64, or None; visual geometry, else collision geometry
    link_meshes: tuple[TriangleMesh | None, ...]
    # boxes, cylinders, capsules and spheres of the same geometry
    link_primitives: tuple[tuple[UrdfPrimitive, ...], ...]
    # red, green and blue from 0 to 1 of a link's first visual with a color; None where there is none
    link_colors: tuple[tuple[float, ...] | None, ...] = ()
