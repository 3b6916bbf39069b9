"""The solids of an articulated shape, one per part, with sizes that can be scaled."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from torchreg._threads import in_new_thread, one_thread
from torchreg.errors import ModelError
from torchreg.geometry.primitives import PRIMITIVE_KINDS, Planes
from torchreg.geometry.rigid import RIGID_TOLERANCE, rigid_matrix, rotation_error

# Radius of a ball that holds a solid, in norms of its sizes: boxes reach their corners and capsules their round ends.
BALL_FACTOR = 1.5
# Exponent, to base 2, of a field that is negligible next to the dominating solid's field of one, in any precision.
_MIN_EXPONENT = -120.0


@dataclass(frozen=True)
class Primitive:
    """One solid of a part, with its long axis along z."""

    kind: str  # "ellipsoid", "capsule", "cone" or "superquadric"
    sizes: tuple[float, ...]  # the kind's sizes, metres; see `torchreg.geometry.primitives`
    pose: Tensor  # (4, 4) ``T_part_primitive``


class DeferredSolids:
    """Solids that are made when they are first needed, once for all copies; the guess is of the same kinds."""

    def __init__(self, guess: Sequence[Primitive], make: Callable[[], Sequence[Primitive]]) -> None:
        self.guess, self._make = tuple(guess), make

    def __len__(self) -> int:
        return len(self.guess)

    def __iter__(self) -> Iterator[Primitive]:
        return iter(self.made)

    def __getitem__(self, part: int) -> Primitive:
        return self.made[part]

    def __deepcopy__(self, memo: dict[int, Any]) -> DeferredSolids:
        return self  # nothing changes it

    @cached_property
    def made(self) -> tuple[Primitive, ...]:
        """The solids, made on first access, whatever modes of torch the caller is in."""
        return in_new_thread(self._made_here)

    def _made_here(self) -> tuple[Primitive, ...]:
        with one_thread():
            return tuple(self._make())


class _SizeTables(nn.Module):
    """The sizes (P_kind, S_kind) of the solids of each kind, as buffers."""

    def __init__(self, tables: Sequence[Sequence[Sequence[float]]]) -> None:
        super().__init__()
        for number, table in enumerate(tables):
            self.register_buffer(str(number), torch.tensor(table, dtype=torch.float64))

    def __getitem__(self, number: int) -> Tensor:
        return self.get_buffer(str(number))

    def __len__(self) -> int:
        return len(self._buffers)

    def __iter__(self) -> Iterator[Tensor]:
        return (self[number] for number in range(len(self)))


class PrimitiveSet(nn.Module):
    """The solids of all parts: signed distances and their gradients, evaluated kind by kind."""

    rotations: Tensor
    centers: Tensor
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
            sizes = PRIMITIVE_KINDS[name].sizes
            self.register_buffer(f"members_{name}", torch.tensor(group), persistent=False)
            self.register_buffer(f"long_{name}", torch.tensor([size.is_long for size in sizes]), persistent=False)
            self.register_buffer(f"scalable_{name}", torch.tensor([size.is_length for size in sizes]), persistent=False)
        poses = torch.stack([primitive.pose.double() for primitive in primitives])
        self.register_buffer("rotations", poses[:, :3, :3].clone(), persistent=False)
        self.register_buffer("centers", poses[:, :3, 3].clone())
        self.sizes = _SizeTables([[primitives[i].sizes for i in group] for group in members])

    def __len__(self) -> int:
        return len(self.part_kinds)

    def solids(self) -> list[Primitive]:
        """Return the solids with their present sizes and poses, in the order of the parts; detached, on the CPU."""
        sizes = {
            int(part): tuple(row)
            for kind, rows in zip(self.kinds, self.sizes, strict=True)
            for part, row in zip(self.get_buffer(f"members_{kind}"), rows.tolist(), strict=True)
        }
        poses = rigid_matrix(self.rotations, self.centers).detach().cpu()
        return [Primitive(kind, sizes[part], poses[part]) for part, kind in enumerate(self.part_kinds)]

    def scaled_sizes(self, length_scales: Tensor, radius_scales: Tensor) -> list[Tensor]:
        """Return the sizes (P_kind, S_kind) of each kind, lengths along z and radii across it scaled by (P,)."""
        scaled = []
        for name, sizes in zip(self.kinds, self.sizes, strict=True):
            along, across = length_scales, radius_scales
            if len(self.kinds) > 1:
                members = self.get_buffer(f"members_{name}")
                along, across = along[members], across[members]
            factors = torch.where(self.get_buffer(f"long_{name}"), along.unsqueeze(-1), across.unsqueeze(-1))
            if not all(size.is_length for size in PRIMITIVE_KINDS[name].sizes):
                factors = torch.where(self.get_buffer(f"scalable_{name}"), factors, 1.0)
            scaled.append(sizes * factors)
        return scaled

    def half_extents(self, sizes: Sequence[Tensor]) -> Tensor:
        """Return half extents (P, 3) of each solid along x, y and z by its sizes: across it, its largest radius."""
        rows = []
        for kind, size in zip(self.kinds, sizes, strict=True):
            is_long, lengths = self.get_buffer(f"long_{kind}"), self.get_buffer(f"scalable_{kind}")
            across = torch.where(lengths & ~is_long, size, 0.0).amax(-1)
            rows.append(torch.stack([across, across, torch.where(is_long, size, 0.0).amax(-1)], dim=-1))
        return torch.cat(rows)[self.kind_order]

    def reaches(self, sizes: Sequence[Tensor]) -> Tensor:
        """Return the radius (P,) of a ball around each solid's center that holds the solid, metres."""
        balls = [
            torch.where(self.get_buffer(f"scalable_{kind}"), size, 0.0).norm(dim=-1)
            for kind, size in zip(self.kinds, sizes, strict=True)
        ]
        return torch.cat(balls)[self.kind_order] * BALL_FACTOR

    def forward(self, local_points: Tensor, sizes: Sequence[Tensor]) -> Tensor:
        """Return the distances (..., P), metres, of points (..., P, 3), each in the frame of its solid."""
        return self.plane_distance(_single_column(local_points), sizes).squeeze(-1)

    def plane_distance(self, planes: Planes, sizes: Sequence[Tensor], parts: Sequence[int] | None = None) -> Tensor:
        """Return the distances (..., P, N) of points as planes x, y, z (..., P, N), one row per part of ``parts``."""
        groups = self._by_kind(sizes, parts)
        columns = [
            PRIMITIVE_KINDS[group.kind].plane_distance(group.pick(planes), group.sizes.unsqueeze(-2))
            for group in groups
        ]
        return _in_order(groups, columns)

    def plane_gradient(
        self, planes: Planes, sizes: Sequence[Tensor], parts: Sequence[int] | None = None
    ) -> tuple[Tensor, Planes]:
        """Return distances (..., P, N) and planes of their analytic gradients in the solids' frames."""
        groups = self._by_kind(sizes, parts)
        pairs = [
            PRIMITIVE_KINDS[group.kind].plane_gradient(group.pick(planes), group.sizes.unsqueeze(-2))
            for group in groups
        ]
        x, y, z = (_in_order(groups, [pair[1][axis] for pair in pairs]) for axis in range(3))
        return _in_order(groups, [pair[0] for pair in pairs]), (x, y, z)

    def _by_kind(self, sizes: Sequence[Tensor], parts: Sequence[int] | None) -> list[_KindRows]:
        if parts is None:
            every = [None] if len(self.kinds) == 1 else [self.get_buffer(f"members_{kind}") for kind in self.kinds]
            return [_KindRows(*group) for group in zip(self.kinds, every, sizes, strict=True)]
        groups = []
        for kind, size in zip(self.kinds, sizes, strict=True):
            rows = [row for row, part in enumerate(parts) if self.part_kinds[part] == kind]
            if rows:
                members = self.get_buffer(f"members_{kind}").tolist()
                index = torch.tensor([members.index(parts[row]) for row in rows], device=size.device)
                groups.append(_KindRows(kind, torch.tensor(rows, device=size.device), size[index]))
        return groups


def _single_column(points: Tensor) -> Planes:
    """Return points (..., P, 3) as planes (..., P, 1)."""
    x, y, z = points.unsqueeze(-2).unbind(-1)
    return x, y, z


@dataclass(frozen=True)
class _KindRows:
    """The rows of some planes that belong to solids of one kind (None: all), and the sizes of those solids."""

    kind: str
    rows: Tensor | None
    sizes: Tensor

    def pick(self, planes: Planes) -> Planes:
        if self.rows is None:
            return planes
        x, y, z = (plane.index_select(-2, self.rows) for plane in planes)
        return x, y, z


def _in_order(groups: Sequence[_KindRows], planes: Sequence[Tensor]) -> Tensor:
    """Return the rows of all groups in the order of the parts."""
    if len(groups) == 1:
        return planes[0]
    order = torch.cat([group.rows for group in groups if group.rows is not None]).argsort()
    return torch.cat(list(planes), dim=-2).index_select(-2, order)


def fuse(distances: Tensor, neighbors: Tensor, nu: float | Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance (...) to the fused surface, ``-nu log phi``, and its weights (..., P); eqs. 1 and 2."""
    nearest, dominating = distances.min(dim=-1, keepdim=True)
    # Zero or one per point and solid; in the memory order of distances of planes.
    fuses = neighbors.to(distances.dtype).index_select(-1, dominating.flatten())
    fuses = fuses.unflatten(-1, dominating.shape[:-1]).movedim(0, -1)
    return _summed(distances, nearest, fuses, nu)


def fuse_given(distances: Tensor, fuses: Tensor, nu: float | Tensor) -> tuple[Tensor, Tensor]:
    """Return the output of `fuse` for solids (N, P) that are given for each point, whichever dominates."""
    nearest = distances.masked_fill(~fuses, torch.inf).amin(-1, keepdim=True)
    return _summed(torch.where(fuses, distances, nearest), nearest, fuses.to(distances.dtype), nu)


def _summed(distances: Tensor, nearest: Tensor, fuses: Tensor, nu: float | Tensor) -> tuple[Tensor, Tensor]:
    # A power of two costs a quarter of exp() on a CPU, unless it underflows.
    fields = ((nearest - distances) * (math.log2(math.e) / nu)).clamp_min(_MIN_EXPONENT).exp2() * fuses
    total = fields.sum(-1, keepdim=True)
    return (nearest - nu * total.log()).squeeze(-1), fields / total


def _check_primitive(index: int, primitive: Primitive) -> None:
    if primitive.kind not in PRIMITIVE_KINDS:
        raise ModelError(f"primitive {index} has kind {primitive.kind!r}; known: {', '.join(PRIMITIVE_KINDS)}")
    title, sizes = f"primitive {index} ({primitive.kind})", PRIMITIVE_KINDS[primitive.kind].sizes
    if len(primitive.sizes) != len(sizes):
        names = tuple(size.name for size in sizes)
        raise ModelError(f"{title} needs sizes {names}, got {len(primitive.sizes)} numbers")
    for size, value in zip(sizes, primitive.sizes, strict=True):
        if not 0 < value < math.inf:
            raise ModelError(f"{title} has {size.name} = {value}; it must be positive and finite")
    pose = primitive.pose.double()
    if tuple(pose.shape) != (4, 4) or not bool(torch.isfinite(pose).all()):
        raise ModelError(f"{title} needs a finite (4, 4) pose, got shape {tuple(pose.shape)}")
    if rotation_error(pose[:3, :3]) > RIGID_TOLERANCE.single or pose[:3, :3].det() < 0:
        raise ModelError(f"{title} has a pose that is not a rigid motion (scale, shear or mirror)")
