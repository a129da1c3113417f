"""Which view comes next, and its photo, read ahead where it lies on disk."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from gsplat_edu.errors import ArgumentError
from gsplat_edu.train.saved import check_entries, check_numpy_generator, check_whole
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
        self._queue.pop(0)
        ahead, self._ahead = self._ahead, None
        view = self.views[index]
        photo = ahead[1].result() if ahead and ahead[0] == index else view.read()
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

    def check_state(self, state: object) -> None:
        """Check what `load_state` is going to take.

        Raises:
            ArgumentError: it is not what `state` returns for these views; names the entry.
        """
        given = check_entries("feed", state, ("queue", "generator"))
        queue, count = given["queue"], len(self.views)
        if not isinstance(queue, list) or len(queue) > (1 if self._order == "random" else count):
            raise ArgumentError("feed: queue: has to be a list of at most one entry per view")
        for index in queue:
            check_whole("feed: queue", index, count - 1)
        if len(set(queue)) < len(queue):
            raise ArgumentError("feed: queue: names a view twice")
        check_numpy_generator("feed: generator", given["generator"], self._generator)

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.check_state(state)
        self._queue, self._ahead = list(state["queue"]), None
        self._generator.bit_generator.state = state["generator"]
