"""A headless browser, for tests of what a browser is to show."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Without a GPU; the less is drawn, the sooner it is there.
_SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_SMALL, _LARGE = {"width": 1000, "height": 700}, {"width": 1400, "height": 900}


@contextmanager
def open_page(*, served: bool = False) -> Iterator:
    """A page of Chromium; the test is skipped where there is no Chromium.

    Args:
        served: whether it is to show what this machine serves, with WebGL; otherwise it reaches no network.
    """
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip("needs Chromium (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        # Tests may run as root, in a container: a sandbox of the browser's own is not to be had there.
        arguments = ["--no-sandbox", *(_SOFTWARE_GL if served else ())]
        browser = driver.chromium.launch(executable_path=path, args=arguments)
        try:
            page = browser.new_context(offline=not served, viewport=_SMALL if served else _LARGE).new_page()
            yield page
        finally:
            browser.close()
