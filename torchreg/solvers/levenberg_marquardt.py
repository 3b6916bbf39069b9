"""Batched Levenberg-Marquardt with box limits, on vectors or manifolds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchreg.solvers.damped_descent import DampingRule, Trial, damped_descent


@dataclass(frozen=True)
class _Damping(DampingRule):
    """Relative damping: its start, its update and its floor."""

    initial: float = 1e-3
    # Less than half of the predicted decrease is doubtful: steps that overshoot to almost the same cost would otherwise
    # zigzag for long, each of them accepted.
    trusted: float = 0.5
    down: float = 0.2
    doubtful: float = 2.0
    up: float = 6.0
    least: float = 1e-7
    # Least damping in units of D eps, the rounding that makes a singular Hessian of D variables indefinite.
    rounding_cover: float = 4.0


_DAMPING = _Damping()


class Linearization(NamedTuple):
    """A least-squares problem around a state, for every problem of the batch.

    Args:
        cost: (B,) half the weighted sum of squared residuals.
        gradient: (B, D) of the cost.
        hessian: (B, D, D) its Gauss-Newton approximation ``J^T W J``.
    """

    cost: Tensor
    gradient: Tensor
    hessian: Tensor

    def plus(self, other: Linearization) -> Linearization:
        """Return the problem whose cost is the sum of both."""
        return Linearization(self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian)


@dataclass(frozen=True)
class LMResult:
    """Result of the iteration.

    Args:
        state: (B, D).
        cost: (B,) at the state.
        damping: (B,) to continue with.
        last_step: (B, D) the last accepted step, zero if there was none.
        num_steps: steps tried.
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
    factor, is rejected and the damping raised; one that lowers it by much less than predicted is accepted and the
    damping raised a little.

    Args:
        linearize: state (B, D) to `Linearization`.
        state: (B, D) initial state; clamped to the limits first.
        retract: (state, step) to state; addition by default.
        lower: (D,) or (B, D) limits of the state, or None.
        upper: (D,) or (B, D) limits of the state, none below ``lower``, or None.
        damping: (B,) initial relative damping; 1e-3 by default.
        max_steps: number of linearizations after the first.
        atol: stop when every problem's largest step component is at most this.
        start: the linearization at ``state``, which must lie within the limits, if known.
        cost: state (B, D) to cost (B,) like ``linearize``'s, if that is cheaper; the last trial needs no more.

    Returns:
        An `LMResult`; the initial state of problems without finite cost there.

    Differentiable: no.

    Cost: ``max_steps + 1`` linearizations and ``max_steps`` batched Cholesky factorizations.

    References: Marquardt 1963; Bertsekas 1982 for the limits.
    """
    low = state.new_full(state.shape[-1:], -torch.inf) if lower is None else lower
    high = state.new_full(state.shape[-1:], torch.inf) if upper is None else upper
    rounding = _DAMPING.rounding_cover * state.shape[-1] * torch.finfo(state.dtype).eps

    def within(state: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(state, low), high)

    def solve(state: Tensor, problem: Linearization, damping: Tensor) -> Trial[Tensor]:
        step, sound = damped_step(problem, damping, frozen=held_at_limits(problem.gradient, state, low, high))
        promised = -0.5 * (problem.gradient * step).sum(-1)
        return Trial(within(retract(state, step)), step, promised, sound)

    def small(trial: Trial[Tensor], before: Tensor, after: Tensor) -> Tensor:
        # All problems stop together, when the last one has converged.
        return ((trial.step.abs().amax(-1) <= atol) & trial.sound).all().expand(before.shape)

    found = damped_descent(
        linearize,
        solve,
        within(state),
        state.new_full(state.shape[:1], _DAMPING.initial) if damping is None else damping,
        rule=replace(_DAMPING, least=max(_DAMPING.least, rounding)),
        max_steps=max_steps,
        converged=small if atol > 0 else None,
        start=start,
        final_cost=cost,
    )
    last_step = found.last_step.expand(state.shape)
    return LMResult(found.state, found.system.cost, found.damping, last_step, found.num_steps)


def damped_step(problem: Linearization, damping: Tensor, *, frozen: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return the step ``-(H + damping diag(H))^-1 g``, zero in frozen and in unconstrained variables.

    A variable is unconstrained when its curvature is below the rounding of the largest one's. A problem whose damped
    system has no Cholesky factor gets a zero step.

    Args:
        problem: the linearized problem.
        damping: (B,) relative damping.
        frozen: (B, D) True for variables to hold.

    Returns:
        Steps (B, D), and a mask (B,) of the systems that could be factored.

    Differentiable: no.
    """
    hessian, gradient = problem.hessian, problem.gradient
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    # A variable without curvature keeps its value: unit diagonal, zero gradient. The floor bounds the repair.
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
    """Return a mask (B, D) of the variables that a descent must hold: pushed outwards at a limit, or without range."""
    return ((state <= lower) & (gradient > 0)) | ((state >= upper) & (gradient < 0)) | (lower == upper)
