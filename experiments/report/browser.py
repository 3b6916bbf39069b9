"""A report in a browser: a picture of the page, and the browser's messages."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from torchreg.io.atomic import write_atomic

from ..errors import ExperimentError
from ..store import explained

_WIDTH, _MAX_HEIGHT, _SETTLE_SECONDS = 1250, 8000, 1.0
_NAMES = ("chromium", "chromium-browser", "google-chrome")


def photograph(page: Path, picture: Path) -> list[str]:
    """Write a PNG of a whole page, opened without a network, and return the messages of the browser's console.

    Args:
        page: an HTML file.
        picture: where to.

    Raises:
        ExperimentError: if Chromium, its driver or selenium is not installed.
        StoreError: if the picture cannot be written.
    """
    try:
        from selenium import webdriver
    except ImportError as error:
        raise ExperimentError("selenium is not installed: pip install selenium") from error
    browser = next(filter(None, map(shutil.which, _NAMES)), None)
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        raise ExperimentError("Chromium is not installed: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    # Names are not resolved: what the page does not hold itself shows up as an error.
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--host-resolver-rules=MAP * ~NOTFOUND"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        chrome.set_window_size(_WIDTH, 1000)
        chrome.get(page.absolute().as_uri())
        height = int(chrome.execute_script("return document.documentElement.scrollHeight"))
        chrome.set_window_size(_WIDTH, min(height + 150, _MAX_HEIGHT))
        time.sleep(_SETTLE_SECONDS)
        with explained(picture):
            write_atomic(picture, chrome.get_screenshot_as_png())
        return [f"{entry['level']}: {entry['message']}" for entry in chrome.get_log("browser")]
    finally:
        chrome.quit()
