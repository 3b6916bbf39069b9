"""Damaged results and hostile configurations: named, left out, run again; nothing is written or read elsewhere."""

import json
import time

import pytest

pytest.importorskip("duckdb", reason="experiments take the extra experiments")

from experiments.command_line import main
from experiments.compose import load_sweep
from experiments.driver import run_sweep
from experiments.engines.base import EngineConfig
from experiments.engines.local import LocalEngine
from experiments.errors import ConfigError, StoreError
from experiments.report.page import write_report
from experiments.schema import ProbeTrial
from experiments.tables import query_records, write_parquet


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
    assert write_parquet(store) == (3, [])


def test_a_damaged_table_is_made_again(store, probe_sweep, inline_engine):
    run_sweep(probe_sweep(), store, lambda: inline_engine)
    write_parquet(store)
    store.parquet.write_bytes(b"PAR1 no more")
    assert "3" in query_records(store, "select count(*) from trials")


@pytest.mark.parametrize("content", [b"[" * 100_000, b"null", b"[1]", b"\xff", b'{"trial": 3'])
def test_a_damaged_sweep_says_what_to_do(store, content):
    store.root.mkdir()
    (store.root / "sweep.json").write_bytes(content)
    with pytest.raises((StoreError, ConfigError)):
        store.read_sweep()


def test_a_trial_that_hangs_is_ended_and_recorded_as_such(store, probe_sweep):
    sweep = probe_sweep(trial=ProbeTrial(seconds=60.0), grid={"scale": [1.0]})
    outcomes, begin = [], time.perf_counter()
    summary = run_sweep(
        sweep, store, lambda: LocalEngine(EngineConfig()), timeout=0.5, on_outcome=lambda *row: outcomes.append(row[0])
    )
    assert time.perf_counter() - begin < 40
    assert (summary.ran, summary.failed, summary.unfinished) == (1, 1, 0)
    assert outcomes[0].note == "timed out after 0.5 s"
    (record,), bad = store.records()
    assert not bad
    assert (record.status, record.attempt, record.wall_seconds) == ("failed", 1, 0.5)


def test_a_trial_in_time_is_left_alone(store, probe_sweep):
    summary = run_sweep(
        probe_sweep(grid={"scale": [1.0]}), store, lambda: LocalEngine(EngineConfig()), timeout=60.0
    )  # fmt: skip
    assert (summary.ran, summary.failed) == (1, 0)


@pytest.mark.parametrize("name", ["../../x", "/abs", "a/../../x", "..", "", " ", "a//b", "C:x", "a\\..\\..\\b", "a\nb"])
def test_names_stay_inside_the_results(name, probe_sweep):
    with pytest.raises(ValueError, match="name must be that of a folder below the results"):
        probe_sweep(name)


def test_commands_that_only_read_stay_inside_too(tmp_path, monkeypatch, capsys):
    outside = tmp_path / "x"
    outside.mkdir()
    (outside / "sweep.json").write_text("{}")
    monkeypatch.setattr("sys.argv", ["experiments", "collect", "../x", "--results", str(tmp_path / "results")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert "is not below the results" in capsys.readouterr().err


def write(tmp_path, text):
    path = tmp_path / "sweep.yaml"
    path.write_text(text)
    return str(path)


def test_aliases_are_counted_before_they_are_replaced(tmp_path):
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    rows += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    begin = time.perf_counter()
    with pytest.raises(ConfigError, match="more than 100000 values, aliases included"):
        load_sweep(write(tmp_path, "\n".join(rows)))
    assert time.perf_counter() - begin < 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: " + "[" * 200 + "]" * 200, "deep within each other"),
        ("# " + "x" * 1_000_001, "have at most 1000000"),
        ("task: probe\nquestion: ${oc.env:PATH}\n", "environment variables"),
        ("a: &a [*a]", "cannot be read|unknown"),
        ("\t\x00", "cannot be read"),
    ],
)
def test_hostile_configurations_are_refused(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        load_sweep(write(tmp_path, text))


def test_honest_aliases_are_read(tmp_path):
    text = "task: probe\nquestion: &q why\ntrial: {}\ngrid:\n  scale: &s [1.0, 2.0]\n  size: [1]\nreport: {}\n"
    assert load_sweep(write(tmp_path, text)).grid["scale"] == [1.0, 2.0]
