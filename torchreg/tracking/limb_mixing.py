"""Where limbs went that no prediction tells: the surface fitted from many starts at once, and the best of each limb."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg.alignment.problem import PRIOR_SHARE, AlignProblem
from torchreg.alignment.surface_fit import surface_steps
from torchreg.shapes.limbs import Limb
from torchreg.shapes.primitives import fuse
from torchreg.solvers.cover import best_covers
from torchreg.solvers.robust import welsch_loss

# Kernel widths of the fits from all starts, one step at each, as shares of the size; more data lead no better.
_WIDTHS, _NUM_DATA = (0.06, 0.04, 0.03, 0.02), 300
# Standard deviation of the data for the weight of the prior, as a share of the size.
_NOISE = 0.01
# A limb that lives on the data of its neighbor leaves few data of its own, and those not far away: this tells it.
_SCORE_WIDTH = 0.012
# Combinations kept from limb to limb.
_BEAM = 32


def scattered(pose: Tensor, std: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return ``count`` poses (count, num_dofs) whose joints are scattered about a pose (1, num_dofs).

    Args:
        pose: (1, num_dofs).
        std: (num_dofs - 6,) of the joints, radians or metres.
        count: of poses.
        generator: of the scatter.
    """
    offsets = torch.randn(count, len(std), generator=generator).to(pose) * std
    return torch.cat([pose[:, :6].expand(count, -1), pose[:, 6:] + offsets], dim=-1)


def fit_limbs(problem: AlignProblem, starts: Tensor, limbs: Sequence[Limb], generator: torch.Generator) -> Tensor:
    """Return the pose (1, num_dofs) that explains most data, each limb as one of the starts led it.

    Args:
        problem: one alignment.
        starts: (S, num_dofs) in its coordinates, within the limits.
        limbs: of the shape.
        generator: draws the data that the starts are fitted to.

    Cost: 15 ms for a hand and ten starts on one CPU core.
    """
    few = problem.draw(_NUM_DATA, generator).rows(torch.zeros(len(starts), dtype=torch.long, device=starts.device))
    noise = torch.full_like(starts[:, 0], _NOISE * problem.size)
    for share in _WIDTHS:
        solved = surface_steps(few, starts, torch.full_like(noise, share * problem.size), noise, 1)
        starts = solved.state
    # What no data show stays as it was expected.
    options = torch.cat([starts, problem.prior.mean])
    return mixed(problem, options, int(solved.cost.argmin()), [limb for limb in limbs if limb.dofs])


def mixed(problem: AlignProblem, poses: Tensor, best: int, limbs: Sequence[Limb]) -> Tensor:
    """Return one of some poses (S, num_dofs), as (1, num_dofs), with each limb as in that pose which suits best.

    Limbs are chosen together, so that no two explain the same data.

    Args:
        problem: one alignment.
        poses: in its coordinates.
        best: index of the pose whose base is kept.
        limbs: those with degrees of freedom.
    """
    if not limbs:
        return poses[best : best + 1]
    shape = problem.skin.shape
    options = torch.cat([poses[best : best + 1, :6].expand(len(poses), -1), poses[:, 6:]], dim=-1)
    distances = shape.placed_distances(problem.data, shape.part_transforms(options))
    width = _SCORE_WIDTH * problem.size
    costs = PRIOR_SHARE * 0.5 * problem.prior.precision * (options - problem.prior.mean).square()
    tables, prices = [], []
    for limb in limbs:
        neighbors = shape.adjacency[limb.parts][:, limb.parts]
        tables.append(_lost(fuse(distances[:, limb.parts].mT, neighbors, shape.nu)[0], width)[None])
        prices.append(costs[:, limb.dofs].sum(-1)[None])
    moved = {part for limb in limbs for part in limb.parts}
    trunk = [part for part in range(shape.num_parts) if part not in moved]
    left = _lost(distances[best, trunk].amin(0), width) if trunk else torch.ones_like(distances[0, 0])
    chosen = best_covers(left[None], tables, prices, count=1, beam=_BEAM, num_exchanged=0)[0][0, 0]
    pose = options[best : best + 1].clone()
    for limb, option in zip(limbs, chosen.tolist(), strict=True):
        pose[0, limb.dofs] = options[option, limb.dofs]
    return pose


def _lost(distance: Tensor, width: float) -> Tensor:
    """Return how far data are from being explained, from 0 to 1."""
    return welsch_loss((distance / width).square())
