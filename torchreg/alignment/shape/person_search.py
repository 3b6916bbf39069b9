"""Global initialization of the pose and shape coefficients of a rig, and restarts of a single limb."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import CLUSTERS
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.search.limb_search import joint_samples
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates
from torchreg.alignment.search.rough_poses import (
    UniformRotations,
    UprightRotations,
    closeness,
    register_rigidly,
    two_sided_cost,
    typical_poses,
)
from torchreg.alignment.shape.shape_problem import ShapeProblem
from torchreg.geometry.rotation import compose_rotation_vectors, so3_log, spread_rotations
from torchreg.geometry.sampling import farthest_points
from torchreg.geometry.upright import Direction
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.limbs import Body, bodies_below, find_bodies, find_limbs
from torchreg.shapes.pose_algebra import BASE_DOFS, shifted


@dataclass(frozen=True)
class _PersonSearch:
    """Numbers of the search."""

    same: float = 0.06  # as a share of the size: candidates whose points differ by less are duplicates
    duplicate_limb_rms: float = 0.03  # the same, of states that differ in one limb only
    turn: float = math.pi / 6  # by which people are turned anew: as far as the rotations of the search are apart
    most_swung: float = 0.5  # of the surface: a limb that is more is not swung, as the rest would be
    num_data: int = 500


_SEARCH = _PersonSearch()


def find_people(
    problem: AlignProblem,
    rig: Articulation,
    people: Tensor,
    count: int,
    generator: torch.Generator,
    upright: Direction | None = None,
) -> Tensor:
    """Return states (count, D + K) from a global search of pose and coefficients in a scan, best first.

    Coefficients (S, K) in evenly spread or upright rotations are registered rigidly, and ranked by unexplained data and
    surface.
    """
    turns = spread_rotations(UniformRotations.count) if upright is None else UprightRotations(upright).rotations(rig.up)
    rotations = so3_log(turns).to(people)
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
    return Candidates.ranked(problem, registered, costs).distinct(_SEARCH.same, count).poses[0]


def limb_restarts(problem: ShapeProblem, state: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return a state (D + K,) with one limb re-initialized over its joints' ranges, (count, D + K), best first."""
    rig, mean, size = problem.skin.shape.rig, problem.prior.mean[0], problem.size
    bodies, drawn = find_bodies(rig), problem.draw(_SEARCH.num_data, generator)
    num_points = min(SEARCH_BUDGET.num_coarse_data, len(problem.skin))
    skin = problem.skin.subset(farthest_points(problem.skin.points, num_points))
    owner, points = skin.weights.argmax(-1), skin(state)[None, None]
    swung, costs = [], []
    for limb in find_limbs(rig)[0]:
        below = bodies_below(rig, bodies, limb.bodies[0])
        moves = torch.isin(owner, owner.new_tensor([part for body in below for part in body.parts]))
        if not limb.dofs or not CLUSTERS.share < float(moves.double().mean()) < _SEARCH.most_swung:
            continue
        reset = _with_joints(state, below, mean)
        states = [reset.unsqueeze(0)]
        for body in limb.bodies:
            samples = joint_samples(rig, body)
            for rest in (reset, _with_joints(state, bodies_below(rig, below, body), mean)):
                states.append(rest.repeat(len(samples), 1))
                states[-1][:, list(body.dofs)] = samples
        swung.append(problem.clamp_candidates(torch.cat(states).unsqueeze(0)))
        # The rest is where it was.
        rest_data, rest_points = closeness(points[..., ~moves, :], drawn, size)
        data, moved = closeness(skin.subset(moves.nonzero()[:, 0])(swung[-1]), drawn, size)
        near = torch.cat([rest_points.expand(1, moved.shape[1], -1), moved], dim=-1)
        costs.append(two_sided_cost(torch.maximum(data, rest_data), near, drawn))
    if not swung:
        return state[None][:0]
    # Those who hardly differ from the given one, the first, are duplicates of it.
    pool = torch.cat([state[None, None], *swung], dim=1)
    ranked = Candidates.ranked(problem, pool, torch.cat([torch.full((1, 1), -torch.inf).to(state), *costs], dim=1))
    return ranked.distinct(_SEARCH.duplicate_limb_rms, 1 + count).poses[0, 1:]


def _with_joints(state: Tensor, bodies: Sequence[Body], values: Tensor) -> Tensor:
    """Return a state (D + K,) with the joints of some bodies at other values (D + K,)."""
    dofs, moved = [dof for body in bodies for dof in body.dofs], state.clone()
    moved[dofs] = values[dofs]
    return moved


def rotation_restarts(problem: ShapeProblem, state: Tensor) -> Tensor:
    """Return a state (D + K,) rotated to both sides about each axis, joints at the prior's mean, (6, D + K)."""
    num_dofs = problem.skin.shape.rig.num_dofs
    axes = torch.eye(3).to(state)
    turned = state.repeat(6, 1)
    turned[:, BASE_DOFS:num_dofs] = problem.prior.mean[:1, BASE_DOFS:num_dofs]
    middle = problem.skin(state.unsqueeze(0)).mean(-2)
    turned[:, 3:BASE_DOFS] = compose_rotation_vectors(_SEARCH.turn * torch.cat([axes, -axes]), turned[:, 3:BASE_DOFS])
    return shifted(turned, middle - problem.skin(turned).mean(-2))
