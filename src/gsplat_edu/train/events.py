"""Events that the trainer reports to its callbacks (a log, a progress bar, a plot), along with itself."""

from __future__ import annotations

from collections.abc import ItemsView, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor

PHOTO = "photo"
"""Name of the term that compares image and photo; logs and progress call it the loss."""


@runtime_checkable
class Terms(Protocol):
    """() every term of an objective, by name; if a training stays on a device, reading one waits for the step.

    It is a protocol and not a mapping, so that nothing that checks types reads a term.
    """

    def __getitem__(self, name: str, /) -> Tensor: ...

    def __iter__(self) -> Iterator[str]: ...

    def __len__(self) -> int: ...

    def items(self) -> ItemsView[str, Tensor]: ...  # noqa: D102


@dataclass(frozen=True)
class StepEvent:
    """One step was taken.

    Args:
        iteration: The last image of the step, counted from 0: a step has `TrainConfig.batch` of them.
        num_gaussians: Gaussians that were rendered.
        terms: () every term of the objective before the step, a mean over its views, by name, on the Gaussians' device.
            If the training stays on a device, reading a term waits for the step.
        photo_factor: Divisor of the photos' width and height; see `gsplat_edu.train.schedule.photo_factor`.
    """

    iteration: int
    num_gaussians: int
    terms: Terms
    photo_factor: float = 1.0

    @property
    def loss_tensor(self) -> Tensor:
        """() the objective's term "photo"."""
        return self.terms[PHOTO]

    @property
    def loss(self) -> float:
        """The loss before the step, as a number. Reading it synchronises with a GPU."""
        return float(self.loss_tensor)


@dataclass(frozen=True)
class DensifyEvent:
    """Adaptive density control changed the Gaussians, after the step of the same iteration.

    Args:
        iteration: Counted from 0.
        num_cloned: Gaussians added as clones.
        num_split_children: Gaussians added as children of splits; their parents are removed.
        num_pruned: Gaussians removed for their opacity or size.
        num_gaussians: Gaussians afterwards.
    """

    iteration: int
    num_cloned: int
    num_split_children: int
    num_pruned: int
    num_gaussians: int


@dataclass(frozen=True)
class ResetEvent:
    """Opacities were lowered, after the step (and the densification) of the same iteration.

    Args:
        iteration: Counted from 0.
        opacity: The upper bound applied.
    """

    iteration: int
    opacity: float


@dataclass(frozen=True)
class RelocateEvent:
    """MCMC moved dead Gaussians onto living ones and added others, after the step of the same iteration.

    Args:
        iteration: Counted from 0.
        num_relocated: Dead Gaussians that were moved.
        num_added: Gaussians added.
        num_gaussians: Gaussians afterwards.
    """

    iteration: int
    num_relocated: int
    num_added: int
    num_gaussians: int


Change = DensifyEvent | ResetEvent | RelocateEvent
Event = StepEvent | Change


class Losses:
    """The losses of a run as numbers.

    They are collected on the Gaussians' device and read in batches: reading synchronises with a GPU, and keeping a
    tensor for every step would pin heap pages. The last step's is read after the next one has begun.
    """

    ROOM = 1024

    def __init__(self, like: Tensor) -> None:
        self._read: list[float] = []
        self._waiting, self._count = like.new_empty(self.ROOM), 0
        self._last: Terms | None = None

    def add(self, terms: Terms) -> None:
        """Keep the loss among the terms of a step."""
        self._keep_last()
        self._last = terms

    def _keep_last(self) -> None:
        if self._last is None:
            return
        self._waiting[self._count] = self._last[PHOTO]
        self._count, self._last = self._count + 1, None
        if self._count == self.ROOM:
            self._move()

    def _move(self) -> None:
        self._read += self._waiting[: self._count].tolist()
        self._count = 0

    def read(self) -> list[float]:
        """Return all losses so far."""
        self._keep_last()
        self._move()
        return self._read
