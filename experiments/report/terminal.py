"""The table of a sweep as text: a row per cell, each number with its 95 % confidence interval."""

from __future__ import annotations

from collections.abc import Sequence

from ..plan import planned_trials
from ..report import charts
from ..report.cells import Cell, all_axes, cells_of, known_metrics, label, number, short, shown_metrics
from ..schema import SweepConfig
from ..store import Store

_MAX_ROWS, _MAX_METRICS = 60, 6


def sweep_table(sweep: SweepConfig, store: Store) -> str:
    """Return the table of what has run of a sweep: medians over seeds, of shares means.

    Raises:
        ConfigError: if the report asks for a metric that is not there.
    """
    rows = planned_trials(sweep)
    ids = {trial.id for trial in rows}
    records = {record.id: record for record in store.records()[0] if record.id in ids}
    cells = cells_of(sweep, rows, records)
    metrics = shown_metrics(sweep, known_metrics(records))[:_MAX_METRICS]
    axes = all_axes(sweep)
    lines = [[*map(short, axes), "done", *map(charts.named, metrics)]]
    for cell in cells[:_MAX_ROWS]:
        told = [_told(sweep, cell, metric) for metric in metrics]
        lines.append([*(label(cell.axes[axis]) for axis in axes), f"{cell.done}/{cell.trials}", *told])
    text = _aligned(lines, len(axes))
    if len(cells) > _MAX_ROWS:
        text += f"\n{len(cells) - _MAX_ROWS} more rows are in the report"
    return text


def _told(sweep: SweepConfig, cell: Cell, metric: str) -> str:
    value = charts.told(sweep, cell, metric)
    if value is None:
        return "-"
    interval = charts.interval(sweep, cell, metric)
    return number(value) + (f" [{number(interval[0], 3)}, {number(interval[1], 3)}]" if interval else "")


def _aligned(lines: Sequence[Sequence[str]], left: int) -> str:
    """Return lines with columns under each other, the first ones flush left."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    rows = []
    for line in lines:
        cells = [
            text.ljust(width) if column < left else text.rjust(width)
            for column, (text, width) in enumerate(zip(line, widths, strict=True))
        ]
        rows.append("  ".join(cells).rstrip())
    return "\n".join([rows[0], "-" * max(map(len, rows)), *rows[1:]])
