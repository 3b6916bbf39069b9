"""Trials in processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing.connection import wait as wait_for

from ..engines.base import EngineConfig, share_code, visible_gpus
from ..errors import ExperimentError
from ..worker import Job, Outcome, execute, use_threads


class LocalEngine:
    """Pools of one process each, so that a process that dies takes no trial but its own with it.

    Args:
        config: the number of processes, and so on.
    """

    def __init__(self, config: EngineConfig) -> None:
        self.config = config
        self.gpus = visible_gpus() if config.gpus != 0 else []
        share_code()
        self._pools: list[ProcessPoolExecutor | None] = [None] * config.jobs
        self._busy: set[int] = set()

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome per job; see `Engine`."""
        waiting = deque(replace(job, accelerated=job.accelerated and bool(self.gpus)) for job in jobs)
        running: dict[Future[Outcome], tuple[int, Job]] = {}
        free = list(reversed(range(self.config.jobs)))
        while waiting or running:
            while waiting and free:
                slot, job = free.pop(), waiting.popleft()
                running[self._submit(slot, job)] = slot, job
                self._busy.add(slot)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                slot, job = running.pop(future)
                free.append(slot)
                try:
                    outcome = future.result()
                except BrokenProcessPool:
                    self._drop(slot)
                    outcome = Outcome(job.id, "lost")
                self._busy.discard(slot)
                yield outcome

    def close(self) -> None:
        """End all processes: those that are idle by themselves, the others at once."""
        for slot in range(len(self._pools)):
            self._drop(slot)

    def _submit(self, slot: int, job: Job) -> Future[Outcome]:
        """Give a job to the pool of a slot; a process that died idle is replaced."""
        for _ in range(2):
            pool = self._pools[slot]
            if pool is None:
                pool = self._pools[slot] = self._new_pool(slot)
            try:
                return pool.submit(execute, job)
            except BrokenProcessPool:
                self._drop(slot)
        raise ExperimentError("processes die as soon as they start; see whether there is memory left")

    def _new_pool(self, slot: int) -> ProcessPoolExecutor:
        gpu = self.gpus[slot % len(self.gpus)] if self.gpus else None
        # Threads of this process would not survive a fork, so that each starts afresh.
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, context, _begin, (self.config.threads, gpu))

    def _drop(self, slot: int) -> None:
        pool, self._pools[slot] = self._pools[slot], None
        if pool is None:
            return
        if slot not in self._busy:
            pool.shutdown()
            return
        processes = list((getattr(pool, "_processes", None) or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()
        for process in processes:
            process.join()
        self._busy.discard(slot)


def _begin(threads: int, gpu: str | None) -> None:
    """Prepare a new process: its threads, its GPU, and that it ends when the driver does."""
    use_threads(threads)
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)
