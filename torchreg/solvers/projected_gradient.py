"""Minima of convex costs under x >= 0, by accelerated projected gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class _StepLength:
    """Numbers by which the step length follows the curvature."""

    # Doublings of the curvature in a step, until the cost stays below its quadratic bound.
    max_doublings: int = 60
    # Factor on the curvature after a step, so that step lengths grow again where it is less.
    curvature_down: float = 0.9
    # Length of the probe of the first curvature, as a share of the largest variable.
    probe: float = 1e-3


_STEP = _StepLength()


@dataclass(frozen=True)
class DescentResult:
    """Result of projected gradient descent.

    Args:
        x: (..., n).
        cost: (...) at ``x``.
        num_steps: steps taken by the slowest problem.
        converged: (...) whether the last step was within the tolerance, or too short to lower the cost at all.
    """

    x: Tensor
    cost: Tensor
    num_steps: int
    converged: Tensor


def projected_gradient(
    cost: Callable[[Tensor], Tensor],
    start: Tensor,
    *,
    scale: Tensor | None = None,
    max_steps: int = 500,
    tol: float = 1e-6,
) -> DescentResult:
    """Return x >= 0 of low cost by accelerated projected gradient steps; problems of a batch proceed independently.

    Momentum is dropped where it opposes the step or raises the cost, so that the cost never rises. Step lengths follow
    the curvature, which is doubled until the cost stays below its quadratic bound.

    Args:
        cost: x (..., n) to convex, differentiable costs (...).
        start: (..., n) finite and of finite cost; negative entries are set to zero first.
        scale: (..., n) positive step lengths of the variables relative to each other, best the inverse of the
            curvature's diagonal; ones by default.
        max_steps: largest number of steps.
        tol: largest change of a variable, as a share of the largest variable, in the last step without momentum.

    Differentiable: no; the gradients of ``cost`` come from autograd.

    References: Beck and Teboulle 2009; O'Donoghue and Candes 2015 for the restarts.
    """
    scale = torch.ones_like(start) if scale is None else scale
    x = start.detach().clamp_min(0)
    value, gradient = _value_and_gradient(cost, x)
    curvature = _probe(cost, x, gradient, scale)
    ahead, weight = x, torch.ones_like(value)
    done = torch.zeros_like(value, dtype=torch.bool)
    steps = 0
    while steps < max_steps and not bool(done.all()):
        steps += 1
        reference, gradient = _value_and_gradient(cost, ahead)
        trial, lower, curvature = _bounded_step(
            cost, ahead, reference, gradient, scale=scale, curvature=curvature, done=done
        )
        step = trial - ahead
        without_momentum = (ahead == x).all(-1)
        small = step.abs().amax(-1) <= tol * trial.abs().amax(-1)
        opposed = ((step * (trial - x) / scale).sum(-1) < 0) | (lower > value)
        keep = (lower <= value) & ~done
        grown = 0.5 * (1 + (1 + 4 * weight**2).sqrt())
        momentum = torch.where(opposed, 0.0, (weight - 1) / grown).unsqueeze(-1)
        weight = torch.where(opposed, 1.0, grown)
        moved = torch.where(keep.unsqueeze(-1), trial, x)
        # A small step with momentum is tried again without before it counts.
        momentum = momentum.masked_fill((small & ~without_momentum).unsqueeze(-1), 0.0)
        ahead = moved + momentum * (moved - x)
        done = done | (without_momentum & (small | ~(lower < value)))
        x, value = moved, torch.where(keep, lower, value)
        curvature = curvature * _STEP.curvature_down
    return DescentResult(x, value, steps, done)


def _value_and_gradient(cost: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        value = cost(x)
        (gradient,) = torch.autograd.grad(value.sum(), x)
    return value.detach(), gradient


def _probe(cost: Callable[[Tensor], Tensor], x: Tensor, gradient: Tensor, scale: Tensor) -> Tensor:
    """Return the curvature (...) along the gradient, relative to ``1 / scale``."""
    direction = scale * gradient
    longest = direction.abs().amax(-1, keepdim=True)
    reach = x.abs().amax(-1, keepdim=True)
    length = torch.where(reach > 0, reach, 1.0) * _STEP.probe
    direction = direction * (length / longest.clamp_min(torch.finfo(x.dtype).tiny))
    change = _value_and_gradient(cost, x + direction)[1] - gradient
    curvature = (change * direction).sum(-1) / (direction**2 / scale).sum(-1)
    return torch.where(curvature > 0, curvature, 1.0)


def _bounded_step(
    cost: Callable[[Tensor], Tensor],
    ahead: Tensor,
    value: Tensor,
    gradient: Tensor,
    *,
    scale: Tensor,
    curvature: Tensor,
    done: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the point after a projected step, its cost, and the curvature whose quadratic bound holds there."""
    slack = 10 * torch.finfo(ahead.dtype).eps * value.abs()
    for _ in range(_STEP.max_doublings):
        trial = (ahead - scale * gradient / curvature.unsqueeze(-1)).clamp_min(0)
        step = trial - ahead
        with torch.no_grad():
            lower = cost(trial)
        bound = value + (gradient * step).sum(-1) + 0.5 * curvature * (step**2 / scale).sum(-1)
        # Not `>`: a cost that is not finite must shorten the step too.
        over = ~(lower <= bound + slack) & ~done
        if not bool(over.any()):
            break
        curvature = torch.where(over, 2 * curvature, curvature)
    return trial, lower, curvature
