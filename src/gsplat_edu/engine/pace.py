"""How a part is cut into submissions, so that none keeps a slow GPU busy for long.

Windows resets a device that works on one submission for about two seconds, and other systems have such watchdogs too.
No workgroup of a pass waits for another one, and each finds its place from `Job.first`, so a pass may be dispatched in
stretches, in one submission or in many: the bits are the same. A part whose passes have not been timed is played in
short stretches, each of which the host waits for. From then on it is one submission, or as many as the limit asks for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

LIMIT = 0.2
"""Seconds that a submission may take: a tenth of what Windows allows."""

FIRST = 64
"""Workgroups of the first stretch of a pass that has not been timed."""

GROWTH = 4
"""A stretch has at most so many times the workgroups of the one before."""

ENOUGH = 1 / 20
"""Part of the limit from which on a time says more of the pass than of the call."""

REACH = 8
"""A time that was shorter holds for passes of at most so many times the workgroups."""

SLOWEST = 2
"""A part that takes so many times the limit of its submissions is timed again."""

LEAST_LIMIT, FASTEST = 0.05, 1e-9
"""Seconds: a lower limit does not make a part look slow; and what a workgroup takes at least."""


class Stretch(NamedTuple):
    """Consecutive workgroups of a pass.

    Args:
        place: The pass, counted in its part.
        first: The first of them.
        groups: Their number.
    """

    place: int
    first: int
    groups: int


class Timing(NamedTuple):
    """What is known of an entry point.

    Args:
        each: Seconds of a workgroup.
        groups: Workgroups up to which this holds.
    """

    each: float
    groups: float


class Pace:
    """Times of a device's entry points, and the cuts that follow.

    Args:
        limit: Seconds that a submission may take; 0 for one workgroup in each, infinity for a part in one.

    Attributes:
        known: Timings by entry point.
        version: Changes whenever they do, so that a plan can be kept.
    """

    def __init__(self, limit: float = LIMIT) -> None:
        self.limit = limit
        self.known: dict[str, Timing] = {}
        self.version = 0

    def is_known(self, name: str, groups: int) -> bool:
        """Return whether an entry point was timed well enough for so many workgroups."""
        if self.limit == float("inf"):
            return True
        found = self.known.get(name)
        return found is not None and groups <= found.groups

    def plan(self, passes: Sequence[tuple[str, int]], widest: int) -> list[list[Stretch]]:
        """Cut a part into submissions.

        Args:
            passes: Entry point and workgroups of each pass.
            widest: Workgroups in one dimension: a stretch that is not a whole pass has only one.
        """
        submissions: list[list[Stretch]] = [[]]
        room = self.limit
        for place, (name, groups) in enumerate(passes):
            each = max(self.known[name].each if name in self.known else 0.0, FASTEST)
            first = 0
            while first < groups:
                if submissions[-1] and room < each:
                    submissions.append([])
                    room = self.limit
                here = int(min(max(room / each, 1), groups - first))
                here = here if here == groups else min(here, widest)
                submissions[-1].append(Stretch(place, first, here))
                room -= here * each
                first += here
        return submissions

    def first_stretch(self, groups: int) -> int:
        """Return the workgroups with which the timing of a pass begins."""
        return min(groups, FIRST if self.limit else 1)

    def next_stretch(self, before: int, seconds: float, left: int, widest: int) -> int:
        """Return the workgroups that take half the limit if they are as fast as those before."""
        fits = before * 0.5 * self.limit / max(seconds, FASTEST)
        return int(max(min(fits, GROWTH * before, left, widest), 1))

    def note(self, name: str, times: Iterable[tuple[int, float]]) -> None:
        """Remember the workgroups and seconds of an entry point's stretches: the slowest one counts.

        The first one may include the driver's compiler, so it counts only if it is the only one. A pass says nothing
        new if a longer one of the same entry point was too short to tell: every other level of a scan, for instance.
        """
        self.version += 1
        stretches = [(groups, max(seconds, 0.0)) for groups, seconds in times]
        telling = [seconds / groups for groups, seconds in stretches[1:] if seconds >= ENOUGH * self.limit]
        total = sum(groups for groups, _ in stretches)
        if telling:
            self.known[name] = Timing(max(telling), float("inf"))
        elif not self.is_known(name, REACH * total):
            self.known[name] = Timing(sum(seconds for _, seconds in stretches) / total, REACH * total)

    def watch(self, names: Iterable[str], seconds: float, submissions: int) -> None:
        """Forget the entry points of a part that took far longer than its submissions may."""
        if seconds > SLOWEST * max(self.limit, LEAST_LIMIT) * submissions:
            self.version += 1
            for name in names:
                self.known.pop(name, None)
