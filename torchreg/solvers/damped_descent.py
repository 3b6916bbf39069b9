"""The one damped Gauss-Newton loop: who linearizes a least-squares problem and solves for a step is handed in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor


class System(Protocol):
    """A least-squares problem around a state: a NamedTuple of tensors with the batch dimensions (...) first."""

    @property
    def cost(self) -> Tensor:
        """Half the weighted sum of squared residuals, (...)."""
        ...

    def _replace(self, *, cost: Tensor) -> Any: ...


# A tensor, or a NamedTuple of tensors, with the batch dimensions first.
State = TypeVar("State")
AnySystem = TypeVar("AnySystem", bound=System)


@dataclass(frozen=True)
class DampingRule:
    """How the damping follows what steps bring.

    Args:
        trusted: share of the promised decrease from which a step shows that the model holds.
        down: factor after such a step.
        doubtful: factor after one that brought less.
        up: factor after one that raised the cost, or that could not be solved for.
        least: smallest damping, against rounding.
        most: largest damping: beyond it no step moves anything.
    """

    trusted: float
    down: float
    doubtful: float
    up: float
    least: float
    most: float = 1e7


class Trial(NamedTuple, Generic[State]):
    """A step that is not tested yet.

    Args:
        state: where it leads.
        step: (..., D), or in any other shape.
        promised: (...) by how much the cost would fall were it quadratic, ``-g^T s / 2``.
        sound: (...) False where the damped system had no solution and the step is zero.
    """

    state: State
    step: Tensor
    promised: Tensor
    sound: Tensor


class Descent(NamedTuple, Generic[State, AnySystem]):
    """Where the iteration stopped.

    Args:
        state: of the lowest cost.
        system: the problem around it; after ``final_cost`` its cost alone is up to date.
        damping: (...) to continue with.
        last_step: the last step that was kept, zero if none was.
        num_steps: steps tried.
        done: (...) whether the problem settled.
    """

    state: State
    system: AnySystem
    damping: Tensor
    last_step: Tensor
    num_steps: int
    done: Tensor


def damped_descent(
    linearize: Callable[[State], AnySystem],
    solve: Callable[[State, AnySystem, Tensor], Trial[State]],
    state: State,
    damping: Tensor,
    *,
    rule: DampingRule,
    max_steps: int,
    settled: Callable[[Trial[State], Tensor, Tensor], Tensor] | None = None,
    done: Tensor | None = None,
    start: AnySystem | None = None,
    final_cost: Callable[[State], Tensor] | None = None,
) -> Descent[State, AnySystem]:
    """Return the state of lowest cost that damped steps find; problems of a batch proceed independently.

    A step that raises the cost is undone and the damping raised; one that lowers it is kept, and the damping follows
    what it brought, see `DampingRule`.

    Args:
        linearize: the problem around a state.
        solve: (state, problem, damping (...)) to a step.
        state: to start from.
        damping: (...) to start with.
        rule: how the damping changes.
        max_steps: steps tried at most.
        settled: (trial, cost before, cost after) to (...) whether a problem is done, and stays where it is; None never.
        done: (...) problems that are done from the start.
        start: the problem around the start, if it is known already.
        final_cost: cost (...) of a state, where that is cheaper: the last trial needs no more.

    Differentiable: no.

    References: Levenberg 1944; Marquardt 1963.
    """
    current = linearize(state) if start is None else start
    done = torch.zeros_like(current.cost, dtype=torch.bool) if done is None else done
    last_step, num_steps = None, 0
    while num_steps < max_steps and not (settled is not None and bool(done.all())):
        num_steps += 1
        trial = solve(state, current, damping)
        last = final_cost is not None and num_steps == max_steps
        after = current._replace(cost=final_cost(trial.state)) if last else linearize(trial.state)  # type: ignore[misc]
        decrease = current.cost - after.cost
        lower = (decrease >= 0) & trial.sound
        trusted = decrease >= rule.trusted * trial.promised
        lowered = torch.where(trusted, rule.down * damping, rule.doubtful * damping)
        damping = torch.where(lower, lowered, rule.up * damping).clamp(rule.least, rule.most)
        keep = lower & ~done
        last_step = _chosen(keep, trial.step, torch.zeros_like(trial.step) if last_step is None else last_step)
        if settled is not None:
            done = done | (settled(trial, current.cost, after.cost) & trial.sound)
        state, current = _chosen(keep, trial.state, state), _chosen(keep, after, current)
    last_step = current.cost.new_zeros(()) if last_step is None else last_step
    return Descent(state, current, damping, last_step, num_steps, done)


def _chosen(mask: Tensor, new: Any, old: Any) -> Any:
    """Return the new tensor, or NamedTuple of tensors, where ``mask`` (...) is True, else the old one."""
    if isinstance(old, Tensor):
        return torch.where(mask[(..., *[None] * (old.ndim - mask.ndim))], new, old)
    return type(old)(*(_chosen(mask, fresh, kept) for fresh, kept in zip(new, old, strict=True)))
