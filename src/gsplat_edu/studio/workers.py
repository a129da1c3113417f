"""Worker processes for short tasks, so that the server never imports torch and never decodes a photo."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from http import HTTPStatus
from typing import Any

from gsplat_edu.base.locks import POLL
from gsplat_edu.base.reading import parse_json
from gsplat_edu.server.refusal import RefusedError

PATIENCE = 180.0
"""Seconds after which a worker that does not answer is ended."""

MOST_WAITING = 6
"""Requests that wait for a worker; each holds a thread of the server."""

COMMAND = (sys.executable, "-m", "gsplat_edu.studio.worker")
"""What runs a worker."""


class Worker:
    """A worker process, started when it is needed. It may be used from any thread.

    Requests wait for one another; equal ones that wait get one answer.

    Args:
        nice: Niceness of the process.
        waiting: Requests that may wait for it; None for `MOST_WAITING`.
        command: What runs a worker, but for its niceness; it answers lines as `gsplat_edu.studio.worker` does.
        patience: Seconds after which a worker that does not answer is ended.

    Attributes:
        process: The process; None before the first request and after one that it did not answer.
        closed: Whether it was closed, and starts no process any more.
        asked: Requests that wait or run now.
    """

    def __init__(
        self,
        nice: int = 0,
        waiting: int | None = None,
        command: Sequence[str] = COMMAND,
        patience: float = PATIENCE,
    ) -> None:
        self._command, self._patience = (*command, str(nice)), patience
        self._lock = threading.Lock()
        self.closed = False
        self._most = MOST_WAITING if waiting is None else waiting
        self.asked = 0
        self._sharing = threading.Lock()  # of the two around it
        self._coming: dict[bytes, Future[bytes]] = {}  # the answers to requests that have not begun
        self.process: subprocess.Popen[bytes] | None = None

    def ask(self, task: str, **arguments: Any) -> Any:  # noqa: ANN401
        """Run a task (`gsplat_edu.studio.worker.TASKS`) in the worker and return its result.

        Raises:
            RefusedError: it failed, has ended, or too many requests are waiting; has the line.
        """
        line = json.dumps({"task": task, **arguments}).encode() + b"\n"
        with self._sharing:
            if self.asked >= self._most:
                raise RefusedError(
                    f"{task}: too many requests are waiting; try again soon", HTTPStatus.SERVICE_UNAVAILABLE
                )
            self.asked += 1
            shared = self._coming.get(line)
            own = self._coming[line] = Future() if shared is None else shared
        try:
            said = self._answered(line, own) if shared is None else shared.result()
        finally:
            with self._sharing:
                self.asked -= 1
        if not said:
            raise RefusedError(
                f"{task}: its process ended or took too long; close other programs, or cancel a job",
                HTTPStatus.INTERNAL_SERVER_ERROR,
            )
        found = parse_json(said)
        if "error" in found:
            raise RefusedError(found["error"])
        return found["result"]

    def close(self) -> None:
        """End the process and its task."""
        self.closed = True
        while not self._lock.acquire(timeout=POLL):  # a request waits for an answer, or starts the process
            if (process := self.process) is not None:
                process.kill()
        try:
            self._drop()
        finally:
            self._lock.release()

    def _drop(self) -> None:
        """Forget the process."""
        process, self.process = self.process, None
        if process is None:
            return
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()

    def _answered(self, line: bytes, answer: Future[bytes]) -> bytes:
        """Send a request when those before it are done; return its answer, and give it to those who share it."""
        try:
            with self._lock:
                with self._sharing:
                    del self._coming[line]  # later requests may be about newer files
                # again if the process had just ended after `IDLE` seconds
                said = self._asked(line) or self._asked(line)
        except BaseException as error:
            answer.set_exception(error)
            raise
        answer.set_result(said)
        return said

    def _asked(self, line: bytes) -> bytes:
        """Send a request; return the answer, empty if there is none."""
        if self.closed:
            return b""
        if self.process is None or self.process.poll() is not None:
            self._drop()
            self.process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )
        process = self.process
        assert process.stdin is not None and process.stdout is not None
        timer = threading.Timer(self._patience, process.kill)
        timer.start()
        try:
            process.stdin.write(line)
            process.stdin.flush()
            said = process.stdout.readline()
        except OSError:
            said = b""
        finally:
            timer.cancel()
        if said.endswith(b"\n"):
            return said
        self._drop()
        return b""
