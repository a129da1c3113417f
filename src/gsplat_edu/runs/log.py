"""The log of a run: log.jsonl, one JSON object per line, each with the number of images trained on as `iteration`."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, TextIO

import torch

from gsplat_edu.base.files import named_failure, written_aside
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.records import without_nan
from gsplat_edu.train.events import Event, StepEvent

IMAGES_PER_LINE = 10
"""Images per line; a step with more images gets its own line. Loss and time are means over a line's images."""


class LogWriter:
    """Writes the trainer's events to the log.

    Args:
        path: The file; lines are appended.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: TextIO | None = None
        self._steps: list[StepEvent] = []
        self._last = 0.0
        self._done: int | None = None  # images of the steps so far
        self._images = 0  # those of `_steps`

    def record(self, event: Event, seconds: float) -> None:
        """Write a change of the Gaussians at once, and one line for every ten images.

        Args:
            event: The event.
            seconds: Wall time of the training so far.
        """
        iteration = event.iteration + 1
        if not isinstance(event, StepEvent):
            kind = type(event).__name__.removesuffix("Event").lower()
            self.write({**dataclasses.asdict(event), "iteration": iteration, "event": kind})
            return
        before = iteration - 1 if self._done is None else self._done
        self._done, self._images = iteration, self._images + iteration - before
        self._steps.append(event)
        if iteration // IMAGES_PER_LINE > before // IMAGES_PER_LINE:
            count, names = len(self._steps), list(event.terms)
            values = [[step.loss_tensor, *(step.terms[name] for name in names)] for step in self._steps]
            # one GPU synchronisation per line
            rows = torch.stack([torch.stack(row) for row in values]).tolist()
            loss, *terms = (sum(column) / count for column in zip(*rows, strict=True))
            line = {
                "iteration": iteration,
                "loss": loss,
                "terms": dict(zip(names, terms, strict=True)),
                "num_gaussians": event.num_gaussians,
                "photo_factor": event.photo_factor,
                "ms": round(1e3 * (seconds - self._last) / self._images, 3),
                "seconds": round(seconds, 3),
            }
            self.write(line)
            self._steps, self._images, self._last = [], 0, seconds

    def write(self, line: dict[str, Any]) -> None:
        """Append a line and flush it to the operating system."""
        if self._file is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("a", encoding="utf-8")
        with named_failure(self.path):
            self._file.write(json.dumps(without_nan(line), allow_nan=False) + "\n")
            self._file.flush()

    def cut(self, iteration: int, seconds: float = 0.0) -> None:
        """Drop the lines of steps after a checkpoint; those steps will be repeated.

        Args:
            iteration: Steps taken at the checkpoint.
            seconds: Wall time of the training up to the checkpoint.
        """
        self.close()
        self._steps, self._images, self._last, self._done = [], 0, seconds, iteration
        if not self.path.exists():
            return
        kept = []
        for line in read_text(self.path, errors="replace").splitlines(keepends=True):
            try:
                if line.endswith("\n") and parse_json(line)["iteration"] <= iteration:
                    kept.append(line)
            except (ValueError, KeyError, TypeError):
                continue  # incomplete: the process was killed
        with written_aside(self.path) as aside:
            aside.write_text("".join(kept), encoding="utf-8")

    def close(self) -> None:
        """Close the file; the next line reopens it."""
        if self._file is not None:
            self._file.close()
            self._file = None
