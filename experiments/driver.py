"""A sweep from plan to results: finished trials are kept, missing ones are run."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from .engines.base import Engine
from .errors import CorruptRecordError
from .plan import PlannedTrial, planned_trials
from .records import TrialRecord
from .registry import find_task
from .schema import SweepConfig
from .sinks import Sink
from .store import Store
from .worker import Job, Outcome, finished

# How long to wait before asking again for trials that another driver runs.
_BUSY_SECONDS = 0.3
# Rounds without any progress after which trials whose process never begins are given up.
_MAX_IDLE_ROUNDS = 3


@dataclass
class Summary:
    """Counts of a driver's run.

    Args:
        planned: number of different trials.
        kept: that were finished before.
        ran: that were run now, by this driver.
        elsewhere: that another driver ran meanwhile.
        failed: of all, those that failed.
        skipped: of all, those that had nothing to do.
        unfinished: trials without a record, as no process could run them.
        set_aside: messages about files that were no records.
        foreign: records in the folder that belong to other configurations.
    """

    planned: int = 0
    kept: int = 0
    ran: int = 0
    elsewhere: int = 0
    failed: int = 0
    skipped: int = 0
    unfinished: int = 0
    set_aside: list[str] = field(default_factory=list)
    foreign: int = 0


OnOutcome = Callable[[Outcome, Summary], None]


def run_sweep(
    sweep: SweepConfig,
    store: Store,
    start_engine: Callable[[], Engine],
    *,
    engine_name: str = "local",
    threads: int = 1,
    retry_failed: bool = False,
    timeout: float | None = None,
    on_outcome: OnOutcome | None = None,
    sinks: Sequence[Sink] = (),
) -> Summary:
    """Run the missing trials of a sweep, and return their counts.

    Args:
        sweep: which trials there are.
        store: folder of the results; drivers may share it.
        start_engine: makes the engine; not called if nothing is missing.
        engine_name: for the records.
        threads: of each worker.
        retry_failed: whether trials that failed or were skipped run again.
        timeout: seconds after which a trial is ended and recorded as failed; None waits for ever.
        on_outcome: called after each trial.
        sinks: called with each new record.

    Raises:
        ConfigError: if a case or axis does not fit the task.
        StoreError: if results cannot be written.
    """
    trials = {trial.id: trial for trial in planned_trials(sweep)}
    store.prepare()
    store.write_sweep(sweep)
    session, summary = secrets.token_hex(4), Summary(planned=len(trials))
    waiting = []
    for trial in trials.values():
        record = _known(store, trial.id, summary)
        if record is not None and finished(record, session, retry_failed):
            summary.kept += 1
            _count(record.status, summary)
        else:
            job = _job(sweep, trial, store, session, engine_name, threads, retry_failed)
            waiting.append(replace(job, timeout=timeout))
    summary.foreign = sum(path.stem not in trials for path in store.trials.glob("*.json"))
    if waiting:
        engine = start_engine()
        try:
            for outcome in _rounds(engine, waiting):
                _tally(outcome, summary)
                if on_outcome is not None:
                    on_outcome(outcome, summary)
                if outcome.fresh and sinks:
                    _tell(store.read(outcome.id), sinks)
        finally:
            engine.close()
    summary.unfinished = summary.planned - summary.kept - summary.ran - summary.elsewhere
    return summary


def _rounds(engine: Engine, jobs: list[Job]) -> Iterator[Outcome]:
    """Yield the outcomes of jobs that end with a record; lost ones and those of other processes are repeated."""
    idle = 0
    while jobs and idle < _MAX_IDLE_ROUNDS:
        remaining, again, lost = {job.id: job for job in jobs}, [], False
        for outcome in engine.run(jobs):
            job = remaining.pop(outcome.id)
            outcome = _recorded_last(job) or outcome if outcome.state == "lost" else outcome
            if outcome.state == "recorded":
                yield outcome
            else:
                again.append(job)
                lost |= outcome.state == "lost"
        # A worker that takes a trial counts attempts and gives up itself: only processes that never begin get here.
        idle = idle + 1 if lost and len(again) == len(jobs) and not _begun(again) else 0
        jobs = [*again, *remaining.values()]
        if jobs:
            time.sleep(_BUSY_SECONDS)


def _recorded_last(job: Job) -> Outcome | None:
    """Return the outcome of a job whose process ended once it had written the record, as after a timeout."""
    try:
        record = Store(Path(job.store)).read(job.id)
    except CorruptRecordError:
        return None
    if record is None or record.session != job.session:
        return None
    return Outcome(job.id, "recorded", record.status, True, record.note)


def _begun(jobs: Sequence[Job]) -> bool:
    return any(Store(Path(job.store)).claim_path(job.id).exists() for job in jobs)


def _job(
    sweep: SweepConfig, trial: PlannedTrial, store: Store, session: str, engine: str, threads: int, retry: bool
) -> Job:
    accelerated = find_task(sweep.task).accelerated
    root = str(store.root.absolute())
    return Job(root, sweep.task, trial.id, trial.config, session, engine, threads, accelerated, retry)


def _known(store: Store, trial: str, summary: Summary) -> TrialRecord | None:
    try:
        return store.read(trial)
    except CorruptRecordError as error:
        # The worker that runs the trial again sets the file aside.
        summary.set_aside.append(str(error))
        return None


def _tally(outcome: Outcome, summary: Summary) -> None:
    if outcome.fresh:
        summary.ran += 1
    else:
        summary.elsewhere += 1
    _count(outcome.status, summary)


def _count(status: str, summary: Summary) -> None:
    summary.failed += status == "failed"
    summary.skipped += status == "skipped"


def _tell(record: TrialRecord | None, sinks: Sequence[Sink]) -> None:
    if record is not None:
        for sink in sinks:
            sink(record)
