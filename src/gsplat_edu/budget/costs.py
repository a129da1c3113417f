"""What a training costs as arithmetic: memory and time of any number of Gaussians, pixels and iterations.

Memory is counted by what has to lie there at once, on top of what the process holds; the constants were measured from
outside on whole runs (benchmarks/RESULTS.md). Time is fitted to the steps that `gsplat_edu.budget.probe` took.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64
from scipy.optimize import nnls

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.train.config import TrainConfig

GROWTH = (0.005, 0.08)
"""adc: Gaussians that a densification adds, for each pixel of a photo and for each start point. Whole trainings added
3,100 (snowmiku97, 3,000 iterations), 4,100 (7,000), 5,500 (7,000, not rescaled) and 3,900 (1,200 at half size), where
this says 5,700 and 3,000; fox 3,500, where it says 5,000. Scenes of many small things ask for several times as many."""

FEW_POINTS = 30_000
"""Start points beyond these do not make a scene ask for more."""

COPIES = 8
"""Sizes of the parameters that a Gaussian takes at the peak: parameters, gradients, two moments, the copies that
density control makes of them, and the holes those leave behind."""

PER_GAUSSIAN = 100
"""Bytes of a Gaussian in the renderer's buffers, and in the statistics of density control."""

PER_PAIR = 75
"""Bytes of a pair of Gaussian and tile: the pair, its gradients' slot, a quarter for growth, and what was too small."""

TRAINED_PAIRS = 5
"""Pairs per Gaussian of a trained scene; those of benchmarks/RESULTS.md have 3.4 to 5.0."""

PER_PIXEL = 180
"""Bytes that judging takes for a pixel: images of float64 and their differences. A training step takes fewer."""

DECODING = 10
"""Bytes that decoding takes for a pixel of the file (`gsplat_edu.data.images.AT_ONCE`)."""

PICTURE_BYTES = 250_000
"""Of a test view in the report, until that is written."""

LATER = 150 * 2**20
"""Bytes that a process grows by once it trains and judges, whatever the scene: code, threads, arenas."""


@dataclass(frozen=True)
class Facts:
    """What of a capture decides the cost.

    Args:
        train: Views to train on.
        test: Views that are held out.
        points: Start points.
        pixels: Of a view, the mean.
        largest: Pixels of the largest view.
        full: Pixels of the largest photo as it is decoded, before it is made smaller.
        photo_bytes: Of all photos in memory.
        workers: Photos decoded at once.
    """

    train: int
    test: int
    points: int
    pixels: float
    largest: float
    full: float
    photo_bytes: int
    workers: int

    @classmethod
    def of(cls, dataset: Dataset, full: Dataset | None = None) -> Facts:
        """Take the facts of a dataset.

        Args:
            dataset: The capture at the size it is trained at.
            full: The same at the size of its files; None where that is the same.
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
        )

    def smaller(self, factor: float) -> Facts:
        """Return the facts with both sides of every view divided by a factor."""
        area = factor * factor
        return dataclasses.replace(
            self,
            pixels=self.pixels / area,
            largest=self.largest / area,
            photo_bytes=int(self.photo_bytes / area),
        )


@dataclass(frozen=True)
class Speed:
    """Seconds of an iteration: fixed + per_pixel * pixels + per_gaussian * Gaussians."""

    fixed: float
    per_pixel: float
    per_gaussian: float

    def seconds(self, gaussians: float, pixels: float) -> float:
        """Return the seconds of an iteration."""
        return self.fixed + self.per_pixel * pixels + self.per_gaussian * gaussians

    @classmethod
    def fitted(cls, steps: Sequence[tuple[float, float, float]]) -> Speed:
        """Fit it to (Gaussians, pixels, seconds) of measured steps, by least squares with no part below zero."""
        table = np.array(steps, dtype=np.float64)
        columns = np.stack([np.ones(len(table)), table[:, 1], table[:, 0]], axis=1)
        scale = columns.max(axis=0)
        parts, _ = nnls(columns / scale, table[:, 2])
        return cls(*(float(part) for part in parts / scale))


@dataclass(frozen=True)
class Measurements:
    """What `probe` found.

    Args:
        backend: The backend that rendered.
        speed: Of an iteration.
        read: Seconds to read a photo.
        score: Seconds to score a view, for each of its pixels.
        picture: Seconds to write a test view's pictures, for each of its pixels.
        pairs: Pairs of Gaussian and tile of the start, in a view.
        resident: Bytes the process held before it trained.
        settled: Bytes it held after the probe, what was freed given back.
        noise: How far the times of equal steps lay apart, as a factor.
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

    @property
    def process(self) -> int:
        """Bytes of the process without scene and photos, once it has trained and judged.

        A GPU's driver takes what it takes. Of what the kernels keep after a probe nothing is lost to the run.
        """
        later = self.resident + LATER
        return max(later, self.settled) if self.backend == "cuda" else later


def expected_counts(config: TrainConfig, points: int, pixels: float) -> Int64[np.ndarray, " iterations"]:
    """Guess how many Gaussians every iteration renders.

    adc adds the same number at each densification, see `GROWTH`; mcmc multiplies; a cap binds both.

    Args:
        config: The run.
        points: Start points.
        pixels: Of a view.
    """
    cap = config.max_gaussians or sys.maxsize
    counts = np.full(config.iterations, min(points, cap), dtype=np.int64)
    stop = {"adc": config.adc.densify_stop, "mcmc": config.mcmc.stop}.get(config.strategy, 0)
    every = config.densify_every
    first, added = (config.densify_start // every + 1) * every, _added(points, pixels)
    for moment in range(first, min(stop, config.iterations), every):
        now = int(counts[moment])
        grown = now + added if config.strategy == "adc" else int(config.mcmc.growth * now)
        counts[moment + 1 :] = min(grown, cap)
    return counts


def wanted_gaussians(config: TrainConfig, points: int, pixels: float) -> int:
    """Guess how many Gaussians the images ask for in the time there is: the growth of adc, without a cap.

    Arguments as for `expected_counts`.
    """
    window = min(config.adc.densify_stop, config.iterations) - config.densify_start
    return points + _added(points, pixels) * max(window // config.densify_every, 0)


def _added(points: int, pixels: float) -> int:
    return round(GROWTH[0] * pixels + GROWTH[1] * min(points, FEW_POINTS))


@dataclass(frozen=True)
class Footprint:
    """How memory follows from the choices that a run leaves open.

    Args:
        facts: The capture, at the size it is trained at.
        process: Bytes without scene and photos.
        pairs: Pairs of Gaussian and tile of the start, in a view.
        sh_degree: Of the Gaussians.
    """

    facts: Facts
    process: int
    pairs: int
    sh_degree: int

    @property
    def _per_gaussian(self) -> int:
        floats = 11 + 3 * (self.sh_degree + 1) ** 2
        return COPIES * 4 * floats + PER_GAUSSIAN

    def parts(self, gaussians: int, image_memory: int) -> dict[str, int]:
        """Return what lies in memory at the peak, bytes.

        Args:
            gaussians: The most there will be.
            image_memory: Bytes of photos to keep.
        """
        facts = self.facts
        kept = min(facts.photo_bytes, image_memory)
        pairs = max(self.pairs, TRAINED_PAIRS * gaussians)
        read_again = 2 * DECODING * facts.full if kept < facts.photo_bytes else 0.0
        found = {
            "program": self.process,
            "photos": kept,
            "Gaussians": gaussians * self._per_gaussian + pairs * PER_PAIR,
            "images": int(PER_PIXEL * facts.largest + read_again) + facts.test * PICTURE_BYTES,
        }
        # All photos are read before there is a Gaussian: several at once, at their full size.
        reading = int(facts.workers * DECODING * facts.full)
        found["images"] = max(found["images"], reading - found["Gaussians"])
        return found

    def peak(self, gaussians: int, image_memory: int) -> int:
        """Return the bytes at the peak; arguments as for `parts`."""
        return sum(self.parts(gaussians, image_memory).values())

    def most_gaussians(self, limit: int, image_memory: int) -> int:
        """Return how many Gaussians a limit in bytes leaves room for; below zero where there is none for any."""
        if self.peak(0, image_memory) > limit:
            return -1
        # Where reading sets the peak, Gaussians take the room that it leaves; no more fit than all of the limit holds.
        low, high = 0, limit // self._per_gaussian + 1  # of which the first fits and the second does not
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if self.peak(middle, image_memory) <= limit else (low, middle)
        return low
