"""Threads for work on many small tensors: a single thread per operation, and two pieces of work side by side."""

from __future__ import annotations

import os
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


class _SharedCount:
    """The number of threads that torch gives to a Python thread which has not used it yet.

    Setting the number of one thread also sets this one. So while any thread works with a single one, threads that
    begin would keep that for ever; the last to end its work puts the number back that the first had found.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all threads."""
        self._lock = threading.Lock()
        self._working, self._found = 0, 1

    def begin(self) -> int:
        """Set the caller's number to 1 and return the number to give back."""
        with self._lock:
            before = torch.get_num_threads()
            if self._working == 0:
                self._found = in_new_thread(torch.get_num_threads)
            self._working += 1
            # Unless the caller began to use torch beside such work.
            before = self._found if before == 1 else before
            torch.set_num_threads(1)
            return before

    def end(self, before: int) -> None:
        """Give the caller its number back."""
        with self._lock:
            self._working -= 1
            torch.set_num_threads(before)
            if self._working == 0 and before != self._found:
                in_new_thread(lambda: torch.set_num_threads(self._found))


def in_new_thread(call: Callable[[], _First]) -> _First:
    """Return the result of a call in a thread of its own, where no mode of torch is on that the caller is in."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(call).result()


_shared = _SharedCount()
if hasattr(os, "register_at_fork"):
    # In a forked process the other threads, which may hold the lock, do not exist.
    os.register_at_fork(after_in_child=_shared.reset)


@contextmanager
def one_thread(only: bool = True) -> Iterator[None]:
    """Let torch use one thread on the CPU for the work of the calling Python thread in a ``with`` block.

    Waking further threads takes longer than operations on small tensors. `run_both` still runs two pieces of work at
    once where torch could use more threads before. Not ``only``: nothing changes.
    """
    if not only or _is_single():
        yield
        return
    before = _shared.begin()
    try:
        with _allowed(getattr(_budget, "allowed", None) or before, single=True):
            yield
    finally:
        _shared.end(before)


def run_both(first: Callable[[], _First], second: Callable[[], _Second]) -> tuple[_First, _Second]:
    """Return the results of two independent calls, the second made at the same time by another thread if torch may.

    The two calls share the caller's threads. Gradients are recorded as in the caller. An error of the first call is
    raised when the second has ended.
    """
    allowed = _num_allowed()
    if allowed < 2:
        return first(), second()
    grad, inference, single = torch.is_grad_enabled(), torch.is_inference_mode_enabled(), _is_single()

    def in_second_thread() -> _Second:
        if single and torch.get_num_threads() != 1:
            torch.set_num_threads(1)
        with _allowed(allowed // 2, single), torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return second()

    with ThreadPoolExecutor(1) as pool:
        pending = pool.submit(in_second_thread)
        with _allowed(allowed - allowed // 2, single):
            result = first()
        return result, pending.result()


def _num_allowed() -> int:
    """Return the number of threads that may work for the caller, itself included."""
    return getattr(_budget, "allowed", None) or torch.get_num_threads()


def _is_single() -> bool:
    """Return whether the caller already works within `one_thread`."""
    return getattr(_budget, "single", False)


@contextmanager
def _allowed(number: int, single: bool) -> Iterator[None]:
    """Let the calling thread, and those it starts, use a number of threads in a ``with`` block."""
    before = getattr(_budget, "allowed", None), _is_single()
    _budget.allowed, _budget.single = number, single
    try:
        yield
    finally:
        _budget.allowed, _budget.single = before
