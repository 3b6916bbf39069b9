"""Reports of sweeps: what their page shows, the intervals in it, and the other places where records go."""

import base64
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from scipy import stats

pytest.importorskip("plotly", reason="experiments take the extra experiments")

from experiments.driver import run_sweep
from experiments.errors import ConfigError, ExperimentError, StoreError
from experiments.plan import planned_trials
from experiments.records import TrialRecord, provenance
from experiments.report.cells import cells_of, marginal
from experiments.report.intervals import confidence_interval
from experiments.report.page import write_report
from experiments.schema import ProbeTrial, ReportConfig
from experiments.sinks import SINKS, make_sink


class Reader(HTMLParser):
    """Collects the tags of a page, its text outside scripts, and what it would load from elsewhere."""

    def __init__(self, path):
        super().__init__()
        self.tags, self.text, self.loads, self._script = [], "", [], False
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self._script = tag in ("script", "style")
        self.loads += [value for name, value in attributes if name == "src" or (tag == "link" and name == "href")]

    def handle_endtag(self, tag):
        self._script = False

    def handle_data(self, data):
        self.text += "" if self._script else data


@pytest.fixture
def page(store):
    """Return the function that writes the report of a sweep and returns its path."""
    return lambda sweep, *notes: write_report(sweep, store, store.root / "report.html", *notes)


@pytest.fixture
def fill(store):
    """Return the function that writes a record per trial whose metric is a function of its configuration."""

    def fill(sweep, value=lambda config: 1.0):
        store.prepare()
        version, settings = provenance()["versions"]["torchreg"], {"started": "2026-01-01T00:00:00+00:00"}
        for trial in planned_trials(sweep):
            metrics = {"error_mm": value(trial.config), "failed": float(trial.config["seed"] == 0)}
            outcome = metrics, {"run": 0.5}, {"error_mm": [2.0 * metrics["error_mm"], metrics["error_mm"]]}
            identity = trial.id, sweep.task, version, trial.config, trial.seed, "done"
            store.write(TrialRecord(*identity, *outcome, **settings, **provenance()))
        return {record.id: record for record in store.records()[0]}

    return fill


@pytest.fixture
def grid(probe_sweep):
    report = ReportConfig(
        metrics=("error_mm", "failed", "seconds.run"), heat=("scale", "rounds"), heat_metrics=("error_mm",),
        share=("failed",),
    )  # fmt: skip
    return probe_sweep(grid={"scale": [1.0, 2.0, 4.0], "rounds": [1, 2]}, seeds=5, report=report)


def test_cells_hold_medians_and_quartiles_over_seeds(fill, grid):
    cells = cells_of(grid, planned_trials(grid), fill(grid, lambda config: 10 * config["scale"] + config["seed"] ** 2))
    axes = [(cell.axes["scale"], cell.axes["rounds"]) for cell in cells]
    assert axes[:3] == [(1.0, 1), (1.0, 2), (2.0, 1)]
    spread = cells[0].metrics["error_mm"]
    # 10 and the squares of 0 to 4.
    assert (spread.count, spread.median, spread.low, spread.high, spread.mean) == (5, 14, 11, 19, 16)
    assert cells[0].metrics["failed"].mean == pytest.approx(0.2)
    assert marginal(cells, "scale", "error_mm", share=False) == {"1": 14, "2": 24, "4": 44}


def test_the_page_is_one_file_that_shows_everything(fill, page, grid):
    fill(grid, lambda config: config["scale"] + config["rounds"])
    reader, text = Reader(page(grid)), page(grid).read_text()
    assert all(value.startswith("data:") for value in reader.loads)
    counts = "30 trials: 30 done, 0 failed, 0 skipped"
    for words in ("does it work?", counts, "error, mm", "5 / 5", "Per axis", "Convergence"):
        assert words in reader.text
    assert text.count('class="plotly-graph-div"') == 4  # a heat map, a line plot per axis of numbers, and a curve
    assert len(text) > 4_000_000  # Plotly itself lies in the page
    # The best value is marked, whether less or more is better.
    for sweep, best in ((grid, "1"), (replace(grid, report=replace(grid.report, higher=("error_mm",))), "4")):
        fill(sweep, lambda config: config["scale"])
        assert re.findall(r'<td class="best">([\d.]+)', page(sweep).read_text())[0] == best


def test_failures_come_with_traceback_and_command(store, page, probe_sweep, inline_engine):
    sweep = probe_sweep(grid={"outcome": ["done", "failed", "skipped"]})
    run_sweep(sweep, store, lambda: inline_engine)
    text = Reader(page(sweep)).text
    assert "outcome failed, seed 0: ValueError: the probe was told to fail" in text
    assert "Traceback (most recent call last)" in text
    assert "python -m experiments rerun" in text
    assert "1 skipped: there is nothing to probe" in text


def test_nothing_in_a_trial_becomes_markup(store, page, probe_sweep, inline_engine):
    evil = "<img src=x onerror=alert(1)></script>"
    cases = ({"case": evil}, {"case": "fine", "scale": 2.0})
    sweep = replace(probe_sweep(cases=cases, grid={}, report=ReportConfig(heat=()), seeds=2), question=evil)
    run_sweep(sweep, store, lambda: inline_engine)
    record = store.read(planned_trials(sweep)[0].id)
    store.write(replace(record, status="failed", note=evil, traceback=evil))
    reader = Reader(page(sweep))
    assert "img" not in reader.tags
    assert reader.text.count(evil) >= 3
    # Inside scripts the charts' texts are escaped, so that none can end its script.
    assert reader.tags.count("script") == page(sweep).read_text().count("</script>")


def test_pictures_lie_in_the_page_and_models_are_linked(fill, store, page, grid, tmp_path):
    trial = planned_trials(grid)[0]
    record = fill(grid)[trial.id]
    store.write(replace(record, artifacts={"view": "a.png", "model": "b c.glb", "lost": "gone.png"}))
    folder = store.artifacts(trial.id)
    folder.mkdir(parents=True)
    Image.new("RGB", (1, 1)).save(folder / "a.png")
    (folder / "b c.glb").write_bytes(b"glTF")
    path = write_report(grid, store, store.root / "pages" / "report.html")
    assert base64.b64encode((folder / "a.png").read_bytes()).decode() in path.read_text()
    assert Reader(path).tags.count("img") == 1
    assert f'href="../artifacts/{trial.id}/b%20c.glb"' in path.read_text()
    assert "view: scale 1, rounds 1, seed 0" in path.read_text()
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        write_report(grid, store, tmp_path / "file" / "report.html")


def test_missing_and_foreign_records_are_named(fill, store, page, grid, probe_sweep):
    fill(grid)
    for trial in planned_trials(grid)[:4]:
        store.record_path(trial.id).unlink()
    (store.trials / "0000000000000000.json").write_text("{")
    fill(probe_sweep(trial=ProbeTrial(size=99)), lambda config: float("nan"))
    text = Reader(page(grid, ["A note."])).text
    assert "A note." in text
    assert "4 trials have not run yet" in text
    assert "3 records of other configurations" in text
    assert "0000000000000000.json is not a record of a trial" in text
    message = r"unknown metric eror_mm in report; known metrics: error_mm, failed, seconds\.run"
    with pytest.raises(ConfigError, match=message):
        page(replace(grid, report=replace(grid.report, metrics=("eror_mm",))))


def test_shares_have_the_interval_of_a_score_test():
    for count, total in ((0, 10), (3, 12), (12, 12)):
        values = [1.0] * count + [0.0] * (total - count)
        expected = stats.binomtest(count, total).proportion_ci(method="wilson")
        assert confidence_interval(values, mean=True) == pytest.approx((expected.low, expected.high), abs=1e-6)


def test_intervals_of_means_and_medians_are_those_in_theory():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    half = 1.96 * values.std() / 20
    expected = (values.mean() - half, values.mean() + half)
    assert confidence_interval(values.tolist(), mean=True) == pytest.approx(expected, abs=0.03)
    random = np.random.default_rng(2)
    found = [confidence_interval(random.exponential(1.0, 25).tolist(), mean=False) for _ in range(200)]
    assert 0.88 < np.mean([low <= np.log(2) <= high for low, high in found]) <= 1.0
    assert confidence_interval([1.0], mean=False) is None
    assert confidence_interval([2.0, 2.0], mean=False) == (2.0, 2.0)


@pytest.mark.parametrize("name", SINKS)
def test_a_sink_whose_package_is_missing_says_so(name, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard" if name == "tensorboard" else name, None)
    with pytest.raises(ExperimentError, match=f"--sink {name} needs the package .*, which is not installed"):
        make_sink(name, "sweep", str(tmp_path))
