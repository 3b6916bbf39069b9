"""A headless Chromium, where there is one, and pages in it that keep a record of errors and requests."""

import math
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import torchreg as tr
from tests.viz.conftest import spine, tools  # noqa: F401
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy

CHROMIUM = os.environ.get("TORCHREG_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
# WebGL without a graphics card.
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZE = {"width": 900, "height": 540}


@dataclass
class Record:
    """What a page said and asked for."""

    page: object
    errors: list = field(default_factory=list)
    requests: list = field(default_factory=list)

    def problems(self, url):
        """Return errors, and requests to anything but the server at a URL or the page itself."""
        url = url.partition("?")[0]
        near = (url, url.replace("http://", "ws://"), "data:", "blob:")
        return [*self.errors, *(f"asked for {place}" for place in self.requests if not place.startswith(near))]


@pytest.fixture(scope="session")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="tests of pages need the package playwright")
    pytest.importorskip("viser", reason="the viewer needs viser")
    if CHROMIUM is None:
        pytest.skip("tests of pages need chromium, which was not found; set TORCHREG_CHROMIUM to its program")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def record(browser):
    page = browser.new_page(viewport=SIZE)
    found = Record(page)
    page.on("console", lambda message: message.type == "error" and found.errors.append(message.text))
    page.on("pageerror", lambda error: found.errors.append(str(error)))
    page.on("request", lambda request: found.requests.append(request.url))
    page.on("websocket", lambda socket: found.requests.append(socket.url))
    yield found
    page.close()


@pytest.fixture
def pictures(tmp_path):
    """Return the folder that screenshots go to: TORCHREG_SCREENSHOTS, if it is set."""
    place = Path(os.environ.get("TORCHREG_SCREENSHOTS", tmp_path))
    place.mkdir(parents=True, exist_ok=True)
    return place


@pytest.fixture(scope="session")
def toy_pair():
    return jointed_toy(2, seed=2, scanner=DepthScanner(num_points=3000), step=math.radians(20)).pair(0, 1)


@pytest.fixture(scope="session")
def registered_toy(toy_pair):
    return tr.register(toy_pair.source, toy_pair.target, 8, 40, start=toy_pair.truth)


@pytest.fixture
def app(registered_toy, tmp_path):
    from torchreg.viz.pose_app import PoseApp
    from torchreg.viz.pose_editor import PoseEditor

    with PoseApp(PoseEditor(registered_toy), output=tmp_path / "posed", port=0) as app:
        yield app
