"""Gestures of a person's mouse and fingers on any page. Places are CSS px of the window."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from waiting import FRAMES

STEPS = 4
"""Moves from one place to the next."""


def drag(tab: Any, *places: Sequence[float], button: str = "left") -> None:
    """Press the mouse at the first place, move it along the others, and release it at the last one."""
    tab.mouse.move(*places[0])
    tab.mouse.down(button=button)
    for place in places[1:]:
        tab.mouse.move(*place, steps=STEPS)
    tab.mouse.up(button=button)


def touch(session: Any, kind: str, *places: Sequence[float]) -> None:
    """Put fingers down at some places, move them there, or lift those that have no place; wait until the page has heard
    of it.

    Args:
        session: A session of the browser's protocol with the tab.
        kind: touchStart, touchMove or touchEnd.
        places: A place for each finger.
    """
    points = [{"x": float(x), "y": float(y), "id": i} for i, (x, y) in enumerate(places)]
    session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    session.send("Runtime.evaluate", {"expression": f"({FRAMES})()", "awaitPromise": True})


def swipe(tab: Any, *places: Sequence[float]) -> None:
    """Put a finger down at the first place, move it along the others, and lift it."""
    session = tab.context.new_cdp_session(tab)
    touch(session, "touchStart", places[0])
    for start, end in pairwise(places):
        for k in range(1, STEPS + 1):
            touch(
                session, "touchMove", tuple(a + k / STEPS * (b - a) for a, b in zip(start, end, strict=True))
            )
    touch(session, "touchEnd")
    session.detach()


def inside(box: Mapping[str, float], *shares: Sequence[float]) -> Iterator[tuple[float, float]]:
    """Yield the places at some fractions of a box's width and height."""
    for x, y in shares:
        yield box["x"] + x * box["width"], box["y"] + y * box["height"]
