"""The damped Gauss-Newton loop, for any linearization of a least-squares problem and any solver for its steps."""

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
    """Update of the damping after a step."""

    trusted: float  # share of the predicted decrease from which the quadratic model counts as valid
    down: float  # factor after a step with such a decrease
    doubtful: float  # factor after a step with a smaller decrease
    up: float  # factor after a step that raised the cost, or whose system could not be solved
    least: float
    most: float = 1e7


class Trial(NamedTuple, Generic[State]):
    """A step before its cost is known."""

    state: State
    step: Tensor
    promised: Tensor  # (...) decrease of the cost in the quadratic model, ``-g^T s / 2``
    sound: Tensor  # (...) False where the damped system had no solution and the step is zero


class Descent(NamedTuple, Generic[State, AnySystem]):
    """State of lowest cost, and the system around it, of which only the cost is up to date after ``final_cost``."""

    state: State
    system: AnySystem
    damping: Tensor
    last_step: Tensor  # the last accepted step, zero if there was none
    num_steps: int  # steps tried
    done: Tensor


def damped_descent(
    linearize: Callable[[State], AnySystem],
    solve: Callable[[State, AnySystem, Tensor], Trial[State]],
    state: State,
    damping: Tensor,
    *,
    rule: DampingRule,
    max_steps: int,
    converged: Callable[[Trial[State], Tensor, Tensor], Tensor] | None = None,
    done: Tensor | None = None,
    start: AnySystem | None = None,
    final_cost: Callable[[State], Tensor] | None = None,
) -> Descent[State, AnySystem]:
    """Return the state of lowest cost that damped steps find (Levenberg 1944; Marquardt 1963), each problem by itself.

    ``solve`` maps (state, system, damping (...)) to a step, ``converged`` (trial, cost before, cost after) to (...)
    whether a problem keeps its state. ``final_cost`` is a cheaper cost (...) of a state, for the last trial.
    """
    current = linearize(state) if start is None else start
    done = torch.zeros_like(current.cost, dtype=torch.bool) if done is None else done
    last_step, num_steps = None, 0
    while num_steps < max_steps and not (converged is not None and bool(done.all())):
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
        if converged is not None:
            done = done | (converged(trial, current.cost, after.cost) & trial.sound)
        state, current = _chosen(keep, trial.state, state), _chosen(keep, after, current)
    last_step = current.cost.new_zeros(()) if last_step is None else last_step
    return Descent(state, current, damping, last_step, num_steps, done)


def _chosen(mask: Tensor, new: Any, old: Any) -> Any:
    """Return the new tensor, or NamedTuple of tensors, where ``mask`` (...) is True, else the old one."""
    if isinstance(old, Tensor):
        return torch.where(mask[(..., *[None] * (old.ndim - mask.ndim))], new, old)
    return type(old)(*(_chosen(mask, fresh, kept) for fresh, kept in zip(new, old, strict=True)))
