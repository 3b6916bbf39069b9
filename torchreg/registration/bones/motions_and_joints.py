"""Fitting the motions of all bones in all frames together with the joints between them: the T-step with free joints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import skew
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.registration.bones.motions import FIRST_DAMPING, add_inertia, rounding_cover, straightened
from torchreg.solvers.damped_descent import DampingRule, Trial, damped_descent

# Bones meet at the surface that was scanned, joints lie inside: a firmer lambda draws them out, to a limb's radius off.
JOINT_REGULARIZATION = 1e-3
# Any decrease shows that the model holds.
_RULE = DampingRule(trusted=0.0, down=0.25, doubtful=0.25, up=4.0, least=0.0)


@dataclass(frozen=True)
class JointFit:
    """Motions that fit matches, and joints that hold in all of them.

    Args:
        transforms: (F, B, 4, 4).
        centers: (P, 3) of the joints, in the space that the motions start from.
        energy: (F,) of the problem at them.
        num_steps: linear systems solved.
        converged: whether the last step was within the tolerance.
    """

    transforms: Tensor
    centers: Tensor
    energy: Tensor
    num_steps: int
    converged: bool


@torch.no_grad()
def fit_bones_and_joints(
    problem: BoneProblem,
    transforms: Tensor,
    centers: Tensor | None = None,
    *,
    regularization: float = JOINT_REGULARIZATION,
    max_steps: int = 5,
    rtol: float = 1e-3,
) -> JointFit:
    """Return the motions of all frames and the centers of the joints that have the least energy together.

    ``sum_f E(T_f, c) + F beta lambda sum_p |c_p - m_p|^2``, with E that of the problem, its joints at c, and m the
    centers of its moments. Taking turns with `find_joints` instead moves stiff joints by very little in each turn:
    motions give way to wrong centers, which then look right. Motions are eliminated frame by frame, so that a step
    solves F systems of 6 B unknowns and one of 3 P.

    Args:
        problem: of F frames, with joints.
        transforms: (F, B, 4, 4) to start from.
        centers: (P, 3) to start from, m by default.
        regularization: lambda, see `find_joints`.
        max_steps: most linear systems.
        rtol: done when a step changes the energy by less than this share.

    Returns:
        a `JointFit`.

    Raises:
        InputError: if a shape does not fit, the problem has no joints, or a tolerance is out of range.

    Differentiable: no.

    Cost: 0.05 s a step for ten frames, 2,500 points and 14 bones on one core.

    References: Chang and Zwicker 2009, eq. 5, where centers are given; Triggs et al. 2000, section 6.1, for the
    elimination.
    """
    check_count(max_steps, "max_steps", 1)
    check_positive(rtol, "rtol", allow_zero=True)
    check_positive(regularization, "regularization")
    moments = _joints_of(problem)
    check_shape(problem.targets, "targets", ("F", len(problem.points), 3))
    check_shape(transforms, "transforms", ("F", problem.binding.num_bones, 4, 4))
    transforms = problem.batched(transforms)
    centers = moments.center if centers is None else centers
    check_shape(centers, "centers", (len(moments.pairs), 3))

    def linearize(place: _Place) -> _System:
        return _linearized(problem, place, regularization)

    def solve(place: _Place, system: _System, level: Tensor) -> Trial[_Place]:
        return _step(problem, place, system, level)

    def settled(trial: Trial[_Place], before: Tensor, after: Tensor) -> Tensor:
        return (before - after).abs() <= rtol * before

    found = damped_descent(
        linearize,
        solve,
        _Place(transforms, centers),
        transforms.new_tensor(FIRST_DAMPING),
        rule=replace(_RULE, least=rounding_cover(problem)),
        max_steps=max_steps,
        converged=settled,
    )
    energy = 2 * found.system.costs
    return JointFit(
        straightened(found.state.transforms), found.state.centers, energy, found.num_steps, bool(found.done)
    )


class _Place(NamedTuple):
    """The unknowns: motions (F, B, 4, 4) and centers of joints (P, 3)."""

    transforms: Tensor
    centers: Tensor


class _System(NamedTuple):
    """Half the energy around motions and centers.

    Args:
        costs: (F,) at them, half the problem's energy.
        cost: () of all frames, and of the centers.
        gradient: (F, 6 B) by the twists.
        hessian: (F, 6 B, 6 B).
        center_gradient: (P, 3).
        center_hessian: (P, 3, 3), of each center with itself.
        mixed: (F, 6 B, 3 P).
    """

    costs: Tensor
    cost: Tensor
    gradient: Tensor
    hessian: Tensor
    center_gradient: Tensor
    center_hessian: Tensor
    mixed: Tensor


def _linearized(problem: BoneProblem, place: _Place, regularization: float) -> _System:
    moments, (transforms, centers) = _joints_of(problem), place
    motions, joints = problem.linearize(transforms, centers), _joint_gaps(problem, transforms, centers)
    frames, size, count = len(transforms), transforms.shape[1], len(centers)
    mixed = transforms.new_zeros(frames, size, count, 6, 3)
    joint = torch.arange(count, device=transforms.device)
    for bone, by_twist in zip(moments.pairs.unbind(-1), joints.by_twist, strict=True):
        mixed[:, bone, joint] += by_twist.mT @ joints.by_center
    strength = frames * problem.joint_weight * regularization
    away = centers - moments.center
    identity = torch.eye(3, dtype=transforms.dtype, device=transforms.device)
    return _System(
        costs=motions.cost,
        cost=motions.cost.sum() + 0.5 * strength * away.square().sum(),
        gradient=motions.gradient,
        hessian=motions.hessian,
        center_gradient=(joints.by_center.mT @ joints.gap.unsqueeze(-1)).squeeze(-1).sum(0) + strength * away,
        center_hessian=(joints.by_center.mT @ joints.by_center).sum(0) + strength * identity,
        mixed=mixed.permute(0, 1, 3, 2, 4).reshape(frames, 6 * size, 3 * count),
    )


class _JointGaps(NamedTuple):
    """How far apart motions take joints, times the roots of what these count, and the derivatives.

    Args:
        gap: (F, P, 3).
        by_center: (F, P, 3, 3).
        by_twist: (F, P, 3, 6) by twists of the first bone of each pair, and of the second.
    """

    gap: Tensor
    by_center: Tensor
    by_twist: tuple[Tensor, Tensor]


def _joint_gaps(problem: BoneProblem, transforms: Tensor, centers: Tensor) -> _JointGaps:
    first, second = _joints_of(problem).pairs.unbind(-1)
    count = torch.ones_like(centers[:, 0]) if problem.pair_weights is None else problem.pair_weights
    root = (problem.joint_weight * count).sqrt().unsqueeze(-1)
    middles = problem.centers(transforms)
    identity = torch.eye(3, dtype=centers.dtype, device=centers.device)
    images, slopes = [], []
    for bone, sign in ((first, 1.0), (second, -1.0)):
        image = transform_points(transforms[:, bone], centers.unsqueeze(-2)).squeeze(-2)
        by_twist = torch.cat([identity.expand(*image.shape, 3), -skew(image - middles[:, bone])], dim=-1)
        images.append(image)
        slopes.append(sign * root.unsqueeze(-1) * by_twist)
    turns = (transforms[:, first] - transforms[:, second])[..., :3, :3]
    return _JointGaps(root * (images[0] - images[1]), root.unsqueeze(-1) * turns, (slopes[0], slopes[1]))


def _joints_of(problem: BoneProblem) -> JointMoments:
    """Return the joints of a problem; raise if there are none that count."""
    if problem.moments is None or not len(problem.moments.pairs) or problem.joint_weight == 0:
        raise InputError("the problem must have joints that count; see fit_bones for bones without")
    return problem.moments


def _step(problem: BoneProblem, place: _Place, system: _System, level: Tensor) -> Trial[_Place]:
    """Return a Gauss-Newton step of twists (F, B, 6) and centers, damped as in `fit_bones`."""
    transforms, centers = place
    size, count = transforms.shape[1], len(centers)
    factor, info = torch.linalg.cholesky_ex(add_inertia(problem, transforms, system.hessian, level))
    sound = ~info.any()
    if not sound:  # rounding has left a system without a Cholesky factor
        return Trial(place, transforms.new_zeros(len(transforms), size, 6), torch.zeros_like(level), sound)
    solved = torch.cholesky_solve(torch.cat([system.mixed, system.gradient.unsqueeze(-1)], dim=-1), factor)
    by_center, alone = solved[..., :-1], solved[..., -1]
    reduced = torch.block_diag(*system.center_hessian) - (system.mixed.mT @ by_center).sum(0)
    right = system.center_gradient.flatten() - (system.mixed.mT @ alone.unsqueeze(-1)).sum(0).squeeze(-1)
    reduced.diagonal().mul_(1 + level)
    shifts = -torch.linalg.solve(reduced, right)
    twists = (-alone - by_center @ shifts).unflatten(-1, (size, 6))
    moved = turn_about(transforms, twists, problem.centers(transforms))
    return Trial(_Place(moved, centers + shifts.unflatten(0, (count, 3))), twists, torch.zeros_like(level), sound)
