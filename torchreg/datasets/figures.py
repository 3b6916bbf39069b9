"""Bodies of parts that hang on joints: one skin that bends, or rigid pieces that meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.datasets.solids import Solid, Vector, mesh_of, union_distance
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import rigid_matrix


@dataclass(frozen=True)
class Part:
    """One part of a body in its rest pose.

    Args:
        name: unlike the others'.
        parent: name of the part on which it hangs, None for the root.
        joint: where it hangs on it; for the root its own middle. Metres, y up and z forward.
        solids: what it is made of, in the coordinates of the whole body.
    """

    name: str
    parent: str | None
    joint: Vector
    solids: tuple[Solid, ...]


@dataclass(frozen=True, eq=False)
class Figure:
    """A surface in its rest pose, and how it follows its parts by linear blend skinning.

    Args:
        mesh: the rest surface, metres, y up and z forward.
        weights: (V, P) rows sum to one.
        joints: (P, 3) where each part hangs on its parent, in the rest pose; for the root its own middle.
        parents: P indices, parents before children, -1 for the root.
        part_names: P names.
    """

    mesh: TriangleMesh
    weights: Tensor
    joints: Tensor
    parents: tuple[int, ...]
    part_names: tuple[str, ...]

    def __post_init__(self) -> None:
        count = len(self.parents)
        check_shape(self.weights, "weights", (self.mesh.num_vertices, count))
        check_shape(self.joints, "joints", (count, 3))
        if len(self.part_names) != count:
            raise InputError(f"part_names must name the {count} parts, got {len(self.part_names)} names")
        for index, parent in enumerate(self.parents):
            if not (-1 <= parent < index and (parent == -1) == (index == 0)):
                raise InputError(f"parents must be one root (-1) and then earlier parts, got {self.parents}")

    @property
    def num_parts(self) -> int:
        """Number of parts."""
        return len(self.parents)

    def index(self, name: str) -> int:
        """Return the number of the part called ``name``; InputError lists the known names."""
        if name not in self.part_names:
            raise InputError(f"no part is called {name!r}; known: {', '.join(self.part_names)}")
        return self.part_names.index(name)

    def transforms(self, rotations: Tensor, base: Tensor | None = None) -> Tensor:
        """Return the motion of every part from the rest pose.

        Args:
            rotations: (..., P, 3, 3) turn of each part about its joint against its parent, in the axes of the rest
                pose; the root turns about its own middle.
            base: (..., 4, 4) motion of the whole figure after that; None leaves it where it is.

        Returns:
            (..., P, 4, 4) rigid motions of points in the rest pose.
        """
        check_shape(rotations, "rotations", (self.num_parts, 3, 3), batch=True)
        joints = self.joints.to(rotations)
        about = joints - (rotations @ joints.unsqueeze(-1)).squeeze(-1)
        local = rigid_matrix(rotations, about)
        moved = [local[..., 0, :, :] if base is None else base.to(local) @ local[..., 0, :, :]]
        for index in range(1, self.num_parts):
            moved.append(moved[self.parents[index]] @ local[..., index, :, :])
        return torch.stack(moved, dim=-3)

    def vertices(self, transforms: Tensor) -> Tensor:
        """Return the vertices (..., V, 3) of the surface when its parts move by ``transforms`` (..., P, 4, 4)."""
        check_shape(transforms, "transforms", (self.num_parts, 4, 4), batch=True)
        rest, weights = self.mesh.vertices.to(transforms), self.weights.to(transforms)
        blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
        return (blended[..., :3] @ rest.unsqueeze(-1)).squeeze(-1) + blended[..., 3]

    def joint_positions(self, transforms: Tensor) -> Tensor:
        """Return where the joints (..., P - 1, 3) of all parts but the root are, in the order of the parts."""
        moved = transforms[..., 1:, :, :]
        return (moved[..., :3, :3] @ self.joints[1:].to(moved).unsqueeze(-1)).squeeze(-1) + moved[..., :3, 3]


def bending_figure(parts: Sequence[Part], *, spacing: float, blend: float, softness: float) -> Figure:
    """Return a body of one closed skin, smoothly fused and smoothly skinned.

    Weights are ``softmax(-d_p / softness)`` over the distances d_p to the parts in the rest pose, so that the skin
    bends over about four times ``softness``; parts that are not to stick together lie apart in the rest pose.

    Args:
        parts: parents before children.
        spacing: of the mesh, metres.
        blend: about the radius of the seams, metres.
        softness: see above, metres.

    Raises:
        InputError: if a name is unknown or doubled, or a number is not positive.
    """
    check_positive(softness, "softness")
    parents = _parents(parts)
    mesh = mesh_of([solid for part in parts for solid in part.solids], spacing, blend)
    distances = torch.stack([union_distance(part.solids, mesh.vertices, 0.0) for part in parts], dim=-1)
    return _figure(parts, parents, mesh, torch.softmax(-distances / softness, dim=-1))


def jointed_figure(parts: Sequence[Part], *, spacing: float) -> Figure:
    """Return a body of rigid pieces, each with a closed surface of its own.

    Args:
        parts: parents before children.
        spacing: of the meshes, metres.

    Raises:
        InputError: if a name is unknown or doubled, or the spacing is not positive.
    """
    parents = _parents(parts)
    meshes = [mesh_of(part.solids, spacing) for part in parts]
    counts = torch.tensor([mesh.num_vertices for mesh in meshes])
    starts = (counts.cumsum(0) - counts).tolist()
    faces = torch.cat([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    surface = TriangleMesh(torch.cat([mesh.vertices for mesh in meshes]), faces)
    owner = torch.arange(len(parts)).repeat_interleave(counts)
    return _figure(parts, parents, surface, torch.nn.functional.one_hot(owner, len(parts)).to(surface.vertices))


def _parents(parts: Sequence[Part]) -> tuple[int, ...]:
    names = [part.name for part in parts]
    if len(set(names)) != len(names):
        raise InputError(f"parts must have names of their own, got {', '.join(names)}")
    for index, part in enumerate(parts):
        if (part.parent is None) != (index == 0) or (part.parent is not None and part.parent not in names[:index]):
            raise InputError(f"part {part.name!r} hangs on {part.parent!r}: parents come first, and the root has none")
    return tuple(-1 if part.parent is None else names.index(part.parent) for part in parts)


def _figure(parts: Sequence[Part], parents: tuple[int, ...], mesh: TriangleMesh, weights: Tensor) -> Figure:
    joints = torch.tensor([part.joint for part in parts], dtype=mesh.vertices.dtype)
    return Figure(mesh, weights, joints, parents, tuple(part.name for part in parts))
