"""Fitting the motions of all bones at once to matched points while joints hold: the T-step of scan registration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive, check_shape
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.solvers.levenberg_marquardt import Linearization, damped_step

# Nothing beside the pull of matches, of which a bone gets one part in B, but enough against rounding where none pulls.
_DEFAULT_DAMPING = 1e-4
# By how much of what the model promised a step must lower the energy for the damping to fall.
_TRUSTED_SHARE = 0.5
_DAMPING_DOWN, _DAMPING_UP = 0.25, 4.0
_LARGEST_DAMPING = 1e7
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
def bone_step(
    problem: BoneProblem, transforms: Tensor, *, damping: float = _DEFAULT_DAMPING, fixed: Tensor | None = None
) -> Tensor:
    """Return the motions after one Gauss-Newton step, ``R <- exp(w) R`` about the bones' middles, untested.

    Args:
        problem: the problem.
        transforms: (..., B, 4, 4) to start from.
        damping: see `fit_bones`.
        fixed: (B,) bool, bones to hold.

    Returns:
        (..., B, 4, 4).

    Raises:
        InputError: if a shape does not fit or ``damping`` is not positive.

    Differentiable: no.

    Cost: 2 ms for 2,000 points and 40 bones with binary weights on one core, 3 ms where weights blend at the borders.

    References: Chang and Zwicker 2009, section 4.1.
    """
    check_positive(damping, "damping")
    transforms = problem.batched(transforms)
    current = problem.linearize(transforms)
    twists = _damped_twists(problem, transforms, current, torch.full_like(current.cost, damping), fixed)
    return straightened(turn_about(transforms, twists, problem.centers(transforms)))


@torch.no_grad()
def fit_bones(
    problem: BoneProblem,
    transforms: Tensor,
    *,
    fixed: Tensor | None = None,
    max_steps: int = 5,
    rtol: float = 1e-4,
    atol: float = 0.0,
    damping: float | Tensor = _DEFAULT_DAMPING,
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
    transforms = problem.batched(transforms)
    current = problem.linearize(transforms)
    least = 24 * transforms.shape[-3] * torch.finfo(transforms.dtype).eps
    level = torch.as_tensor(damping, dtype=transforms.dtype, device=transforms.device).expand(current.cost.shape)
    floor = _rounding_floor(problem)
    done = 2 * current.cost <= atol**2
    steps = 0
    while steps < max_steps and not bool(done.all()):
        steps += 1
        twists = _damped_twists(problem, transforms, current, level, fixed)
        if retract is None:
            trial_transforms = turn_about(transforms, twists, problem.centers(transforms))
        else:
            trial_transforms = retract(transforms, twists)
        trial = problem.linearize(trial_transforms)
        decrease = current.cost - trial.cost
        better = (decrease >= 0) & ~done
        small = (decrease.abs() <= rtol * current.cost + floor) | (2 * trial.cost <= atol**2)
        promised = -0.5 * (current.gradient * twists.flatten(-2)).sum(-1)
        level = torch.where(decrease > _TRUSTED_SHARE * promised, level * _DAMPING_DOWN, level)
        level = torch.where(decrease >= 0, level, level * _DAMPING_UP).clamp(least, _LARGEST_DAMPING)
        transforms = torch.where(better[..., None, None, None], trial_transforms, transforms)
        current = Linearization(
            torch.where(better, trial.cost, current.cost),
            torch.where(better[..., None], trial.gradient, current.gradient),
            torch.where(better[..., None, None], trial.hessian, current.hessian),
        )
        done = done | small
    return BoneFit(straightened(transforms), 2 * current.cost, level, steps, done)


def _rounding_floor(problem: BoneProblem) -> float:
    """Return a change of the cost that is nothing but rounding."""
    size = problem.bodies.spread.diagonal(dim1=-2, dim2=-1).sum(-1).mean()
    return (_ROUNDING * torch.finfo(size.dtype).eps) ** 2 * float(size)


def _damped_twists(
    problem: BoneProblem, transforms: Tensor, current: Linearization, level: Tensor, fixed: Tensor | None
) -> Tensor:
    """Return the twists (..., B, 6) of a Gauss-Newton step that pays for the shift of what bones carry."""
    size = problem.binding.num_bones
    hessian = current.hessian.clone()
    blocks = hessian.unflatten(-1, (size, 6)).unflatten(-3, (size, 6)).diagonal(dim1=-4, dim2=-2)
    blocks += (level / size)[..., None, None, None] * problem.inertia(transforms).movedim(-3, -1)
    frozen = None
    if fixed is not None:
        check_shape(fixed, "fixed", (size,))
        frozen = fixed.to(hessian.device).repeat_interleave(6).expand(level.numel(), -1)
    flat = Linearization(
        current.cost.reshape(-1), current.gradient.reshape(-1, 6 * size), hessian.reshape(-1, 6 * size, 6 * size)
    )
    # What is left of the diagonal's damping repairs rounding alone.
    rounding = torch.full_like(flat.cost, 24 * size * torch.finfo(flat.cost.dtype).eps)
    return damped_step(flat, rounding, frozen=frozen).reshape(*transforms.shape[:-2], 6)


def straightened(transforms: Tensor) -> Tensor:
    """Return motions with the nearest rotations, by one Newton step: products of many drift by rounding."""
    rotation = transforms[..., :3, :3]
    transforms = transforms.clone()
    transforms[..., :3, :3] = 1.5 * rotation - 0.5 * rotation @ rotation.mT @ rotation
    return transforms
