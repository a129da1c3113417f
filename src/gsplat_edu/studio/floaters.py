"""Judgements of the studio's scenes: one runs at a time, and a few results are kept."""

from __future__ import annotations

import threading
from pathlib import Path

from gsplat_edu.server.refusal import conflict
from gsplat_edu.viewer.proposing import Proposing

KEPT = 8
"""Judgements that are kept; the oldest ones go first."""


class Proposals:
    """The judgements by scene. It may be used from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: dict[str, Proposing] = {}

    def of(self, key: str, source: Path) -> Proposing:
        """Return the judgement of a scene, a new one if none is kept.

        Args:
            key: Changes with the scene.
            source: Scene file or run folder.
        """
        with self._lock:
            found = self._kept.pop(key, None) or Proposing(source)
            self._kept[key] = found
            idle = [name for name, one in self._kept.items() if not one.running]
            for name in idle[: max(len(self._kept) - KEPT, 0)]:
                if name != key:
                    del self._kept[name]
            return found

    def start(self, proposing: Proposing) -> None:
        """Start a judgement.

        Raises:
            RefusedError: another one is running.
            OSError: the process cannot be started.
        """
        with self._lock:
            if any(one.running and one is not proposing for one in self._kept.values()):
                raise conflict(
                    "another scene is being judged; wait until that ends, or stop it in its editor"
                )
            proposing.start()

    def close(self) -> None:
        """End the one that is running."""
        with self._lock:
            for one in self._kept.values():
                one.stop()
