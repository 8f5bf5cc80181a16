"""A headless Chromium for the tests of the page; they are skipped, visibly, where it is not."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = os.environ.get("PLGRIM_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser, of Playwright's synchronous interface."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed: extra `page`"
    )
    if CHROMIUM is None:
        pytest.skip("no Chromium: install the system's package, or name one with PLGRIM_CHROMIUM")
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()


def until(page: Any, condition: str, within_s: float = 30.0) -> float:
    """Wait until an expression holds in the page; seconds waited. The page's policy forbids Playwright's own wait."""
    began = time.monotonic()
    while not page.evaluate(condition):
        assert time.monotonic() - began < within_s, f"never true in the page: {condition}"
        page.wait_for_timeout(50)
    return time.monotonic() - began
