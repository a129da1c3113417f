"""Draw the next view and prepare its target: read ahead, composited over the background, and cached on a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.scene.photo import Photo, eroded
from gsplat_edu.scene.views import View
from gsplat_edu.train.saved import check_entries, check_numpy_generator, check_whole

DEVICE_SHARE = 0.25
"""Fraction of the GPU memory free at the start of training that photos may use. The rest is for the Gaussians."""

SMALLEST_SIDE = 32
"""Photos are not reduced below this side, px: SSIM's window has 11."""

REDUCED_ROOM = 1 << 29
"""Bytes of photos of reduced size that are kept in memory; others are downscaled again for each use."""

CPU = torch.device("cpu")

Color = tuple[float, float, float]

Ready = tuple[Photo, Bool[np.ndarray, "H W"] | None]
"""A photo, composited if the background is fixed, and its `opaque` before that."""


@dataclass(frozen=True, eq=False)
class Draw:
    """The view drawn for a step.

    Args:
        index: Index into the feed's views.
        view: The view.
        photo: Its photo, composited already if the background is fixed; None if its target is cached on the GPU.
        opaque: (H, W) `Photo.opaque`.
    """

    index: int
    view: View
    photo: Photo | None
    opaque: Bool[np.ndarray, "H W"] | None = None


@dataclass(frozen=True, eq=False)
class Target:
    """The target of a view's render, on the Gaussians' device.

    Args:
        image: (H, W, 3) the photo over the background.
        mask: (H, W) true for pixels that count; None if all do.
        opaque: (H, W) `Photo.opaque`; None if the photo has no alpha.
        outside: (H, W) `Photo.excluded` of the capture's own mask, without a margin of a pixel, because the edges of
            masks are not exact; None if the photo has no mask, or the feed was made without `outside`.
    """

    image: UInt8[Tensor, "H W 3"] | Float32[Tensor, "H W 3"]
    mask: Bool[Tensor, "H W"] | None
    opaque: Bool[Tensor, "H W"] | None = None
    outside: Bool[Tensor, "H W"] | None = None

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        planes = (self.image, self.mask, self.opaque, self.outside)
        return sum(tensor.nbytes for tensor in planes if tensor is not None)


class ViewFeed:
    """An endless sequence of views and targets, determined by the seed.

    A photo on disk is read while the previous step runs. A photo in memory that is not opaque is composited over a
    fixed background only once. As many targets as fit into `room` are cached, and their photos are not read again;
    targets over random backgrounds are made for every step.

    Args:
        views: Views to draw from, at least one.
        order: "shuffled" draws each view once before any is repeated; "random" draws with replacement.
        seed: Seed of the order.
        background: Colour behind photos that are not opaque; None for a random colour per draw.
        device: Device of the Gaussians.
        room: Bytes of targets to cache; if None, `DEVICE_SHARE` of a GPU's free memory, and 0 on the CPU.
        outside: Whether targets contain the pixels that the capture's masks exclude.
    """

    def __init__(
        self,
        views: Sequence[View],
        order: str,
        seed: int,
        background: Color | None = (0.0, 0.0, 0.0),
        device: torch.device = CPU,
        room: int | None = None,
        outside: bool = False,
    ) -> None:
        self.views = self._full = tuple(views)
        self._factor, self._order = 1.0, order
        self._shortest = min(min(view.camera.W, view.camera.H) for view in self._full)
        self._background, self._device, self._outside = background, device, outside
        self._generator = np.random.default_rng(seed)
        self._queue: list[int] = []
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="photo")
        self._ahead: tuple[int, Future[Ready]] | None = None
        self._flat: dict[View, Ready] = {}
        self._flat_room = 0
        self._kept: dict[View, Target] = {}
        self._room = _free_bytes(device) if room is None else room

    def use_factor(self, factor: float) -> None:
        """Give the views with width and height divided by a factor from now on; the order of the draws stays.

        No side is reduced below `SMALLEST_SIDE`. Photos of reduced size are kept in memory up to `REDUCED_ROOM`.

        Args:
            factor: At least 1.
        """
        factor = max(min(factor, self._shortest / SMALLEST_SIDE), 1.0)
        if factor == self._factor:
            return
        if self._ahead is not None:
            self._ahead[1].exception()  # waits: the thread must not add to the cache any more
        self._factor, self.views = factor, tuple(view.scaled(factor) for view in self._full)
        self._room += sum(target.nbytes for target in self._kept.values())
        self._ahead, self._flat, self._kept = None, {}, {}
        self._flat_room = REDUCED_ROOM

    def next(self, later: int = 1) -> Draw:
        """Draw a view, and start reading the photo of a later one. If reading fails, the view remains due.

        Args:
            later: Number of draws to look ahead: the photo of that draw is read now, if the draw is known.
        """
        index = self._following()
        ahead, self._ahead = self._ahead, None
        view = self.views[index]
        photo = opaque = None
        if view not in self._kept:
            photo, opaque = ahead[1].result() if ahead and ahead[0] == index else self._read(view)
        self.skip()  # after reading, so that a view whose photo cannot be read is drawn again
        if later <= len(self._queue):
            following = self._queue[later - 1]
            after = self.views[following]
            if after.on_disk and after not in self._kept:
                self._ahead = following, self._reader.submit(self._read, after)
        return Draw(index, view, photo, opaque)

    def close(self) -> None:
        """Finish the photo that is being read, and end the thread that reads ahead; the feed is not used after that."""
        self._reader.shutdown()

    def skip(self) -> None:
        """Draw a view that another process renders; its photo is not read."""
        self._following()
        self._queue.pop(0)
        self._following()

    def _read(self, view: View) -> Ready:
        """Read a photo and composite it over a fixed background; cache it if it was in memory or is of reduced size."""
        if view in self._flat:
            return self._flat[view]
        photo = view.read()
        opaque = photo.opaque
        if photo.alpha is not None and self._background is not None:
            photo = Photo(photo.over(self._background), None, photo.mask, photo.outside, photo.lens_only)
            if not view.on_disk:
                self._flat[view] = photo, opaque
        nbytes = photo.nbytes + (0 if opaque is None else opaque.nbytes)
        if self._factor > 1.0 and nbytes <= self._flat_room:
            self._flat[view] = photo, opaque
            self._flat_room -= nbytes
        return photo, opaque

    def target(self, draw: Draw, background: Color) -> Target:
        """Move the target of a draw to the Gaussians' device; cache it there if it is constant and fits.

        Args:
            draw: The result of `next`.
            background: Colour behind a photo that is not opaque; the feed's own if it has one.
        """
        view, photo = draw.view, draw.photo
        if photo is None:
            return self._kept[view]
        outside = photo.excluded if self._outside else None
        planes = (photo.mask, draw.opaque, None if outside is None else eroded(outside))
        moved = [None if plane is None else torch.from_numpy(plane).to(self._device) for plane in planes]
        target = Target(torch.from_numpy(photo.over(background)).to(self._device), *moved)
        if photo.alpha is None and target.nbytes <= self._room:
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
        """Return the state for a checkpoint, as JSON: the outstanding draws and the generator."""
        return {"queue": list(self._queue), "generator": self._generator.bit_generator.state}

    def check_state(self, state: object) -> None:
        """Check a state before `load_state` uses it.

        Raises:
            ArgumentError: the state does not fit these views; the message names the entry.
        """
        given = check_entries("feed", state, ("queue", "generator"))
        queue, count = given["queue"], len(self.views)
        if not isinstance(queue, list) or len(queue) > (1 if self._order == "random" else count):
            raise ArgumentError("feed: queue: has to be a list of at most one entry per view")
        for index in queue:
            check_whole("feed: queue", index, count - 1)
        if len(set(queue)) < len(queue):
            raise ArgumentError("feed: queue: contains a view twice")
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
