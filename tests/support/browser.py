"""A headless browser, for tests of what a browser is to show."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


@contextmanager
def open_page() -> Iterator:
    """A page of Chromium that reaches no network; the test is skipped where there is no Chromium."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip("needs Chromium (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        # Tests may run as root, in a container: a sandbox of the browser's own is not to be had there.
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        try:
            page = browser.new_context(offline=True, viewport={"width": 1400, "height": 900}).new_page()
            yield page
        finally:
            browser.close()
