"""A thread that works on the newest values alone: values that arrive while it is busy replace waiting ones."""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from typing import Generic, TypeVar

from torchreg.errors import TorchregError

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class LatestWorker(Generic[Key, Value]):
    """A thread that calls ``work`` with {key: newest value} of what changed since; submitting never waits."""

    def __init__(
        self,
        work: Callable[[Mapping[Key, Value]], None],
        on_error: Callable[[Exception], None],
        name: str = "torchreg worker",
    ) -> None:
        self._work, self._on_error = work, on_error
        self._condition = threading.Condition()
        self._waiting: dict[Key, Value] = {}
        self._busy, self._closed = False, False
        self._seconds: deque[float] = deque(maxlen=1000)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def seconds(self) -> tuple[float, ...]:
        """Durations of the last 1,000 calls, oldest first."""
        with self._condition:
            return tuple(self._seconds)

    @property
    def median_seconds(self) -> float:
        """Median of `seconds`; NaN before the first call."""
        return statistics.median(self.seconds or (float("nan"),))

    def submit(self, key: Key, value: Value) -> None:
        """Ask for work on a value; a newer value of the same key replaces it, and nothing happens after `close`."""
        with self._condition:
            if self._closed:
                return
            self._waiting[key] = value
            self._condition.notify_all()

    def drop(self) -> None:
        """Drop waiting values, and return once the running call is done."""
        with self._condition:
            self._waiting.clear()
            self._condition.wait_for(lambda: not self._busy)

    def flush(self, timeout: float | None = None) -> bool:
        """Return once all values are worked on; False if that took longer than ``timeout`` seconds."""
        with self._condition:
            return self._condition.wait_for(lambda: not self._busy and not self._waiting, timeout)

    def close(self) -> None:
        """End the thread, once the running call is done."""
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
            except (TorchregError, RuntimeError, ArithmeticError, ValueError) as error:
                # The thread lives on whatever a page sent.
                self._on_error(error)
            finally:
                with self._condition:
                    self._seconds.append(time.perf_counter() - start)
                    self._busy = False
                    self._condition.notify_all()
