"""Solids on a tree of parts, meshed as one bending skin or as rigid pieces, and posed: the bodies of made-up data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.datasets.solids import Solid, Vector, mesh_of, union_distance
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, concatenate
from torchreg.geometry.rigid import rigid_matrix

SIDES = {"left": 1.0, "right": -1.0}  # signs of x


@dataclass(frozen=True)
class Part:
    """One part of a body at rest: metres, y up and z forward; the root's joint is its own middle."""

    name: str
    parent: str | None
    joint: Vector
    solids: tuple[Solid, ...]


@dataclass(frozen=True, eq=False)
class Figure:
    """A surface at rest and its P parts, which move it by linear blend skinning with weights (V, P).

    Parents come before children, -1 for the root; metres, y up and z forward.
    """

    mesh: TriangleMesh
    weights: Tensor
    joints: Tensor
    parents: tuple[int, ...]
    part_names: tuple[str, ...]

    @property
    def num_parts(self) -> int:
        """Number of parts."""
        return len(self.parents)

    def index(self, name: str) -> int:
        """Return the number of the part called ``name``; InputError lists the known names."""
        if name not in self.part_names:
            raise InputError(f"figure must have a part called {name!r}, got {', '.join(self.part_names)}")
        return self.part_names.index(name)

    def transforms(self, rotations: Tensor, base: Tensor | None = None) -> Tensor:
        """Return the rigid motions (..., P, 4, 4) of all parts from the rest pose, followed by the motion of the base.

        Rotations (..., P, 3, 3) turn each part about its joint relative to its parent, in the axes of the rest pose.
        """
        joints = self.joints.to(rotations)
        about = joints - (rotations @ joints.unsqueeze(-1)).squeeze(-1)
        local = rigid_matrix(rotations, about)
        moved = [local[..., 0, :, :] if base is None else base.to(local) @ local[..., 0, :, :]]
        for index in range(1, self.num_parts):
            moved.append(moved[self.parents[index]] @ local[..., index, :, :])
        return torch.stack(moved, dim=-3)

    def vertices(self, transforms: Tensor) -> Tensor:
        """Return the vertices (..., V, 3) of the surface when its parts move by ``transforms`` (..., P, 4, 4)."""
        rest, weights = self.mesh.vertices.to(transforms), self.weights.to(transforms)
        blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
        return (blended[..., :3] @ rest.unsqueeze(-1)).squeeze(-1) + blended[..., 3]

    def joint_positions(self, transforms: Tensor) -> Tensor:
        """Return the joints (..., P - 1, 3) of all parts but the root, moved by ``transforms`` (..., P, 4, 4)."""
        moved = transforms[..., 1:, :, :]
        return (moved[..., :3, :3] @ self.joints[1:].to(moved).unsqueeze(-1)).squeeze(-1) + moved[..., :3, 3]


def meshed_figure(
    parts: Sequence[Part], *, spacing: float, blend: float = 0.0, softness: float | None = None
) -> Figure:
    """Return a body of rigid pieces, each with a closed surface, or of one closed, smoothly fused and skinned surface.

    Weights of a skin are ``softmax(-d_p / softness)`` over the distances d_p to the parts in the rest pose, metres;
    None leaves the pieces rigid. Parts that must not fuse lie apart in the rest pose. ``blend`` is the approximate
    radius of the seams, metres.
    """
    check_positive(spacing, "spacing")
    check_positive(blend, "blend", allow_zero=True)
    parents = _parents(parts)
    if softness is None:
        pieces = [mesh_of(part.solids, spacing) for part in parts]
        mesh = concatenate(pieces)
        owner = torch.arange(len(parts)).repeat_interleave(torch.tensor([piece.num_vertices for piece in pieces]))
        weights = torch.nn.functional.one_hot(owner, len(parts)).to(mesh.vertices)
    else:
        check_positive(softness, "softness")
        mesh = mesh_of([solid for part in parts for solid in part.solids], spacing, blend)
        distances = torch.stack([union_distance(part.solids, mesh.vertices, 0.0) for part in parts], dim=-1)
        weights = torch.softmax(-distances / softness, dim=-1)
    joints = torch.tensor([part.joint for part in parts], dtype=mesh.vertices.dtype)
    return Figure(mesh=mesh, weights=weights, joints=joints, parents=parents, part_names=tuple(p.name for p in parts))


def _parents(parts: Sequence[Part]) -> tuple[int, ...]:
    """Return the number of each part's parent, -1 for the root."""
    names = [part.name for part in parts]
    if len(set(names)) != len(names):
        raise InputError(f"parts must have different names, got {', '.join(names)}")
    for index, part in enumerate(parts):
        if (part.parent is not None) != (index > 0) or (part.parent is not None and part.parent not in names[:index]):
            raise InputError(f"part {part.name!r} hangs on {part.parent!r}: parents come first, and the root has none")
    return tuple(-1 if part.parent is None else names.index(part.parent) for part in parts)
