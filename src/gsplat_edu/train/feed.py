"""Which view comes next, and its photo, read ahead where it lies on disk."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from gsplat_edu.views import Photo, View


class ViewFeed:
    """An endless sequence of views, the same for the same seed.

    Args:
        views: What to draw from, at least one.
        order: "shuffled": each once before any comes again; "random": with replacement.
        seed: Seed of the order.
    """

    def __init__(self, views: Sequence[View], order: str, seed: int) -> None:
        self.views, self._order = tuple(views), order
        self._generator = np.random.default_rng(seed)
        self._queue: list[int] = []
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="photo")
        self._ahead: tuple[int, Future[Photo]] | None = None

    def next(self) -> tuple[View, Photo]:
        """Draw a view, and begin to read the photo of the one after it."""
        index = self._following()
        ahead, self._ahead = self._ahead, None
        view = self.views[index]
        photo = ahead[1].result() if ahead and ahead[0] == index else view.read()
        self._queue.pop(0)  # not before: a photo that cannot be read is still due
        following = self._following()
        if self.views[following].on_disk:
            self._ahead = following, self._reader.submit(self.views[following].read)
        return view, photo

    def _following(self) -> int:
        if not self._queue and self._order == "random":
            self._queue.append(int(self._generator.integers(len(self.views))))
        elif not self._queue:
            self._queue += self._generator.permutation(len(self.views)).tolist()
        return self._queue[0]

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint keeps: the draws that are outstanding and the generator, as JSON."""
        return {"queue": list(self._queue), "generator": self._generator.bit_generator.state}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self._queue, self._ahead = [int(index) for index in state["queue"]], None
        if any(not 0 <= index < len(self.views) for index in self._queue):
            raise ValueError("it names a view that is not there")
        self._generator.bit_generator.state = state["generator"]
