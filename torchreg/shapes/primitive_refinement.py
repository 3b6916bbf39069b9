"""Refining the solids of all parts together, so that their fused surface runs through given points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

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
        """Return cost, gradient and Gauss-Newton Hessian at a state (1, D).

        A point's residuals depend on the solids that fuse where it is and on its own, a few of many: points with the
        same nearest solid are taken together, and only their solids' columns.
        """
        rotations, centers, sizes = self.solids_at(state)
        local = ((self.points.unsqueeze(-2) - centers).unsqueeze(-2) @ rotations).squeeze(-2)
        distances = self.solids(local, sizes)
        cost, gradient, hessian = self._prior(state, rotations)
        scale, rows, shares = _REFINEMENT.robust_scale * self.nu, list[Tensor](), list[Tensor]()
        for residual, weights, weight in self._residuals(distances):
            scaled = (residual / scale).square()
            cost = cost + 0.5 * weight * scale**2 * cauchy_loss(scaled).sum()
            root = (weight * cauchy_weight(scaled)).sqrt()
            rows.append(root * residual)
            shares.append(root.unsqueeze(-1) * weights)
        nearest = distances.argmin(-1)
        order, columns = nearest.argsort(), self._columns(nearest)
        points, parts = columns[nearest[order]].nonzero().unbind(-1)
        points = order[points]
        motions = self._motions(local[points, parts], parts, sizes)
        jacobians = motions.unsqueeze(-1) * torch.stack(shares, -1)[points, parts].unsqueeze(-2)
        residuals = torch.stack(rows, -1)[order]
        self._add_groups(jacobians, residuals, columns, nearest.bincount(minlength=len(columns)), gradient, hessian)
        return Linearization(cost.view(1), gradient.view(1, -1), hessian.unsqueeze(0))

    def _columns(self, nearest: Tensor) -> Tensor:
        """Return (P, P): the solids that residuals of points depend on, by the solid that is nearest to them."""
        columns = self.neighbors.bool().clone()
        columns[nearest, self.owners] = True
        return columns

    @staticmethod
    def _add_groups(
        jacobians: Tensor, residuals: Tensor, columns: Tensor, counts: Tensor, gradient: Tensor, hessian: Tensor
    ) -> None:
        """Add the terms of all points to the gradient (D,) and the Hessian (D, D).

        Args:
            jacobians: (M, width, 3) of the pairs of points and solids, those of one nearest solid after the other.
            residuals: (N, 3) in the same order.
            columns: (P, P) see `_columns`.
            counts: (P,) points by their nearest solid.
            gradient: changed in place.
            hessian: changed in place.
        """
        width, pair, point = jacobians.shape[1], 0, 0
        within = torch.arange(width)
        for part, count in enumerate(counts.tolist()):
            if not count:
                continue
            solids = columns[part].nonzero()
            rows = jacobians[pair : pair + count * len(solids)].reshape(count, -1, 3).permute(1, 0, 2).flatten(1)
            entries = (solids * width + within).flatten()
            gradient[entries] += rows @ residuals[point : point + count].flatten()
            hessian[entries[:, None], entries] += rows @ rows.mT
            pair, point = pair + count * len(solids), point + count

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

    def _motions(self, local: Tensor, parts: Tensor, sizes: Sequence[Tensor]) -> Tensor:
        """Return (M, width): derivatives of distances by the motion and the logarithms of sizes of their solids.

        Args:
            local: (M, 3) points, each in the frame of its solid.
            parts: (M,) numbers of the solids.
            sizes: of all solids, kind by kind.
        """
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

    def _prior(self, state: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return cost, gradient and Hessian of the prior at the start."""
        rows = state.view(len(self.solids), self.width)
        local = (rows[:, None, :3] @ rotations).squeeze(-2)
        offset = torch.cat([local, rows[:, 3:]], dim=-1)
        extent = self.solids.reaches(list(self.solids.sizes)) / BALL_FACTOR
        spread = torch.cat([extent.unsqueeze(-1).expand(-1, 3), torch.ones_like(rows[:, 3:])], dim=-1)
        stiffness = (_REFINEMENT.stiffness * self.nu / spread).square()
        return 0.5 * (stiffness * offset.square()).sum(), (stiffness * offset).flatten(), stiffness.flatten().diag()
