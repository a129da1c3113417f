"""The tempo of a training: which iteration of the recipe each iteration of the run stands for.

A recipe is written for a number of iterations. A run with a time limit measures during training how many fit, and
stretches or shrinks the rest of its schedule. Every such change is stored, so that a repeated or resumed run takes the
same steps.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

from gsplat_edu.base.errors import ArgumentError

MOST_CHANGES = 1_000
"""Largest number of changes of a tempo; a file with more is refused."""


@dataclass(frozen=True)
class Tempo:
    """Position in the recipe as a function of the iteration, piecewise linear.

    position(i) = p_k + (length - p_k) (i - i_k) / (n_k - i_k),  with p_k = position(i_k)

    k is the last change with i_k <= i; without changes, position(i) = i. Positions are whole batches.

    Args:
        length: Iterations of the recipe.
        changes: For each change, the iteration i_k from which it holds, and n_k > i_k, at which the recipe ends.
        batch: Images of a step.
    """

    length: int
    changes: tuple[tuple[int, int], ...] = ()
    batch: int = 1

    @classmethod
    @functools.lru_cache(maxsize=8)
    def parsed(cls, text: str, iterations: int, batch: int = 1) -> Tempo:
        """Return the tempo that a setting describes.

        Args:
            text: "" for that of the recipe, or "LENGTH,FROM:END,FROM:END,...", ascending, as `__str__` writes it.
            iterations: Iterations of the run, the length if the text is empty.
            batch: Images of a step.

        Raises:
            ArgumentError: the text is not such a description.
        """
        if not text:
            return cls(iterations, (), batch)
        words = text.split(",")
        try:
            length, changes = int(words[0]), tuple(_change(word) for word in words[1:])
        except ValueError:
            form = 'whole numbers as "LENGTH,FROM:END,...", for example "3000,800:2400"'
            raise ArgumentError(f"tempo: is {text[:60]!r}, but has to be {form}") from None
        if length < 1 or not changes or len(changes) > MOST_CHANGES:
            raise ArgumentError(f"tempo: needs a length of at least 1 and 1 to {MOST_CHANGES} changes")
        begins = [0, *(begin for begin, _ in changes)]
        if any(b < a for a, b in itertools.pairwise(begins)) or any(n <= i for i, n in changes):
            raise ArgumentError("tempo: the changes have to ascend, and each has to end after it begins")
        return cls(length, changes, batch)

    def __str__(self) -> str:
        """Return the description that `parsed` reads; empty without changes."""
        if not self.changes:
            return ""
        return ",".join([str(self.length), *(f"{begin}:{end}" for begin, end in self.changes)])

    @property
    def iterations(self) -> int:
        """Iterations of the run that reach the end of the recipe."""
        return self.changes[-1][1] if self.changes else self.length

    def changed(self, iteration: int, iterations: int) -> Tempo:
        """Return the tempo whose rest, from an iteration on, ends at another one.

        Args:
            iteration: The iteration about to be trained.
            iterations: New number of iterations of the run, above `iteration`.
        """
        kept = tuple(change for change in self.changes if change[0] < iteration)
        return replace(self, changes=(*kept, (iteration, iterations)))

    def position(self, iteration: int) -> int:
        """Return the iteration of the recipe that an iteration of the run stands for; both are counted from 0.

        Args:
            iteration: A multiple of the batch. Beyond the end of the run, positions go on one by one.
        """
        begin, start, end = 0, 0, self.length
        for change_begin, change_end in self.changes:
            if change_begin > iteration:
                break
            begin, start, end = change_begin, self._at(change_begin, begin, start, end), change_end
        return self._at(iteration, begin, start, end)

    def _at(self, iteration: int, begin: int, start: int, end: int) -> int:
        """Return the position on the piece that goes from `start` at `begin` to the length at `end`."""
        if iteration >= end:
            return max(start, self.length) + iteration - end
        position = start + (self.length - start) * (iteration - begin) // (end - begin)
        return position // self.batch * self.batch

    def passed(self, iteration: int) -> Iterator[int]:
        """Yield the positions that a step passes: none if the run is slower than the recipe, several if it is faster.

        Args:
            iteration: The first image of the step.

        Yields:
            Multiples of the batch, from the step's own position up to the next step's, exclusive.
        """
        yield from range(self.position(iteration), self.position(iteration + self.batch), self.batch)


def _change(word: str) -> tuple[int, int]:
    begin, end = word.split(":")
    return int(begin), int(end)


def accept_tempo(name: str, value: str) -> None:
    """Accept the descriptions of `Tempo.parsed`."""
    if not isinstance(value, str):
        raise ArgumentError(f"{name}: has to be a text")
    Tempo.parsed(value, 1)
