"""Batched Levenberg-Marquardt with box limits, on vectors or manifolds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

_DAMPING_DOWN = 0.2
_DAMPING_DOUBT = 2.0
_DAMPING_UP = 6.0
# A step that brings less than this share of the decrease that its slope promises makes the model doubtful.
_DOUBTFUL_SHARE = 0.5
_MIN_DAMPING = 1e-7
_MAX_DAMPING = 1e7
# Rounding makes a singular Hessian of D variables indefinite by about D eps; a damping of a few times that covers it.
_ROUNDING_COVER = 4.0


@dataclass(frozen=True)
class Linearization:
    """A least-squares problem around a state, for every problem of the batch.

    Args:
        cost: (B,) half the weighted sum of squared residuals.
        gradient: (B, D) of the cost.
        hessian: (B, D, D) its Gauss-Newton approximation ``J^T W J``.
    """

    cost: Tensor
    gradient: Tensor
    hessian: Tensor


@dataclass(frozen=True)
class LMResult:
    """Where the iteration stopped.

    Args:
        state: (B, D).
        cost: (B,) at the state.
        damping: (B,) to continue with.
        last_step: (B, D) the last accepted step, zero if none was.
        num_steps: steps taken.
    """

    state: Tensor
    cost: Tensor
    damping: Tensor
    last_step: Tensor
    num_steps: int


def levenberg_marquardt(
    linearize: Callable[[Tensor], Linearization],
    state: Tensor,
    *,
    retract: Callable[[Tensor, Tensor], Tensor] = torch.add,
    lower: Tensor | None = None,
    upper: Tensor | None = None,
    damping: Tensor | None = None,
    max_steps: int = 10,
    atol: float = 0.0,
    start: Linearization | None = None,
    cost: Callable[[Tensor], Tensor] | None = None,
) -> LMResult:
    """Return the state of lowest cost that the iteration finds; problems of a batch proceed independently.

    Each step solves ``(H + damping diag(H)) s = -g``. Variables at a limit whose gradient pushes outwards are frozen
    for the step; the others are clamped at the limit. A step that raises the cost, or whose system has no Cholesky
    factor, is undone and the damping raised; one that lowers it by much less than promised is kept and the damping
    raised a little.

    Args:
        linearize: state (B, D) to `Linearization`.
        state: (B, D) start; clamped to the limits first.
        retract: (state, step) to state; addition by default.
        lower: (D,) or (B, D) limits of the state, or None.
        upper: (D,) or (B, D) limits of the state, none below ``lower``, or None.
        damping: (B,) relative damping to start with; 1e-3 by default.
        max_steps: number of linearizations after the first.
        atol: stop when every problem's largest step component is at most this.
        start: what ``linearize`` returns at ``state``, which must lie within the limits, if it is known already.
        cost: state (B, D) to cost (B,) like ``linearize``'s, if that is cheaper; the last trial needs no more.

    Returns:
        an `LMResult`; where the start has no finite cost, the start.

    Differentiable: no.

    Cost: ``max_steps + 1`` linearizations and ``max_steps`` batched Cholesky factorizations.

    References: Marquardt 1963; Bertsekas 1982 for the limits.
    """
    low = state.new_full(state.shape[-1:], -torch.inf) if lower is None else lower
    high = state.new_full(state.shape[-1:], torch.inf) if upper is None else upper
    min_damping = max(_MIN_DAMPING, _ROUNDING_COVER * state.shape[-1] * torch.finfo(state.dtype).eps)
    state = torch.minimum(torch.maximum(state, low), high)
    damping = state.new_full(state.shape[:1], 1e-3) if damping is None else damping
    current = linearize(state) if start is None else start
    last_step = torch.zeros_like(state)
    num_steps = 0
    while num_steps < max_steps:
        num_steps += 1
        step, sound = _solve(current, damping, held_at_limits(current.gradient, state, low, high))
        trial_state = torch.minimum(torch.maximum(retract(state, step), low), high)
        if cost is not None and num_steps == max_steps:
            trial = replace(current, cost=cost(trial_state))
        else:
            trial = linearize(trial_state)
        decrease = current.cost - trial.cost
        better = (decrease >= 0) & sound
        # A quadratic falls by at least half of slope times step. Steps that overshoot almost to the same height would
        # else zigzag for long, each of them accepted.
        trusted = decrease >= (-0.5 * _DOUBTFUL_SHARE) * (current.gradient * step).sum(-1)
        keep = better.unsqueeze(-1)
        state = torch.where(keep, trial_state, state)
        last_step = torch.where(keep, step, last_step)
        current = Linearization(
            torch.where(better, trial.cost, current.cost),
            torch.where(keep, trial.gradient, current.gradient),
            torch.where(keep.unsqueeze(-1), trial.hessian, current.hessian),
        )
        accepted = torch.where(trusted, damping * _DAMPING_DOWN, damping * _DAMPING_DOUBT)
        damping = torch.where(better, accepted, damping * _DAMPING_UP).clamp_(min_damping, _MAX_DAMPING)
        if atol > 0 and bool(((step.abs().amax(-1) <= atol) & sound).all()):
            break
    return LMResult(state, current.cost, damping, last_step, num_steps)


def damped_step(problem: Linearization, damping: Tensor, *, frozen: Tensor | None = None) -> Tensor:
    """Return the step ``-(H + damping diag(H))^-1 g``, zero in frozen variables and where nothing constrains one.

    A variable counts as unconstrained when its curvature is below the rounding of the largest one's. A problem whose
    damped system has no Cholesky factor gets a zero step.

    Args:
        problem: the linearized problem.
        damping: (B,) relative damping.
        frozen: (B, D) True for variables to hold.

    Returns:
        (B, D).

    Differentiable: no.
    """
    return _solve(problem, damping, frozen)[0]


def _solve(problem: Linearization, damping: Tensor, frozen: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the damped step (B, D) and whether its system could be factored (B,)."""
    hessian, gradient = problem.hessian, problem.gradient
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    # A variable without curvature keeps its place: unit diagonal, zero gradient. The floor bounds the repair.
    idle = diagonal <= diagonal.amax(-1, keepdim=True) * torch.finfo(hessian.dtype).eps
    idle = idle if frozen is None else idle | frozen
    # Scaling by the root of the diagonal makes metres and radians alike, and the factorization sound in float32.
    scale = diagonal.rsqrt().masked_fill_(idle, 0.0)
    scaled = hessian * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    scaled.diagonal(dim1=-2, dim2=-1).copy_((1 + damping).unsqueeze(-1))
    factor, info = torch.linalg.cholesky_ex(scaled)
    step = torch.cholesky_solve((gradient * scale).unsqueeze(-1), factor).squeeze(-1) * -scale
    sound = info == 0
    # A NaN in the gradient alone leaves the factor sound; its trial must not reach the caller's function.
    return torch.where(torch.isfinite(step) & sound.unsqueeze(-1), step, 0.0), sound


def held_at_limits(gradient: Tensor, state: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return which variables (B, D) a descent must hold: pushed outwards at a limit, or without range."""
    return ((state <= lower) & (gradient > 0)) | ((state >= upper) & (gradient < 0)) | (lower == upper)
