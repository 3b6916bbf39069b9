"""The numbers of a report: medians and spread over seeds, by DuckDB."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import ConfigError
from ..plan import PlannedTrial, axes_of, canonical
from ..records import TrialRecord
from ..schema import SweepConfig
from ..sinks import numbers_of
from ..tables import duckdb, pa


@dataclass(frozen=True)
class Spread:
    """A metric over the seeds of a cell: count, median, quartiles, mean, and the values themselves."""

    count: int
    median: float
    low: float
    high: float
    mean: float
    values: tuple[float, ...] = ()


@dataclass(frozen=True)
class Cell:
    """All seeds of one point of a sweep.

    Args:
        axes: where it is.
        trials: number of them.
        done: number of them that succeeded.
        metrics: by name.
    """

    axes: dict[str, Any]
    trials: int
    done: int
    metrics: dict[str, Spread]


def cells_of(sweep: SweepConfig, trials: Sequence[PlannedTrial], records: dict[str, TrialRecord]) -> list[Cell]:
    """Return the cells of a sweep in its order.

    Args:
        sweep: what was asked.
        trials: of the sweep.
        records: by id; trials without a record count as not done.

    Raises:
        ConfigError: if a metric that the report is to show is in no record.
    """
    keys = {canonical(trial.axes): trial.axes for trial in trials}
    number = {key: index for index, key in enumerate(keys)}
    cells: list[list[PlannedTrial]] = [[] for _ in keys]
    for trial in trials:
        cells[number[canonical(trial.axes)]].append(trial)
    rows = [
        (index, name, value)
        for index, members in enumerate(cells)
        for trial in members
        if trial.id in records and records[trial.id].status == "done"
        for name, value in numbers_of(records[trial.id]).items()
    ]
    spreads = _spreads(rows)
    done = [sum(trial.id in records and records[trial.id].status == "done" for trial in members) for members in cells]
    names = shown_metrics(sweep, known_metrics(records))
    return [
        Cell(axes, len(members), good, {name: spreads[index, name] for name in names if (index, name) in spreads})
        for index, (axes, members, good) in enumerate(zip(keys.values(), cells, done, strict=True))
    ]


def known_metrics(records: dict[str, TrialRecord]) -> list[str]:
    """Return the names of all metrics and seconds in records."""
    metrics = dict.fromkeys(name for record in records.values() for name in record.metrics)
    seconds = dict.fromkeys(f"seconds.{name}" for record in records.values() for name in record.seconds)
    return [*metrics, *seconds]


def shown_metrics(sweep: SweepConfig, found: Sequence[str]) -> list[str]:
    """Return the metrics of the table.

    Raises:
        ConfigError: if the report asks for one that no record has.
    """
    for name in (*sweep.report.metrics, *sweep.report.heat_metrics):
        if found and name not in found:
            raise ConfigError(f"unknown metric {name} in report; known metrics: {', '.join(sorted(found))}")
    return list(sweep.report.metrics) or list(found)


def marginal(cells: Sequence[Cell], axis: str, metric: str, *, share: bool) -> dict[str, float]:
    """Return per value of an axis the median over its cells of a metric's median, or the mean of its mean."""
    rows = [(label(cell.axes[axis]), _value(cell, metric, share)) for cell in cells if metric in cell.metrics]
    if not rows:
        return {}
    table = pa.table({"value": [row[0] for row in rows], "number": [row[1] for row in rows]})
    ask = "SELECT value, {}(number) FROM cells GROUP BY value".format("avg" if share else "median")
    with duckdb.connect() as connection:
        connection.register("cells", table)
        found = dict(connection.execute(ask).fetchall())
    return {value: found[value] for value in dict.fromkeys(row[0] for row in rows)}


def all_axes(sweep: SweepConfig) -> list[str]:
    """Return the names of the axes that have more than one value, or all if none has."""
    axes = axes_of(sweep)
    return [name for name, values in axes.items() if len(values) > 1] or list(axes)


def label(value: Any) -> str:
    """Return a value of an axis as a text, numbers as short as possible."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def number(value: float, digits: int = 4) -> str:
    """Return a number with a number of digits, whole thousands in full."""
    return f"{value:.0f}" if abs(value) >= 10 ** (digits - 1) else f"{value:.{digits}g}"


def short(axis: str) -> str:
    """Return the last part of an axis's name."""
    return axis.rpartition(".")[2].replace("_", " ")


def _value(cell: Cell, metric: str, share: bool) -> float:
    spread = cell.metrics[metric]
    return spread.mean if share else spread.median


def _spreads(found: list[tuple[int, str, float]]) -> dict[tuple[int, str], Spread]:
    if not found:
        return {}
    columns = list(zip(*found, strict=True))
    table = pa.table({"cell": columns[0], "metric": columns[1], "number": pa.array(columns[2], pa.float64())})
    ask = (
        "SELECT cell, metric, count(*), median(number), quantile_cont(number, 0.25), quantile_cont(number, 0.75), "
        "avg(number), list(number ORDER BY number) FROM numbers GROUP BY cell, metric"
    )
    with duckdb.connect() as connection:
        connection.register("numbers", table)
        rows = connection.execute(ask).fetchall()
    return {
        (cell, metric): Spread(count, median, low, high, mean, tuple(values))
        for cell, metric, count, median, low, high, mean, values in rows
    }
