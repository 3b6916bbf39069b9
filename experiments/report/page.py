"""The page of a report: its question, results, failures and provenance."""

from __future__ import annotations

import base64
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from torchreg.io.atomic import write_atomic

from ..errors import ExperimentError
from ..plan import PlannedTrial, planned_trials
from ..records import TrialRecord
from ..report import charts
from ..report.cells import (
    Cell,
    all_axes,
    cells_of,
    known_metrics,
    label,
    marginal,
    number,
    short,
    shown_metrics,
)
from ..schema import SweepConfig
from ..store import Store, explained

_MAX_FAILURES, _MAX_PICTURES, _MAX_ROWS = 50, 24, 1000
_TEMPLATES = Path(__file__).parent


@dataclass(frozen=True)
class Figure:
    """A picture or model of a trial: its caption, and a link or the picture itself."""

    caption: str
    link: str
    picture: str = ""


def write_report(sweep: SweepConfig, store: Store, output: Path, notes: Sequence[str] = ()) -> Path:
    """Write the report of a sweep and return its path: one file that opens without a network.

    Pictures lie in the page, glTF files are linked. The records are only read.

    Raises:
        ConfigError: if the report asks for a metric or an axis that is not there.
        StoreError: if the page cannot be written.
        ExperimentError: if jinja2 or Plotly is not installed.
    """
    trials = list({trial.id: trial for trial in planned_trials(sweep)}.values())
    found, bad = store.records()
    # Trials of the same configuration may stand in several rows.
    rows = planned_trials(sweep)
    ids = {trial.id for trial in trials}
    records = {record.id: record for record in found if record.id in ids}
    told = [*notes, *_notes(trials, records, len(found) - len(records))]
    told += [f"Left out, as it is no record: {error}" for error in bad]
    content = _render(_page(sweep, store, rows, records, told, output))
    with explained(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(output, content.encode())
    return output


def _render(page: dict[str, Any]) -> str:
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ExperimentError(
            f"{error.name} is not installed: pip install 'torchreg-articulated[experiments]'"
        ) from error
    loader = FileSystemLoader(_TEMPLATES)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("page.html.j2").render(plotly=get_plotlyjs(), **page)


def _page(
    sweep: SweepConfig, store: Store, rows: Sequence[PlannedTrial], records: dict[str, TrialRecord],
    notes: list[str], output: Path,
) -> dict[str, Any]:  # fmt: skip
    cells = cells_of(sweep, rows, records)
    metrics = shown_metrics(sweep, known_metrics(records))
    heat = list(sweep.report.heat_metrics) or metrics[:1]
    drawn = [chart for metric in heat for chart in charts.heat_maps(sweep, cells, metric)]
    if not drawn:
        drawn = [chart for metric in metrics[:2] if (chart := charts.dots(sweep, cells, metric)) is not None]
    drawn += [chart for metric in heat[:2] or metrics[:2] for chart in charts.lines(sweep, cells, metric)]
    lines = [charts.curves(sweep, rows, records, name) for name in charts.curve_names(sweep, records)]
    pictures, models = _figures(store, rows, records, output)
    return {
        "sweep": sweep,
        "notes": notes,
        "table": _table(sweep, cells, metrics),
        "marginals": _marginals(sweep, cells, metrics),
        "charts": drawn,
        "curves": lines,
        "failures": [
            (_caption(trial), records[trial.id])
            for trial in _once(rows)
            if trial.id in records and records[trial.id].status == "failed"
        ][:_MAX_FAILURES],
        "skipped": Counter(record.note for record in records.values() if record.status == "skipped"),
        "pictures": pictures,
        "models": models,
        "facts": _facts(store, records),
    }


def _notes(trials: Sequence[PlannedTrial], records: dict[str, TrialRecord], foreign: int) -> list[str]:
    counts = Counter(record.status for record in records.values())
    missing = len(trials) - len(records)
    notes = [f"{len(trials)} trials: {counts['done']} done, {counts['failed']} failed, {counts['skipped']} skipped."]
    if missing:
        notes.append(f"{missing} trials have not run yet: the numbers are preliminary.")
    if foreign:
        notes.append(f"{foreign} records of other configurations or versions lie in the folder and are left out.")
    commits = {record.commit for record in records.values()}
    if len(commits) > 1:
        notes.append(f"The trials ran at different commits: {', '.join(sorted(commits))}.")
    return notes


def _table(sweep: SweepConfig, cells: Sequence[Cell], metrics: Sequence[str]) -> dict[str, Any]:
    axes = all_axes(sweep)
    best = {metric: _best(sweep, [charts.told(sweep, cell, metric) for cell in cells], metric) for metric in metrics}
    rows = []
    for cell in cells[:_MAX_ROWS]:
        values = []
        for metric in metrics:
            value = charts.told(sweep, cell, metric)
            spread = cell.metrics.get(metric)
            varied = spread is not None and metric not in sweep.report.share and spread.count > 1
            between = f"{number(spread.low, 3)} to {number(spread.high, 3)}" if spread is not None and varied else ""
            text = "-" if value is None else number(value)
            values.append((text, between, value is not None and len(cells) > 1 and value == best[metric]))
        rows.append(([label(cell.axes[axis]) for axis in axes], f"{cell.done} / {cell.trials}", values))
    heads = [charts.named(metric) for metric in metrics]
    return {"axes": [short(axis) for axis in axes], "heads": heads, "rows": rows, "cut": len(cells) - len(rows)}


def _marginals(sweep: SweepConfig, cells: Sequence[Cell], metrics: Sequence[str]) -> list[dict[str, Any]]:
    """Return per axis a table of its values, over all others; none if there is one axis only."""
    axes = all_axes(sweep)
    if len(axes) < 2:
        return []
    tables = []
    for axis in axes:
        found = {metric: marginal(cells, axis, metric, share=metric in sweep.report.share) for metric in metrics}
        best = {metric: _best(sweep, list(column.values()), metric) for metric, column in found.items()}
        values = dict.fromkeys(value for column in found.values() for value in column)
        rows = [
            (value, [(number(column[value]), column[value] == best[name]) if value in column else ("-", False)
                     for name, column in found.items()])
            for value in values
        ]  # fmt: skip
        tables.append({"axis": short(axis), "heads": [charts.named(metric) for metric in metrics], "rows": rows})
    return tables


def _best(sweep: SweepConfig, values: Sequence[float | None], metric: str) -> float | None:
    known = [value for value in values if value is not None]
    if not known or len(set(known)) == 1 or metric in sweep.report.neutral:
        return None
    return max(known) if metric in sweep.report.higher else min(known)


def _figures(
    store: Store, rows: Sequence[PlannedTrial], records: dict[str, TrialRecord], output: Path
) -> tuple[list[Figure], list[Figure]]:
    pictures: list[Figure] = []
    models: list[Figure] = []
    for trial in _once(rows):
        for name, file in records[trial.id].artifacts.items() if trial.id in records else ():
            path = store.artifacts(trial.id) / str(file)
            if not path.is_file():
                continue
            link = quote(os.path.relpath(path, output.parent).replace(os.sep, "/"))
            caption = f"{name}: {_caption(trial)}"
            if path.suffix == ".png" and len(pictures) < _MAX_PICTURES:
                data = base64.b64encode(path.read_bytes()).decode()
                pictures.append(Figure(caption, link, f"data:image/png;base64,{data}"))
            elif path.suffix in (".glb", ".gltf"):
                models.append(Figure(caption, link))
    return pictures, models


def _once(rows: Sequence[PlannedTrial]) -> list[PlannedTrial]:
    return list({trial.id: trial for trial in rows}.values())


def _caption(trial: PlannedTrial) -> str:
    return ", ".join([*(f"{short(axis)} {label(value)}" for axis, value in trial.axes.items()), f"seed {trial.seed}"])


def _facts(store: Store, records: dict[str, TrialRecord]) -> list[tuple[str, str]]:
    """Return the provenance of the numbers."""
    every = list(records.values())
    if not every:
        return []

    def seen(name: str) -> str:
        return ", ".join(sorted({str(getattr(record, name)) for record in every}))

    versions = sorted({f"{name} {number}" for record in every for name, number in record.versions.items()})
    return [
        ("commit", seen("commit") or "unknown"),
        ("versions", ", ".join(versions)),
        ("host", seen("host")),
        ("device", seen("device")),
        ("threads per worker", seen("threads")),
        ("engine", seen("engine")),
        (
            "first and last start",
            f"{min(record.started for record in every)} to {max(record.started for record in every)}",
        ),
        ("time of all trials", f"{sum(record.wall_seconds for record in every):.1f} s"),
        ("processor time of all trials", f"{sum(float(record.seconds.get('cpu') or 0) for record in every):.1f} s"),
        ("largest peak memory", f"{max(record.peak_memory_mb for record in every):.0f} MB"),
        ("records", str(store.trials)),
    ]
