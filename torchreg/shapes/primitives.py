"""The solids of an articulated shape, one per part, with learnable sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchreg.errors import ModelError
from torchreg.geometry.primitives import PRIMITIVE_KINDS, Planes
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import compose_rotation_vectors, so3_exp
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt
from torchreg.solvers.robust import cauchy_loss, cauchy_weight

# Boxes reach their corners and capsules their round ends: the norm of the sizes and half as much again covers both.
_BALL_FACTOR = 1.5
_LOG2_E = 1 / math.log(2)
# Nothing beside the dominating solid's field of one, in any precision.
_MIN_EXPONENT = -120.0
# Fitting solids to a surface: residuals beyond this many fusion lengths lose weight; weights of the terms beside the
# fused distance; fusion lengths of residual that a change by the solid's own size is worth.
_REFINE_SCALE = 1.5
_OWN_WEIGHT = 0.3
_RIVAL_WEIGHT = 0.3
_REFINE_STIFFNESS = 2.0
# Metres, radians and logarithms of sizes.
_REFINE_ATOL = 1e-5


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

    def plane_distance(self, planes: Planes, sizes: Sequence[Tensor], parts: Sequence[int] | None = None) -> Tensor:
        """Return what `forward` does for points given as planes x, y and z (..., P, N): distances (..., P, N).

        Args:
            planes: one row per part, or per member of ``parts``.
            sizes: from `scaled_sizes`.
            parts: the parts whose solids the rows belong to; all by default.
        """
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
                place = torch.tensor([members.index(parts[row]) for row in rows], device=size.device)
                groups.append(_KindRows(kind, torch.tensor(rows, device=size.device), size[place]))
        return groups


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
    if len(groups) == 1:
        return planes[0]
    order = torch.cat([group.rows for group in groups if group.rows is not None]).argsort()
    return torch.cat(list(planes), dim=-2).index_select(-2, order)


def fuse(distances: Tensor, neighbors: Tensor, nu: float) -> tuple[Tensor, Tensor]:
    """Return the distance to the fused surface, ``-nu log phi``, and each solid's share in its gradient.

    phi sums the fields ``exp(-d_q / nu)`` of the dominating solid and its neighbors only, in the log domain.

    Args:
        distances: (..., P) to every solid, metres.
        neighbors: (P, P) booleans, True on the diagonal.
        nu: fusion length, metres.

    Returns:
        (...) metres and (..., P), which sums to one.

    Differentiable: in ``distances``, where the dominating solid is unique.

    References: Dewaele et al. 2006, eqs. 1 and 2.
    """
    nearest, dominating = distances.min(dim=-1, keepdim=True)
    # Zero or one for every datum and solid; in the memory order that distances of planes have.
    fuses = neighbors.to(distances.dtype).index_select(-1, dominating.flatten())
    fuses = fuses.unflatten(-1, dominating.shape[:-1]).movedim(0, -1)
    # A power of two costs a quarter of exp() on a CPU, unless it underflows.
    fields = ((nearest - distances) * (_LOG2_E / nu)).clamp_min(_MIN_EXPONENT).exp2() * fuses
    total = fields.sum(-1, keepdim=True)
    return (nearest - nu * total.log()).squeeze(-1), fields / total


def refine_primitives(
    primitives: Sequence[Primitive], neighbors: Tensor, nu: float, points: Tensor, owners: Tensor, max_steps: int = 30
) -> list[Primitive]:
    """Return solids moved, turned and resized so that their fused surface runs through surface points.

    Damped least squares over all solids at once: the fused distance of every point, to a lesser degree the distance to
    the solid that owns it and by how much another solid is nearer, and a weak pull to the start, which keeps whole the
    solids that show only a patch. Residuals beyond the fusion length lose weight.

    Args:
        primitives: first guess, one per part, with poses in the points' coordinates.
        neighbors: (P, P) booleans, which solids fuse; True on the diagonal.
        nu: fusion length, metres.
        points: (N, 3) on the surface, metres.
        owners: (N,) part that each point belongs to.
        max_steps: damped least-squares steps.

    Returns:
        one `Primitive` per part, of the same kinds.

    References: Marquardt 1963.
    """
    solids = PrimitiveSet(primitives).requires_grad_(False)
    problem = _Refinement(solids, neighbors, nu, points.double(), owners)
    start = torch.zeros(1, len(primitives) * problem.width, dtype=torch.float64)
    found = levenberg_marquardt(
        problem.linearize, start, retract=problem.retract, max_steps=max_steps, atol=_REFINE_ATOL
    )
    rotations, centers, sizes = problem.solids_at(found.state)
    members = [int(part) for kind in solids.kinds for part in solids.get_buffer(f"members_{kind}")]
    rows = dict(zip(members, (row.tolist() for size in sizes for row in size), strict=True))
    poses = rigid_matrix(rotations, centers)
    return [Primitive(first.kind, tuple(rows[part]), poses[part]) for part, first in enumerate(primitives)]


@dataclass(frozen=True)
class _Refinement:
    """The problem of `refine_primitives`. Its state has one row per part: center (3), turn (3), logarithms of sizes."""

    solids: PrimitiveSet
    neighbors: Tensor
    nu: float
    points: Tensor
    owners: Tensor

    @property
    def width(self) -> int:
        return 6 + max(size.shape[-1] for size in self.solids.sizes)

    def solids_at(self, state: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        rows = state.view(len(self.solids), self.width)
        sizes = [
            size * (rows[self.solids.get_buffer(f"members_{kind}"), 6 : 6 + size.shape[-1]]).exp()
            for kind, size in zip(self.solids.kinds, self.solids.sizes, strict=True)
        ]
        return self.solids.rotations @ so3_exp(rows[:, 3:6]), self.solids.centers + rows[:, :3], sizes

    def retract(self, state: Tensor, step: Tensor) -> Tensor:
        """Return the state after a step whose moves and turns are in the solids' own frames."""
        rows, change = state.view(-1, self.width), step.view(-1, self.width)
        rotations = self.solids.rotations @ so3_exp(rows[:, 3:6])
        centers = rows[:, :3] + (rotations @ change[:, :3].unsqueeze(-1)).squeeze(-1)
        turns = compose_rotation_vectors(rows[:, 3:6], change[:, 3:6])
        return torch.cat([centers, turns, rows[:, 6:] + change[:, 6:]], dim=-1).view(1, -1)

    def linearize(self, state: Tensor) -> Linearization:
        rotations, centers, sizes = self.solids_at(state)
        local = ((self.points.unsqueeze(-2) - centers).unsqueeze(-2) @ rotations).squeeze(-2)
        distances, gradients = self.solids.distance_and_gradient(local, sizes)
        turning = -torch.linalg.cross(local, gradients)
        motions = torch.cat([-gradients, turning, self._size_gradients(local, sizes)], dim=-1)
        cost, gradient, hessian = self._pull(state, rotations)
        for residual, shares, weight in self._residuals(distances):
            scaled = (residual / (_REFINE_SCALE * self.nu)).square()
            trust = weight * cauchy_weight(scaled)
            jacobian = (motions * shares.unsqueeze(-1)).flatten(1)
            cost = cost + 0.5 * weight * (_REFINE_SCALE * self.nu) ** 2 * cauchy_loss(scaled).sum()
            gradient = gradient + jacobian.mT @ (trust * residual)
            hessian = hessian + jacobian.mT @ (trust.unsqueeze(-1) * jacobian)
        return Linearization(cost.view(1), gradient.view(1, -1), hessian.unsqueeze(0))

    def _residuals(self, distances: Tensor) -> list[tuple[Tensor, Tensor, float]]:
        """Return (residual (N,), shares of the solids (N, P), weight) of the three terms."""
        fused, shares = fuse(distances, self.neighbors, self.nu)
        owner = nn.functional.one_hot(self.owners, len(self.solids)).to(distances)
        dominating = nn.functional.one_hot(distances.argmin(-1), len(self.solids)).to(distances)
        owned, nearest = (distances * owner).sum(-1), distances.amin(-1)
        return [(fused, shares, 1.0), (owned, owner, _OWN_WEIGHT), (owned - nearest, owner - dominating, _RIVAL_WEIGHT)]

    def _size_gradients(self, local: Tensor, sizes: Sequence[Tensor]) -> Tensor:
        """Return (N, P, width - 6): derivatives of the distances by the logarithms of sizes, zero for exponents."""
        with torch.enable_grad():
            leaves = [size.expand(len(local), *size.shape).clone().requires_grad_() for size in sizes]
            found = torch.autograd.grad(self.solids(local, leaves).sum(), leaves)
        columns = [
            nn.functional.pad(
                gradient * size * self.solids.get_buffer(f"scalable_{kind}"), (0, self.width - 6 - size.shape[-1])
            )
            for kind, gradient, size in zip(self.solids.kinds, found, sizes, strict=True)
        ]
        return torch.cat(columns, dim=-2)[:, self.solids.kind_order]

    def _pull(self, state: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return cost, gradient and Hessian of the pull to the start."""
        rows = state.view(len(self.solids), self.width)
        back = (rows[:, None, :3] @ rotations).squeeze(-2)
        offset = torch.cat([back, rows[:, 3:]], dim=-1)
        reach = self.solids.reaches(list(self.solids.sizes)) / _BALL_FACTOR
        spread = torch.cat([reach.unsqueeze(-1).expand(-1, 3), torch.ones_like(rows[:, 3:])], dim=-1)
        stiffness = (_REFINE_STIFFNESS * self.nu / spread).square()
        return 0.5 * (stiffness * offset.square()).sum(), (stiffness * offset).flatten(), stiffness.flatten().diag()


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
