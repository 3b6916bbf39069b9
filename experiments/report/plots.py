"""The plots of a sweep as one picture: metrics over every axis of numbers, with 95 % confidence intervals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchreg.viz.figures import new_figure, save_picture

from ..plan import planned_trials
from ..schema import SweepConfig
from ..store import Store
from .cells import cells_of, known_metrics, short, shown_metrics
from .charts import group_of, lines_over, named, numeric_axes

_WIDTH, _HEIGHT, _MAX_METRICS = 380, 300, 2


def save_plots(sweep: SweepConfig, store: Store, path: Path) -> Path | None:
    """Return the path of a picture of the first metrics of a sweep over its axes of numbers; None if it has none.

    Raises:
        ConfigError: if the report asks for a metric that is not there.
    """
    rows, axes = planned_trials(sweep), numeric_axes(sweep)
    ids = {trial.id for trial in rows}
    records = {record.id: record for record in store.records()[0] if record.id in ids}
    metrics = list(sweep.report.heat_metrics) or shown_metrics(sweep, known_metrics(records))
    cells, metrics = cells_of(sweep, rows, records), metrics[:_MAX_METRICS]
    if not axes or not metrics:
        return None
    figure, _ = new_figure(_WIDTH * len(axes), _HEIGHT * len(metrics), 0)
    panels = figure.subplots(len(metrics), len(axes), squeeze=False)
    for row, metric in enumerate(metrics):
        for column, axis in enumerate(axes):
            ax = panels[row, column]
            for line in lines_over(sweep, cells, metric, axis):
                middle = np.array(line.middle)
                ends = np.abs(np.array([line.low, line.high]) - middle)
                ax.errorbar(line.across, middle, ends, marker="o", markersize=3, capsize=2, lw=1.2, label=line.name)
            ax.set(xlabel=short(axis), ylabel=named(metric))
            ax.set_ylim(bottom=0)
            ax.grid(alpha=0.3)
            if group_of(sweep, axis):
                ax.legend(fontsize=7, frameon=False, title=short(group_of(sweep, axis)), title_fontsize=7)
    figure.tight_layout()
    save_picture(figure, path)
    return path
