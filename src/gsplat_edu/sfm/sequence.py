"""Find out whether photos were taken in sequence: their order by name or time, and the evidence for it.

Names are in natural order (IMG_9 before IMG_10). The evidence is that photos resemble their successors: ranked by
similarity to a photo, its successor is among the first few far more often than by chance.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

FIRST = 5
"""A successor counts if it is among this number of most similar photos: two on each side, and one of another lap."""

CHANCE = 5e-7
"""Largest probability with which a random order is taken for a sequence. Two are tried at most, by name and by time, so
an unordered set is taken for one with a probability of at most one in a million."""

MAJORITY = 0.5
"""At least this fraction of the photos must resemble their successors; among very many photos, a small fraction would
already exceed chance."""

BLOCK = 256
"""Number of photos whose similarities to all others are in memory at once."""


@dataclass(frozen=True)
class PhotoSequence:
    """Photos that were taken in sequence.

    Args:
        order: The photos' indices in the order in which they were taken.
        by: Source of the order, for the sentence: names or times.
        alike: Number of photos whose successor is among the `FIRST` most similar ones.
        by_chance: Largest number that a random order reaches with a probability of more than `CHANCE`.
    """

    order: list[int]
    by: str
    alike: int
    by_chance: int

    def __str__(self) -> str:
        """Return the sentence about the order and its evidence."""
        count = len(self.order) - 1
        return (
            f"the photos were taken in sequence: sorted by {self.by}, {self.alike} of {count} have the next one among "
            f"the {FIRST} most similar (at most {self.by_chance} by chance)"
        )


def natural_order(names: Sequence[str]) -> list[int]:
    """Return the indices that sort names with their numbers compared as numbers, and regardless of case."""

    def key(index: int) -> tuple[list[str | int], str]:
        parts = re.split("([0-9]+)", names[index])  # text and numbers take turns, so they are never compared
        return [int(part) if k % 2 else part.casefold() for k, part in enumerate(parts)], names[index]

    return sorted(range(len(names)), key=key)


def find_sequence(
    names: Sequence[str], times: Sequence[str], described: Float32[np.ndarray, "n d"]
) -> PhotoSequence | None:
    """Return the order in which photos were taken, or None if they do not follow one another.

    Args:
        names: Their names.
        times: When they were taken, as texts that sort by time; empty if unknown.
        described: (n, d) their unit descriptors, as from `gsplat_edu.sfm.pairs.photo_descriptors`.
    """
    by_name = natural_order(names)
    orders = [(by_name, "name")]
    if all(times) and len(set(times)) > 1:
        by_time = sorted(by_name, key=lambda index: times[index])
        if by_time == by_name:
            orders = [(by_name, "name, as by EXIF time")]
        else:
            orders.append((by_time, "EXIF time"))
    enough = max(by_chance(len(names)) + 1, MAJORITY * (len(names) - 1))
    found = [
        PhotoSequence(order, by, alike, by_chance(len(names)))
        for order, by in orders
        if (alike := successors_alike(described[order])) >= enough
    ]
    return max(found, key=lambda one: one.alike, default=None)


def successors_alike(described: Float32[np.ndarray, "n d"]) -> int:
    """Count the photos whose successor is among the `FIRST` photos most similar to them; ties count against it.

    Args:
        described: (n, d) unit descriptors in the order to examine; zero for photos without features.
    """
    count, alike = len(described), 0
    for start in range(0, count - 1, BLOCK):
        here = np.arange(start, min(start + BLOCK, count - 1))
        similarity = described[here] @ described.T
        following = similarity[np.arange(len(here)), here + 1]
        similarity[np.arange(len(here)), here] = -np.inf
        alike += int(((similarity >= following[:, None]).sum(axis=1) <= FIRST).sum())
    return alike


def by_chance(count: int) -> int:
    """Return the largest number of `successors_alike` that a random order reaches with a probability above `CHANCE`.

    Draw the order photo by photo. If m photos are left, each is next with probability 1/m, and at most `FIRST` of them
    count, for any earlier draws: the conditional probability is at most min(1, FIRST / m). The number is therefore
    stochastically at most the sum of independent variables that are 1 with these probabilities.

    Args:
        count: Number of photos.
    """
    law = np.ones(1)
    for left in range(1, count):
        p = min(1.0, FIRST / left)
        law = np.convolve(law, (1.0 - p, p))
    at_least = np.cumsum(law[::-1])[::-1]  # at_least[h] = P(sum >= h)
    return int(np.flatnonzero(at_least > CHANCE)[-1])
