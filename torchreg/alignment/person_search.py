"""Where a person of unknown size may stand: rough places and sizes of a rig with coefficients, without a start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.limb_search import distinct_first, take_rows
from torchreg.alignment.pose_search import mean_distances
from torchreg.alignment.problem import AlignProblem
from torchreg.alignment.rough_poses import register_rigidly, spread_rotations, typical_poses
from torchreg.geometry.rotation import compose_rotation_vectors, so3_log
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import BASE_DOFS, shifted


@dataclass(frozen=True)
class _PersonSearch:
    """Numbers of the search."""

    num_rotations: int = 200  # of each size: 30 degrees apart, which the rigid EM bridges
    num_compared: int = 400  # best candidates, among which different ones are sought
    same: float = 0.06  # as a share of the size: candidates whose points differ by less are duplicates
    other: float = 0.05  # the same, of fitted people: what differs by more is a rival
    turn: float = math.pi / 6  # by which people are turned anew: as far as the rotations of the search are apart


_SEARCH = _PersonSearch()


def find_people(
    problem: AlignProblem, rig: Articulation, people: Tensor, count: int, generator: torch.Generator
) -> Tensor:
    """Return states (count, D + K) of people that may be what a scan shows, the likeliest first.

    People of all sizes, in evenly spread rotations, are registered rigidly to the scan, and ranked by the data far from
    them and by how much of them is far from the data.

    Args:
        problem: of one scan.
        rig: whose degrees of freedom a state begins with.
        people: (S, K) coefficients.
        count: of states, at most.
        generator: of what is drawn.
    """
    rotations = so3_log(spread_rotations(_SEARCH.num_rotations)).to(people)
    joints = typical_poses(rig)
    grid = (len(people), len(joints), len(rotations))
    states = people.new_zeros(*grid, rig.num_dofs + people.shape[-1])
    states[..., : rig.num_dofs] = joints.unsqueeze(1)
    states[..., 3:6] = rotations
    states[..., rig.num_dofs :] = people[:, None, None]
    median = problem.data[0][problem.valid[0]].median(0).values
    # One size after another: the points of all at once would take much memory.
    states[..., :3] += median - torch.stack([problem.skin(rows).mean(-2) for rows in states])
    states = problem.clamp_candidates(states.flatten(0, -2).unsqueeze(0))
    registered, costs = register_rigidly(problem, states, generator)
    best = take_rows(registered, costs.argsort(1)[:, : _SEARCH.num_compared])
    order = distinct_first(mean_distances(problem, best) < _SEARCH.same * problem.size)
    return take_rows(best, order[:, :count])[0]


def turned_people(problem: AlignProblem, state: Tensor, num_dofs: int) -> Tensor:
    """Return a person (D + K,) turned to both sides about each axis of space, joints as the prior has them, (6, D + K).

    A person that leans explains one leg by the other, whose own data are left; no step leads upright from there.

    Args:
        problem: of one scan.
        state: fitted; its size is kept.
        num_dofs: D, of the pose.
    """
    axes = torch.eye(3).to(state)
    turned = state.repeat(6, 1)
    turned[:, BASE_DOFS:num_dofs] = problem.prior.mean[:1, BASE_DOFS:num_dofs]
    middle = problem.skin(state.unsqueeze(0)).mean(-2)
    turned[:, 3:BASE_DOFS] = compose_rotation_vectors(_SEARCH.turn * torch.cat([axes, -axes]), turned[:, 3:BASE_DOFS])
    return shifted(turned, middle - problem.skin(turned).mean(-2))


def lead_over_rivals(problem: AlignProblem, states: Tensor, costs: Tensor) -> Tensor:
    """Return the cost (1,) by which the best of different states (S, D + K) is worse than the best, or infinity.

    Args:
        problem: of one scan, in rows as the states.
        states: fitted.
        costs: (S,).
    """
    best = int(costs.argmin())
    apart = mean_distances(problem, states.unsqueeze(0))[0, best] > _SEARCH.other * problem.size
    return torch.where(apart, costs, math.inf).amin().unsqueeze(0) - costs[best]
