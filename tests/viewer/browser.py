"""A real browser, where one is installed."""

import shutil
import time

import pytest

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")


def launch():
    """(playwright, browser) to be closed by the caller; skips with the reason where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    path = next((path for name in NAMES if (path := shutil.which(name))), None)
    if path is None:
        pytest.skip(f"needs a browser: one of {', '.join(NAMES)}")
    playwright = sync_api.sync_playwright().start()
    return playwright, playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])


def wait(page, condition: str, seconds: float = 300) -> None:
    """Until the JavaScript expression holds; the page's policy forbids playwright's own way."""
    end = time.monotonic() + seconds
    while not page.evaluate(f"Boolean({condition})"):
        assert time.monotonic() < end, f"not {condition}: {page.inner_text('#status')!r}"
        time.sleep(0.02)


DRAWN = "window.nerfvol && nerfvol.drawing && nerfvol.drawing.complete && nerfvol.drawing.stats.still"
