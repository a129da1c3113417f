"""Pictures for browsers without WebGL2, drawn by our own renderer on request, and rarely while a training runs."""

from __future__ import annotations

import base64
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from gsplat_edu.base.locks import POLL
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.workers import Worker

NICE = 10
"""Niceness of the drawing process, so that a training goes first."""

REST = 24.0
"""While a training runs, pause after each picture for this multiple of its processor time.

One thread then draws for 1/25 of the time, so the training slows by at most 4 %, even if all its threads wait for that
core.
"""

MOST_WAITING = 4
"""Largest number of waiting requests; each holds a thread of the server."""


class Painter:
    """Draws for all pages, one picture after the other.

    Attributes:
        worker: The process that draws.
        free_at: When the next picture may be drawn beside a training, in seconds of `time.monotonic`.
    """

    def __init__(self) -> None:
        self.worker = Worker(NICE)
        self._room = threading.Semaphore(MOST_WAITING)
        self._one = threading.Lock()
        self.free_at = 0.0
        self._closed = False

    def paint(self, is_training: Callable[[], bool], **task: Any) -> bytes:  # noqa: ANN401
        """Return a JPEG, after earlier requests and, while a training runs, after the pause.

        Args:
            is_training: Whether a training runs now.
            task: See `gsplat_edu.studio.worker.make_picture`.

        Raises:
            RefusedError: too many requests wait, or the picture cannot be drawn; has the line.
        """
        if not self._room.acquire(blocking=False):
            raise RefusedError(
                "picture: too many pages wait for one; close some", HTTPStatus.SERVICE_UNAVAILABLE
            )
        try:
            with self._one:
                while not self._closed and is_training() and time.monotonic() < self.free_at:
                    time.sleep(POLL)
                made = self.worker.ask("picture", threads=int(is_training()), **task)
                self.free_at = time.monotonic() + REST * made["seconds"]
        finally:
            self._room.release()
        return base64.b64decode(made["jpeg"])

    def close(self) -> None:
        """End the worker."""
        self._closed = True
        self.worker.close()
