"""Cost model of a training: memory and time for any number of Gaussians, pixels and iterations.

Memory is the sum of everything held at the same time, added to the process's own; the constants were measured from
outside on whole runs (the earlier results that benchmarks/RESULTS.md names). Time is fitted to the steps measured by
`gsplat_edu.budget.probe`.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import nnls

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.engine.room import PIXEL_BYTES, REPEATED_PHOTOS, Load, Room, kept_photos
from gsplat_edu.photos.image_files import BYTES_PER_PIXEL
from gsplat_edu.scene.sh import num_coefficients
from gsplat_edu.train.capacity import added_gaussians, wanted_gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.feed import REDUCED_ROOM
from gsplat_edu.train.overlap import separate_views
from gsplat_edu.train.part import parts
from gsplat_edu.train.part_values import Cost
from gsplat_edu.train.schedule import photo_factor, planned_counts

COPIES = 8
"""Peak memory of a Gaussian as a multiple of its parameters: parameters, gradients, two moments, the copies that
density control makes, and fragmentation."""

PER_GAUSSIAN = 100
"""Bytes per Gaussian in the renderer's buffers and in the statistics of density control."""

PER_PAIR = 75
"""Bytes per pair of Gaussian and tile: the pair, its gradient slot, a quarter for growth, and outgrown buffers."""

TRAINED_PAIRS = 5
"""Pairs per Gaussian in a trained scene; the captures of benchmarks/RESULTS.md have 3.4 to 5.0."""

PER_PIXEL = 180
"""Bytes per pixel during evaluation: float64 images and their differences. A training step takes fewer."""

PICTURE_BYTES = 250_000
"""Bytes per test view held for the report until it is written."""

TILE_PIXELS = 128
"""Assumed pixels per tile, of 16 x 16: the tiles at the borders of a photo reach beyond it."""

LATER = 150 * 2**20
"""Growth of the process once it trains and evaluates, bytes, for any scene: code, threads, allocator arenas."""

Amount = TypeVar("Amount", float, np.ndarray)
"""A number, or an array with one number for each iteration."""


@dataclass(frozen=True)
class Facts:
    """Properties of a capture that determine the cost.

    Args:
        train: Number of training views.
        test: Number of held-out views.
        points: Number of start points, or of Gaussians in the start scene.
        pixels: Mean pixels of a view.
        largest: Pixels of the largest view.
        full: Pixels of the largest photo as decoded, before it is downscaled.
        photo_bytes: Bytes of all photos in memory.
        workers: Number of photos decoded at the same time.
        decoding: Bytes per pixel of the file during decoding, most for HEIC and 16 bits.
        measured: Whether the start points are points of the scene; otherwise they are random.
        depth: What gave the depth that the training views carry, "points" or "maps"; empty if they carry none.
        separate: Of the training views, as `gsplat_edu.train.overlap.separate_views` counts them.
        lens_pixels: Pixels of one training view for each lens that is kept; pinholes have none.
        asked: What the user asked of parts that the views do not carry yet (`gsplat_edu.runs.options.RunOptions`).
    """

    train: int
    test: int
    points: int
    pixels: float
    largest: float
    full: float
    photo_bytes: int
    workers: int
    decoding: int = BYTES_PER_PIXEL
    measured: bool = True
    depth: str = ""
    separate: float = 1.0
    lens_pixels: float = 0.0
    asked: Mapping[str, str] = dataclasses.field(default_factory=dict, hash=False)

    @classmethod
    def of(
        cls, dataset: Dataset, full: Dataset | None = None, *, asked: Mapping[str, str] | None = None
    ) -> Facts:
        """Collect the facts of a dataset.

        Args:
            dataset: The capture at training size.
            full: The capture at the size of its files; None if that is the training size.
            asked: As for `Facts`; None for nothing.
        """
        sizes, decoded = (
            [v.camera.W * v.camera.H for v in (*d.train, *d.test)] for d in (dataset, full or dataset)
        )
        return cls(
            len(dataset.train),
            len(dataset.test),
            len(dataset.points),
            float(np.mean(sizes)),
            max(sizes),
            max(decoded),
            dataset.images.needed,
            dataset.images.workers,
            dataset.images.decoding,
            dataset.measured,
            _depth_of(dataset),
            separate_views([view.camera for view in dataset.train], dataset.points),
            _lens_pixels(dataset),
            asked or {},
        )

    def wanted(self, config: TrainConfig) -> int:
        """Estimate how many Gaussians the images need (`wanted_gaussians`)."""
        return wanted_gaussians(config, self.points, self.pixels, self.train, self.separate)

    def smaller(self, factor: float) -> Facts:
        """Return the facts with width and height of every view divided by a factor."""
        area = factor * factor
        return dataclasses.replace(
            self,
            pixels=self.pixels / area,
            largest=self.largest / area,
            photo_bytes=int(self.photo_bytes / area),
            lens_pixels=self.lens_pixels / area,
        )


@dataclass(frozen=True)
class Speed:
    """Seconds of an iteration: fixed + per_pixel * pixels + per_gaussian * Gaussians."""

    fixed: float
    per_pixel: float
    per_gaussian: float

    def seconds(self, gaussians: Amount, pixels: Amount) -> Amount:
        """Return the seconds of an iteration, or of several for arrays."""
        return self.fixed + self.per_pixel * pixels + self.per_gaussian * gaussians

    @classmethod
    def fitted(cls, steps: Sequence[tuple[float, float, float]]) -> Speed:
        """Fit measured steps (Gaussians, pixels, seconds) by non-negative least squares."""
        table = np.array(steps, dtype=np.float64)
        columns = np.stack([np.ones(len(table)), table[:, 1], table[:, 0]], axis=1)
        scale = columns.max(axis=0)
        parts, _ = nnls(columns / scale, table[:, 2])
        return cls(*(float(part) for part in parts / scale))


@dataclass(frozen=True)
class Measurements:
    """Measurements of `gsplat_edu.budget.probe.probe`.

    Args:
        backend: The backend that rendered.
        speed: Time of an iteration.
        read: Seconds to read a photo.
        score: Seconds per pixel to score a view.
        picture: Seconds per pixel to write a test view's pictures.
        pairs: Pairs of Gaussian and tile in one view of the start scene.
        resident: Bytes held by the process before training.
        settled: Bytes held after the probe, with freed memory returned to the system.
        noise: Spread of the times of equal steps, as a factor.
        exchange: Seconds per Gaussian to read the state of a training from a device and to send it back.
        room: What that device has room for; None for the processor and CUDA.
    """

    backend: str
    speed: Speed
    read: float
    score: float
    picture: float
    pairs: int
    resident: int
    settled: int
    noise: float = 1.0
    exchange: float = 0.0
    room: Room | None = None

    @property
    def process(self) -> int:
        """Bytes of the process without scene and photos, once it has trained and evaluated.

        On a GPU this includes the driver's memory. The run reuses buffers that the kernels keep after the probe.
        """
        later = self.resident + LATER
        return max(later, self.settled) if self.backend == "cuda" else later


def expected_counts(config: TrainConfig, points: int, pixels: float) -> Int64[np.ndarray, " iterations"]:
    """Estimate the number of Gaussians at every iteration.

    adc adds the same number at each densification (`added_gaussians`), mcmc grows by a factor, fast linearly to its
    cap; a cap limits all of them.

    Args:
        config: The run.
        points: Number of start points.
        pixels: Pixels of a view.
    """
    cap = config.max_gaussians or sys.maxsize
    counts = np.full(config.iterations, min(points, cap), dtype=np.int64)
    if config.strategy == "fast":
        return planned_counts(config, int(counts[0]), cap, np.arange(config.iterations))
    stop = {"adc": config.adc.densify_stop, "mcmc": config.mcmc.stop}.get(config.strategy, 0)
    every = config.densify_every
    first, added = (config.densify_start // every + 1) * every, added_gaussians(points, pixels)
    for moment in range(first, min(stop, config.iterations), every):
        now = int(counts[moment])
        grown = now + added if config.strategy == "adc" else int(config.mcmc.growth * now)
        counts[moment + 1 :] = min(grown, cap)
    return counts


def exchanged_gaussians(config: TrainConfig, counts: Int64[np.ndarray, " iterations"]) -> int:
    """Return the Gaussians that go from a device to the processor and back, summed over all changes of the density.

    Args:
        config: The run.
        counts: The Gaussians at every iteration.
    """
    stops = {"adc": config.adc.densify_stop, "mcmc": config.mcmc.stop, "fast": config.fast.stop}
    stop = min(stops.get(config.strategy, 0), len(counts) - 1)
    return int(counts[config.densify_start : stop : config.densify_every].sum())


def harmonics_of(sh_degree: int) -> int:
    """Return the harmonics of a Gaussian besides the first."""
    return num_coefficients(sh_degree) - 1


def pixel_share(config: TrainConfig) -> float:
    """Return the mean fraction of the pixels that an iteration renders, sampled at about 1,000 iterations."""
    some = range(0, config.iterations, max(config.iterations // 1_000, 1))
    return float(np.mean([photo_factor(config, iteration) ** -2 for iteration in some]))


def costs_of_parts(config: TrainConfig, facts: Facts) -> list[Cost]:
    """Return what the parts add to a training.

    Args:
        config: The run.
        facts: The capture at training size.
    """
    found = (
        part.cost(config.settings_of(name), facts.asked.get(name), facts) for name, part in parts().items()
    )
    return [cost for cost in found if cost is not None]


def term_factors(config: TrainConfig, facts: Facts) -> Float64[np.ndarray, " iterations"]:
    """Return the time of each iteration as a multiple of its time without the terms of parts.

    Arguments as for `costs_of_parts`. The steps that compute a term share its time with the others.
    """
    factors = np.ones(config.iterations)
    for cost in costs_of_parts(config, facts):
        factors[cost.since :] += cost.time
    return factors


def step_profile(config: TrainConfig, facts: Facts, speed: Speed) -> Float64[np.ndarray, " iterations"]:
    """Return the expected seconds of every iteration.

    Args:
        config: The run, with the schedule of its recipe.
        facts: The capture at training size.
        speed: The speed of this machine.
    """
    counts = expected_counts(config, facts.points, facts.pixels)
    factors = np.array([photo_factor(config, iteration) for iteration in range(config.iterations)])
    seconds = speed.seconds(counts.astype(np.float64), facts.pixels / factors**2)
    return np.array(seconds * term_factors(config, facts))


def photo_copies(config: TrainConfig, facts: Facts) -> int:
    """Return how many bytes the training's own copies of photos, and what its parts keep, add to the peak memory.

    Only training photos have copies: reduced ones early, with at most half of their pixels. All of these are freed
    before training uses full size. While they exist, a step therefore takes at most half of the memory that the
    evaluation takes for images, and only what exceeds the other half raises the peak.

    Args:
        config: The run.
        facts: The capture at training size.
    """
    kept = sum(cost.memory for cost in costs_of_parts(config, facts))
    if photo_factor(config, 0) <= 1.0:
        return kept
    share = facts.train / max(facts.train + facts.test, 1)
    copies = min(REDUCED_ROOM, int(share * facts.photo_bytes) // 2)
    return kept + max(copies - int(PER_PIXEL * facts.largest) // 2, 0)


def _lens_pixels(dataset: Dataset) -> float:
    """Return `Facts.lens_pixels` of a capture."""
    lenses = {view.camera.intrinsics for view in dataset.train if not view.camera.pinhole}
    return float(sum(lens.W * lens.H for lens in lenses))


def _depth_of(dataset: Dataset) -> str:
    """Return what gives the depth that the training views carry, by the first one that has some."""
    read = next((view.depth for view in dataset.train if view.depth is not None), None)
    return "" if read is None else "points" if read().sparse else "maps"


@dataclass(frozen=True)
class Footprint:
    """Memory as a function of the number of Gaussians and the memory for photos.

    Args:
        facts: The capture at training size.
        process: Bytes of the process without scene and photos.
        pairs: Pairs of Gaussian and tile in one view of the start scene.
        sh_degree: SH degree of the Gaussians.
        batch: Views of a step, whose gradients are held as partial sums: one more for each doubling.
        room: The device on which the training stays; None for the processor and CUDA.
    """

    facts: Facts
    process: int
    pairs: int
    sh_degree: int
    batch: int = 1
    room: Room | None = None

    @property
    def _per_gaussian(self) -> int:
        floats = 11 + 3 * (self.sh_degree + 1) ** 2
        return (COPIES + math.ceil(math.log2(self.batch))) * 4 * floats + PER_GAUSSIAN

    def on_device(self, gaussians: int, image_memory: int) -> int:
        """Return the peak memory on the device, bytes; 0 without one. Arguments as for `parts`."""
        if self.room is None:
            return 0
        facts, pairs = self.facts, max(self.pairs, TRAINED_PAIRS * gaussians)
        pixels = math.ceil(facts.largest)
        load = Load(gaussians, harmonics_of(self.sh_degree), pixels, math.ceil(pixels / TILE_PIXELS), pairs)
        photos = PIXEL_BYTES * math.ceil(facts.pixels) * facts.train
        return load.bytes() + min(photos, kept_photos(image_memory))

    def parts(self, gaussians: int, image_memory: int) -> dict[str, int]:
        """Return the peak memory of the process by part, bytes, with the device's if it shares that memory.

        Args:
            gaussians: Largest number of Gaussians.
            image_memory: Bytes of photos kept in memory.
        """
        facts = self.facts
        kept = min(facts.photo_bytes, image_memory)
        pairs = max(self.pairs, TRAINED_PAIRS * gaussians)
        read_again = 2 * facts.decoding * facts.full if kept < facts.photo_bytes else 0.0
        found = {
            "program": self.process,
            "photos": kept,
            "Gaussians": gaussians * self._per_gaussian + (0 if self.room else pairs * PER_PAIR),
            "images": int(PER_PIXEL * facts.largest + read_again) + facts.test * PICTURE_BYTES,
        }
        # Photos are first read before any Gaussian exists, several at once and at full size.
        reading = int(facts.workers * facts.decoding * facts.full)
        found["images"] = max(found["images"], reading - found["Gaussians"])
        if (
            self.room is not None
        ):  # photos that are decoded anew stay while their steps may have to be taken again
            found["photos"] += min(facts.photo_bytes - kept, REPEATED_PHOTOS)
        if self.room is not None and self.room.shared:
            found["device"] = self.on_device(gaussians, image_memory)
        return found

    def peak(self, gaussians: int, image_memory: int) -> int:
        """Return the peak memory in bytes; arguments as for `parts`."""
        return sum(self.parts(gaussians, image_memory).values())

    def most_gaussians(self, limit: int, image_memory: int) -> int:
        """Return how many Gaussians fit into a limit in bytes; negative if not even an empty scene fits."""
        if self.peak(0, image_memory) > limit:
            return -1
        # While reading determines the peak, Gaussians are free; the limit itself gives an upper bound for the search.
        low, high = 0, limit // self._per_gaussian + 1  # low fits, high does not
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if self.peak(middle, image_memory) <= limit else (low, middle)
        return low
