"""What a training will take on this machine: time and memory, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsplat_edu.budget.costs import Facts, Footprint, Measurements, expected_counts
from gsplat_edu.budget.probe import probe
from gsplat_edu.data.dataset import Dataset, DataSettings, load_dataset
from gsplat_edu.runs.training import RunOptions
from gsplat_edu.text import short_number, spelled_seconds
from gsplat_edu.train.config import TrainConfig

SAVING = 4e8
"""Bytes per second at which checkpoints are written."""

ENDING = 2.5
"""Seconds for the scene's file, the report and the last checkpoint's bookkeeping."""

SURE = 1.6
"""Factor within which the time of a whole training is known on a quiet machine: how many Gaussians a scene will ask
for, and how they will lie, is not known before."""

SURE_OF_MEMORY = 1.25


@dataclass(frozen=True)
class Forecast:
    """What a run is expected to take.

    Args:
        iterations: Its length.
        backend: What renders.
        gaussians: At its start and at its end.
        steps: Seconds of its first and of its last iteration.
        seconds: By part: "reading", "training", "judging" on the way, "saving", "ending".
        memory: Bytes at the peak by part: "program", "photos", "Gaussians", "images".
        factor: The time may be longer or shorter by it.
    """

    iterations: int
    backend: str
    gaussians: tuple[int, int]
    steps: tuple[float, float]
    seconds: dict[str, float]
    memory: dict[str, int]
    factor: float

    @property
    def total(self) -> float:
        """Seconds from the first photo to the report."""
        return sum(self.seconds.values())

    @property
    def peak(self) -> int:
        """Bytes at the peak."""
        return sum(self.memory.values())

    def lines(self) -> list[str]:
        """Say it: time, memory, and how sure that is."""
        parts = ", ".join(f"{name} {spelled_seconds(s)}" for name, s in self.seconds.items() if s >= 0.5)
        first, last = (short_number(1e3 * s, 3) for s in self.steps)
        grown = " to ".join(f"{count:,}" for count in dict.fromkeys(self.gaussians))
        held = ", ".join(f"{name} {spelled_bytes(size)}" for name, size in self.memory.items())
        return [
            f"time: about {spelled_seconds(self.total)} for {self.iterations:,} iterations on {self.backend}"
            + (f" ({parts})" if parts else ""),
            f"an iteration: {first} ms at first, {last} ms at the end; {grown} Gaussians",
            f"memory: up to {spelled_bytes(self.peak)} ({held})",
            f"how sure: time within a factor of {self.factor:.1f}, memory of {SURE_OF_MEMORY}; measured just now, "
            "while other programs took what they took",
        ]


def spelled_bytes(size: float) -> str:
    """Write a size: 1.25 GiB, 204 MiB."""
    return f"{size / 2**30:.3g} GiB" if size >= 2**30 else f"{size / 2**20:.0f} MiB"


def predict(
    facts: Facts,
    measured: Measurements,
    config: TrainConfig,
    image_memory: int = DataSettings.image_memory,
    eval_every: int = RunOptions.eval_every,
    save_every: int = RunOptions.save_every,
) -> Forecast:
    """Reckon what a run takes.

    Args:
        facts: The capture, at the size it is trained at.
        measured: The machine.
        config: The run.
        image_memory: Bytes of photos kept in memory; the others are read again, on one core of those that render.
        eval_every: Iterations between judgements; 0 for none.
        save_every: Iterations between checkpoints; 0 for none.
    """
    counts = expected_counts(config, facts.points, facts.pixels)
    speed, last = measured.speed, config.iterations - 1
    missing = 1.0 - min(image_memory / max(facts.photo_bytes, 1), 1.0)
    reading_again = measured.read * missing / torch.get_num_threads()
    each = speed.seconds(float(counts.mean()), facts.pixels) + reading_again
    footprint = Footprint(facts, measured.process, measured.pairs, config.sh_degree)
    judged, saved = (last // every if every else 0 for every in (eval_every, save_every))
    saving = saving_seconds(float(counts.mean()), config.sh_degree)
    views = facts.train + facts.test
    return Forecast(
        iterations=config.iterations,
        backend=measured.backend,
        gaussians=(int(counts[0]), int(counts[-1])),
        steps=tuple(speed.seconds(float(counts[i]), facts.pixels) + reading_again for i in (0, -1)),  # type: ignore[arg-type]
        seconds={
            "reading": measured.read * views / facts.workers,
            "training": each * config.iterations,
            "judging": judged * facts.test * measured.score * facts.pixels,
            "saving": saved * saving,
            "ending": ending_seconds(facts, measured.score, measured.picture) + 2 * saving,
        },
        memory=footprint.parts(int(counts.max()), image_memory),
        factor=SURE * min(measured.noise, 2.0),
    )


def ending_seconds(facts: Facts, score: float, picture: float) -> float:
    """Reckon what comes after training: every view is scored, test views are drawn, the report is written.

    Args:
        facts: The capture.
        score: Seconds to score a view, for each of its pixels.
        picture: Seconds to write a test view's pictures, for each of its pixels.
    """
    return ENDING + ((facts.train + facts.test) * score + facts.test * picture) * facts.pixels


def saving_seconds(gaussians: float, sh_degree: int) -> float:
    """Reckon what a checkpoint takes: parameters and two moments of each.

    Args:
        gaussians: How many there are.
        sh_degree: Theirs.
    """
    return gaussians * 12 * (11 + 3 * (sh_degree + 1) ** 2) / SAVING


def forecast(
    dataset: Dataset,
    config: TrainConfig,
    measured: Measurements | None = None,
    *,
    backend: str = "cpu",
    eval_every: int = RunOptions.eval_every,
    save_every: int = RunOptions.save_every,
) -> Forecast:
    """Forecast a run on this machine.

    Args:
        dataset: The capture.
        config: The run.
        measured: What `probe` found; it is asked now where None.
        backend: The rendering backend, by its own name.
        eval_every: Iterations between judgements; 0 for none.
        save_every: Iterations between checkpoints; 0 for none.

    Raises:
        ArgumentError: the backend is the dense one.
        DatasetError: a photo cannot be read.
    """
    facts = Facts.of(dataset, load_dataset(dataset.path))
    found = measured or probe(dataset, config, backend)
    return predict(facts, found, config, dataset.images.budget, eval_every, save_every)
