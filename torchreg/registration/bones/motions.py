"""Fitting the motions of all bones at once to correspondences while joints hold: the T-step of scan registration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.registration.blend import turn_about
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.solvers.damped_descent import DampingRule, Trial, damped_descent
from torchreg.solvers.levenberg_marquardt import Linearization, damped_step

_RULE = DampingRule(trusted=0.5, down=0.25, doubtful=1.0, up=4.0, least=0.0)


@dataclass(frozen=True)
class TStep:
    """The numbers of a T-step."""

    # first weight of the mean squared displacement of the bodies: nothing against the residuals, of which a bone gets
    # one part in B, but enough against rounding where a bone has none
    damping: float = 1e-4
    rtol: float = 1e-3  # relative change of the energy below which a step is the last
    # units in the last place of the squared size of the bodies by which rounding alone changes the cost
    rounding: float = 10.0


T_STEP = TStep()


@dataclass(frozen=True)
class BoneFit:
    """Motions that fit correspondences."""

    transforms: Tensor  # (..., B, 4, 4)
    energy: Tensor  # (...) at them
    num_steps: int  # linear systems solved
    converged: Tensor  # (...) whether the last step was within the tolerance


@torch.no_grad()
def fit_bones(
    problem: BoneProblem,
    transforms: Tensor,
    *,
    fixed: Tensor | None = None,
    max_steps: int = 5,
    rtol: float = T_STEP.rtol,
    atol: float = 0.0,
    damping: float | Tensor = T_STEP.damping,
    retract: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> BoneFit:
    """Return the motions of least energy that damped Gauss-Newton steps find, each problem of a batch by itself.

    The damping weighs the mean squared displacement of the bones' bodies: chains of bones move together as freely as
    one bone, which a damping of the diagonal would prevent where joints are stiff.

    ``rtol``: relative change of a problem's energy below which a step is its last. ``atol``: a problem is done when its
    energy is below the square of this length. ``retract``: motions and twists (..., B, 6) about the bodies' centers to
    motions; `turn_about` by default (Chang and Zwicker 2009, eq. 5; Marquardt 1963).
    """
    transforms = problem.batched(transforms)
    current = problem.linearize(transforms)
    level = torch.as_tensor(damping, dtype=transforms.dtype, device=transforms.device).expand(current.cost.shape)
    floor = _rounding_of_cost(problem)

    def solve(transforms: Tensor, current: Linearization, level: Tensor) -> Trial[Tensor]:
        twists, sound = _damped_twists(problem, transforms, current, level, fixed)
        if retract is None:
            moved = turn_about(transforms, twists, problem.centers(transforms))
        else:
            moved = retract(transforms, twists)
        return Trial(moved, twists, -0.5 * (current.gradient * twists.flatten(-2)).sum(-1), sound)

    def settled(trial: Trial[Tensor], before: Tensor, after: Tensor) -> Tensor:
        return ((before - after).abs() <= rtol * before + floor) | (2 * after <= atol**2)

    found = damped_descent(
        problem.linearize,
        solve,
        transforms,
        level,
        rule=replace(_RULE, least=least_damping(problem)),
        max_steps=max_steps,
        converged=settled,
        done=2 * current.cost <= atol**2,
        start=current,
    )
    return BoneFit(nearest_rigid(found.state), 2 * found.system.cost, found.num_steps, found.done)


def least_damping(problem: BoneProblem) -> float:
    """Return the damping that makes up for rounding in the Hessian of a problem's 6 B twists."""
    return 24 * problem.binding.num_bones * torch.finfo(problem.points.dtype).eps


def _rounding_of_cost(problem: BoneProblem) -> float:
    """Return a change of the cost that is nothing but rounding."""
    size = problem.bodies.spread.diagonal(dim1=-2, dim2=-1).sum(-1).mean()
    return (T_STEP.rounding * torch.finfo(size.dtype).eps) ** 2 * float(size)


def add_inertia(problem: BoneProblem, transforms: Tensor, hessian: Tensor, damping: Tensor) -> Tensor:
    """Return Hessians (..., 6 B, 6 B) plus damping (...) times those of the bodies' mean squared displacement."""
    size = problem.binding.num_bones
    damped = hessian.clone()
    blocks = damped.unflatten(-1, (size, 6)).unflatten(-3, (size, 6)).diagonal(dim1=-4, dim2=-2)
    blocks += (damping / size)[..., None, None, None] * problem.inertia(transforms).movedim(-3, -1)
    return damped


def _damped_twists(
    problem: BoneProblem, transforms: Tensor, current: Linearization, damping: Tensor, fixed: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the twists (..., B, 6) of a damped Gauss-Newton step, and whether its system could be solved (...)."""
    size = problem.binding.num_bones
    hessian = add_inertia(problem, transforms, current.hessian, damping)
    frozen = None
    if fixed is not None:
        frozen = fixed.to(hessian.device).repeat_interleave(6).expand(damping.numel(), -1)
    flat = Linearization(
        current.cost.reshape(-1), current.gradient.reshape(-1, 6 * size), hessian.reshape(-1, 6 * size, 6 * size)
    )
    # Beside the inertia, a damping of the diagonal repairs rounding alone.
    twists, sound = damped_step(flat, torch.full_like(flat.cost, least_damping(problem)), frozen=frozen)
    return twists.reshape(*transforms.shape[:-2], 6), sound.reshape(current.cost.shape)


def nearest_rigid(transforms: Tensor) -> Tensor:
    """Return motions with the nearest rotations, by one Newton step: products of many drift by rounding."""
    rotation = transforms[..., :3, :3]
    transforms = transforms.clone()
    transforms[..., :3, :3] = 1.5 * rotation - 0.5 * rotation @ rotation.mT @ rotation
    return transforms
