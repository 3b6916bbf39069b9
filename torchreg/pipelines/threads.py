"""One thread for work on many small tensors: waking others takes longer than what they would do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread(only: bool = True) -> Iterator[None]:
    """Let torch use one thread on the CPU for what the calling Python thread does inside, and as many as before after.

    Where other programs keep the cores busy, several threads wait for each other most of the time.

    Args:
        only: whether the work is on small tensors at all; False changes nothing.
    """
    if not only:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
