"""A training that stays on the device: Gaussians, moments, statistics and photos, and the steps that change them.

A step is one submission, and the host does not wait for it: what it reads of a step, eight words, it reads after it has
submitted the next one. If a step found no room for its pairs, it and the one after it changed nothing; they are
submitted again when there is room.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.engine.frame import CORE, PAIRS, PIXEL, VISIBLE, render_counts, rounded_pairs
from gsplat_edu.engine.host import Device, Memory
from gsplat_edu.engine.passes import sort_bits
from gsplat_edu.engine.step import (
    DISSIMILARITY,
    HALT,
    L1,
    LIVE,
    OPACITY,
    PAIRS_AT_FIRST,
    PAIRS_SPARE,
    SCALE,
    STATE,
    STATISTICS,
    Noise,
    PackedPhoto,
    StepNumbers,
    pairs_room,
    step_program,
)
from gsplat_edu.engine.transfers import Kept, Ticket
from gsplat_edu.engine.view import DeviceView

PHOTO_ROOM = 1 << 30
"""Bytes of photos that stay on the device; others are sent again for each step. WebGPU does not tell free memory."""

IN_FLIGHT = 1
"""Steps that may be unfinished when the next one is submitted."""


@dataclass(frozen=True)
class Sums:
    """What a step tells the host.

    Args:
        l1: Mean of |image - photo|.
        dissimilarity: Mean of 1 - SSIM.
        opacity: Sum of the opacities that are averaged.
        scale: Sum of the scales.
        visible: Gaussians that were drawn.
        pairs: Pairs of Gaussian and tile.
    """

    l1: float
    dissimilarity: float
    opacity: float
    scale: float
    visible: int
    pairs: int


class Result:
    """The sums of a step, when they have arrived.

    Args:
        resident: Whose step it is.
        values: 3 H W of its view.
    """

    def __init__(self, resident: Resident, values: int) -> None:
        self._resident, self._values = resident, values
        self._sums: Sums | None = None

    @property
    def sums(self) -> Sums:
        """The sums; waits for the step.

        Raises:
            BackendUnavailableError: the device fails.
        """
        while self._sums is None:
            self._resident.collect()
        return self._sums

    def arrive(self, live: np.ndarray) -> None:
        """Take the contents of `live` at the end of the step."""
        floats = live.view(np.float32).astype(np.float64)
        l1, dissimilarity = (float(floats[place]) / self._values for place in (L1, DISSIMILARITY))
        sums = float(floats[OPACITY]), float(floats[SCALE])
        self._sums = Sums(l1, dissimilarity, *sums, int(live[VISIBLE]), int(live[PAIRS]))


@dataclass(eq=False)
class _Step:
    """A step as it was submitted, to be submitted again if it found no room."""

    view: DeviceView
    photo: KeptPhoto
    numbers: StepNumbers
    result: Result
    ticket: Ticket | None = None
    noise: Noise | None = None


@dataclass(frozen=True, eq=False)
class KeptPhoto:
    """A photo on the device, and whether its colours are floats."""

    kept: Kept
    floats: bool


class Resident:
    """The Gaussians of a run on a device.

    Args:
        device: The device.
        harmonics: K, per Gaussian besides the first.
        photo_room: Bytes of photos to keep there.

    Attributes:
        most_pairs_each: Most pairs a Gaussian that a step has had, with some to spare; new buffers have room for these.
        unfinished: Steps whose sums have not arrived, oldest first.
        photos: By the number of its view, what a photo on the device belongs to, and the photo.
        photo_room: Bytes that are left for further photos.
    """

    def __init__(self, device: Device, harmonics: int, photo_room: int = PHOTO_ROOM) -> None:
        self.device, self.harmonics = device, harmonics
        self.count = 0
        self._memory: Memory | None = None
        self._pixels, self._tiles, self._pairs = 1, 1, 0
        self._optics = "pinhole"
        self.most_pairs_each = PAIRS_AT_FIRST
        self.unfinished: deque[_Step] = deque()
        self.photos: dict[int, tuple[object, KeptPhoto]] = {}
        self.photo_room = photo_room
        self._last: DeviceView | None = None
        self._failure: BackendUnavailableError | None = None

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Begin with Gaussians, moments and statistics.

        Args:
            state: float32 arrays by the names of `STATE`: core, core_first and core_second (N, 14); rest, rest_first
                and rest_second (N, K, 3); statistics (N, 2).

        Raises:
            BackendUnavailableError: the device has too little memory or too small buffers; the message says which.
        """
        if self._failure is None:
            self.settle()
        self._failure = None
        count = len(state["core"])
        like = self._memory if count == self.count else None
        self._memory = self._last = None  # given back before the next one is asked for
        self.count = count
        self._pairs = pairs_room(count, self.most_pairs_each)
        memory = self._allocate(like)
        for name in STATE:
            memory.write(name, state[name])
        self._memory = memory

    def read(self) -> dict[str, np.ndarray]:
        """Wait for all steps, and return the state; see `load`."""
        memory = self._settled()
        shapes = {"core": (self.count, CORE), "rest": (self.count, self.harmonics, 3)}
        shapes["statistics"] = (self.count, STATISTICS)
        found = {}
        for name in STATE:
            shape = shapes.get(name) or shapes[name.partition("_")[0]]
            found[name] = memory.read(name).view(np.float32)[: int(np.prod(shape))].reshape(shape).copy()
        return found

    def image(self) -> np.ndarray:
        """Wait for all steps, and return the last one's image, (H, W, 3) float32."""
        memory, view = self._settled(), self._last
        if view is None:
            raise ValueError("there is no image: take a step first")
        H, W = view.camera.H, view.camera.W
        planes = memory.read("image").view(np.float32)[: H * W * PIXEL].reshape(H, W, PIXEL)
        return planes[..., :3].copy()

    def step(
        self,
        view: DeviceView,
        index: int,
        photo: Callable[[], PackedPhoto],
        constant: object | None,
        numbers: StepNumbers,
    ) -> Result:
        """Submit a step, and wait at most for the one before the last.

        Args:
            view: Camera and settings.
            index: The view's number, under which its photo is kept.
            photo: Returns the photo; called if it is not on the device.
            constant: What the photo belongs to: it is the same whenever this is. None if it is another each time.
            numbers: Rates and weights.

        Raises:
            BackendUnavailableError: the device fails, or has no buffers that large.
        """
        pixels = view.camera.H * view.camera.W
        one = _Step(view, self._photo(index, photo, constant), numbers, Result(self, 3 * pixels))
        if self._failure is not None:
            raise self._failure
        self._submit(one)
        while len(self.unfinished) > IN_FLIGHT:
            self.collect()
        return one.result

    def add_noise(self, noise: Noise) -> None:
        """Move the means at random after the last step, without waiting for it.

        Raises:
            BackendUnavailableError: the device fails.
        """
        if self.unfinished:
            self.unfinished[-1].noise = noise
        self.memory.play("noise", noise.packed())

    def settle(self) -> None:
        """Wait for all steps.

        Raises:
            BackendUnavailableError: the device fails; or a step found no room and could not get it, now or before.
        """
        if self._failure is not None:
            raise self._failure
        while self.unfinished:
            self.collect()

    def collect(self) -> None:
        """Wait for the oldest step whose sums have not arrived, and take them; repeat it if it found no room."""
        one = self.unfinished[0]
        live = _words(one)
        if not live[HALT]:
            self.unfinished.popleft()
            needed = PAIRS_SPARE * int(live[PAIRS]) / max(self.count, 1)
            self.most_pairs_each = max(self.most_pairs_each, needed)
            one.result.arrive(live)
            return
        again = list(self.unfinished)
        for other in again[1:]:
            _words(other)
        self.unfinished.clear()
        self._pairs = rounded_pairs(int(live[PAIRS]))
        try:
            self._memory = self._allocate(self.memory)
        except BackendUnavailableError as error:
            self._failure = (
                error  # the host has counted steps that did not happen: nothing may be saved from now on
            )
            raise
        for each in again:
            self._submit(each)
            if each.noise is not None:
                self.memory.play("noise", each.noise.packed())

    def _submit(self, one: _Step) -> None:
        self._make_room_for(one.view)
        memory, pixels = self.memory, one.view.camera.H * one.view.camera.W
        numbers = one.numbers.packed(pixels, self.count, one.photo.floats)
        block = one.view.packed(self.harmonics, numbers)
        one.ticket = memory.submit("step", block, "live", one.photo.kept, "photo")
        self._last = one.view
        self.unfinished.append(one)

    @property
    def memory(self) -> Memory:
        """The buffers of the Gaussians and of a step.

        Raises:
            ValueError: nothing is loaded.
        """
        if self._memory is None:
            raise ValueError("nothing is loaded")
        return self._memory

    def _settled(self) -> Memory:
        self.settle()
        return self.memory

    def _photo(self, index: int, photo: Callable[[], PackedPhoto], constant: object | None) -> KeptPhoto:
        """Return a photo on the device, and keep it there if it is constant and there is room."""
        belongs, known = self.photos.get(index, (None, None))
        if known is not None and constant is not None and belongs is constant:
            return known
        if known is not None:
            self.photo_room += known.kept.nbytes
            del self.photos[index]
        packed = photo()
        sent = KeptPhoto(self.device.keep(packed.words), packed.floats)
        if constant is not None and sent.kept.nbytes <= self.photo_room:
            self.photo_room -= sent.kept.nbytes
            self.photos[index] = constant, sent
        return sent

    def _make_room_for(self, view: DeviceView) -> None:
        """Enlarge the buffers if a view is larger than all before, and take the passes of its lens."""
        pixels = view.camera.H * view.camera.W
        if pixels > self._pixels or view.tiles > self._tiles or view.optics != self._optics:
            self.settle()
            self._optics = view.optics
            self._pixels, self._tiles = max(pixels, self._pixels), max(view.tiles, self._tiles)
            self._memory = self._allocate(self.memory)

    def _allocate(self, like: Memory | None) -> Memory:
        """Return buffers, those of another size new, and all others with what is in them."""
        counts = render_counts(self.count, self.harmonics, self._pixels, self._tiles, self._pairs, LIVE)
        wanted = step_program(sort_bits(self._tiles.bit_length()), self._optics)
        memory = self.device.allocate(wanted, counts, like=like)
        memory.write("live", np.zeros(LIVE, dtype=np.uint32))
        return memory


def _words(one: _Step) -> np.ndarray:
    assert one.ticket is not None
    return one.ticket.words()
