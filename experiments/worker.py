"""One trial from claim to record, in whatever process an engine has for it."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import resource
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import torchreg

from .claims import claimed
from .errors import CorruptRecordError, SkippedTrial, StoreError
from .records import TrialRecord, provenance
from .registry import Bench, Task, TrialOutcome, find_task
from .store import Store, explained
from .structure import build

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
# A trial that ends its process this often in one session is told as failed.
MAX_ATTEMPTS = 3
_MAX_WARNINGS = 20
# For the record of a trial that timed out to be written.
_GRACE_SECONDS = 10.0
_MEGABYTE = 2.0**20


@dataclass(frozen=True)
class Job:
    """A trial to be run.

    Args:
        store: folder of the results.
        task: name in the registry.
        id: of the trial.
        config: resolved.
        session: the run of the driver.
        engine: name, for the record.
        threads: of the worker.
        accelerated: whether a GPU was set aside for it.
        retry: run it again if it failed or was skipped in another session.
        timeout: seconds after which it is ended and recorded as failed; None waits for ever.
    """

    store: str
    task: str
    id: str
    config: dict[str, Any]
    session: str
    engine: str = "local"
    threads: int = 1
    accelerated: bool = False
    retry: bool = False
    timeout: float | None = None


@dataclass(frozen=True)
class Outcome:
    """The end of a job, as an engine reports it.

    Args:
        id: of the trial.
        state: "recorded": there is a record; "busy": another process is at it; "lost": the process died.
        status: of the record.
        fresh: whether the record was made by this job.
        note: of the record.
    """

    id: str
    state: Literal["recorded", "busy", "lost"]
    status: str = ""
    fresh: bool = False
    note: str = ""


def use_threads(count: int) -> None:
    """Limit this process to ``count`` threads, so that parallel jobs do not compete for cores."""
    for name in THREAD_VARIABLES:
        os.environ[name] = str(count)
    if "torch" in sys.modules:
        import torch

        torch.set_num_threads(count)


def finished(record: TrialRecord | None, session: str, retry: bool) -> bool:
    """Return whether a trial has a record."""
    if record is None:
        return False
    return record.status == "done" or not retry or record.session == session


def execute(job: Job) -> Outcome:
    """Run a trial unless it is finished or someone else is at it, and return what came of it.

    A record that cannot be read is set aside, and the trial runs again.

    Raises:
        StoreError: if the result cannot be written.
    """
    store = Store(Path(job.store))
    with explained(store.claim_path(job.id)), claimed(store.claim_path(job.id), job.session) as attempt:
        if not attempt:
            return Outcome(job.id, "busy")
        try:
            known = store.read(job.id)
        except CorruptRecordError:
            store.set_aside(job.id)
            known = None
        if known is not None and finished(known, job.session, job.retry):
            return Outcome(job.id, "recorded", known.status, note=known.note)
        if attempt > MAX_ATTEMPTS:
            record = _gave_up(job, attempt)
        else:
            with _ended_after(job, store, attempt):
                record = _run(job, store, attempt)
        store.write(record)
        return Outcome(job.id, "recorded", record.status, True, record.note)


def measure(task: Task, config: dict[str, Any], bench: Bench) -> TrialOutcome:
    """Run a task on its plain configuration."""
    return task.load()(build(task.schema, config, "config"), bench)


def _blank(job: Job, attempt: int) -> TrialRecord:
    """Return the record of a trial before it runs."""
    path = Store(Path(job.store)).record_path(job.id)
    return TrialRecord(
        job.id, job.task, torchreg.__version__, job.config, int(job.config.get("seed", 0)), "done",
        threads=job.threads, engine=job.engine, attempt=attempt, session=job.session,
        started=datetime.now(UTC).isoformat(timespec="seconds"), rerun=f"python -m {__package__} rerun {path}",
        **provenance(),
    )  # fmt: skip


def _gave_up(job: Job, attempt: int) -> TrialRecord:
    note = f"the process that ran this trial died {attempt - 1} times, without memory perhaps"
    return replace(_blank(job, attempt), status="failed", note=note, traceback=note)


def _run(job: Job, store: Store, attempt: int) -> TrialRecord:
    record, task, begin = _blank(job, attempt), find_task(job.task), time.perf_counter()
    with warnings.catch_warnings(record=True) as told, _peak_memory() as peak:
        warnings.simplefilter("always")
        try:
            use_threads(job.threads)
            task.load()
            # Once more, for the libraries that came with the task; their loading is no part of the trial's time.
            use_threads(job.threads)
            bench = Bench(_device(job), store.artifacts(job.id))
            record = replace(record, device=bench.device if bench.device == "cpu" else _gpu_name())
            begin, busy = time.perf_counter(), time.process_time()
            found = measure(task, job.config, bench)
            # What other programs take away from a busy machine shows in all seconds but these.
            seconds = found.seconds | {"cpu": time.process_time() - busy}
            record = replace(
                record, metrics=found.metrics, seconds=seconds, curves=found.curves, artifacts=found.artifacts
            )
        except SkippedTrial as reason:
            record = replace(record, status="skipped", note=str(reason))
        except StoreError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever a trial raises is its result
            note = f"{type(error).__name__}: {error}"
            record = replace(record, status="failed", note=note, traceback=traceback.format_exc())
        wall = time.perf_counter() - begin
    texts = tuple(dict.fromkeys(f"{warning.category.__name__}: {warning.message}" for warning in told))
    return replace(
        record, warnings=texts[:_MAX_WARNINGS], wall_seconds=wall, peak_memory_mb=peak[0], peak_gpu_memory_mb=peak[1]
    )


@contextlib.contextmanager
def _ended_after(job: Job, store: Store, attempt: int) -> Iterator[None]:
    """Record a trial as failed, and end this process, unless the block is left before the trial's time is over.

    The process is at the trial's mercy: only its end is sure to end the trial.
    """
    if job.timeout is None:
        yield
        return
    # Of the record and the end of the process, one thread decides.
    seconds, over = job.timeout, threading.Lock()

    def end() -> None:
        if over.acquire(blocking=False):
            note = f"timed out after {seconds:g} s"
            store.write(replace(_blank(job, attempt), status="failed", note=note, traceback=note, wall_seconds=seconds))
            store.claim_path(job.id).unlink(missing_ok=True)
            os._exit(1)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    # Should the trial not let any other thread of Python run, it ends all the same, and counts as an attempt.
    faulthandler.dump_traceback_later(seconds + _GRACE_SECONDS, exit=True)
    try:
        yield
        if not over.acquire(blocking=False):
            time.sleep(2 * _GRACE_SECONDS)  # the other thread ends the process
    finally:
        timer.cancel()
        faulthandler.cancel_dump_traceback_later()


def _device(job: Job) -> str:
    if not job.accelerated:
        return "cpu"
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _gpu_name() -> str:
    import torch

    return str(torch.cuda.get_device_name())


@contextlib.contextmanager
def _peak_memory() -> Iterator[list[float]]:
    """Yield a list that holds the peak of the process and of the accelerator in MB once the block is left."""
    peak = [0.0, 0.0]
    # Linux starts counting anew on this; elsewhere the peak is that of all trials of the process so far.
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    accelerator = "torch" in sys.modules and sys.modules["torch"].cuda.is_initialized()
    if accelerator:
        sys.modules["torch"].cuda.reset_peak_memory_stats()
    yield peak
    peak[0] = _peak_megabytes()
    if "torch" in sys.modules and sys.modules["torch"].cuda.is_initialized():
        peak[1] = sys.modules["torch"].cuda.max_memory_allocated() / _MEGABYTE


def _peak_megabytes() -> float:
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    scale = _MEGABYTE if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale
