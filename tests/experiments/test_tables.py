import json

import pytest

pytest.importorskip("duckdb", reason="experiments take the extra experiments")

import duckdb
import pyarrow.parquet as pq

from experiments.driver import run_sweep
from experiments.errors import ConfigError
from experiments.plan import planned_trials
from experiments.schema import ProbeTrial
from experiments.tables import query_records, write_parquet


@pytest.fixture
def filled(store, probe_sweep, inline_engine):
    sweep = probe_sweep(trial=ProbeTrial(rounds=3), grid={"outcome": ["done", "failed"], "scale": [1.0, 2.0]}, seeds=2)
    run_sweep(sweep, store, lambda: inline_engine)
    return store


def test_one_table_holds_all_records(filled):
    assert write_parquet(filled) == (8, [])
    table = pq.read_table(filled.parquet)
    assert table.num_rows == 8
    assert {"id", "status", "config.scale", "metrics.value", "seconds.compute", "curves.norm"} <= set(
        table.column_names
    )
    for row in table.to_pylist():
        record = filled.read(row["id"])
        assert row["config.scale"] == record.config["scale"]
        assert row["metrics.value"] == record.metrics.get("value")
        assert row["curves.norm"] == record.curves.get("norm")
        assert json.loads(row["versions"]) == record.versions


def test_duckdb_reads_the_file_and_agrees_with_the_records(filled):
    write_parquet(filled)
    ask = f"SELECT avg(\"metrics.value\") FROM '{filled.parquet}' WHERE status = 'done'"
    values = [record.metrics["value"] for record in filled.records()[0] if record.status == "done"]
    assert duckdb.sql(ask).fetchall()[0][0] == pytest.approx(sum(values) / len(values), rel=1e-12)


def test_questions_are_answered_from_the_newest_records(filled, probe_sweep, inline_engine):
    assert "8" in query_records(filled, "SELECT count(*) FROM trials")
    run_sweep(probe_sweep(seeds=9, grid={"scale": [5.0]}), filled, lambda: inline_engine)
    assert "17" in query_records(filled, "SELECT count(*) FROM trials")
    with pytest.raises(ConfigError, match="the query was not understood"):
        query_records(filled, "SELECT nonsense FROM trials")


def test_damaged_records_are_left_out_and_told(filled):
    path = next(iter(filled.trials.glob("*.json")))
    path.write_text("{")
    count, bad = write_parquet(filled)
    assert (count, len(bad)) == (7, 1)
    assert path.name in str(bad[0])


def test_an_empty_folder_gives_an_empty_table(store):
    store.prepare()
    assert write_parquet(store) == (0, [])
    assert pq.read_table(store.parquet).num_rows == 0


def test_values_of_several_kinds_share_a_column(store, probe_sweep, inline_engine):
    """Fields that are a number here and a list there are kept as texts."""
    from experiments.tables import as_table

    run_sweep(probe_sweep(), store, lambda: inline_engine)
    records = [store.read(trial.id) for trial in planned_trials(probe_sweep())]
    records[0].config["scale"] = [1, 2]
    table = as_table(records)
    assert table["config.scale"].to_pylist() == ["[1, 2]", "2.0", "3.0"]
    records[0].config["scale"] = 1
    assert as_table(records)["config.scale"].to_pylist() == [1.0, 2.0, 3.0]
