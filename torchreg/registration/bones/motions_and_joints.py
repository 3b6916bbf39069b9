"""Fitting the motions of all bones in all frames together with the joints between them: the T-step with free joints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import skew
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.joints import REGULARIZATION
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.registration.bones.motions import T_STEP, add_inertia, least_damping, nearest_rigid
from torchreg.solvers.damped_descent import DampingRule, Trial, damped_descent

# Any decrease shows that the model holds.
_RULE = DampingRule(trusted=0.0, down=0.25, doubtful=0.25, up=4.0, least=0.0)


@dataclass(frozen=True)
class JointFit:
    """Motions (F, B, 4, 4), joints (P, 3) that hold in all frames, where motions start from, and energies (F,)."""

    transforms: Tensor
    centers: Tensor
    energy: Tensor


@torch.no_grad()
def fit_bones_and_joints(
    problem: BoneProblem,
    transforms: Tensor,
    centers: Tensor,
    *,
    regularization: float = REGULARIZATION.fitted,
    max_steps: int = 5,
    rtol: float = T_STEP.rtol,
) -> JointFit:
    """Return the motions of all frames and the centers (P, 3) of the joints that have the least energy together.

    ``sum_f E(T_f, c) + F beta lambda sum_p |c_p - m_p|^2``, m the centers of the moments. Alternating with
    `find_joints` instead is biased and moves stiff joints by very little, as motions adapt to wrong centers. Motions
    are eliminated frame by frame: F systems of 6 B unknowns and one of 3 P (eq. 5; Triggs et al. 2000, section 6.1).
    """

    def linearize(state: _State) -> _JointSystem:
        return _linearized(problem, state, regularization)

    def solve(state: _State, system: _JointSystem, damping: Tensor) -> Trial[_State]:
        return _step(problem, state, system, damping)

    def settled(trial: Trial[_State], before: Tensor, after: Tensor) -> Tensor:
        return (before - after).abs() <= rtol * before

    found = damped_descent(
        linearize,
        solve,
        _State(problem.batched(transforms), centers),
        transforms.new_tensor(T_STEP.damping),
        rule=replace(_RULE, least=least_damping(problem)),
        max_steps=max_steps,
        converged=settled,
    )
    transforms, centers = found.state
    return JointFit(nearest_rigid(transforms), centers, 2 * found.system.costs)


class _State(NamedTuple):
    """The unknowns: motions (F, B, 4, 4) and centers of joints (P, 3)."""

    transforms: Tensor
    centers: Tensor


class _JointSystem(NamedTuple):
    """Half the energy around twists of the motions (F, 6 B) and centers (P, 3), whose Hessians are block-diagonal."""

    costs: Tensor  # (F,) half the problem's energy
    cost: Tensor  # () of all frames, and of the centers
    gradient: Tensor
    hessian: Tensor
    center_gradient: Tensor
    center_hessian: Tensor
    mixed: Tensor  # (F, 6 B, 3 P), the Hessian between both


def _linearized(problem: BoneProblem, state: _State, regularization: float) -> _JointSystem:
    transforms, centers = state
    motions, joints = problem.linearize(transforms, centers), _joint_residuals(problem, transforms, centers)
    frames, size, count = len(transforms), transforms.shape[1], len(centers)
    mixed = transforms.new_zeros(frames, size, count, 6, 3)
    joint = torch.arange(count, device=transforms.device)
    for bone, by_twist in zip(problem.moments.pairs.unbind(-1), joints.by_twist, strict=True):
        mixed[:, bone, joint] += by_twist.mT @ joints.by_center
    strength = frames * problem.joint_weight * regularization
    shifts = centers - problem.moments.center
    identity = torch.eye(3, dtype=transforms.dtype, device=transforms.device)
    return _JointSystem(
        costs=motions.cost,
        cost=motions.cost.sum() + 0.5 * strength * shifts.square().sum(),
        gradient=motions.gradient,
        hessian=motions.hessian,
        center_gradient=(joints.by_center.mT @ joints.residual.unsqueeze(-1)).squeeze(-1).sum(0) + strength * shifts,
        center_hessian=(joints.by_center.mT @ joints.by_center).sum(0) + strength * identity,
        mixed=mixed.permute(0, 1, 3, 2, 4).reshape(frames, 6 * size, 3 * count),
    )


class _JointResiduals(NamedTuple):
    """Weighted offsets (F, P, 3) between the images of joints under their two bones' motions, and their derivatives."""

    residual: Tensor
    by_center: Tensor
    by_twist: tuple[Tensor, Tensor]


def _joint_residuals(problem: BoneProblem, transforms: Tensor, centers: Tensor) -> _JointResiduals:
    first, second = problem.moments.pairs.unbind(-1)
    weights = torch.ones_like(centers[:, 0]) if problem.pair_weights is None else problem.pair_weights
    root = (problem.joint_weight * weights).sqrt().unsqueeze(-1)
    middles = problem.centers(transforms)
    identity = torch.eye(3, dtype=centers.dtype, device=centers.device)
    images, jacobians = [], []
    for bone, sign in ((first, 1.0), (second, -1.0)):
        image = transform_points(transforms[:, bone], centers.unsqueeze(-2)).squeeze(-2)
        by_twist = torch.cat([identity.expand(*image.shape, 3), -skew(image - middles[:, bone])], dim=-1)
        images.append(image)
        jacobians.append(sign * root.unsqueeze(-1) * by_twist)
    turns = (transforms[:, first] - transforms[:, second])[..., :3, :3]
    return _JointResiduals(root * (images[0] - images[1]), root.unsqueeze(-1) * turns, (jacobians[0], jacobians[1]))


def _step(problem: BoneProblem, state: _State, system: _JointSystem, damping: Tensor) -> Trial[_State]:
    """Return a Gauss-Newton step of twists (F, B, 6) and centers, damped as in `fit_bones`."""
    transforms, centers = state
    size, count = transforms.shape[1], len(centers)
    factor, info = torch.linalg.cholesky_ex(add_inertia(problem, transforms, system.hessian, damping))
    sound = ~info.any()
    if not sound:  # rounding has left a system without a Cholesky factor
        return Trial(state, transforms.new_zeros(len(transforms), size, 6), torch.zeros_like(damping), sound)
    solved = torch.cholesky_solve(torch.cat([system.mixed, system.gradient.unsqueeze(-1)], dim=-1), factor)
    by_center, at_centers = solved[..., :-1], solved[..., -1]
    # The Schur complement of the motions, for the centers.
    reduced = torch.block_diag(*system.center_hessian) - (system.mixed.mT @ by_center).sum(0)
    right = system.center_gradient.flatten() - (system.mixed.mT @ at_centers.unsqueeze(-1)).sum(0).squeeze(-1)
    reduced.diagonal().mul_(1 + damping)
    shifts = -torch.linalg.solve(reduced, right)
    twists = (-at_centers - by_center @ shifts).unflatten(-1, (size, 6))
    moved = turn_about(transforms, twists, problem.centers(transforms))
    return Trial(_State(moved, centers + shifts.unflatten(0, (count, 3))), twists, torch.zeros_like(damping), sound)
