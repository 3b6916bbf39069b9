"""The solids of an articulated shape, one per part, with learnable sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchreg.errors import ModelError
from torchreg.geometry.primitives import PRIMITIVE_KINDS

# Boxes reach their corners and capsules their round ends: the norm of the sizes and half as much again covers both.
_BALL_FACTOR = 1.5


@dataclass(frozen=True)
class Primitive:
    """One solid of a part.

    Args:
        kind: "ellipsoid", "capsule", "cone" or "superquadric".
        sizes: the kind's sizes, metres; see `torchreg.geometry.primitives`.
        pose: (4, 4) ``T_part_primitive``; the solid's long axis is its z axis.
    """

    kind: str
    sizes: tuple[float, ...]
    pose: Tensor


class PrimitiveSet(nn.Module):
    """One solid per part behind one interface: signed distances and their gradients.

    Args:
        primitives: one `Primitive` per part.

    Raises:
        ModelError: if a kind is unknown, a size is missing, not positive or not finite, or a pose is not rigid.
    """

    rotations: Tensor
    kind_order: Tensor

    def __init__(self, primitives: Sequence[Primitive]) -> None:
        super().__init__()
        for index, primitive in enumerate(primitives):
            _check_primitive(index, primitive)
        self.kinds = tuple(dict.fromkeys(primitive.kind for primitive in primitives))
        members = [[i for i, p in enumerate(primitives) if p.kind == kind] for kind in self.kinds]
        self.part_kinds = tuple(primitive.kind for primitive in primitives)
        order = torch.tensor([i for group in members for i in group])
        self.register_buffer("kind_order", order.argsort(), persistent=False)
        for name, group in zip(self.kinds, members, strict=True):
            self.register_buffer(f"members_{name}", torch.tensor(group), persistent=False)
            self.register_buffer(f"long_{name}", torch.tensor(PRIMITIVE_KINDS[name].long_sizes), persistent=False)
            self.register_buffer(f"scalable_{name}", torch.tensor(PRIMITIVE_KINDS[name].scalable), persistent=False)
        poses = torch.stack([primitive.pose.double() for primitive in primitives])
        self.register_buffer("rotations", poses[:, :3, :3].clone(), persistent=False)
        self.centers = nn.Parameter(poses[:, :3, 3].clone())
        self.sizes = nn.ParameterList(
            nn.Parameter(torch.tensor([primitives[i].sizes for i in group], dtype=torch.float64)) for group in members
        )

    def __len__(self) -> int:
        return len(self.part_kinds)

    def scaled_sizes(self, length_scales: Tensor, radius_scales: Tensor) -> list[Tensor]:
        """Return the sizes of each kind's solids with lengths along z and radii across it scaled.

        Args:
            length_scales: (P,).
            radius_scales: (P,).

        Returns:
            one (P_kind, S_kind) tensor per kind.

        Differentiable: in both, and in the sizes.
        """
        scaled = []
        for name, sizes in zip(self.kinds, self.sizes, strict=True):
            along, across = length_scales, radius_scales
            if len(self.kinds) > 1:
                members = self.get_buffer(f"members_{name}")
                along, across = along[members], across[members]
            factors = torch.where(self.get_buffer(f"long_{name}"), along.unsqueeze(-1), across.unsqueeze(-1))
            if not all(PRIMITIVE_KINDS[name].scalable):
                factors = torch.where(self.get_buffer(f"scalable_{name}"), factors, 1.0)
            scaled.append(sizes * factors)
        return scaled

    def reaches(self, sizes: Sequence[Tensor]) -> Tensor:
        """Return the radius (P,) of a ball around each solid's center that holds the solid, metres."""
        balls = [
            torch.where(self.get_buffer(f"scalable_{kind}"), size, 0.0).norm(dim=-1)
            for kind, size in zip(self.kinds, sizes, strict=True)
        ]
        return torch.cat(balls)[self.kind_order] * _BALL_FACTOR

    def forward(self, local_points: Tensor, sizes: Sequence[Tensor]) -> Tensor:
        """Return the distance of points to every part's solid.

        Args:
            local_points: (..., P, 3), each part's column in that solid's frame, metres.
            sizes: from `scaled_sizes`.

        Returns:
            (..., P), metres, negative inside.

        Differentiable: in both.
        """
        if len(self.kinds) == 1:
            return PRIMITIVE_KINDS[self.kinds[0]].distance(local_points, sizes[0])
        columns = [
            PRIMITIVE_KINDS[kind].distance(local_points[..., self.get_buffer(f"members_{kind}"), :], size)
            for kind, size in zip(self.kinds, sizes, strict=True)
        ]
        return torch.cat(columns, dim=-1)[..., self.kind_order]

    def distance_and_gradient(self, local_points: Tensor, sizes: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the distances (..., P) and their analytic gradients (..., P, 3) in the solids' frames."""
        if len(self.kinds) == 1:
            return PRIMITIVE_KINDS[self.kinds[0]].gradient(local_points, sizes[0])
        pairs = [
            PRIMITIVE_KINDS[kind].gradient(local_points[..., self.get_buffer(f"members_{kind}"), :], size)
            for kind, size in zip(self.kinds, sizes, strict=True)
        ]
        distance = torch.cat([pair[0] for pair in pairs], dim=-1)[..., self.kind_order]
        return distance, torch.cat([pair[1] for pair in pairs], dim=-2)[..., self.kind_order, :]


def _check_primitive(index: int, primitive: Primitive) -> None:
    if primitive.kind not in PRIMITIVE_KINDS:
        raise ModelError(f"primitive {index} has kind {primitive.kind!r}; known: {', '.join(PRIMITIVE_KINDS)}")
    what, names = f"primitive {index} ({primitive.kind})", PRIMITIVE_KINDS[primitive.kind].sizes
    if len(primitive.sizes) != len(names):
        raise ModelError(
            f"primitive {index} ({primitive.kind}) needs sizes {names}, got {len(primitive.sizes)} numbers"
        )
    for name, size in zip(names, primitive.sizes, strict=True):
        if not 0 < size < float("inf"):
            raise ModelError(
                f"primitive {index} ({primitive.kind}) has {name} = {size}; it must be positive and finite"
            )
    pose = primitive.pose.double()
    if tuple(pose.shape) != (4, 4) or not bool(torch.isfinite(pose).all()):
        raise ModelError(f"{what} needs a finite (4, 4) pose, got shape {tuple(pose.shape)}")
    rotation, identity = pose[:3, :3], torch.eye(3, dtype=pose.dtype, device=pose.device)
    if not torch.allclose(rotation @ rotation.mT, identity, atol=1e-4) or rotation.det() < 0:
        raise ModelError(f"{what} has a pose that is not a rigid motion (scale, shear or mirror)")
