import errno
import os

import pytest

from experiments import driver
from experiments.driver import run_sweep
from experiments.errors import StoreError
from experiments.plan import planned_trials
from experiments.schema import ProbeTrial
from experiments.worker import Outcome


def run(sweep, store, engine, **settings):
    return run_sweep(sweep, store, lambda: engine, **settings)


def test_a_sweep_runs_once(store, probe_sweep, inline_engine):
    sweep, told = probe_sweep(seeds=4), []
    summary = run(sweep, store, inline_engine, on_outcome=lambda outcome, so_far: told.append(so_far.ran))
    assert (summary.planned, summary.ran, summary.kept, summary.unfinished) == (12, 12, 0, 0)
    assert told == list(range(1, 13))
    again = run(sweep, store, None)
    assert (again.ran, again.kept, again.unfinished) == (0, 12, 0)


def test_a_longer_sweep_runs_what_is_new(store, probe_sweep, inline_engine):
    run(probe_sweep(seeds=1), store, inline_engine)
    summary = run(probe_sweep(seeds=3), store, inline_engine)
    assert (summary.kept, summary.ran) == (3, 6)
    assert set(inline_engine.ran.values()) == {1}


def test_failed_trials_run_again_on_request_only(store, probe_sweep, inline_engine):
    sweep = probe_sweep(grid={"outcome": ["done", "failed", "skipped"]})
    first = run(sweep, store, inline_engine)
    assert (first.failed, first.skipped, first.ran) == (1, 1, 3)
    again = run(sweep, store, inline_engine)
    assert (again.kept, again.ran, again.failed, again.skipped) == (3, 0, 1, 1)
    retried = run(sweep, store, inline_engine, retry_failed=True)
    assert (retried.kept, retried.ran) == (1, 2)


def test_an_edited_configuration_keeps_the_old_results(store, probe_sweep, inline_engine):
    run(probe_sweep(trial=ProbeTrial(size=4)), store, inline_engine)
    before = {path.name: path.read_bytes() for path in store.trials.iterdir()}
    summary = run(probe_sweep(trial=ProbeTrial(size=5)), store, inline_engine)
    assert (summary.ran, summary.kept, summary.foreign) == (3, 0, 3)
    after = {path.name: path.read_bytes() for path in store.trials.iterdir()}
    assert len(after) == 6
    assert before.items() <= after.items()
    assert run(probe_sweep(trial=ProbeTrial(size=4)), store, None).kept == 3


def test_damaged_records_are_told_and_made_anew(store, probe_sweep, inline_engine):
    sweep = probe_sweep()
    run(sweep, store, inline_engine)
    one, other, _ = [store.record_path(trial.id) for trial in planned_trials(sweep)]
    one.write_bytes(one.read_bytes()[:100])
    other.write_text(other.read_text().replace('"scale": 2.0', '"scale": 2.5'))
    summary = run(sweep, store, inline_engine)
    assert (summary.kept, summary.ran, len(summary.set_aside)) == (1, 2, 2)
    assert "changed after the trial ran" in summary.set_aside[1]
    assert len(list(store.trials.glob("*.corrupt-1"))) == 2


def test_a_disk_that_fills_up_stops_the_sweep_and_loses_nothing(store, probe_sweep, inline_engine, monkeypatch):
    sweep, real, left = probe_sweep(seeds=2), os.fsync, [8]

    def fsync(handle):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        with pytest.raises(
            StoreError, match="No space left on device; free some space and give the same command again"
        ):
            run(sweep, store, inline_engine)
    kept = len(list(store.trials.glob("*.json")))
    assert 0 < kept < 6
    summary = run(sweep, store, inline_engine)
    assert (summary.kept, summary.ran, summary.unfinished) == (kept, 6 - kept, 0)


class StubbornEngine:
    """Loses every trial before it begins."""

    def __init__(self):
        self.rounds = 0

    def run(self, jobs):
        self.rounds += 1
        for job in jobs:
            yield Outcome(job.id, "lost")

    def close(self):
        pass


def test_processes_that_never_begin_are_not_started_for_ever(store, probe_sweep, monkeypatch):
    monkeypatch.setattr(driver, "_BUSY_SECONDS", 0)
    engine = StubbornEngine()
    assert run(probe_sweep(), store, engine).unfinished == 3
    assert engine.rounds == 3


def test_new_records_go_to_the_sinks(store, probe_sweep, inline_engine):
    told = []
    run(probe_sweep(), store, inline_engine, sinks=[told.append])
    assert [record.config["scale"] for record in told] == [1.0, 2.0, 3.0]
    run(probe_sweep(), store, inline_engine, sinks=[told.append])
    assert len(told) == 3
