"""Refining the solids of all parts together, so that their fused surface runs through given points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchreg.geometry.primitives import PRIMITIVE_KINDS
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import compose_rotation_vectors, so3_exp
from torchreg.shapes.primitives import BALL_FACTOR, Primitive, PrimitiveSet, fuse
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt
from torchreg.solvers.robust import cauchy_loss, cauchy_weight


@dataclass(frozen=True)
class _RefinementSettings:
    """Weights of the refinement."""

    # Robust scale of the residuals, in fusion lengths.
    robust_scale: float = 1.5
    # Weight of the distance to the solid that owns a point, relative to that of the fused distance.
    owner_weight: float = 0.3
    # Weight of the excess of that distance over the one to the nearest solid.
    excess_weight: float = 0.3
    # Residual, in fusion lengths, that costs as much as a change by the solid's own size.
    stiffness: float = 2.0
    # Share in the gradient of the fused distance below which a solid does not count at a point.
    least_share: float = 1e-9
    # Damped least-squares steps, and the step at which they end: metres, radians and logarithms of sizes.
    max_steps: int = 30
    atol: float = 1e-5


_REFINEMENT = _RefinementSettings()


def refine_primitives(
    primitives: Sequence[Primitive],
    neighbors: Tensor,
    nu: float,
    points: Tensor,
    owners: Tensor,
    max_steps: int = _REFINEMENT.max_steps,
) -> list[Primitive]:
    """Return solids moved, turned and resized so that their fused surface runs through points (N, 3) on the surface.

    Damped least squares over all solids at once (Marquardt 1963): the fused distance of every point, with less weight
    the distance to its own solid and its excess over that to the nearest one, and a weak prior at the start.
    """
    solids = PrimitiveSet(primitives).requires_grad_(False)
    problem = _RefinementProblem(solids, neighbors, nu, points.double(), owners)
    start = zero = torch.zeros(1, len(primitives) * problem.width, dtype=torch.float64)
    lowest = torch.inf

    def linearize(state: Tensor) -> Linearization:
        nonlocal lowest
        fields = problem.fields_at(state)
        cost = problem.cost(fields)
        if float(cost) > lowest:  # rejected, whatever its derivatives
            return Linearization(cost.view(1), zero, zero.unsqueeze(-1).expand(-1, -1, zero.shape[-1]))
        lowest = float(cost)
        gradient, hessian = problem.derivatives(fields)
        return Linearization(cost.view(1), gradient.view(1, -1), hessian.unsqueeze(0))

    found = levenberg_marquardt(linearize, start, retract=problem.retract, max_steps=max_steps, atol=_REFINEMENT.atol)
    rotations, centers, sizes = problem.solids_at(found.state)
    members = [int(part) for kind in solids.kinds for part in solids.get_buffer(f"members_{kind}")]
    rows = dict(zip(members, (row.tolist() for size in sizes for row in size), strict=True))
    poses = rigid_matrix(rotations, centers)
    return [Primitive(first.kind, tuple(rows[part]), poses[part]) for part, first in enumerate(primitives)]


@dataclass(frozen=True)
class _Fields:
    """The distances of all points in one state.

    ``residuals`` (N, 3): the fused distance, that to the own solid, and its excess over that to the nearest one;
    ``squared`` in robust scales. ``local`` (P, 3, N) in the frames of the solids, ``shares`` (N, P) of the fused one.
    """

    offset: Tensor
    sizes: list[Tensor]
    local: Tensor
    shares: Tensor
    nearest: Tensor
    residuals: Tensor
    squared: Tensor


@dataclass(frozen=True)
class _RefinementProblem:
    """The problem of `refine_primitives`; a state has a row per part: center (3), rotation (3), logarithms of sizes."""

    solids: PrimitiveSet
    neighbors: Tensor
    nu: float
    points: Tensor
    owners: Tensor

    @property
    def width(self) -> int:
        """Length of a row of the state."""
        return 6 + max(size.shape[-1] for size in self.solids.sizes)

    def solids_at(self, state: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return rotations (P, 3, 3), centers (P, 3) and sizes of the solids in a state."""
        rows = state.view(len(self.solids), self.width)
        sizes = [
            size * (rows[self.solids.get_buffer(f"members_{kind}"), 6 : 6 + size.shape[-1]]).exp()
            for kind, size in zip(self.solids.kinds, self.solids.sizes, strict=True)
        ]
        return self.solids.rotations @ so3_exp(rows[:, 3:6]), self.solids.centers + rows[:, :3], sizes

    def retract(self, state: Tensor, step: Tensor) -> Tensor:
        """Return the state after a step whose translations and rotations are in the solids' own frames."""
        rows, change = state.view(-1, self.width), step.view(-1, self.width)
        rotations = self.solids.rotations @ so3_exp(rows[:, 3:6])
        centers = rows[:, :3] + (rotations @ change[:, :3].unsqueeze(-1)).squeeze(-1)
        rotated = compose_rotation_vectors(rows[:, 3:6], change[:, 3:6])
        return torch.cat([centers, rotated, rows[:, 6:] + change[:, 6:]], dim=-1).view(1, -1)

    def fields_at(self, state: Tensor) -> _Fields:
        """Return the distances in a state (1, D)."""
        rotations, centers, sizes = self.solids_at(state)
        turned = (rotations.mT.flatten(0, 1) @ self.points.mT).unflatten(0, (-1, 3))
        local = turned - rotations.mT @ centers.unsqueeze(-1)
        x, y, z = local.unbind(1)
        distances = self.solids.plane_distance((x, y, z), sizes).mT
        fused, shares = fuse(distances, self.neighbors, self.nu)
        least, nearest = distances.min(-1)
        owned = distances.gather(-1, self.owners.unsqueeze(-1)).squeeze(-1)
        residuals = torch.stack([fused, owned, owned - least], dim=-1)
        rows = state.view(len(self.solids), self.width)
        offset = torch.cat([(rows[:, None, :3] @ rotations).squeeze(-2), rows[:, 3:]], dim=-1)
        return _Fields(offset, sizes, local, shares, nearest, residuals, (residuals / self._scale).square())

    @property
    def _scale(self) -> float:
        """The robust scale of the residuals, metres."""
        return _REFINEMENT.robust_scale * self.nu

    @cached_property
    def _weights(self) -> Tensor:
        """The weights (3,) of the residuals."""
        return torch.tensor([1.0, _REFINEMENT.owner_weight, _REFINEMENT.excess_weight], dtype=torch.float64)

    @cached_property
    def _stiffness(self) -> Tensor:
        """The stiffness (P, width) of the prior at the start."""
        extent = self.solids.reaches(list(self.solids.sizes)) / BALL_FACTOR
        by_size = self.nu / extent.unsqueeze(-1).expand(-1, 3)
        by_turn = torch.full((len(extent), self.width - 3), self.nu, dtype=torch.float64)
        return (_REFINEMENT.stiffness * torch.cat([by_size, by_turn], dim=-1)).square()

    def cost(self, fields: _Fields) -> Tensor:
        """Return the cost () of a state."""
        robust = self._scale**2 * (self._weights * cauchy_loss(fields.squared)).sum()
        return 0.5 * (robust + (self._stiffness * fields.offset.square()).sum())

    def derivatives(self, fields: _Fields) -> tuple[Tensor, Tensor]:
        """Return gradient (D,) and Gauss-Newton Hessian (D, D) at a state; points with the same solids go together."""
        gradient, hessian = (self._stiffness * fields.offset).flatten(), self._stiffness.flatten().diag()
        concerned = fields.shares > _REFINEMENT.least_share
        for always in (self.owners, fields.nearest):
            concerned.scatter_(-1, always.unsqueeze(-1), True)
        order, sets = _equal_rows(concerned)
        points, parts = concerned[order].nonzero().unbind(-1)
        points = order[points]
        is_own, is_nearest = ((parts == index[points]).double() for index in (self.owners, fields.nearest))
        roots = (self._weights * cauchy_weight(fields.squared)).sqrt()
        shares = torch.stack([fields.shares[points, parts], is_own, is_own - is_nearest], -1) * roots[points]
        motions = self._motions(fields.local[parts, :, points], parts, fields.sizes)
        jacobians = motions.unsqueeze(-1) * shares.unsqueeze(-2)
        _add_sets(jacobians, (roots * fields.residuals)[order], parts, sets, gradient, hessian)
        return gradient, hessian

    def _motions(self, local: Tensor, parts: Tensor, sizes: Sequence[Tensor]) -> Tensor:
        """Return derivatives (M, width) of distances of points (M, 3) by motion and log sizes of their solids (M,)."""
        found = torch.zeros(len(parts), self.width, dtype=torch.float64)
        for kind, size in zip(self.solids.kinds, sizes, strict=True):
            members = self.solids.get_buffer(f"members_{kind}")
            rows = torch.isin(parts, members).nonzero()[:, 0]
            own = size[torch.searchsorted(members, parts[rows])]
            points = local[rows]
            _, gradients = PRIMITIVE_KINDS[kind].gradient(points, own)
            found[rows, :3] = -gradients
            found[rows, 3:6] = -torch.linalg.cross(points, gradients)
            with torch.enable_grad():
                leaf = own.clone().requires_grad_()
                (by_size,) = torch.autograd.grad(PRIMITIVE_KINDS[kind].distance(points, leaf).sum(), leaf)
            # Exponents stay.
            found[rows, 6 : 6 + size.shape[-1]] = by_size * own * self.solids.get_buffer(f"scalable_{kind}")
        return found


def _equal_rows(rows: Tensor) -> tuple[Tensor, list[tuple[int, int]]]:
    """Return an order of boolean rows (N, P) in which equal ones follow each other: how many, and their sums."""
    weights = torch.rand(rows.shape[1], generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    # Equal sums of random weights are those of equal rows.
    keys, order = (rows.double() @ weights).sort()
    counts = keys.unique_consecutive(return_counts=True)[1]
    sums = rows[order[counts.cumsum(0) - 1]].sum(-1)
    return order, list(zip(counts.tolist(), sums.tolist(), strict=True))


def _add_sets(
    jacobians: Tensor,
    residuals: Tensor,
    parts: Tensor,
    sets: Sequence[tuple[int, int]],
    gradient: Tensor,
    hessian: Tensor,
) -> None:
    """Add the terms of all points to gradient and Hessian in place; sets are (points, solids of each) in a row."""
    width, pair, point = jacobians.shape[1], 0, 0
    entries = parts.unsqueeze(-1) * width + torch.arange(width)
    for count, solids in sets:
        end = pair + count * solids
        rows = jacobians[pair:end].view(count, -1, 3).transpose(0, 1).flatten(1)
        columns = entries[pair : pair + solids].flatten()
        gradient[columns] += rows @ residuals[point : point + count].flatten()
        hessian[columns[:, None], columns] += rows @ rows.mT
        pair, point = end, point + count
