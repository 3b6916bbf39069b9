"""A thread that does the newest work alone: what arrives while it is busy replaces what waits."""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from typing import Generic, TypeVar

from torchreg.errors import TorchregError

_REMEMBERED = 1000

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class LatestWorker(Generic[Key, Value]):
    """Calls ``work`` with the newest value of every key that has changed since the last call, on a thread of its own.

    Whoever submits never waits: a mouse that moves faster than poses are solved makes no queue.

    Args:
        work: is called with {key: newest value}; an error of torchreg that it raises is given to ``on_error``.
        on_error: what to do with such an error.
        name: of the thread.
    """

    def __init__(
        self,
        work: Callable[[Mapping[Key, Value]], None],
        on_error: Callable[[TorchregError], None],
        name: str = "torchreg worker",
    ) -> None:
        self._work, self._on_error = work, on_error
        self._condition = threading.Condition()
        self._waiting: dict[Key, Value] = {}
        self._busy, self._closed = False, False
        self._seconds: deque[float] = deque(maxlen=_REMEMBERED)
        self._num_submitted = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def num_submitted(self) -> int:
        """How many values have been submitted."""
        return self._num_submitted

    @property
    def seconds(self) -> tuple[float, ...]:
        """How long the last calls took, oldest first."""
        with self._condition:
            return tuple(self._seconds)

    @property
    def median_seconds(self) -> float:
        """Median of `seconds`; NaN before the first call."""
        return statistics.median(self.seconds or (float("nan"),))

    def submit(self, key: Key, value: Value) -> None:
        """Let the work be done for a value, unless a newer one of the same key comes first, or it was closed."""
        with self._condition:
            if self._closed:
                return
            self._waiting[key] = value
            self._num_submitted += 1
            self._condition.notify_all()

    def drop(self) -> None:
        """Forget what waits, and return once nothing is being done."""
        with self._condition:
            self._waiting.clear()
            self._condition.wait_for(lambda: not self._busy)

    def flush(self, timeout: float | None = None) -> bool:
        """Return once all is done; False if that took longer than ``timeout`` seconds."""
        with self._condition:
            return self._condition.wait_for(lambda: not self._busy and not self._waiting, timeout)

    def close(self) -> None:
        """End the thread, once what is being done is done."""
        with self._condition:
            self._closed = True
            self._waiting.clear()
            self._condition.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                job, self._waiting, self._busy = self._waiting, {}, True
            start = time.perf_counter()
            try:
                self._work(job)
            except TorchregError as error:
                self._on_error(error)
            finally:
                with self._condition:
                    self._seconds.append(time.perf_counter() - start)
                    self._busy = False
                    self._condition.notify_all()
