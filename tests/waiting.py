"""Waiting for a state of a thread, a program or a page. Nothing else in the tests may wait for a time, and
`repo/test_house_limits.py` checks that. Programs that tests start import it too, so it imports little.
"""

import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

HERE = str(Path(__file__).parent)
"""Folder in which a program that a test starts finds this module."""

PATIENCE = 300.0
"""Seconds until a state that does not come fails a test, long enough for a computer that runs other tests as well."""

PAUSE = 0.01
"""Seconds between two looks."""

FRAMES = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))"
"""Two frames of a page: what it planned for the next one is drawn."""


def until(
    condition: Callable[[], Any],
    what: str = "the awaited state",
    pause: Callable[[float], None] = time.sleep,
) -> Any:
    """Wait until a function returns a true value, and return that value.

    Args:
        condition: The function.
        what: What is waited for, for the message of a failure.
        pause: Lets some seconds pass; for a page, something that lets its events arrive.
    """
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end, f"{what} did not occur"
        pause(PAUSE)
    return found


def finished(coroutine: Coroutine[Any, Any, Any]) -> Any:
    """Run a coroutine to its end and return its result; in a thread of its own, because the main thread of a process
    that drives a browser has a running event loop."""
    import asyncio
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, asyncio.wait_for(coroutine, PATIENCE)).result()


def awaited(tab: Any, condition: Callable[[], Any], what: str = "the awaited state") -> Any:
    """Let a tab and its routes go on until a function returns a true value, and return that value."""
    return until(condition, what, lambda seconds: tab.wait_for_timeout(1000 * seconds))


def until_in(tab: Any, frame: Any, expression: str) -> None:
    """Wait until an expression is true in a frame of a tab. Playwright's own function needs eval, which our policies
    forbid."""
    awaited(tab, lambda: _holds(frame, expression), expression)


def resize(tab: Any, width: int, height: int) -> None:
    """Change the size of a tab's window, CSS px, and wait until its page has that size: what is loaded before then
    would see the old one."""
    tab.set_viewport_size({"width": width, "height": height})
    wanted = [width, height]
    awaited(
        tab, lambda: tab.evaluate("[innerWidth, innerHeight]") == wanted, f"a window of {width} x {height}"
    )


def pass_time(tab: Any, milliseconds: int) -> None:
    """Move the clock of a page on, if the test has installed one: every timer in between fires at once, and what the
    page asked its server for has been answered and drawn."""
    tab.clock.run_for(milliseconds)
    settle(tab)


def settle(tab: Any) -> None:
    """Let a page draw what has reached it, and what its server answers to the requests that it has made."""
    tab.evaluate("fetch(location.href).then((answer) => answer.text())")
    tab.evaluate(FRAMES)


def _holds(frame: Any, expression: str) -> bool:
    """Evaluate an expression; false in a frame that is navigating."""
    from playwright.sync_api import Error

    try:
        return bool(frame.evaluate(expression))
    except Error as error:
        if "navigation" not in str(error):
            raise
        return False
