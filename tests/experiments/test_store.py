"""Records, claims and tables on disk: whole or named as damaged, and nothing is lost."""

import errno
import json
import math
import multiprocessing
import os
import signal
from dataclasses import replace

import pytest

pytest.importorskip("duckdb", reason="experiments take the extra experiments")

import duckdb
import pyarrow.parquet as pq

from experiments.claims import claimed, is_claimed
from experiments.driver import run_sweep
from experiments.errors import ConfigError, CorruptRecordError, StoreError
from experiments.plan import planned_trials
from experiments.records import TrialRecord, parse_record, provenance
from experiments.report.page import write_report
from experiments.schema import ProbeTrial, ReportConfig
from experiments.store import same_sweep
from experiments.tables import query_records, write_parquet


@pytest.fixture
def record(probe_sweep):
    trial, version = planned_trials(probe_sweep())[0], provenance()["versions"]["torchreg"]
    return TrialRecord(trial.id, "probe", version, trial.config, 0, "done", {"value": 0.1 + 0.2}, {"compute": 1e-3})


def test_a_record_comes_back_bit_for_bit_and_knows_where_it_was_made(record):
    assert parse_record(record.to_json(), "x.json", record.id) == record
    odd = replace(record, metrics={"a": math.nan, "b": math.inf}, curves={"c": [1.0, math.nan]})
    found = parse_record(odd.to_json(), "x.json")
    assert (found.metrics, found.curves) == ({"a": None, "b": None}, {"c": [1.0, None]})
    found = provenance()
    assert set(found["versions"]) >= {"torch", "numpy", "torchreg", "python"}
    assert found["host"]
    assert isinstance(found["commit"], str)


def test_cut_edited_and_exchanged_records_are_noticed(record):
    whole = record.to_json()
    for length in range(0, len(whole), 97):
        with pytest.raises(CorruptRecordError):
            parse_record(whole[:length], "x.json")
    data = json.loads(whole)
    data["config"]["scale"] = 7.0
    with pytest.raises(CorruptRecordError, match="configuration or version were changed after the trial ran"):
        parse_record(json.dumps(data).encode(), "x.json")
    with pytest.raises(CorruptRecordError, match="holds the record of another trial"):
        parse_record(whole, "x.json", "0123")


@pytest.fixture
def fail_to_write(monkeypatch):
    def fail(number):
        def fsync(handle):
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fsync)

    return fail


def test_records_are_written_and_a_full_disk_leaves_the_old_one(store, record, fail_to_write):
    store.prepare()
    assert store.read(record.id) is None
    store.write(replace(record, note="first"))
    store.write(record)
    assert store.records() == ([record], [])
    before = store.record_path(record.id).read_bytes()
    fail_to_write(errno.ENOSPC)
    message = r"cannot be written: No space left on device; free some space and give the same"
    with pytest.raises(StoreError, match=message):
        store.write(replace(record, note="again"))
    assert store.record_path(record.id).read_bytes() == before
    assert [path.name for path in store.trials.iterdir()] == [f"{record.id}.json"]


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, None])
def test_folders_that_cannot_be_written_are_found_before_anything_runs(store, fail_to_write, number):
    if number is None:
        store.root.write_text("")
    else:
        fail_to_write(number)
    message = "make the folder writable, or name another one with --results"
    with pytest.raises(StoreError, match=message if number else r"results cannot be written: .*; check the path"):
        store.prepare()


def test_a_sweep_is_kept_and_read_back(store, probe_sweep):
    store.prepare()
    assert store.read_sweep() is None
    sweep = probe_sweep(cases=({"case": "a", "size": 3},), report=ReportConfig(metrics=("value",)))
    store.write_sweep(sweep)
    assert same_sweep(store.read_sweep(), sweep)
    assert not same_sweep(sweep, probe_sweep())
    (store.root / "sweep.json").write_text("{")
    with pytest.raises(StoreError, match=r"sweep.json is damaged .*; delete it and start the sweep again, results"):
        store.read_sweep()
    for content in (b"[" * 100_000, b"null", b"[1]", b"\xff", b'{"trial": 3'):
        (store.root / "sweep.json").write_bytes(content)
        with pytest.raises((StoreError, ConfigError)):
            store.read_sweep()


@pytest.mark.parametrize("name", ["../../x", "/abs", "a/../../x", "..", "", " ", "a//b", "C:x", "a\\..\\..\\b", "a\nb"])
def test_names_stay_inside_the_results(name, probe_sweep):
    with pytest.raises(ValueError, match="name must be that of a folder below the results"):
        probe_sweep(name)


def changed(path, *place, value):
    document = json.loads(path.read_text())
    inner = document
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path.write_text(json.dumps(document))


def folder_instead(path):
    path.unlink()
    path.mkdir()
    (path / "inside").touch()


DAMAGES = {
    "a NaN in its configuration": lambda path: path.write_text(
        path.read_text().replace('"scale": 1.0', '"scale": NaN')
    ),
    "an edited configuration": lambda path: changed(path, "config", "scale", value=9.0),
    "text for a metric": lambda path: changed(path, "metrics", "value", value="high"),
    "a list for a metric": lambda path: changed(path, "metrics", "value", value=[1]),
    "text for seconds": lambda path: changed(path, "seconds", "cpu", value="long"),
    "text in a curve": lambda path: changed(path, "curves", "norm", value=[1.0, "x"]),
    "an infinite metric": lambda path: path.write_text(path.read_text().replace('"cpu": ', '"cpu": 1e999, "x": ')),
    "a cut": lambda path: path.write_bytes(path.read_bytes()[:-40]),
    "nothing": lambda path: path.write_bytes(b""),
    "brackets": lambda path: path.write_bytes(b"[" * 100_000),
    "no text": lambda path: path.write_bytes(b"\xff\xfe\x00"),
    "a folder": folder_instead,
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_record_is_named_left_out_and_run_again(damage, store, probe_sweep, inline_engine, tmp_path):
    sweep = probe_sweep()
    run_sweep(sweep, store, lambda: inline_engine)
    broken = next(path for path in sorted(store.trials.glob("*.json")) if '"scale": 1.0' in path.read_text())
    damage(broken)
    count, bad = write_parquet(store)
    assert count == 2
    assert broken.name in str(bad[0])
    assert "2" in query_records(store, "select count(*) from trials")
    page = write_report(sweep, store, tmp_path / "report.html", [])
    assert broken.name in page.read_text(encoding="utf-8")
    again = run_sweep(sweep, store, lambda: inline_engine)
    assert (again.ran, again.kept, again.failed) == (1, 2, 0)
    assert broken.name in again.set_aside[0]
    # Nothing is deleted: what was damaged is kept under another name.
    assert broken.with_name(f"{broken.name}.corrupt-1").exists()
    assert write_parquet(store) == (3, [])


@pytest.fixture
def filled(store, probe_sweep, inline_engine):
    sweep = probe_sweep(trial=ProbeTrial(rounds=3), grid={"outcome": ["done", "failed"], "scale": [1.0, 2.0]}, seeds=2)
    run_sweep(sweep, store, lambda: inline_engine)
    return store


def test_one_table_holds_all_records(filled):
    assert write_parquet(filled) == (8, [])
    table = pq.read_table(filled.parquet)
    wanted = {"id", "status", "config.scale", "metrics.value", "seconds.compute", "curves.norm"}
    assert (table.num_rows, wanted <= set(table.column_names)) == (8, True)
    for row in table.to_pylist():
        record = filled.read(row["id"])
        assert row["config.scale"] == record.config["scale"]
        assert row["metrics.value"] == record.metrics.get("value")
        assert row["curves.norm"] == record.curves.get("norm")
        assert json.loads(row["versions"]) == record.versions
    ask = f"SELECT avg(\"metrics.value\") FROM '{filled.parquet}' WHERE status = 'done'"
    values = [record.metrics["value"] for record in filled.records()[0] if record.status == "done"]
    assert duckdb.sql(ask).fetchall()[0][0] == pytest.approx(sum(values) / len(values), rel=1e-12)


def test_queries_read_the_newest_records_even_over_a_damaged_table(filled, probe_sweep, inline_engine):
    assert "8" in query_records(filled, "SELECT count(*) FROM trials")
    run_sweep(probe_sweep(seeds=9, grid={"scale": [5.0]}), filled, lambda: inline_engine)
    filled.parquet.write_bytes(b"PAR1 no more")
    assert "17" in query_records(filled, "SELECT count(*) FROM trials")
    with pytest.raises(ConfigError, match="the query was not understood"):
        query_records(filled, "SELECT nonsense FROM trials")


def _hold(path, connection):
    with claimed(path, "s") as attempt:
        connection.send(attempt)
        connection.recv()


@pytest.mark.parametrize("killed", [False, True])
def test_one_process_has_a_claim_which_is_free_after_its_end(tmp_path, killed):
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_hold, args=(tmp_path / "c", theirs))
    process.start()
    assert ours.recv() == 1
    assert is_claimed(tmp_path / "c")
    with claimed(tmp_path / "c", "s") as attempt:
        assert attempt == 0
    if killed:
        os.kill(process.pid, signal.SIGKILL)
    else:
        ours.send("done")
    process.join()
    assert not is_claimed(tmp_path / "c")
    # A killed process leaves a trace: the next attempt is the second.
    with claimed(tmp_path / "c", "s") as attempt:
        assert attempt == 1 + killed
    assert not (tmp_path / "c").exists()
