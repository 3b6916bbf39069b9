"""A robot description as a plain record."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchreg.geometry.kinematic_tree import KinematicTree
from torchreg.geometry.mesh import TriangleMesh


@dataclass(frozen=True, eq=False)
class UrdfPrimitive:
    """A box, cylinder, capsule or sphere on a link.

    Args:
        kind: "box", "cylinder", "capsule" or "sphere"; cylinders and capsules lie along z, centered.
        size: metres: three edge lengths of a box; radius and length (without the caps) of a cylinder or capsule;
            radius of a sphere.
        origin: (4, 4) float64 ``T_link_primitive``.
    """

    kind: str
    size: tuple[float, ...]
    origin: Tensor


@dataclass(frozen=True, eq=False)
class UrdfRecord:
    """A robot description: one frame per link, metres and radians.

    Args:
        name: name of the robot.
        tree: one frame per link; a frame has the name of its joint with the parent, the root that of its link.
        link_names: names of the links, in the order of ``tree.joints``.
        link_meshes: mesh in link coordinates, float64, or None; visual geometry, else collision geometry.
        link_primitives: boxes, cylinders, capsules and spheres of the same geometry.
        link_colors: red, green and blue from 0 to 1 of a link's first visual with a color; None where there is none.
    """

    name: str
    tree: KinematicTree
    link_names: tuple[str, ...]
    link_meshes: tuple[TriangleMesh | None, ...]
    link_primitives: tuple[tuple[UrdfPrimitive, ...], ...]
    link_colors: tuple[tuple[float, ...] | None, ...] = ()
