"""Threads for work on many small tensors: one for each, as waking others takes longer than what they would do."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

_One = TypeVar("_One")
_Other = TypeVar("_Other")
# How many threads this one and those it starts may be.
_here = threading.local()


@contextmanager
def one_thread(only: bool = True) -> Iterator[None]:
    """Let torch use one thread on the CPU for what the calling Python thread does inside, and as many as before after.

    Where other programs keep the cores busy, several threads wait for each other most of the time. What is inside may
    still do two things at once, see `both`, where torch could use more threads before.

    Args:
        only: whether the work is on small tensors at all; False changes nothing.
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


def both(one: Callable[[], _One], other: Callable[[], _Other]) -> tuple[_One, _Other]:
    """Return what two calls return, the second made meanwhile by another thread where torch may use more than one.

    Both share the threads that are left. Gradients are recorded in both or none, as outside. An error of the first call
    is raised when the second has ended.

    Args:
        one: called in the calling thread.
        other: called beside it; must not depend on it.
    """
    allowed = _num_allowed()
    if allowed < 2:
        return one(), other()
    grad, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def aside() -> _Other:
        with _allowed(allowed // 2), torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return other()

    with ThreadPoolExecutor(1) as pool:
        later = pool.submit(aside)
        with _allowed(allowed - allowed // 2):
            first = one()
        return first, later.result()


def _num_allowed() -> int:
    """Return how many threads may work for the caller, itself included."""
    return getattr(_here, "allowed", None) or torch.get_num_threads()


@contextmanager
def _allowed(number: int) -> Iterator[None]:
    before = getattr(_here, "allowed", None)
    _here.allowed = number
    try:
        yield
    finally:
        _here.allowed = before
