import json
import os
import warnings
from dataclasses import replace

import pytest

from experiments import worker
from experiments.claims import claimed
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


def test_a_trial_leaves_a_whole_record(store, make_job):
    job = make_job()
    assert execute(job).fresh
    record = store.read(job.id)
    assert record.status == "done"
    assert (record.config, record.seed, record.engine, record.threads, record.device) == (
        job.config,
        0,
        "local",
        1,
        "cpu",
    )
    assert record.wall_seconds > 0
    assert record.peak_memory_mb > 1
    assert record.started.endswith("+00:00")
    assert str(store.record_path(job.id)) in record.rerun
    assert json.loads(store.record_path(job.id).read_text())["versions"]["torch"]
    assert not store.claim_path(job.id).exists()


def test_a_finished_trial_does_not_run_again(store, make_job):
    job = make_job()
    execute(job)
    path = store.record_path(job.id)
    # Not all of stat: reading a file changes the time of its last access.
    before = path.stat().st_ino, path.stat().st_mtime_ns, path.read_bytes()
    outcome = execute(replace(job, session="t", retry=True))
    assert (outcome.state, outcome.fresh) == ("recorded", False)
    assert (path.stat().st_ino, path.stat().st_mtime_ns, path.read_bytes()) == before


def test_a_failure_is_recorded_with_its_traceback_and_retried_on_request_only(store, make_job):
    job = make_job(outcome="failed")
    assert execute(job).status == "failed"
    record = store.read(job.id)
    assert record.note == "ValueError: the probe was told to fail"
    assert 'raise ValueError("the probe was told to fail")' in record.traceback
    assert not execute(replace(job, session="t")).fresh
    assert execute(replace(job, session="t", retry=True)).fresh
    # Two drivers that retry do not run it twice for one session.
    assert not execute(replace(job, session="t", retry=True)).fresh


def test_a_trial_without_anything_to_do_says_why(store, make_job):
    job = make_job(outcome="skipped")
    assert execute(job).status == "skipped"
    assert store.read(job.id).note == "there is nothing to probe"


def test_a_trial_that_someone_else_runs_is_left_alone(store, make_job):
    job = make_job()
    with claimed(store.claim_path(job.id), "other"):
        assert execute(job).state == "busy"
    assert store.read(job.id) is None


def test_a_trial_that_ends_its_process_again_and_again_is_given_up(store, make_job):
    job = make_job(outcome="killed")
    for _ in range(worker.MAX_ATTEMPTS):
        with pytest.raises(KeyboardInterrupt), claimed(store.claim_path(job.id), job.session):
            raise KeyboardInterrupt
    assert execute(job).status == "failed"
    assert "died 3 times" in store.read(job.id).note
    assert store.read(job.id).attempt == 4


@pytest.mark.parametrize("content", ["{", "", "edited"])
def test_a_damaged_record_is_kept_aside_and_the_trial_runs_again(store, make_job, content):
    job = make_job()
    execute(job)
    path = store.record_path(job.id)
    text = path.read_text().replace('"scale": 1.0', '"scale": 9.0') if content == "edited" else content
    path.write_text(text)
    assert execute(job).fresh
    assert store.read(job.id).status == "done"
    assert path.with_name(f"{path.name}.corrupt-1").read_text() == text


def test_warnings_and_odd_numbers_are_recorded(store, make_job, monkeypatch):
    def measure(task, config, bench):
        warnings.warn("beware", UserWarning, stacklevel=1)
        return TrialOutcome({"value": float("nan")})

    monkeypatch.setattr(worker, "measure", measure)
    job = make_job()
    execute(job)
    record = store.read(job.id)
    assert record.warnings == ("UserWarning: beware",)
    assert record.metrics == {"value": None}


def test_threads_are_set_for_libraries_that_are_loaded_and_to_come(monkeypatch):
    import torch

    for name in worker.THREAD_VARIABLES:
        monkeypatch.setenv(name, "7")
    use_threads(1)
    assert torch.get_num_threads() == 1
    assert {os.environ[name] for name in worker.THREAD_VARIABLES} == {"1"}
