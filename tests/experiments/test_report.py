import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

pytest.importorskip("plotly", reason="experiments take the extra experiments")

from experiments.driver import run_sweep
from experiments.errors import ConfigError, StoreError
from experiments.plan import planned_trials
from experiments.records import TrialRecord, provenance
from experiments.report import charts
from experiments.report.cells import cells_of, marginal
from experiments.report.charts import lines_over
from experiments.report.page import write_report
from experiments.report.plots import save_plots
from experiments.schema import ProbeTrial, ReportConfig

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR4nGNgYGBgAAAABQABpfZFQAAAAABJRU5ErkJggg=="
)


class Reader(HTMLParser):
    """Collects the tags of a page, its text outside scripts, and what it would load from elsewhere."""

    def __init__(self):
        super().__init__()
        self.tags, self.text, self.loads, self._script = [], "", [], False

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self._script = tag in ("script", "style")
        self.loads += [value for name, value in attributes if name == "src" or (tag == "link" and name == "href")]

    def handle_endtag(self, tag):
        self._script = False

    def handle_data(self, data):
        self.text += "" if self._script else data


def read(path):
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    return reader


def fill(store, sweep, value):
    """Write a record per trial whose metric is a function of its configuration."""
    store.prepare()
    version = provenance()["versions"]["torchreg"]
    for trial in planned_trials(sweep):
        metrics = {"error_mm": value(trial.config), "failed": float(trial.config["seed"] == 0)}
        curves = {"error_mm": [2.0 * metrics["error_mm"], metrics["error_mm"]]}
        store.write(
            TrialRecord(
                trial.id,
                sweep.task,
                version,
                trial.config,
                trial.seed,
                "done",
                metrics,
                {"run": 0.5},
                curves,
                started="2026-01-01T00:00:00+00:00",
                **provenance(),
            )
        )


@pytest.fixture
def grid(probe_sweep):
    report = ReportConfig(
        metrics=("error_mm", "failed", "seconds.run"), heat=("scale", "rounds"), heat_metrics=("error_mm",),
        share=("failed",),
    )  # fmt: skip
    return probe_sweep(grid={"scale": [1.0, 2.0, 4.0], "rounds": [1, 2]}, seeds=5, report=report)


def test_cells_hold_medians_and_quartiles_over_seeds(store, grid):
    fill(store, grid, lambda config: 10 * config["scale"] + config["seed"] ** 2)
    cells = cells_of(grid, planned_trials(grid), {record.id: record for record in store.records()[0]})
    assert [cell.axes for cell in cells][:3] == [
        {"scale": 1.0, "rounds": 1}, {"scale": 1.0, "rounds": 2}, {"scale": 2.0, "rounds": 1},
    ]  # fmt: skip
    spread = cells[0].metrics["error_mm"]
    # 10 and the squares of 0 to 4.
    assert (spread.count, spread.median, spread.low, spread.high, spread.mean) == (5, 14, 11, 19, 16)
    assert cells[0].metrics["failed"].mean == pytest.approx(0.2)
    assert marginal(cells, "scale", "error_mm", share=False) == {"1": 14, "2": 24, "4": 44}


def test_plots_over_axes_of_numbers_are_one_picture(store, grid, tmp_path):
    fill(store, grid, lambda config: config["scale"] + config["rounds"])
    path = save_plots(grid, store, tmp_path / "plots.png")
    assert path.stat().st_size > 5000
    records = {record.id: record for record in store.records()[0]}
    found = lines_over(grid, cells_of(grid, planned_trials(grid), records), "error_mm", "scale")
    assert all(
        low <= at <= high for line in found for low, at, high in zip(line.low, line.middle, line.high, strict=True)
    )
    assert all(line.middle == sorted(line.middle) for line in found)


def test_the_page_is_one_file_that_shows_everything(store, grid):
    fill(store, grid, lambda config: config["scale"] + config["rounds"])
    reader = read(write_report(grid, store, store.root / "report.html"))
    assert all(value.startswith("data:") for value in reader.loads)
    for text in (
        "does it work?",
        "30 trials: 30 done, 0 failed, 0 skipped",
        "error, mm",
        "5 / 5",
        "Per axis",
        "Convergence",
    ):
        assert text in reader.text
    page = (store.root / "report.html").read_text()
    assert page.count('class="plotly-graph-div"') == 4  # a heat map, a line plot per axis of numbers, and a curve
    assert len(page) > 4_000_000  # Plotly itself lies in the page


def test_best_values_are_marked_where_less_and_where_more_is_better(store, grid):
    fill(store, grid, lambda config: config["scale"])
    for sweep, best in ((grid, "1"), (replace(grid, report=replace(grid.report, higher=("error_mm",))), "4")):
        page = write_report(sweep, store, store.root / "report.html").read_text()
        assert re.findall(r'<td class="best">([\d.]+)', page)[0] == best


def test_failures_come_with_traceback_and_command(store, probe_sweep, inline_engine):
    sweep = probe_sweep(grid={"outcome": ["done", "failed", "skipped"]})
    run_sweep(sweep, store, lambda: inline_engine)
    text = read(write_report(sweep, store, store.root / "report.html")).text
    assert "outcome failed, seed 0: ValueError: the probe was told to fail" in text
    assert "Traceback (most recent call last)" in text
    assert "python -m experiments rerun" in text
    assert "1 skipped: there is nothing to probe" in text


def test_nothing_that_trials_tell_becomes_markup(store, probe_sweep, inline_engine):
    evil = "<img src=x onerror=alert(1)></script>"
    sweep = probe_sweep(
        cases=({"case": evil}, {"case": "fine", "scale": 2.0}), grid={}, report=ReportConfig(heat=()), seeds=2
    )
    sweep = replace(sweep, question=evil)
    run_sweep(sweep, store, lambda: inline_engine)
    record = store.read(planned_trials(sweep)[0].id)
    store.write(replace(record, status="failed", note=evil, traceback=evil))
    reader = read(write_report(sweep, store, store.root / "report.html"))
    assert "img" not in reader.tags
    assert reader.text.count(evil) >= 3
    # Inside scripts the charts' texts are escaped, so that none can end its script.
    assert reader.tags.count("script") == (store.root / "report.html").read_text().count("</script>")


def test_pictures_lie_in_the_page_and_models_are_linked(store, grid):
    fill(store, grid, lambda config: 1.0)
    trial = planned_trials(grid)[0]
    record = store.read(trial.id)
    store.write(replace(record, artifacts={"view": "a.png", "model": "b c.glb", "lost": "gone.png"}))
    folder = store.artifacts(trial.id)
    folder.mkdir(parents=True)
    (folder / "a.png").write_bytes(PIXEL)
    (folder / "b c.glb").write_bytes(b"glTF")
    page = write_report(grid, store, store.root / "pages" / "report.html").read_text()
    assert base64.b64encode(PIXEL).decode() in page
    assert read(store.root / "pages" / "report.html").tags.count("img") == 1
    assert f'href="../artifacts/{trial.id}/b%20c.glb"' in page
    assert "view: scale 1, rounds 1, seed 0" in page


def test_what_is_missing_or_foreign_is_told(store, grid, probe_sweep):
    fill(store, grid, lambda config: 1.0)
    for trial in planned_trials(grid)[:4]:
        store.record_path(trial.id).unlink()
    (store.trials / "0000000000000000.json").write_text("{")
    fill(store, probe_sweep(trial=ProbeTrial(size=99)), lambda config: 9.0)
    text = read(write_report(grid, store, store.root / "report.html", ["A note."])).text
    assert "A note." in text
    assert "4 trials have not run yet" in text
    assert "3 records of other configurations" in text
    assert "0000000000000000.json is not a record of a trial" in text


def test_a_sweep_without_records_still_has_a_page(store, grid):
    store.prepare()
    assert "30 trials have not run yet" in read(write_report(grid, store, store.root / "report.html")).text


def test_a_metric_that_no_record_has_is_named(store, grid):
    fill(store, grid, lambda config: 1.0)
    sweep = replace(grid, report=replace(grid.report, metrics=("eror_mm",)))
    with pytest.raises(
        ConfigError, match=r"unknown metric eror_mm in report; known metrics: error_mm, failed, seconds\.run"
    ):
        write_report(sweep, store, store.root / "report.html")


def test_a_page_that_cannot_be_written_is_named(store, grid, tmp_path):
    fill(store, grid, lambda config: 1.0)
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        write_report(grid, store, tmp_path / "file" / "report.html")


def test_curves_lie_at_their_steps_with_a_band_over_the_seeds(store, probe_sweep):
    report = ReportConfig(curves=("error_mm",), curve_steps="steps", curve_spread=True)
    sweep = probe_sweep(grid={"scale": [1.0]}, seeds=3, report=report)
    fill(store, sweep, lambda config: 1.0 + config["seed"])
    found = {one.id: replace(one, curves=one.curves | {"steps": [0.0, 50.0]}) for one in store.records()[0]}
    chart = charts.curves(sweep, planned_trials(sweep), found, "error_mm")
    # Errors end at 1, 2 and 3, and begin at their doubles.
    assert '"x":[0.0,50.0],"y":[4.0,2.0]' in chart
    assert '"x":[0.0,50.0,50.0,0.0],"y":[6.0,3.0,1.0,2.0]' in chart
    assert "mean, lowest and highest over all trials" in chart
    assert '"type":"log"' not in chart
    steep = replace(sweep, report=replace(report, curve_log=True))
    assert '"type":"log"' in charts.curves(steep, planned_trials(steep), found, "error_mm")
    assert charts.curve_names(replace(sweep, report=replace(report, curves=())), found) == ["error_mm"]
    plain = replace(sweep, report=replace(report, curve_steps="", curve_spread=False))
    chart = charts.curves(plain, planned_trials(plain), found, "error_mm")
    assert '"x":[1.0,2.0],"y":[4.0,2.0]' in chart
    assert chart.count('"type":"scatter","x"') + chart.count('"y":[') <= 2


def test_numbers_that_are_not_finite_leave_gaps(store, probe_sweep):
    sweep = probe_sweep(seeds=2)
    fill(store, sweep, lambda config: float("nan"))
    page = write_report(sweep, store, store.root / "report.html").read_text()
    assert "NaN" not in re.sub(r"<script>.*?</script>", "", page, count=1, flags=re.DOTALL)
    assert json.loads(next(iter(store.trials.glob("*.json"))).read_text())["metrics"]["error_mm"] is None
