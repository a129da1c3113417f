"""The headless Chromium of the tests: one for each process that runs tests, started when a test first asks for it."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import pytest

from waiting import PATIENCE

SLOWDOWN = float(os.environ.get("GSPLAT_EDU_SLOW_TABS", "1"))
"""How many times slower the scripts of each new tab run (`make stress`): it finds tests that do not wait for what they
check."""

GRAPHICS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--enable-features=Vulkan",
)
"""WebGL and WebGPU, computed on the CPU."""


class Tabs:
    """Tabs of the process's browser that are closed together.

    Args:
        browser: Playwright's browser.
    """

    def __init__(self, browser: Any) -> None:
        self._browser = browser
        self._contexts: list[Any] = []

    def new_context(self, **options: Any) -> Any:
        """Open a window without cookies or storage; the options are Playwright's."""
        context = self._browser.new_context(**options)
        context.set_default_timeout(1000 * PATIENCE)
        self._contexts.append(context)
        if SLOWDOWN > 1:
            context.on("page", _slow_down)
        return context

    def new_page(self, **options: Any) -> Any:
        """Open a tab in a window of its own."""
        return self.new_context(**options).new_page()

    def close(self) -> None:
        """Close every window that was opened here."""
        for context in self._contexts:
            context.close()


@contextmanager
def chromium(flags: Sequence[str] = GRAPHICS) -> Iterator[Tabs]:
    """Open tabs in this process's Chromium with these flags; without Chromium or Playwright, the test is skipped."""
    tabs = Tabs(_launched(tuple(flags)))
    yield tabs
    tabs.close()


def stop() -> None:
    """End the browsers of this process and what drives them."""
    if _driver.cache_info().currsize:
        _driver().stop()


@cache
def _launched(flags: tuple[str, ...]) -> Any:
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("chromium is not installed")
    return _driver().chromium.launch(executable_path=program, args=["--no-sandbox", *flags])


@cache
def _driver() -> Any:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    return playwright.sync_playwright().start()


def _slow_down(tab: Any) -> None:
    session = tab.context.new_cdp_session(tab)
    session.send("Emulation.setCPUThrottlingRate", {"rate": SLOWDOWN})
