import errno
import os
import time
from dataclasses import replace

import pytest

from experiments.errors import CorruptRecordError, StoreError
from experiments.plan import planned_trials
from experiments.records import TrialRecord, provenance
from experiments.schema import ReportConfig
from experiments.store import same_sweep


@pytest.fixture
def record(probe_sweep):
    trial = planned_trials(probe_sweep())[0]
    return TrialRecord(trial.id, "probe", provenance()["versions"]["torchreg"], trial.config, 0, "done", {"value": 1.0})


def fail_to_write(monkeypatch, number):
    def fsync(handle):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fsync)


def test_records_are_written_and_read(store, record):
    store.prepare()
    assert store.read(record.id) is None
    store.write(record)
    assert store.read(record.id) == record
    assert store.records() == ([record], [])
    store.write(replace(record, note="again"))
    assert store.read(record.id).note == "again"


def test_a_full_disk_leaves_the_old_record_and_no_rubbish(store, record, monkeypatch):
    store.prepare()
    store.write(record)
    before = store.record_path(record.id).read_bytes()
    fail_to_write(monkeypatch, errno.ENOSPC)
    with pytest.raises(
        StoreError, match=r"cannot be written: No space left on device; free some space and give the same"
    ):
        store.write(replace(record, note="again"))
    assert store.record_path(record.id).read_bytes() == before
    assert [path.name for path in store.trials.iterdir()] == [f"{record.id}.json"]


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_read_only_folder_is_found_before_anything_runs(store, monkeypatch, number):
    fail_to_write(monkeypatch, number)
    with pytest.raises(StoreError, match="make the folder writable, or name another one with --results"):
        store.prepare()


def test_a_file_in_the_place_of_the_folder_is_named(store):
    store.root.write_text("")
    with pytest.raises(StoreError, match=r"results cannot be written: .*; check the path"):
        store.prepare()


def test_a_damaged_record_is_set_aside_and_never_deleted(store, record):
    store.prepare()
    path = store.record_path(record.id)
    for text in ("first", "second"):
        path.write_text(text)
        with pytest.raises(CorruptRecordError):
            store.read(record.id)
        records, bad = store.records()
        assert (records, len(bad)) == ([], 1)
        store.set_aside(record.id)
    assert sorted(one.read_text() for one in store.trials.iterdir()) == ["first", "second"]
    assert store.records() == ([], [])


def test_rubbish_of_a_crash_is_swept_away_after_a_while(store):
    store.prepare()
    old, new = store.trials / ".a.json.1.part", store.trials / ".b.json.2.part"
    for path in (old, new):
        path.write_text("half")
    os.utime(old, (time.time() - 7200,) * 2)
    store.prepare()
    assert [path.name for path in store.trials.iterdir()] == [new.name]


def test_a_sweep_is_kept_and_read_back(store, probe_sweep):
    store.prepare()
    assert store.read_sweep() is None
    sweep = probe_sweep(cases=({"case": "a", "size": 3},), report=ReportConfig(metrics=("value",)))
    store.write_sweep(sweep)
    assert same_sweep(store.read_sweep(), sweep)
    assert not same_sweep(sweep, probe_sweep())
    (store.root / "sweep.json").write_text("{")
    with pytest.raises(
        StoreError, match=r"sweep.json is damaged .*; delete it and start the sweep again, results stay"
    ):
        store.read_sweep()
