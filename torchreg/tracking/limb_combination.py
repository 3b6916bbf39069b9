"""Limbs whose motion no prediction tells: the surface fitted from many starts at once, and the best of each limb."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.fit.annealed_em import narrowing
from torchreg.alignment.fit.problem import PRIOR_SHARE, AlignProblem
from torchreg.alignment.fit.surface_fit import surface_steps
from torchreg.alignment.search.multi_start import SEARCH_BUDGET
from torchreg.shapes.limbs import Limb
from torchreg.shapes.primitives import fuse
from torchreg.solvers.cover import best_covers
from torchreg.solvers.robust import welsch_loss
from torchreg.tracking.frame import WIDTHS


@dataclass(frozen=True)
class FastMotion:
    """Numbers of the fit of fast limbs. Lengths are shares of the model's size."""

    paces: tuple[float, ...] = (-1.0, 0.0, 0.5, 1.5, 2.0, 3.0)  # starts in velocities: joints turn back or speed up
    num_scattered: int = 2  # starts with the joints drawn at random
    score_width: float = 0.012  # kernel of the comparison: a limb on its neighbor's data misses its own by little
    beam: int = 32  # combinations kept from limb to limb


FAST_MOTION = FastMotion()


def scatter_joints(pose: Tensor, std: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return ``count`` poses (count, num_dofs) with joints drawn about a pose (1, num_dofs), of std (num_dofs - 6,)."""
    offsets = torch.randn(count, len(std), generator=generator, dtype=torch.float32).to(pose) * std
    return torch.cat([pose[:, :6].expand(count, -1), pose[:, 6:] + offsets], dim=-1)


def fit_limbs(problem: AlignProblem, starts: Tensor, limbs: Sequence[Limb], generator: torch.Generator) -> Tensor:
    """Return the pose (1, num_dofs) that explains most data, each limb fitted from the best of starts (S, num_dofs)."""
    rows = torch.zeros(len(starts), dtype=torch.long, device=starts.device)
    batch = problem.draw(SEARCH_BUDGET.num_coarse_data, generator).rows(rows)
    noise = torch.full_like(starts[:, 0], SEARCH_BUDGET.noise * problem.size)
    for share in narrowing(WIDTHS.coarse, WIDTHS.stop):
        solved = surface_steps(batch, starts, torch.full_like(noise, share * problem.size), noise, 1)
        starts = solved.state
    # A limb without data stays at its prediction.
    poses = torch.cat([starts, problem.prior.mean])
    return combine_limbs(problem, poses, int(solved.cost.argmin()), [limb for limb in limbs if limb.dofs])


def combine_limbs(problem: AlignProblem, poses: Tensor, best: int, limbs: Sequence[Limb]) -> Tensor:
    """Return one of the poses (S, num_dofs), as (1, num_dofs), with each limb as in the pose that suits it best.

    Limbs are chosen jointly, so that no two explain the same data. The base is that of the pose with index ``best``.
    """
    if not limbs:
        return poses[best : best + 1]
    shape = problem.skin.shape
    options = torch.cat([poses[best : best + 1, :6].expand(len(poses), -1), poses[:, 6:]], dim=-1)
    distances = shape.placed_distances(problem.data, shape.part_transforms(options))
    width = FAST_MOTION.score_width * problem.size
    dof_costs = PRIOR_SHARE * 0.5 * problem.prior.precision * (options - problem.prior.mean).square()
    limb_losses, limb_costs = [], []
    for limb in limbs:
        neighbors = shape.adjacency[limb.parts][:, limb.parts]
        limb_distances = fuse(distances[:, limb.parts].mT, neighbors, shape.fusion_length())[0]
        limb_losses.append(welsch_loss((limb_distances / width).square())[None])
        limb_costs.append(dof_costs[:, limb.dofs].sum(-1)[None])
    moved = {part for limb in limbs for part in limb.parts}
    trunk = [part for part in range(shape.num_parts) if part not in moved]
    trunk_loss = torch.ones_like(distances[0, 0])
    if trunk:
        trunk_loss = welsch_loss((distances[best, trunk].amin(0) / width).square())
    index, _ = best_covers(trunk_loss[None], limb_losses, limb_costs, count=1, beam=FAST_MOTION.beam, num_exchanged=0)
    pose = options[best : best + 1].clone()
    for limb, option in zip(limbs, index[0, 0].tolist(), strict=True):
        pose[0, limb.dofs] = options[option, limb.dofs]
    return pose
