"""What an adapter has room for, and what a training takes there, from the sizes by which its buffers are made."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.engine.frame import KEPT_FRAMES, program, render_counts
from gsplat_edu.engine.host import Device
from gsplat_edu.engine.passes import WORD, sort_bits
from gsplat_edu.engine.resident import PHOTO_ROOM
from gsplat_edu.engine.step import LIVE, PAIRS_AT_FIRST, PAIRS_SPARE, STATE, pairs_room, step_program

ENOUGH = 1 << 28
"""More Gaussians than any adapter has room for."""

PIXEL_BYTES = 4
"""Bytes of a photo's pixel on the device."""

REPEATED_PHOTOS = 1 << 29
"""Most bytes of photos that the host keeps for the steps to be taken again if the device is lost."""


def kept_photos(photo_room: int | None) -> int:
    """Return the bytes of photos that a training keeps on the device.

    Args:
        photo_room: The bytes that it may keep; None for no other limit than `PHOTO_ROOM`.
    """
    return PHOTO_ROOM if photo_room is None else min(photo_room, PHOTO_ROOM)


@dataclass(frozen=True)
class Load:
    """What a step of a training works on.

    Args:
        gaussians: Their number.
        harmonics: K, per Gaussian besides the first.
        pixels: Pixels of the largest view.
        tiles: Its tiles.
        pairs: The most pairs of Gaussian and tile in a view.
    """

    gaussians: int
    harmonics: int
    pixels: int
    tiles: int
    pairs: int

    @property
    def capacity(self) -> int:
        """The pairs for which a training makes room."""
        needed = PAIRS_SPARE * self.pairs / max(self.gaussians, 1)
        return pairs_room(self.gaussians, max(needed, PAIRS_AT_FIRST))

    def step_words(self) -> dict[str, int]:
        """Return the words of every buffer of a step."""
        bits = sort_bits(self.tiles.bit_length())
        counts = render_counts(self.gaussians, self.harmonics, self.pixels, self.tiles, self.capacity, LIVE)
        return step_program(bits).words(counts)

    def frame_words(self) -> dict[str, int]:
        """Return the words of every buffer of a render, as evaluations make it."""
        bits = sort_bits(self.tiles.bit_length())
        counts = render_counts(self.gaussians, self.harmonics, self.pixels, self.tiles, self.capacity)
        return program(bits, False).words(counts)

    def pair_words(self) -> int:
        """Return the words of the buffers of a step whose size follows from the pairs."""
        words = self.step_words()
        buffers = step_program(sort_bits(self.tiles.bit_length())).buffers
        return sum(words[buffer.name] for buffer in buffers if buffer.size.count == "pairs")

    def bytes(self) -> int:
        """Return the most bytes that a training takes on the device at once, without photos.

        Those are the buffers of a step; those of the pairs once more, while larger ones take their place; those of
        the renders of evaluations; and the state on its way between host and device.
        """
        step = self.step_words()
        state = sum(step[name] for name in STATE)
        frames = KEPT_FRAMES * sum(self.frame_words().values())
        return WORD * (sum(step.values()) + self.pair_words() + frames + state)


@dataclass(frozen=True)
class Room:
    """What an adapter has room for. WebGPU does not tell how much memory is free.

    Args:
        adapter: Its name.
        largest: Bytes of the largest buffer that a pass can use.
        shared: Whether its memory is the processor's, so that both count together.
    """

    adapter: str
    largest: int
    shared: bool

    def too_large(self, load: Load) -> tuple[str, int] | None:
        """Return the name and the bytes of the largest buffer if it is larger than the adapter allows."""
        words = load.step_words()
        name = max(words, key=lambda name: words[name])
        return (name, WORD * words[name]) if WORD * words[name] > self.largest else None

    def most_gaussians(self, harmonics: int, pairs_each: float) -> int:
        """Return how many Gaussians a training may have, as far as their buffers and those of their pairs go.

        Args:
            harmonics: K, per Gaussian besides the first.
            pairs_each: Pairs per Gaussian.
        """
        low, high = 0, ENOUGH  # low fits, high does not
        while high - low > 1:
            middle = (low + high) // 2
            fits = self.too_large(Load(middle, harmonics, 1, 1, round(pairs_each * middle))) is None
            low, high = (middle, high) if fits else (low, middle)
        return low

    def most_pixels(self) -> int:
        """Return how many pixels a view may have."""
        words = Load(1, 0, 1 << 20, 1, 1).step_words()
        return self.largest // WORD * (1 << 20) // max(words.values())


def room_of(device: Device) -> Room:
    """Return what a device has room for."""
    return Room(device.name.name, device.largest, device.name.kind != "DiscreteGPU")
