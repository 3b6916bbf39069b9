"""Records as tables: one Parquet file for all of them, queried by DuckDB."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from .errors import ConfigError, CorruptRecordError, ExperimentError
from .records import TrialRecord
from .store import Store, explained
from .structure import flatten

try:
    import duckdb
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise ExperimentError(f"{error.name} is not installed: pip install 'torchreg-articulated[experiments]'") from error

# Columns whose fields become columns of their own, with dotted names.
_NESTED = ("config", "metrics", "seconds", "curves", "artifacts")


def as_table(records: Sequence[TrialRecord]) -> Any:
    """Return an Arrow table with a row per record: its fields, and ``config.KEY``, ``metrics.NAME`` and so on."""
    rows = [_row(record) for record in records]
    names = list(dict.fromkeys(name for row in rows for name in row))
    return pa.table({name: _column([row.get(name) for row in rows]) for name in names} if rows else {"id": []})


def write_parquet(store: Store) -> tuple[int, list[CorruptRecordError]]:
    """Write the table of all records of a folder; return their number, and the corrupt files.

    Raises:
        StoreError: if the file cannot be written.
    """
    records, bad = store.records()
    with explained(store.parquet):
        temporary = store.parquet.with_suffix(".part")
        pq.write_table(as_table(records), temporary)
        temporary.replace(store.parquet)
    return len(records), bad


def query_records(store: Store, sql: str) -> str:
    """Return DuckDB's answer about the table ``trials``, which is collected first if records are newer.

    Raises:
        ConfigError: if DuckDB does not understand the question.
        StoreError: if the table cannot be written.
    """
    _collect_if_older(store)
    with duckdb.connect() as connection:
        try:
            trials = connection.read_parquet(str(store.parquet))
        except duckdb.Error:  # damaged: the records hold all of it
            write_parquet(store)
            trials = connection.read_parquet(str(store.parquet))
        connection.register("trials", trials)
        try:
            return str(connection.sql(sql) or "")
        except duckdb.Error as error:
            raise ConfigError(f"the query was not understood: {error}") from error


def _collect_if_older(store: Store) -> None:
    # The time of the folder changes whenever a record is added or replaced.
    newest = store.trials.stat().st_mtime if store.trials.is_dir() else 0.0
    if not store.parquet.exists() or store.parquet.stat().st_mtime < newest:
        write_parquet(store)


def _row(record: TrialRecord) -> dict[str, Any]:
    row = {name: value for name, value in vars(record).items() if name not in (*_NESTED, "versions")}
    row["versions"] = json.dumps(record.versions)
    row["warnings"] = list(record.warnings)
    for name in _NESTED:
        row |= flatten(getattr(record, name), name)
    return row


def _column(values: list[Any]) -> Any:
    """Return an Arrow column of values, or of their texts if they have several types."""
    known = [value for value in values if value is not None]
    if known and all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in known):
        integers = all(isinstance(value, int) for value in known)
        return pa.array(values, pa.int64() if integers else pa.float64())
    try:
        return pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        return pa.array([None if value is None else json.dumps(value) for value in values])
