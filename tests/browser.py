"""A real browser for the tests that look at pages: Debian's Chromium without a window."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service

FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --disable-dev-shm-usage --window-size=1400,1600"
)


@contextmanager
def open_browser(profile: Path) -> Iterator[Chrome]:
    """
    A browser that logs what the pages ask for and what they complain about.

    :param profile: Empty folder for the browser's own files
    """
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.fail("this test needs a browser: apt-get install chromium chromium-driver (make test does it)")
    options = ChromeOptions()
    options.binary_location = chromium
    for flag in [*FLAGS.split(), f"--user-data-dir={profile}"]:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    browser = Chrome(options=options, service=Service(driver))
    try:
        browser.get("about:blank")
        requested(browser)  # of the browser's own first page
        yield browser
    finally:
        browser.quit()


def requested(browser: Chrome) -> list[str]:
    """Addresses that the pages asked for since the last call, without those that need no network."""
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    urls = [message["params"]["request"]["url"] for message in messages if message["method"] == "Network.requestWillBeSent"]
    return [url for url in urls if not url.startswith(("data:", "blob:", "chrome:"))]
