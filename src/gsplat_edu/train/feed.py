"""Which view comes next, and what its render is compared with: read ahead, put over the background, kept on a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from gsplat_edu.errors import ArgumentError
from gsplat_edu.train.saved import check_entries, check_numpy_generator, check_whole
from gsplat_edu.views import Photo, View

DEVICE_SHARE = 0.25
"""Fraction of the GPU memory that is free when training starts which photos may take. Gaussians take the rest."""

CPU = torch.device("cpu")

Color = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Draw:
    """A view whose turn it is.

    Args:
        index: Which of the feed's views.
        view: The view.
        photo: Its photo; None if its target is kept on the GPU.
    """

    index: int
    view: View
    photo: Photo | None


@dataclass(frozen=True, eq=False)
class Target:
    """What the render of a view is compared with, on the Gaussians' device.

    Args:
        image: (H, W, 3) the photo, over the background.
        mask: (H, W) true where a pixel counts; None where all do.
    """

    image: UInt8[Tensor, "H W 3"] | Float32[Tensor, "H W 3"]
    mask: Bool[Tensor, "H W"] | None

    @property
    def nbytes(self) -> int:
        """Bytes it takes."""
        return sum(tensor.nbytes for tensor in (self.image, self.mask) if tensor is not None)


class ViewFeed:
    """An endless sequence of views and targets, the same for the same seed.

    A photo on disk is read while the step before it runs. A photo in memory that is not opaque is put over a fixed
    background once. A GPU keeps as many targets as it has room for, and their photos are not read again; targets over
    random backgrounds are made for every step.

    Args:
        views: What to draw from, at least one.
        order: "shuffled": each once before any comes again; "random": with replacement.
        seed: Seed of the order.
        background: Behind photos that are not opaque; None: a random colour for every draw.
        device: Where the Gaussians are.
        room: Bytes of targets to keep on a GPU; `DEVICE_SHARE` of what is free where None.
    """

    def __init__(
        self,
        views: Sequence[View],
        order: str,
        seed: int,
        background: Color | None = (0.0, 0.0, 0.0),
        device: torch.device = CPU,
        room: int | None = None,
    ) -> None:
        self.views, self._order = tuple(views), order
        self._background, self._device = background, device
        self._generator = np.random.default_rng(seed)
        self._queue: list[int] = []
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="photo")
        self._ahead: tuple[int, Future[Photo]] | None = None
        self._flat: dict[View, Photo] = {}
        self._kept: dict[View, Target] = {}
        self._room = _free_bytes(device) if room is None else room

    def next(self) -> Draw:
        """Draw a view, which stays due if reading its photo fails, and begin to read the photo of the one after it."""
        index = self._following()
        ahead, self._ahead = self._ahead, None
        view = self.views[index]
        photo = None
        if view not in self._kept:
            photo = ahead[1].result() if ahead and ahead[0] == index else self._read(view)
        self._queue.pop(0)  # only now: a photo that could not be read stays due
        following = self._following()
        after = self.views[following]
        if after.on_disk and after not in self._kept:
            self._ahead = following, self._reader.submit(self._read, after)
        return Draw(index, view, photo)

    def _read(self, view: View) -> Photo:
        """Read a photo and put it over the background if that is known; a photo in memory only once."""
        photo = self._flat.get(view) or view.read()
        if photo.alpha is None or self._background is None:
            return photo
        flat = Photo(photo.over(self._background), mask=photo.mask)
        if not view.on_disk:
            self._flat[view] = flat
        return flat

    def target(self, draw: Draw, background: Color) -> Target:
        """Move what `next` returned to the Gaussians' device; keep it there if it will not change and there is room.

        Args:
            draw: The view and its photo.
            background: Behind the photo where it is not opaque; the feed's own if it has one.
        """
        view, photo = draw.view, draw.photo
        if photo is None:
            return self._kept[view]
        mask = None if photo.mask is None else torch.from_numpy(photo.mask).to(self._device)
        target = Target(torch.from_numpy(photo.over(background)).to(self._device), mask)
        if self._device.type != "cpu" and photo.alpha is None and target.nbytes <= self._room:
            self._kept[view] = target
            self._room -= target.nbytes
        return target

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


def _free_bytes(device: torch.device) -> int:
    if device.type != "cuda":
        return 0
    return int(DEVICE_SHARE * torch.cuda.mem_get_info(device)[0])
