"""Forecast the time and memory of a training on this machine, with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsplat_edu.base.text import short_number, spelled_bytes as spelled_bytes, spelled_seconds
from gsplat_edu.budget.costs import (
    Facts,
    Footprint,
    Measurements,
    exchanged_gaussians,
    expected_counts,
    photo_copies,
    pixel_share,
    term_factors,
)
from gsplat_edu.budget.probe import probe
from gsplat_edu.data.dataset import Dataset, DataSettings
from gsplat_edu.runs.training import RunOptions
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.schedule import photo_factor

BYTES_SAVED_PER_SECOND = 4e8
"""Write speed of checkpoints, bytes per second."""

ENDING_SECONDS = 6.0
"""Seconds to write the scene file, the report and the last checkpoint's bookkeeping on a slow machine. A fast machine
takes 2.5 s; a slow and busy one that planned with 2.5 s exceeded a limit of two minutes by 3 s."""

TIME_UNCERTAINTY = 1.6
"""Factor within which the forecast time holds on a quiet machine. The number of Gaussians that a scene needs, and
their layout, are unknown beforehand."""

MEMORY_UNCERTAINTY = 1.25
"""Factor within which the forecast memory holds."""


@dataclass(frozen=True)
class Forecast:
    """Expected time and memory of a run.

    Args:
        iterations: Number of iterations.
        backend: The rendering backend.
        gaussians: Numbers of Gaussians at the start and at the end.
        steps: Duration of the first and of the last iteration, s.
        seconds: Seconds by part: "reading", "training", "judging" (intermediate evaluations), "saving", "ending"; and
            on a device "density", for what its changes move between device and processor.
        memory: Peak bytes by part: "program", "photos", "Gaussians", "images", and "device" for one that shares the
            processor's memory.
        factor: Uncertainty of the time, as a factor.
        apart: Peak bytes on a device with memory of its own; 0 for others.
    """

    iterations: int
    backend: str
    gaussians: tuple[int, int]
    steps: tuple[float, float]
    seconds: dict[str, float]
    memory: dict[str, int]
    factor: float
    apart: int = 0

    @property
    def total(self) -> float:
        """Seconds from reading the first photo to writing the report."""
        return sum(self.seconds.values())

    @property
    def peak(self) -> int:
        """Peak memory in bytes."""
        return sum(self.memory.values())

    def lines(self) -> list[str]:
        """Return the forecast as lines of text: time, memory and their uncertainty."""
        parts = ", ".join(f"{name} {spelled_seconds(s)}" for name, s in self.seconds.items() if s >= 0.5)
        first, last = (short_number(1e3 * s, 3) for s in self.steps)
        grown = " to ".join(f"{count:,}" for count in dict.fromkeys(self.gaussians))
        apart = f", and {spelled_bytes(self.apart)} on the GPU" if self.apart else ""
        held = ", ".join(f"{name} {spelled_bytes(size)}" for name, size in self.memory.items())
        return [
            f"time: about {spelled_seconds(self.total)} for {self.iterations:,} iterations on {self.backend}"
            + (f" ({parts})" if parts else ""),
            f"an iteration: {first} ms at first, {last} ms at the end; {grown} Gaussians",
            f"memory: up to {spelled_bytes(self.peak)} ({held}){apart}",
            f"accuracy: time within a factor of {self.factor:.1f}, memory within {MEMORY_UNCERTAINTY}; "
            "measured just now, with whatever else is running",
        ]


def predict(
    facts: Facts,
    measured: Measurements,
    config: TrainConfig,
    image_memory: int = DataSettings.image_memory,
    eval_every: int = RunOptions.eval_every,
    save_every: int = RunOptions.save_every,
) -> Forecast:
    """Compute the forecast of a run from measurements.

    Args:
        facts: The capture at training size.
        measured: Measurements of this machine.
        config: The run.
        image_memory: Bytes of photos kept in memory; the others are read again, on one of the rendering cores.
        eval_every: Iterations between evaluations; 0 for none, not even at the end.
        save_every: Iterations between checkpoints; 0 for none.
    """
    counts = expected_counts(config, facts.points, facts.pixels)
    speed, last = measured.speed, config.iterations - 1
    missing = 1.0 - min(image_memory / max(facts.photo_bytes, 1), 1.0)
    reading_again = measured.read * missing / torch.get_num_threads()
    longer = term_factors(config, facts)
    plain = speed.seconds(float(counts.mean()), facts.pixels * pixel_share(config))
    each = plain * float(longer.mean()) + reading_again

    def step(iteration: int) -> float:
        pixels = facts.pixels / photo_factor(config, iteration) ** 2
        return speed.seconds(float(counts[iteration]), pixels) * float(longer[iteration]) + reading_again

    process = measured.process + photo_copies(config, facts)
    room, most = measured.room, int(counts.max())
    footprint = Footprint(facts, process, measured.pairs, config.sh_degree, config.batch, room)
    evaluations, saved = (last // every if every else 0 for every in (eval_every, save_every))
    saving = saving_seconds(float(counts.mean()), config.sh_degree)
    views, at_end = facts.train + facts.test, (measured.score, measured.picture)
    return Forecast(
        iterations=config.iterations,
        backend=measured.backend,
        gaussians=(int(counts[0]), int(counts[-1])),
        steps=(step(0), step(last)),
        seconds={
            "reading": measured.read * views / facts.workers,
            "training": each * config.iterations,
            "judging": evaluations * facts.test * measured.score * facts.pixels,
            "saving": saved * saving,
            "ending": ending_seconds(facts, *(at_end if eval_every else (0.0, 0.0))) + 2 * saving,
            **({} if room is None else {"density": measured.exchange * exchanged_gaussians(config, counts)}),
        },
        memory=footprint.parts(most, image_memory),
        factor=TIME_UNCERTAINTY * min(measured.noise, 2.0),
        apart=0 if room is None or room.shared else footprint.on_device(most, image_memory),
    )


def ending_seconds(facts: Facts, score: float, picture: float) -> float:
    """Estimate the time after training, seconds: score every view, draw the test views, write the report.

    Args:
        facts: The capture.
        score: Seconds per pixel to score a view.
        picture: Seconds per pixel to write a test view's pictures.
    """
    return ENDING_SECONDS + ((facts.train + facts.test) * score + facts.test * picture) * facts.pixels


def saving_seconds(gaussians: float, sh_degree: int) -> float:
    """Estimate the time of a checkpoint, seconds: parameters and two moments of each.

    Args:
        gaussians: Number of Gaussians.
        sh_degree: Their SH degree.
    """
    return gaussians * 12 * (11 + 3 * (sh_degree + 1) ** 2) / BYTES_SAVED_PER_SECOND


def forecast(
    dataset: Dataset,
    full: Dataset,
    config: TrainConfig,
    measured: Measurements | None = None,
    *,
    backend: str = "cpu",
    eval_every: int = RunOptions.eval_every,
    save_every: int = RunOptions.save_every,
) -> Forecast:
    """Forecast a run on this machine.

    Args:
        dataset: The capture at training size.
        full: The capture at the size of its files; the same dataset if that is the training size.
        config: The run.
        measured: Measurements of `probe`; None to measure now.
        backend: The rendering backend, by its own name.
        eval_every: Iterations between evaluations; 0 for none, not even at the end.
        save_every: Iterations between checkpoints; 0 for none.

    Raises:
        ArgumentError: the backend is the dense one.
        DatasetError: a photo cannot be read.
    """
    facts = Facts.of(dataset, full)
    found = measured or probe(dataset, config, backend)
    return predict(facts, found, config, dataset.images.budget, eval_every, save_every)
