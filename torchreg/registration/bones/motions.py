"""Fitting the motions of all bones at once to matched points while joints hold: the T-step of scan registration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive, check_shape
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.solvers.damped_descent import DampingRule, Trial, damped_descent
from torchreg.solvers.levenberg_marquardt import Linearization, damped_step

# Nothing beside the pull of matches, of which a bone gets one part in B, but enough against rounding where none pulls.
FIRST_DAMPING = 1e-4
_RULE = DampingRule(trusted=0.5, down=0.25, doubtful=1.0, up=4.0, least=0.0)
# A change of the cost by this many units in the last place of what bones carry, squared, is rounding.
_ROUNDING = 10.0


@dataclass(frozen=True)
class BoneFit:
    """Motions that fit matches.

    Args:
        transforms: (..., B, 4, 4).
        energy: (...) at them.
        damping: (...) to continue with.
        num_steps: linear systems solved.
        converged: (...) whether the last step was within the tolerance.
    """

    transforms: Tensor
    energy: Tensor
    damping: Tensor
    num_steps: int
    converged: Tensor


@torch.no_grad()
def fit_bones(
    problem: BoneProblem,
    transforms: Tensor,
    *,
    fixed: Tensor | None = None,
    max_steps: int = 5,
    rtol: float = 1e-4,
    atol: float = 0.0,
    damping: float | Tensor = FIRST_DAMPING,
    retract: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> BoneFit:
    """Return the motions of least energy that damped Gauss-Newton steps find, each problem of a batch by itself.

    A step pays for the mean squared shift of what the bones carry, damping times: chains of bones move together as
    freely as one bone, which a damping of the diagonal would prevent where joints are stiff.

    Args:
        problem: the problem.
        transforms: (..., B, 4, 4) to start from.
        fixed: (B,) bool, bones to hold.
        max_steps: most linear systems.
        rtol: a problem is done when a step changes its energy by less than this share.
        atol: a problem is done when its energy is below the square of this length.
        damping: (...) to start with, as an earlier fit of the same kind returned; 1 for starts far off.
        retract: motions and twists (..., B, 6) about the bones' middles to motions; `turn_about` by default.

    Returns:
        a `BoneFit`.

    Raises:
        InputError: if a shape does not fit, or a tolerance is negative.

    Differentiable: no.

    References: Chang and Zwicker 2009, eq. 5; Marquardt 1963.
    """
    check_count(max_steps, "max_steps", 1)
    check_positive(rtol, "rtol", allow_zero=True)
    check_positive(atol, "atol", allow_zero=True)
    if fixed is not None:
        check_shape(fixed, "fixed", (problem.binding.num_bones,))
    transforms = problem.batched(transforms)
    current = problem.linearize(transforms)
    level = torch.as_tensor(damping, dtype=transforms.dtype, device=transforms.device).expand(current.cost.shape)
    floor = _rounding_floor(problem)

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
        rule=replace(_RULE, least=rounding_cover(problem)),
        max_steps=max_steps,
        converged=settled,
        done=2 * current.cost <= atol**2,
        start=current,
    )
    energy = 2 * found.system.cost
    return BoneFit(straightened(found.state), energy, found.damping, found.num_steps, found.done)


def rounding_cover(problem: BoneProblem) -> float:
    """Return the damping that makes up for rounding in the Hessian of a problem's 6 B twists."""
    return 24 * problem.binding.num_bones * torch.finfo(problem.points.dtype).eps


def _rounding_floor(problem: BoneProblem) -> float:
    """Return a change of the cost that is nothing but rounding."""
    size = problem.bodies.spread.diagonal(dim1=-2, dim2=-1).sum(-1).mean()
    return (_ROUNDING * torch.finfo(size.dtype).eps) ** 2 * float(size)


def add_inertia(problem: BoneProblem, transforms: Tensor, hessian: Tensor, level: Tensor) -> Tensor:
    """Return Hessians (..., 6 B, 6 B) damped by the mean squared shift of what the bones carry, level (...) times."""
    size = problem.binding.num_bones
    damped = hessian.clone()
    blocks = damped.unflatten(-1, (size, 6)).unflatten(-3, (size, 6)).diagonal(dim1=-4, dim2=-2)
    blocks += (level / size)[..., None, None, None] * problem.inertia(transforms).movedim(-3, -1)
    return damped


def _damped_twists(
    problem: BoneProblem, transforms: Tensor, current: Linearization, level: Tensor, fixed: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the twists (..., B, 6) of a damped Gauss-Newton step, and whether its system could be solved (...)."""
    size = problem.binding.num_bones
    hessian = add_inertia(problem, transforms, current.hessian, level)
    frozen = None
    if fixed is not None:
        frozen = fixed.to(hessian.device).repeat_interleave(6).expand(level.numel(), -1)
    flat = Linearization(
        current.cost.reshape(-1), current.gradient.reshape(-1, 6 * size), hessian.reshape(-1, 6 * size, 6 * size)
    )
    # What is left of the diagonal's damping repairs rounding alone.
    twists, sound = damped_step(flat, torch.full_like(flat.cost, rounding_cover(problem)), frozen=frozen)
    return twists.reshape(*transforms.shape[:-2], 6), sound.reshape(current.cost.shape)


def straightened(transforms: Tensor) -> Tensor:
    """Return motions with the nearest rotations, by one Newton step: products of many drift by rounding."""
    rotation = transforms[..., :3, :3]
    transforms = transforms.clone()
    transforms[..., :3, :3] = 1.5 * rotation - 0.5 * rotation @ rotation.mT @ rotation
    return transforms
