"""Threads for work on many small tensors: a single thread per operation, and two pieces of work side by side."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

_First = TypeVar("_First")
_Second = TypeVar("_Second")
# Number of threads that this thread and those it starts may use.
_budget = threading.local()


@contextmanager
def one_thread(only: bool = True) -> Iterator[None]:
    """Let torch use one thread on the CPU for the work of the calling Python thread in a ``with`` block.

    Waking further threads takes longer than operations on small tensors, and where other programs keep the cores busy,
    several threads wait for each other most of the time. `run_both` still runs two pieces of work at once where torch
    could use more threads before.

    Args:
        only: whether the work is on small tensors; False changes nothing.
    """
    if not only:
        yield
        return
    before = torch.get_num_threads()
    with _allowed(_num_allowed()):
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)


def run_both(first: Callable[[], _First], second: Callable[[], _Second]) -> tuple[_First, _Second]:
    """Return the results of two calls, the second made at the same time by another thread if torch may use several.

    The two calls share the caller's threads. Gradients are recorded as in the caller. An error of the first call is
    raised when the second has ended.

    Args:
        first: called in the calling thread.
        second: called in a thread beside it; must not depend on the first.
    """
    allowed = _num_allowed()
    if allowed < 2:
        return first(), second()
    grad, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def in_second_thread() -> _Second:
        with _allowed(allowed // 2), torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return second()

    with ThreadPoolExecutor(1) as pool:
        pending = pool.submit(in_second_thread)
        with _allowed(allowed - allowed // 2):
            result = first()
        return result, pending.result()


def _num_allowed() -> int:
    """Return the number of threads that may work for the caller, itself included."""
    return getattr(_budget, "allowed", None) or torch.get_num_threads()


@contextmanager
def _allowed(number: int) -> Iterator[None]:
    """Let the calling thread and those it starts use a number of threads in a ``with`` block."""
    before = getattr(_budget, "allowed", None)
    _budget.allowed = number
    try:
        yield
    finally:
        _budget.allowed = before
