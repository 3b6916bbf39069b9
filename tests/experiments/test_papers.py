"""The papers' tables in small: every experiment runs, and its report shows what it asks for."""

import math

import pytest

pytest.importorskip("jinja2", reason="experiments take the extra experiments")

from experiments.compose import known_configs, load_sweep
from experiments.driver import run_sweep
from experiments.report.page import write_report

SMOKE = [name for name in known_configs() if name.endswith("_smoke")]
# Packages and folders that need not be there.
MAY_SKIP = ("is not installed", "there is no file nowhere")


@pytest.mark.parametrize("name", SMOKE)
def test_the_small_twin_runs_and_is_reported(name, store, inline_engine):
    sweep = load_sweep(name)
    summary = run_sweep(sweep, store, lambda: inline_engine)
    records, bad = store.records()
    assert (summary.failed, summary.unfinished, bad) == (0, 0, []), [record.traceback for record in records]
    for record in records:
        assert record.status == "done" or any(text in record.note for text in MAY_SKIP)
        # Without joints that move there are none to find.
        metrics = {metric: value for metric, value in record.metrics.items() if metric != "joints_right"}
        assert all(value is not None and math.isfinite(value) for value in metrics.values())
        assert all(seconds >= 0 for seconds in record.seconds.values())
        for file in record.artifacts.values():
            assert (store.artifacts(record.id) / file).stat().st_size > 500
    page = write_report(sweep, store, store.root / "report.html").read_text()
    assert sweep.question.replace("'", "&#39;") in page
