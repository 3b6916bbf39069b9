import shutil

import pytest
from PIL import Image

pytest.importorskip("jinja2", reason="experiments take the extra experiments")

from experiments.driver import run_sweep
from experiments.errors import ExperimentError
from experiments.report import browser
from experiments.report.page import write_report
from experiments.schema import ReportConfig


@pytest.fixture
def chromium():
    pytest.importorskip("selenium")
    if shutil.which("chromedriver") is None:
        pytest.skip("there is no Chromium here: apt-get install chromium chromium-driver")


def test_a_report_opens_without_a_network_and_without_complaints(chromium, store, probe_sweep, inline_engine):
    sweep = probe_sweep(
        grid={"scale": [1.0, 2.0], "rounds": [1, 4]}, seeds=2, report=ReportConfig(heat=("scale", "rounds"))
    )
    run_sweep(sweep, store, lambda: inline_engine)
    page = write_report(sweep, store, store.root / "report.html")
    assert browser.photograph(page, store.root / "page.png") == []
    with Image.open(store.root / "page.png") as picture:
        assert picture.width > 1000
        # The heat map is drawn: much of the picture is neither white nor gray.
        red, _, blue = picture.convert("RGB").resize((100, 100)).split()
        pairs = zip(red.tobytes(), blue.tobytes(), strict=True)
        assert sum(abs(one - other) > 60 for one, other in pairs) > 200


def test_complaints_of_the_browser_are_passed_on(chromium, tmp_path):
    page = tmp_path / "bad.html"
    page.write_text("<html><head><link rel='icon' href='data:,'></head><script>undefined_name()</script></html>")
    told = browser.photograph(page, tmp_path / "bad.png")
    assert len(told) == 1
    assert "undefined_name is not defined" in told[0]


def test_without_chromium_it_says_what_to_install(monkeypatch, tmp_path):
    pytest.importorskip("selenium")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ExperimentError, match="apt-get install chromium chromium-driver"):
        browser.photograph(tmp_path / "a.html", tmp_path / "a.png")
