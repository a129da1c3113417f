"""A headless Chromium for tests in a browser."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

PATIENCE = 180_000
"""Milliseconds that a tab waits by default, long enough for a computer that runs other tests as well."""

SLOWDOWN = float(os.environ.get("GSPLAT_EDU_SLOW_TABS", "1"))
"""How many times slower the scripts of each new tab run: `GSPLAT_EDU_SLOW_TABS=6` finds tests that do not wait for what
they check."""


@contextmanager
def chromium(flags: Sequence[str] = ()) -> Iterator[Any]:
    """Launch Chromium, or skip the test if Chromium or Playwright is not installed."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("chromium is not installed")
    with playwright.sync_playwright() as driver:
        launched = driver.chromium.launch(executable_path=program, args=["--no-sandbox", *flags])
        yield patient(launched)
        launched.close()


def patient(browser: Any) -> Any:
    """Make the tabs of a browser wait for PATIENCE, and run SLOWDOWN times slower."""
    new_page, new_context = browser.new_page, browser.new_context

    def slowed(tab: Any) -> Any:
        tab.set_default_timeout(PATIENCE)
        if SLOWDOWN > 1:
            session = tab.context.new_cdp_session(tab)
            session.send("Emulation.setCPUThrottlingRate", {"rate": SLOWDOWN})
        return tab

    def context_with(**options: Any) -> Any:
        context = new_context(**options)
        context.set_default_timeout(PATIENCE)
        page_of = context.new_page
        context.new_page = lambda: slowed(page_of())
        return context

    browser.new_page = lambda **options: slowed(new_page(**options))
    browser.new_context = context_with
    return browser
