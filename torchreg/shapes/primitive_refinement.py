"""Refining the solids of all parts together, so that their fused surface runs through given points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

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
    # Weight of the distance to the solid that owns a point, beside that of the fused distance.
    owner_weight: float = 0.3
    # Weight of the excess of that distance over the one to the nearest solid.
    excess_weight: float = 0.3
    # Residual, in fusion lengths, that costs as much as a change by the solid's own size.
    stiffness: float = 2.0
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
    """Return solids moved, turned and resized so that their fused surface runs through surface points.

    Damped least squares over all solids at once: the fused distance of every point, with less weight the distance to
    the solid that owns it and its excess over that to the nearest solid, and a weak prior at the start, which holds
    solids of which only a patch is seen. Residuals beyond the fusion length lose weight.

    Args:
        primitives: first guess, one per part, with poses in the points' coordinates.
        neighbors: (P, P) booleans, which solids fuse; True on the diagonal.
        nu: fusion length, metres.
        points: (N, 3) on the surface, metres.
        owners: (N,) part that each point belongs to.
        max_steps: damped least-squares steps.

    Returns:
        Solids, one per part, of the same kinds.

    References: Marquardt 1963.
    """
    solids = PrimitiveSet(primitives).requires_grad_(False)
    problem = _RefinementProblem(solids, neighbors, nu, points.double(), owners)
    start = torch.zeros(1, len(primitives) * problem.width, dtype=torch.float64)
    found = levenberg_marquardt(
        problem.linearize, start, retract=problem.retract, max_steps=max_steps, atol=_REFINEMENT.atol
    )
    rotations, centers, sizes = problem.solids_at(found.state)
    members = [int(part) for kind in solids.kinds for part in solids.get_buffer(f"members_{kind}")]
    rows = dict(zip(members, (row.tolist() for size in sizes for row in size), strict=True))
    poses = rigid_matrix(rotations, centers)
    return [Primitive(first.kind, tuple(rows[part]), poses[part]) for part, first in enumerate(primitives)]


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

    def linearize(self, state: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at a state (1, D)."""
        rotations, centers, sizes = self.solids_at(state)
        local = ((self.points.unsqueeze(-2) - centers).unsqueeze(-2) @ rotations).squeeze(-2)
        distances, gradients = self.solids.distance_and_gradient(local, sizes)
        moments = -torch.linalg.cross(local, gradients)
        motions = torch.cat([-gradients, moments, self._size_gradients(local, sizes)], dim=-1)
        cost, gradient, hessian = self._prior(state, rotations)
        scale = _REFINEMENT.robust_scale * self.nu
        for residual, shares, weight in self._residuals(distances):
            scaled = (residual / scale).square()
            weights = weight * cauchy_weight(scaled)
            jacobian = (motions * shares.unsqueeze(-1)).flatten(1)
            cost = cost + 0.5 * weight * scale**2 * cauchy_loss(scaled).sum()
            gradient = gradient + jacobian.mT @ (weights * residual)
            hessian = hessian + jacobian.mT @ (weights.unsqueeze(-1) * jacobian)
        return Linearization(cost.view(1), gradient.view(1, -1), hessian.unsqueeze(0))

    def _residuals(self, distances: Tensor) -> list[tuple[Tensor, Tensor, float]]:
        """Return the residuals (N,), the solids' weights (N, P) in them, and the weight of each of the three terms."""
        fused, shares = fuse(distances, self.neighbors, self.nu)
        owner = nn.functional.one_hot(self.owners, len(self.solids)).to(distances)
        dominating = nn.functional.one_hot(distances.argmin(-1), len(self.solids)).to(distances)
        owned, nearest = (distances * owner).sum(-1), distances.amin(-1)
        return [
            (fused, shares, 1.0),
            (owned, owner, _REFINEMENT.owner_weight),
            (owned - nearest, owner - dominating, _REFINEMENT.excess_weight),
        ]

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

    def _prior(self, state: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return cost, gradient and Hessian of the prior at the start."""
        rows = state.view(len(self.solids), self.width)
        local = (rows[:, None, :3] @ rotations).squeeze(-2)
        offset = torch.cat([local, rows[:, 3:]], dim=-1)
        extent = self.solids.reaches(list(self.solids.sizes)) / BALL_FACTOR
        spread = torch.cat([extent.unsqueeze(-1).expand(-1, 3), torch.ones_like(rows[:, 3:])], dim=-1)
        stiffness = (_REFINEMENT.stiffness * self.nu / spread).square()
        return 0.5 * (stiffness * offset.square()).sum(), (stiffness * offset).flatten(), stiffness.flatten().diag()
