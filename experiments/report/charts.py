"""The charts of a report, as pieces of HTML that need Plotly's script on the page."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..plan import PlannedTrial, axes_of
from ..records import TrialRecord
from ..report.cells import Cell, Spread, all_axes, label, short
from ..report.intervals import confidence_interval
from ..schema import SweepConfig

_MAX_MAPS, _MAX_DOTS, _MAX_LINES = 6, 60, 12
_HEIGHT, _CELL_PIXELS = 380, 46
_COLORS = (
    "#3366aa",
    "#dd7733",
    "#339966",
    "#aa3355",
    "#7755bb",
    "#888833",
    "#33a0b5",
    "#775544",
    "#555555",
    "#cc66aa",
    "#bbaa00",
    "#2f4f9f",
)


def heat_maps(sweep: SweepConfig, cells: Sequence[Cell], metric: str) -> list[str]:
    """Return a heat map per combination of the axes that are not on it."""
    if not sweep.report.heat:
        return []
    across, down = sweep.report.heat
    axes = axes_of(sweep)
    others = [name for name in all_axes(sweep) if name not in (across, down)]
    found = []
    for rest in itertools.islice(itertools.product(*(axes[name] for name in others)), _MAX_MAPS):
        chosen = dict(zip(others, rest, strict=True))
        shown = [cell for cell in cells if all(cell.axes[name] == value for name, value in chosen.items())]
        title = ", ".join(f"{short(name)} {label(value)}" for name, value in chosen.items())
        found.append(_heat_map(sweep, shown, metric, (axes[across], axes[down]), title))
    return found


def _heat_map(
    sweep: SweepConfig, cells: Sequence[Cell], metric: str, values: tuple[list[Any], list[Any]], title: str
) -> str:
    import plotly.graph_objects as go

    across, down = sweep.report.heat
    known = {(label(cell.axes[across]), label(cell.axes[down])): told(sweep, cell, metric) for cell in cells}
    right, below = ([label(value) for value in side] for side in values)
    numbers = [[known.get((x, y)) for x in right] for y in below]
    texts = [["" if number is None else f"{number:.3g}" for number in row] for row in numbers]
    high = metric in sweep.report.higher
    scale = "Blues" if high else "Oranges"
    figure = go.Figure(
        go.Heatmap(
            z=numbers, x=right, y=below, text=texts, texttemplate="%{text}", colorscale=scale, xgap=2, ygap=2,
            hovertemplate=f"{short(across)} %{{x}}<br>{short(down)} %{{y}}<br>%{{z:.4g}}<extra></extra>",
            colorbar={"title": {"text": named(metric)}, "thickness": 12},
        )
    )  # fmt: skip
    figure.update_xaxes(type="category", title=short(across))
    figure.update_yaxes(type="category", title=short(down), autorange="reversed")
    heading = f"{named(metric)} ({'more' if high else 'less'} is better)" + (f"; {title}" if title else "")
    return _html(figure, heading, max(_HEIGHT - 100, 150 + _CELL_PIXELS * len(below)))


def dots(sweep: SweepConfig, cells: Sequence[Cell], metric: str) -> str | None:
    """Return medians with quartiles of all cells, or None if there are too many."""
    import plotly.graph_objects as go

    shown = [cell for cell in cells if metric in cell.metrics]
    if not 2 <= len(shown) <= _MAX_DOTS:
        return None
    axes = all_axes(sweep)
    first = sweep.report.group or axes[0]
    rest = [name for name in axes if name != first]
    figure = go.Figure()
    for value, color in zip(dict.fromkeys(label(cell.axes[first]) for cell in shown), itertools.cycle(_COLORS)):
        mine = [cell for cell in shown if label(cell.axes[first]) == value]
        spreads = [cell.metrics[metric] for cell in mine]
        middle = [told(sweep, cell, metric) for cell in mine]
        places = [", ".join(label(cell.axes[name]) for name in rest) or value for cell in mine]
        figure.add_scatter(
            x=places, y=middle, name=value, mode="markers", marker={"size": 9, "color": color},
            error_y=None if metric in sweep.report.share else _whiskers(spreads),
        )  # fmt: skip
    figure.update_xaxes(type="category", title=", ".join(short(name) for name in rest) or short(first))
    figure.update_yaxes(title=named(metric), rangemode="tozero")
    figure.update_layout(scattermode="group", legend_title_text=short(first))
    kind = "means" if metric in sweep.report.share else "medians and quartiles"
    return _html(figure, f"{named(metric)}: {kind} over seeds", _HEIGHT)


def _whiskers(spreads: Sequence[Spread]) -> dict[str, Any]:
    above = [spread.high - spread.median for spread in spreads]
    below = [spread.median - spread.low for spread in spreads]
    return {"type": "data", "symmetric": False, "array": above, "arrayminus": below, "thickness": 1, "width": 3}


@dataclass(frozen=True)
class Line:
    """A metric over an axis of numbers.

    Args:
        name: value of the axis that groups; empty if there is none.
        across: values of the axis.
        middle: median, or mean of a share, over all else.
        low: end of its 95 % confidence interval.
        high: the other end.
    """

    name: str
    across: list[Any]
    middle: list[float]
    low: list[float]
    high: list[float]


def numeric_axes(sweep: SweepConfig) -> list[str]:
    """Return the axes that have several values, all numbers."""
    axes = axes_of(sweep)
    return [name for name in all_axes(sweep) if len(axes[name]) > 1 and all(map(_is_number, axes[name]))]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def group_of(sweep: SweepConfig, axis: str) -> str:
    """Return the axis by whose values lines over another axis are told apart; empty if there is none."""
    rest = [name for name in all_axes(sweep) if name != axis]
    return sweep.report.group if sweep.report.group in rest else next(iter(rest), "")


def lines_over(sweep: SweepConfig, cells: Sequence[Cell], metric: str, axis: str) -> list[Line]:
    """Return a metric over an axis of numbers, a line per value of the axis that groups, all else together."""
    group, mean, found = group_of(sweep, axis), metric in sweep.report.share, []
    for value in itertools.islice(
        dict.fromkeys(label(cell.axes[group]) if group else "" for cell in cells), _MAX_LINES
    ):
        mine = [cell for cell in cells if metric in cell.metrics and (not group or label(cell.axes[group]) == value)]
        across = sorted({cell.axes[axis] for cell in mine})
        pools = [[v for cell in mine if cell.axes[axis] == x for v in cell.metrics[metric].values] for x in across]
        middle = [statistics.fmean(pool) if mean else statistics.median(pool) for pool in pools]
        ends = [confidence_interval(pool, mean=mean) or (at, at) for pool, at in zip(pools, middle, strict=True)]
        found.append(Line(value, across, middle, [end[0] for end in ends], [end[1] for end in ends]))
    return found


def lines(sweep: SweepConfig, cells: Sequence[Cell], metric: str) -> list[str]:
    """Return plots of a metric over each axis of numbers, with 95 % bands."""
    return [_line_plot(sweep, cells, metric, axis) for axis in numeric_axes(sweep)]


def _line_plot(sweep: SweepConfig, cells: Sequence[Cell], metric: str, axis: str) -> str:
    import plotly.graph_objects as go

    figure, group = go.Figure(), group_of(sweep, axis)
    for line, color in zip(lines_over(sweep, cells, metric, axis), itertools.cycle(_COLORS)):
        figure.add_scatter(
            x=[*line.across, *line.across[::-1]], y=[*line.high, *line.low[::-1]], fill="toself", fillcolor=color,
            opacity=0.15, mode="lines", line={"width": 0}, hoverinfo="skip", showlegend=False,
        )  # fmt: skip
        figure.add_scatter(
            x=line.across, y=line.middle, name=line.name or short(metric), mode="lines+markers", line={"color": color}
        )
    figure.update_xaxes(title=short(axis))
    figure.update_yaxes(title=named(metric), rangemode="tozero")
    figure.update_layout(legend_title_text=short(group), showlegend=bool(group))
    kind = "mean" if metric in sweep.report.share else "median"
    return _html(figure, f"{named(metric)} over {short(axis)}: {kind} over all others, 95 % confidence", _HEIGHT)


def curve_names(sweep: SweepConfig, records: dict[str, TrialRecord]) -> list[str]:
    """Return the curves to draw."""
    found = dict.fromkeys(name for record in records.values() for name in record.curves)
    drawn = sweep.report.curves or [name for name in found if name != sweep.report.curve_steps]
    return [name for name in drawn if name in found]


def curves(
    sweep: SweepConfig, trials: Sequence[PlannedTrial], records: dict[str, TrialRecord], name: str
) -> str:  # fmt: skip
    """Return a curve over the steps, a line per value of the axis that groups them: the median, or mean and band."""
    import plotly.graph_objects as go

    report = sweep.report
    axis = report.group or next(iter(axes_of(sweep)), "")
    groups: dict[str, list[TrialRecord]] = {}
    for trial in trials:
        record = records.get(trial.id)
        if record is not None and record.curves.get(name):
            groups.setdefault(label(trial.axes.get(axis, "")), []).append(record)
    figure = go.Figure()
    for (value, members), color in zip(itertools.islice(groups.items(), _MAX_LINES), itertools.cycle(_COLORS)):
        columns = _columns([record.curves[name] for record in members])
        places = _places(members, report.curve_steps, len(columns))
        if report.curve_spread:
            _add_band(figure, places, columns, color)
        middle = statistics.fmean if report.curve_spread else statistics.median
        figure.add_scatter(
            x=places, y=[middle(column) if column else None for column in columns], name=value or name,
            mode="lines+markers", line={"color": color}, marker={"size": 4},
        )  # fmt: skip
    figure.update_xaxes(title=short(report.curve_steps) or "step")
    figure.update_yaxes(title=named(name), rangemode="tozero", type="log" if report.curve_log else "linear")
    figure.update_layout(legend_title_text=short(axis), showlegend=True)
    kind = "mean, lowest and highest" if report.curve_spread else "median"
    each = f", by {short(axis)}" if axis else ""
    heading = f"{named(name)} along the steps: {kind} over all trials{each}"
    return _html(figure, heading, _HEIGHT)


def _add_band(figure: Any, places: Sequence[float], columns: Sequence[Sequence[float]], color: str) -> None:
    known = [(place, min(column), max(column)) for place, column in zip(places, columns, strict=True) if column]
    across, low, high = (list(side) for side in zip(*known, strict=True)) if known else ([], [], [])
    figure.add_scatter(
        x=across + across[::-1], y=high + low[::-1], fill="toself", fillcolor=color, opacity=0.15,
        mode="lines", line={"width": 0}, hoverinfo="skip", showlegend=False,
    )  # fmt: skip


def _places(members: Sequence[TrialRecord], steps: str, count: int) -> list[float]:
    """Return the steps of the values of curves: those of the longest trial, or else 1, 2, ..."""
    told = max((record.curves.get(steps, []) for record in members), key=len)
    return list(told) if len(told) == count else [float(number) for number in range(1, count + 1)]


def _columns(lines: Sequence[Sequence[float | None]]) -> list[list[float]]:
    """Return the known values at every step; trials that ended earlier keep their last value."""
    length = max(map(len, lines))
    padded = [[*line, *[line[-1]] * (length - len(line))] for line in lines]
    return [[value for value in step if value is not None] for step in zip(*padded, strict=True)]


def told(sweep: SweepConfig, cell: Cell, metric: str) -> float | None:
    """Return the value of a cell: the median over its seeds, or for a share the mean."""
    spread = cell.metrics.get(metric)
    if spread is None:
        return None
    return spread.mean if metric in sweep.report.share else spread.median


def interval(sweep: SweepConfig, cell: Cell, metric: str) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of what `told` gives, None for fewer than two seeds."""
    spread = cell.metrics.get(metric)
    return None if spread is None else confidence_interval(spread.values, mean=metric in sweep.report.share)


def named(metric: str) -> str:
    """Return a metric's name as text, with its unit."""
    name = metric.removeprefix("seconds.")
    text = name.replace("_", " ")
    if name != metric:
        return f"{text}, s"
    for ending, unit in ((" mm", "mm"), (" percent", "%"), (" ms", "ms"), (" seconds", "s")):
        if text.endswith(ending):
            return f"{text.removesuffix(ending)}, {unit}"
    return text


def _html(figure: Any, title: str, height: int) -> str:
    figure.update_layout(
        title={"text": title, "font": {"size": 14}}, template="simple_white", height=height,
        margin={"l": 70, "r": 20, "t": 45, "b": 55}, font={"family": "system-ui, sans-serif", "size": 12},
    )  # fmt: skip
    text: str = figure.to_html(
        full_html=False, include_plotlyjs=False, config={"displayModeBar": False, "responsive": True}
    )
    return text
