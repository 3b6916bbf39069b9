"""Trials in jobs of Slurm, by submitit. Each job takes trial after trial until none is left."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..engines.base import EngineConfig, share_code
from ..errors import CorruptRecordError, ExperimentError, StoreError
from ..store import Store
from ..worker import Job, Outcome, execute, finished, use_threads

_POLL_SECONDS = 0.2
# After the end of a job its files may take a moment to be seen.
_GRACE_SECONDS = {"local": 0.3}
_GRACE_ELSEWHERE = 5.0


def work(jobs: Sequence[Job]) -> list[str]:
    """Run all jobs that no other process runs or has finished, and return the errors of writing."""
    use_threads(jobs[0].threads)
    told = []
    for job in jobs:
        try:
            execute(job)
        except StoreError as error:
            told.append(str(error))
    return told


class SlurmEngine:
    """As many Slurm jobs as asked for; claims in the folder of results, which all machines must see, share the work.

    Jobs outlive the driver; a driver that is started again waits for what they are at. Options are submitit's, such as
    ``timeout_min`` or ``slurm_partition``; ``cluster=local`` runs the jobs as processes of this machine.

    Args:
        config: number of jobs, and so on.

    Raises:
        ExperimentError: if submitit is not installed or there is no Slurm.
    """

    def __init__(self, config: EngineConfig) -> None:
        try:
            import submitit
        except ImportError as error:
            raise ExperimentError("submitit is not installed: pip install 'torchreg-articulated[slurm]'") from error
        self.config, self._submitit = config, submitit
        self.cluster = config.options.get("cluster", "slurm")
        if self.cluster == "slurm" and shutil.which("sbatch") is None:
            raise ExperimentError(
                "there is no Slurm here (no sbatch); --slurm cluster=local runs its jobs as processes"
            )
        share_code()
        self._running: list[Any] = []

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome per job; see `Engine`."""
        if not jobs:
            return
        gpus = int(self.config.gpus or 0)
        jobs = [replace(job, accelerated=job.accelerated and gpus > 0) for job in jobs]
        executor = self._executor(Path(jobs[0].store), gpus)
        # Each begins elsewhere, so that they do not queue for the same claims.
        count = min(self.config.jobs, len(jobs))
        parts = [[*jobs[start::count], *_others(jobs, start, count)] for start in range(count)]
        with executor.batch():
            running = [executor.submit(work, part) for part in parts]
        self._running = list(running)
        yield from self._watch(jobs, running)
        # All is recorded, so that jobs that still run end by themselves.
        deadline = time.monotonic() + _GRACE_ELSEWHERE
        while self.cluster == "local" and time.monotonic() < deadline and not all(job.done() for job in running):
            time.sleep(_POLL_SECONDS)
        self._running = []

    def _executor(self, store: Path, gpus: int) -> Any:
        executor = self._submitit.AutoExecutor(folder=store / "slurm", cluster=self.cluster)
        options: dict[str, Any] = {"timeout_min": 24 * 60, "cpus_per_task": self.config.threads, "name": "torchreg"}
        options |= {"gpus_per_node": gpus} if gpus else {}
        options |= {key: _number(value) for key, value in self.config.options.items() if key != "cluster"}
        executor.update_parameters(**options)
        return executor

    def _watch(self, jobs: Sequence[Job], running: list[Any]) -> Iterator[Outcome]:
        """Yield outcomes as records appear, and those of jobs without a record when all have ended."""
        remaining, grace = {job.id: job for job in jobs}, _GRACE_SECONDS.get(self.cluster, _GRACE_ELSEWHERE)
        ended: float | None = None
        while remaining:
            for outcome in [outcome for outcome in map(_recorded, remaining.values()) if outcome is not None]:
                del remaining[outcome.id]
                yield outcome
            if ended is None and all(job.done() for job in running):
                ended = time.monotonic()
                self._raise_unwritten(running)
            if ended is not None and time.monotonic() - ended > grace:
                break
            if remaining:
                time.sleep(_POLL_SECONDS)
        for job in remaining.values():
            busy = Store(Path(job.store)).is_claimed(job.id)
            yield Outcome(job.id, "busy" if busy else "lost")

    def _raise_unwritten(self, running: list[Any]) -> None:
        for job in running:
            # A job that died left nothing, and its trials come back as lost; submitit would wait for its result.
            if job.paths.result_pickle.exists() and (told := job.result()):
                raise StoreError(told[0])

    def close(self) -> None:
        """Cancel the jobs that still run."""
        for job in self._running:
            if not job.done():
                job.cancel()


def _others(jobs: Sequence[Job], start: int, count: int) -> list[Job]:
    return [job for number, job in enumerate(jobs) if number % count != start]


def _recorded(job: Job) -> Outcome | None:
    store = Store(Path(job.store))
    try:
        record = store.read(job.id)
    except CorruptRecordError:
        return None
    if record is None or not finished(record, job.session, job.retry):
        return None
    return Outcome(job.id, "recorded", record.status, record.session == job.session, record.note)


def _number(text: str) -> Any:
    try:
        return int(text)
    except ValueError:
        return text
