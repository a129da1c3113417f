"""Run `gsplat_edu.runs.floaters` beside a server, and say how far it is. Imports nothing slow."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

NAME = "floaters"
"""Last part of the address at which an editor's server answers: GET returns the state, POST starts, DELETE stops."""

MODULE = "gsplat_edu.runs.floaters"


class Proposing:
    """A judgement of one scene, in a process of its own. It may be used from any thread.

    Attributes:
        process: The process while it judges; else None.
    """

    def __init__(self, source: Path) -> None:
        """Take the scene file or run folder; nothing starts yet."""
        self._source = source
        self._lock = threading.Lock()
        self.process: subprocess.Popen[bytes] | None = None
        self._state: dict[str, Any] = {"state": "idle"}

    @property
    def running(self) -> bool:
        """Whether it is judging."""
        return bool(self.state()["state"] == "running")

    def state(self) -> dict[str, Any]:
        """Return "state" and what belongs to it.

        "idle"; "running" with done and total; "done" with groups and basis; "failed" with error.
        """
        with self._lock:
            return dict(self._state)

    def start(self) -> None:
        """Start to judge, unless it is running.

        Raises:
            OSError: the process cannot be started.
        """
        with self._lock:
            if self.process is not None:
                return
            process = subprocess.Popen(
                (sys.executable, "-m", MODULE, os.fspath(self._source.resolve())),
                stdin=subprocess.PIPE,  # its end tells the process that this one has ended
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
            self.process, self._state = process, {"state": "running", "done": 0, "total": 0}
        threading.Thread(target=self._follow, args=(process,), daemon=True).start()

    def stop(self) -> None:
        """End the judgement, if it is running, and forget its result."""
        with self._lock:
            process, self.process, self._state = self.process, None, {"state": "idle"}
        if process is not None:
            process.kill()

    def _follow(self, process: subprocess.Popen[bytes]) -> None:
        """Take the lines of the process until it ends."""
        last: dict[str, Any] = {}
        assert process.stdout is not None and process.stdin is not None
        for line in process.stdout:
            if not line.endswith(b"\n"):
                break
            last = json.loads(line)
            if "done" in last:
                self._set(process, {"state": "running", **last})
        process.stdout.close()
        process.stdin.close()
        process.wait()
        if "groups" in last:
            state = {"state": "done", **last}
        else:
            line = last.get("error", "the process that judges has ended; close other programs, and try again")
            state = {"state": "failed", "error": line}
        self._set(process, state, ended=True)

    def _set(self, process: subprocess.Popen[bytes], state: dict[str, Any], ended: bool = False) -> None:
        with self._lock:
            if self.process is not process:
                return  # it was stopped
            self._state = state
            if ended:
                self.process = None
