"""Batched Levenberg-Marquardt with box limits, on vectors or manifolds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

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
    """A least-squares problem around a state, for every problem of the batch."""

    cost: Tensor  # (B,) half the weighted sum of squared residuals
    gradient: Tensor  # (B, D) of the cost
    hessian: Tensor  # (B, D, D) its Gauss-Newton approximation ``J^T W J``

    def plus(self, other: Linearization) -> Linearization:
        """Return the problem whose cost is the sum of both."""
        return Linearization(self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian)


@dataclass(frozen=True)
class LMResult:
    """States (B, D), their costs (B,), damping to continue with, the last accepted step (zero if none), steps tried."""

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
    """Return the states of lowest cost by steps ``(H + damping diag(H)) s = -g``, each problem of the batch by itself.

    Variables at a limit whose gradient pushes outwards are frozen for the step, others clamped at it. All problems stop
    when the largest step component of each is at most ``atol``; ``cost`` is a cheaper cost (B,) for the last trial
    (Marquardt 1963; Bertsekas 1982 for the limits).
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
    """Return steps (B, D) ``-(H + damping diag(H))^-1 g``, and a mask (B,) of the systems with a Cholesky factor.

    Steps are zero in the other systems, in frozen variables (B, D), and where the curvature is rounding of the largest.
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


@dataclass(frozen=True)
class SharedRows:
    """Groups of ``count`` rows (S count, own + K) with K shared unknowns: states (S, count own + K), one a group.

    ``retract`` moves rows by steps.
    """

    retract: Callable[[Tensor, Tensor], Tensor]
    count: int = 1
    own: int = 0

    def descend(
        self, linearize: Callable[[Tensor], Linearization], rows: Tensor, *, lower: Tensor, upper: Tensor,
        start: Linearization | None = None, damping: Tensor | None = None,
        cost: Callable[[Tensor], Tensor] | None = None, **options: Any,
    ) -> LMResult:  # fmt: skip
        """Return rows after `levenberg_marquardt` within limits of the rows, linearized and with costs by row."""
        found = levenberg_marquardt(
            lambda state: self._system(linearize(self._split(state))), self._joined(rows), retract=self._moved,
            lower=self._joined(lower.expand_as(rows)), upper=self._joined(upper.expand_as(rows)),
            damping=None if damping is None else damping[:: self.count],
            start=None if start is None else self._system(start),
            cost=None if cost is None else lambda state: cost(self._split(state)).unflatten(0, (-1, self.count)).sum(1),
            **options,
        )  # fmt: skip
        return self._spread(found)

    def step(self, around: Linearization, rows: Tensor, *, lower: Tensor, upper: Tensor, damping: float) -> LMResult:
        """Return rows after one damped step without a test."""
        system, state = self._system(around), self._joined(rows)
        low, high = self._joined(lower.expand_as(rows)), self._joined(upper.expand_as(rows))
        shares = torch.full_like(state[:, 0], damping)
        step, _ = damped_step(system, shares, frozen=held_at_limits(system.gradient, state, low, high))
        moved = torch.minimum(torch.maximum(self._moved(state, step), low), high)
        return self._spread(LMResult(moved, system.cost, shares, step, 1))

    def _joined(self, rows: Tensor) -> Tensor:
        if self.count == 1:
            return rows
        grouped = rows.unflatten(0, (-1, self.count))
        return torch.cat([grouped[..., : self.own].flatten(1), grouped[:, 0, self.own :]], dim=-1)

    def _split(self, state: Tensor) -> Tensor:
        if self.count == 1:
            return state
        alone, shared = state.tensor_split([self.count * self.own], dim=-1)
        shared = shared.unsqueeze(1).expand(-1, self.count, -1)
        return torch.cat([alone.unflatten(1, (self.count, -1)), shared], dim=-1).flatten(0, 1)

    def _system(self, rows: Linearization) -> Linearization:
        if self.count == 1:
            return rows
        return join_shared(Linearization(*(value.unflatten(0, (-1, self.count)) for value in rows)), self.own)

    def _moved(self, state: Tensor, step: Tensor) -> Tensor:
        return self._joined(self.retract(self._split(state), self._split(step)))

    def _spread(self, found: LMResult) -> LMResult:
        cost, damping = (value.repeat_interleave(self.count) for value in (found.cost, found.damping))
        return LMResult(self._split(found.state), cost, damping, self._split(found.last_step), found.num_steps)


def join_shared(rows: Linearization, own: int) -> Linearization:
    """Return the problem (S, R own + K) of groups of R rows from those of the rows (S, R, own + K), K shared."""
    gradient, hessian = rows.gradient, rows.hessian
    count = gradient.shape[1]
    index = torch.arange(count, device=hessian.device)
    blocks = hessian.new_zeros(len(hessian), count, own, count, own)
    blocks[:, index, :, index] = hessian[..., :own, :own].transpose(0, 1)
    across = hessian[..., :own, own:].flatten(1, 2)
    top = torch.cat([blocks.flatten(3, 4).flatten(1, 2), across], dim=-1)
    return Linearization(
        cost=rows.cost.sum(-1),
        gradient=torch.cat([gradient[..., :own].flatten(1), gradient[..., own:].sum(1)], dim=-1),
        hessian=torch.cat([top, torch.cat([across.mT, hessian[..., own:, own:].sum(1)], dim=-1)], dim=1),
    )


def shared_information(hessian: Tensor, own: int) -> Tensor:
    """Return what rows tell of the shared unknowns alone (..., K, K): the Schur complement of (..., own + K)."""
    across = hessian[..., :own, own:]
    found = hessian[..., own:, own:] - across.mT @ torch.linalg.solve(hessian[..., :own, :own], across)
    return 0.5 * (found + found.mT)
