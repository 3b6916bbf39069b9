"""Integrals over a grid of products of interpolated weights: mass, center and spread of what two bones share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchreg.registration.bones.sparse_grid import SparseGrid


@dataclass(frozen=True)
class Negligible:
    """Amounts that count as nothing."""

    weight: float = 1e-9  # of a bone at a corner: rounding of normalized weights
    mass: float = 1e-6  # of a pair of bones, as a share of a cell's volume


NEGLIGIBLE = Negligible()


@dataclass(frozen=True)
class JointMoments:
    """The regions that P pairs of bones share, each as a mass with center and spread.

    ``tau_ij int w_i w_j |T_i x - T_j x|^2 dx = |T_i c - T_j c|^2 + tr(D S D^T)``, ``D = R_i - R_j``: eq. 4 in closed
    form, free of the cancellation of moments about a far origin.
    """

    pairs: Tensor  # (P, 2) int64 bones that share weight, the lower first, in order
    mass: Tensor  # (P,) ``m = int w_i w_j dx``, cubic units; tau is its inverse
    center: Tensor  # (P, 3) ``c = int w_i w_j x dx / m``
    spread: Tensor  # (P, 3, 3) ``S = int w_i w_j (x - c) (x - c)^T dx / m``, squared units

    @classmethod
    def none(cls) -> JointMoments:
        """Return the moments of no pair."""
        empty = torch.zeros(0)
        return cls(empty.long().reshape(0, 2), empty, empty.reshape(0, 3), empty.reshape(0, 3, 3))

    def select(self, kept: Tensor) -> JointMoments:
        """Return the pairs that a mask (P,) or indices choose."""
        return JointMoments(self.pairs[kept], self.mass[kept], self.center[kept], self.spread[kept])

    def to(self, *args: Any, **kwargs: Any) -> JointMoments:
        """Return the moments on another device or in another dtype; takes what ``Tensor.to`` takes."""
        mass = self.mass.to(*args, **kwargs)
        return JointMoments(self.pairs.to(mass.device), mass, self.center.to(mass), self.spread.to(mass))


def motion_differences(transforms: Tensor, pairs: Tensor) -> Tensor:
    """Return ``T_i - T_j`` (..., P, 3, 4) of motions (..., B, 4, 4) for pairs (P, 2) of bones."""
    first, second = pairs.unbind(-1)
    return transforms[..., first, :3, :] - transforms[..., second, :3, :]


def gaps_at(differences: Tensor, centers: Tensor) -> Tensor:
    """Return ``T_i c - T_j c`` (..., P, 3), of `motion_differences` (..., P, 3, 4) and centers (P, 3)."""
    return (differences[..., :3] @ centers.unsqueeze(-1)).squeeze(-1) + differences[..., 3]


def joint_moments(
    grid: SparseGrid, weights: Tensor, *, min_mass: float = NEGLIGIBLE.mass, pairs: Tensor | None = None
) -> JointMoments:
    """Return mass, center and spread of ``w_i w_j`` for the pairs of bones that share weight, exactly (eq. 4)."""
    size = weights.shape[1]
    with torch.no_grad():
        reached = (weights.detach().abs() > NEGLIGIBLE.weight)[grid.cell_corners].any(1)
        cell, first, second = _shared_cells(reached) if pairs is None else _cells_of_pairs(reached, pairs)
        # Pairs as numbers, and the position among them of each cell's pair.
        if pairs is None:
            number, which = (first * size + second).unique(return_inverse=True)
        else:
            number = pairs[:, 0] * size + pairs[:, 1]
            order = number.argsort()
            which = order[torch.searchsorted(number[order], first * size + second)]
    corners = grid.cell_corners[cell]
    products = weights[corners, first[:, None]].unsqueeze(-1) * weights[corners, second[:, None]].unsqueeze(-2)
    # Cell by cell: mass (1), first (3) and second (9) moments about the middle, in cells.
    local = products.flatten(1) @ torch.from_numpy(_cell_forms()).to(weights)
    middle = grid.cells[cell].to(weights) + 0.5
    sums = weights.new_zeros(len(number), 13).index_add(0, which, local)
    safe = sums[:, 0].clamp_min(torch.finfo(weights.dtype).tiny)
    first_moment = local[:, 1:4] + local[:, :1] * middle
    center = weights.new_zeros(len(number), 3).index_add(0, which, first_moment) / safe[:, None]
    offset = middle - center[which]
    cross = local[:, 1:4, None] * offset[:, None]
    central = local[:, 4:].unflatten(-1, (3, 3)) + cross + cross.mT
    central = central + local[:, 0, None, None] * offset[:, :, None] * offset[:, None]
    spread = weights.new_zeros(len(number), 3, 3).index_add(0, which, central) / safe[:, None, None]
    h, axes = grid.spacing, grid.axes.to(weights)
    found = JointMoments(
        pairs=torch.stack([number // size, number % size], dim=-1),
        mass=sums[:, 0] * h**3,
        center=grid.origin.to(weights) + (h * center) @ axes.mT,
        spread=h**2 * (axes @ spread @ axes.mT),
    )
    return found if pairs is not None else found.select(sums[:, 0].detach() >= min_mass)


def _shared_cells(reached: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return cell, first and second bone of every pair of bones that reach (C, B) the same cell."""
    shared = (reached.sum(-1) > 1).nonzero()[:, 0]
    # Only the pairs themselves are listed: cells times bones squared would be a thousand times as many.
    cell, bone = reached[shared].nonzero().unbind(-1)
    end = reached[shared].sum(-1).cumsum(0)
    entries = torch.arange(len(cell), device=cell.device)
    later = end[cell] - entries - 1
    first = entries.repeat_interleave(later)
    step = torch.arange(len(first), device=cell.device) - (later.cumsum(0) - later)[first]
    second = first + 1 + step
    return shared[cell[first]], bone[first], bone[second]


def _cells_of_pairs(reached: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return cell, first and second bone for every cell that either bone of a pair reaches."""
    pair, cell = (reached[:, pairs[:, 0]] | reached[:, pairs[:, 1]]).mT.nonzero().unbind(-1)
    return cell, pairs[pair, 0], pairs[pair, 1]


@cache
def _cell_forms() -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return (64, 13): the integrals of products of two corners' shape functions with 1, y_a and y_a y_b."""
    nodes, gauss = np.polynomial.legendre.leggauss(3)
    y, weight = nodes / 2, gauss / 2
    grid = np.stack(np.meshgrid(y, y, y, indexing="ij"), axis=-1).reshape(-1, 3)
    volume = np.einsum("a,b,c->abc", weight, weight, weight).reshape(-1)
    side = np.stack([0.5 - grid, 0.5 + grid], axis=-1)
    shapes = np.einsum("ga,gb,gc->gabc", side[:, 0], side[:, 1], side[:, 2]).reshape(-1, 8)
    powers = np.concatenate([np.ones((len(grid), 1)), grid, (grid[:, :, None] * grid[:, None]).reshape(-1, 9)], axis=1)
    return np.einsum("g,ga,gb,gm->abm", volume, shapes, shapes, powers).reshape(64, 13)
