"""Something that turned between two scans: starts in which all of the source is turned and laid on the target."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.rigid import rigid_matrix, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.registration.annealing import geometric_at
from torchreg.registration.dense.config import ChoiceConfig
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.problem import ScanAlignProblem
from torchreg.registration.dense.stages import embedded, mismatch
from torchreg.solvers.robust import welsch_weight

# Degrees by which the source is turned about each of 26 axes: what is between is near enough.
_ANGLES = (20.0, 40.0, 60.0)
# Samples that are laid on the target, samples that tell how well they lie there, and target samples looked at.
_NUM_LAID, _NUM_JUDGED, _NUM_TARGETS = 80, 150, 300
# Steps of laying, width of what pulls, first and last, and what normals count as that are one apart: lengths.
_STEPS, _WIDTHS, _NORMAL_SCALE = 4, (0.1, 0.02), 0.05
# Turns nearer to each other than this many degrees are one; one must save this much energy over none at all.
_APART, _LEAST_GAIN = 12.0, 0.1


def turned_motions(problem: ScanAlignProblem, config: ChoiceConfig, count: int) -> Tensor:
    """Return turns of all of the source by which it lies clearly better on the target than by a shift alone.

    A torso or a dress that turned away shows new sides, onto which nearest matches spread the old ones. Turns are tried
    all around, about axes that lie in the source as its principal axes do, and only shifts are solved for: free to
    turn, most would turn back. What then lies well where the camera would have seen it is a start; limbs do not follow.

    Args:
        problem: the scans.
        config: the energy by which hypotheses are compared; rigid motions do not bend or strain.
        count: motions wanted.

    Returns:
        (K, 4, 4) rigid motions, the best first, K at most ``count``; none where a shift does as well.

    Cost: 60 ms.
    """
    few = replace(problem, target=problem.target.first(_NUM_TARGETS))
    motions = _laid(few, _turns(problem.graph.points))
    energies = _energies(few, motions, config)
    # The first is not turned.
    better = energies < energies[0] - _LEAST_GAIN
    kept: list[int] = []
    for number in energies.argsort(stable=True)[: int(better.sum())].tolist():
        if len(kept) < count and all(_degrees(motions[number], motions[other]) > _APART for other in kept):
            kept.append(number)
    return motions[kept]


def _turns(points: Tensor) -> Tensor:
    """Return rotations (C, 3, 3), the identity first, that turn with points (S, 3)."""
    steps = torch.tensor([-1.0, 0.0, 1.0]).to(points)
    axes = torch.cartesian_prod(steps, steps, steps)
    axes = torch.nn.functional.normalize(axes[axes.any(1)], dim=-1)
    angles = torch.tensor([math.radians(angle) for angle in _ANGLES]).to(points)
    turns = so3_exp((angles[:, None, None] * axes).flatten(0, 1))
    away = points - points.mean(0)
    frame = torch.linalg.eigh(away.mT @ away).eigenvectors
    return torch.cat((torch.eye(3).to(points).unsqueeze(0), frame @ turns @ frame.mT))


def _laid(problem: ScanAlignProblem, turns: Tensor) -> Tensor:
    """Return motions (C, 4, 4) with given rotations that lay the source on the target."""
    source, target = problem.source.first(_NUM_LAID), problem.target
    places, normals = source.points @ turns.mT, _NORMAL_SCALE * source.normals @ turns.mT
    tree = NeighborTree(torch.cat((target.points, _NORMAL_SCALE * target.normals), dim=1))
    shifts = target.points.mean(0) - places.mean(1)
    for step in range(_STEPS):
        width = geometric_at(_WIDTHS, step / (_STEPS - 1))
        moved = places + shifts.unsqueeze(1)
        index, apart = tree.nearest(torch.cat((moved, normals), dim=-1).flatten(0, 1))
        # Limbs went elsewhere: what is far off pulls hardly.
        pull = welsch_weight(0.5 * (apart / width).square()).view(*moved.shape[:2], 1)
        pull = pull + torch.finfo(torch.float32).tiny
        pulls = pull * (target.points[index].view_as(moved) - moved)
        shifts = shifts + pulls.sum(1) / pull.sum(1)
    return rigid_matrix(turns, shifts)


def _energies(problem: ScanAlignProblem, motions: Tensor, config: ChoiceConfig) -> Tensor:
    """Return the energies (C,) of rigid motions (C, 4, 4)."""
    source, count = problem.source.first(_NUM_JUDGED), len(motions)
    points = transform_points(motions, source.points.expand(count, -1, -1))
    normals = source.normals @ motions[:, :3, :3].mT
    same = (value.repeat(count, *[1] * (value.dim() - 1)) for value in (source.features, source.boundary))
    moved = OrientedSamples(points.flatten(0, 1), normals.flatten(0, 1), *same)
    own = torch.stack(mismatch(problem, moved, config)).sum(0).view(count, -1).mean(1)
    here, there = embedded(moved, config).view(count, -1, 6), embedded(problem.target, config)
    bare = torch.cdist(there.expand(count, -1, -1), here).amin(-1) / config.cap
    return own + bare.clamp(max=1).square().mean(1)


def _degrees(one: Tensor, other: Tensor) -> float:
    """Return the angle between the rotations of two motions (4, 4)."""
    cosine = float(((one[:3, :3] * other[:3, :3]).sum() - 1) / 2)
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
