"""Least squares with unknowns of each row and unknowns that all rows share: an arrow-shaped Hessian."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg.solvers.levenberg_marquardt import (
    Linearization,
    LMResult,
    damped_step,
    held_at_limits,
    levenberg_marquardt,
)


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
