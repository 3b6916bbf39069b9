"""Trials in a worker and sweeps by a driver: each runs once, and whatever happens is recorded."""

import json
import os
import time
import warnings
from dataclasses import replace

import pytest
import torch

from experiments import worker
from experiments.claims import claimed
from experiments.driver import run_sweep
from experiments.engines.base import EngineConfig
from experiments.engines.local import LocalEngine
from experiments.plan import planned_trials
from experiments.registry import TrialOutcome
from experiments.schema import ProbeTrial
from experiments.worker import Job, execute, use_threads


@pytest.fixture
def make_job(store, probe_sweep):
    store.prepare()

    def make(session="s", **settings):
        trial = planned_trials(probe_sweep(trial=ProbeTrial(**settings)))[0]
        return Job(str(store.root), "probe", trial.id, trial.config, session)

    return make


def test_a_trial_leaves_a_whole_record_and_does_not_run_again(store, make_job):
    job = make_job()
    assert execute(job).fresh
    record, path = store.read(job.id), store.record_path(job.id)
    assert (record.status, record.config, record.seed) == ("done", job.config, 0)
    assert (record.engine, record.threads, record.device) == ("local", 1, "cpu")
    assert record.wall_seconds > 0
    assert record.peak_memory_mb > 1
    assert record.started.endswith("+00:00")
    assert str(path) in record.rerun
    assert json.loads(path.read_text())["versions"]["torch"]
    assert not store.claim_path(job.id).exists()
    # Not all of stat: reading a file changes the time of its last access.
    before = path.stat().st_ino, path.stat().st_mtime_ns, path.read_bytes()
    outcome = execute(replace(job, session="t", retry=True))
    assert (outcome.state, outcome.fresh) == ("recorded", False)
    assert (path.stat().st_ino, path.stat().st_mtime_ns, path.read_bytes()) == before


def test_a_trial_is_left_to_who_runs_it_and_given_up_after_ending_its_process_again_and_again(store, make_job):
    job = make_job()
    with claimed(store.claim_path(job.id), "other"):
        assert execute(job).state == "busy"
    assert store.read(job.id) is None
    job = make_job(outcome="killed")
    for _ in range(worker.MAX_ATTEMPTS):
        with pytest.raises(KeyboardInterrupt), claimed(store.claim_path(job.id), job.session):
            raise KeyboardInterrupt
    assert execute(job).status == "failed"
    assert "died 3 times" in store.read(job.id).note
    assert store.read(job.id).attempt == 4


def test_warnings_and_odd_numbers_are_recorded_and_threads_are_set(store, make_job, monkeypatch):
    def measure(task, config, bench):
        warnings.warn("beware", UserWarning, stacklevel=1)
        return TrialOutcome({"value": float("nan")})

    monkeypatch.setattr(worker, "measure", measure)
    job = make_job()
    execute(job)
    record = store.read(job.id)
    assert (record.warnings, record.metrics) == (("UserWarning: beware",), {"value": None})
    for name in worker.THREAD_VARIABLES:
        monkeypatch.setenv(name, "7")
    use_threads(1)
    assert torch.get_num_threads() == 1
    assert {os.environ[name] for name in worker.THREAD_VARIABLES} == {"1"}


def run(sweep, store, engine, **settings):
    return run_sweep(sweep, store, lambda: engine, **settings)


def test_a_trial_that_hangs_is_ended_and_recorded_as_such(store, probe_sweep):
    sweep = probe_sweep(grid={"seconds": [60.0, 0.0]})
    outcomes, begin = [], time.perf_counter()
    summary = run(
        sweep, store, LocalEngine(EngineConfig()), timeout=5.0, on_outcome=lambda *row: outcomes.append(row[0])
    )
    assert time.perf_counter() - begin < 50
    assert (summary.ran, summary.failed, summary.unfinished) == (2, 1, 0)
    assert [outcome.note for outcome in outcomes if outcome.note] == ["timed out after 5 s"]
    records, bad = store.records()
    assert not bad
    (record,) = (record for record in records if record.status == "failed")
    assert (record.attempt, record.wall_seconds) == (1, 5.0)
