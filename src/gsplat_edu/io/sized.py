"""Find the best file of at most a number of bytes: which splats to keep, and how finely to store them.

A `Setting` says how finely a scene is stored, and a step how much of it: up to the number of splats N, a step is how
many splats are kept, the most important ones first. A setting may leave the harmonics above degree 0 out of the less
important splats; steps beyond N give them back, one splat each. Steps beyond that refine what the format can refine
gradually (`Choices.finer`). So the size grows with the step, and `fitted` finds the step whose file is within
`LEAST_USED` of the budget by encoding for real.

`best_file` compares settings by a score of their files, one kind of change at a time: precision, degree, share of
splats with harmonics. Nothing is random, and all sorts are stable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.sh import num_coefficients

LEAST_USED = 0.99
"""A file takes at least this fraction of its budget, unless it holds the whole scene."""

AIM = 0.997
"""Fraction of the budget that the search aims at: between `LEAST_USED` and 1."""

FEWEST = 256
"""Fewest splats of a file; no scene is recognisable with fewer."""

INTERPOLATED = 8
"""Encodings that interpolate between sizes; any further one halves the interval."""

SWEEPS = 2
"""How often each kind of change is tried."""


@dataclass(frozen=True)
class Setting:
    """How finely a scene is stored.

    Args:
        sh_degree: Highest SH degree.
        share: Fraction of the kept splats that have harmonics above degree 0; the others have zeros.
        precision: What the format's encoder makes of it; 0 is the finest.
    """

    sh_degree: int
    share: float = 1.0
    precision: int = 0


@dataclass(frozen=True, eq=False)
class Part:
    """What a file holds of a scene.

    Args:
        gaussians: The kept splats, in the order of the scene.
        rows: Their indices in the scene, increasing.
        with_harmonics: How many of them have harmonics above degree 0.
        finer: How far a format refines the whole scene, from 0 to `Choices.finer`.
    """

    gaussians: Gaussians
    rows: Int64[np.ndarray, " M"]
    with_harmonics: int
    finer: int = 0


@dataclass(frozen=True, eq=False)
class Sized:
    """A file of limited size.

    Args:
        data: Its bytes.
        part: What it holds.
        setting: How finely.
        score: Its score; None if there was nothing to compare.
        whole: Whether it holds the whole scene in full precision.
    """

    data: bytes
    part: Part
    setting: Setting
    score: float | None = None
    whole: bool = False

    def fills(self, most: int) -> bool:
        """Return whether the file uses a budget, bytes, as far as it should."""
        return len(self.data) >= LEAST_USED * most


@dataclass(frozen=True)
class Choices:
    """What a format can choose from.

    Args:
        precisions: Number of precisions, from 0, the finest.
        shares: Fractions of splats with harmonics; 1 is one of them.
        finer: Number of steps by which a format can refine the harmonics of a whole scene.
    """

    precisions: int = 1
    shares: tuple[float, ...] = (1.0,)
    finer: int = 0


USUAL = Choices()
"""Those of a format without a choice."""


Encode = Callable[[Part, Setting], bytes]
"""Encodes a part of a scene as a whole file."""

Judge = Callable[[bytes], float]
"""Scores a file; more is better."""


class Ranked:
    """Splats in the order of their importance.

    Args:
        gaussians: N Gaussians.
        importance: (N,) importance of each splat, at least 0; more is kept longer, equal ones in the order of the
            scene. Times the squares of its coefficients above degree 0, it is that of its harmonics.
    """

    def __init__(self, gaussians: Gaussians, importance: Float64[np.ndarray, " N"]) -> None:
        self.gaussians = gaussians
        self._order = np.argsort(-importance, kind="stable")
        squares = np.square(gaussians.sh_rest.double().numpy(force=True)).sum(axis=(1, 2))
        self._harmonics = importance * squares

    def __len__(self) -> int:
        """Return the number of splats."""
        return len(self.gaussians)

    def most_important(self, count: int) -> Int64[np.ndarray, " M"]:
        """Return the indices of the most important splats, increasing; all if there are not more."""
        return np.sort(self._order[:count])

    def steps(self, setting: Setting) -> int:
        """Return the last step of a setting, with which the scene is whole."""
        return 2 * len(self) - self._with_harmonics(len(self), setting)

    def part(self, setting: Setting, step: int) -> Part:
        """Return what a file of a setting holds at a step."""
        count = min(step, len(self))
        rows = self.most_important(count)
        gaussians = self.gaussians[torch.from_numpy(rows)]
        if setting.sh_degree < gaussians.sh_degree:
            coefficients = num_coefficients(setting.sh_degree) - 1
            gaussians = replace(gaussians, sh_rest=gaussians.sh_rest[:, :coefficients].contiguous())
        kept = min(count, self._with_harmonics(count, setting) + step - count)
        if kept < count:
            bare = np.argsort(-self._harmonics[rows], kind="stable")[kept:]
            rest = gaussians.sh_rest.clone()
            rest[torch.from_numpy(bare)] = 0.0
            gaussians = replace(gaussians, sh_rest=rest)
        finer = max(0, step - self.steps(setting))
        return Part(gaussians, rows, kept if setting.sh_degree else 0, finer)

    def _with_harmonics(self, count: int, setting: Setting) -> int:
        return round(setting.share * count) if setting.sh_degree else count


def fitted(
    ranked: Ranked, setting: Setting, encode: Encode, most: int, choices: Choices = USUAL
) -> Sized | None:
    """Return the largest file of a setting that is found within a budget; None if none of `FEWEST` splats is.

    Args:
        ranked: The scene.
        setting: How finely it is stored.
        encode: Makes a file.
        most: The budget, bytes.
        choices: What the format can choose from.
    """
    last = ranked.steps(setting) + (choices.finer if setting.sh_degree else 0)
    low, high = min(FEWEST, last), last + 1
    part = ranked.part(setting, low)
    data = encode(part, setting)
    if len(data) > most:
        return None
    found, slope, over, tries = Sized(data, part, setting), len(data) / max(low, 1), 0, 0
    while high - low > 1 and not found.fills(most):
        if over:
            slope = (over - len(found.data)) / (high - low)
        tries += 1
        ahead = (AIM * most - len(found.data)) / max(slope, 1e-9)
        step = low + (round(ahead) if tries <= INTERPOLATED else (high - low) // 2)
        step = min(max(step, low + 1), high - 1)
        part = ranked.part(setting, step)
        data = encode(part, setting)
        if len(data) > most:
            high, over = step, len(data)
        else:
            slope = (len(data) - len(found.data)) / (step - low)
            low, found = step, Sized(data, part, setting)
    return found


def best_file(ranked: Ranked, encode: Encode, judge: Judge, most: int, choices: Choices) -> Sized:
    """Return the best file of a scene within a budget; if the scene fits whole in full precision, that file.

    Args:
        ranked: The scene.
        encode: Makes a file.
        judge: Scores a file.
        most: The budget, bytes.
        choices: What the format can choose from.

    Raises:
        ArgumentError: no useful file is as small.
    """
    degree = ranked.gaussians.sh_degree
    finest = Setting(degree)
    whole = ranked.part(finest, len(ranked))
    data = encode(whole, finest)
    if len(data) <= most:
        return Sized(data, whole, finest, whole=True)
    coarsest = Setting(0, precision=choices.precisions - 1)
    tried: dict[Setting, Sized] = {}

    def consider(setting: Setting) -> None:
        if setting not in tried and (file := fitted(ranked, setting, encode, most, choices)) is not None:
            tried[setting] = replace(file, score=judge(file.data))

    def best() -> Sized:
        return max(tried.values(), key=lambda file: (file.fills(most), file.score))

    consider(coarsest)
    if not tried:
        smallest = ranked.part(coarsest, min(FEWEST, len(ranked)))
        raise ArgumentError(
            f"size: {most:,} bytes are too few: the smallest file, of {len(smallest.rows):,} splats, has"
            f" {len(encode(smallest, coarsest)):,} bytes; allow at least as many"
        )
    consider(Setting(degree, precision=min(1, choices.precisions - 1)))
    for _ in range(SWEEPS):
        for precision in range(choices.precisions):
            consider(replace(best().setting, precision=precision))
        for lower in range(degree + 1):
            consider(replace(best().setting, sh_degree=lower, share=best().setting.share if lower else 1.0))
        for share in choices.shares if best().setting.sh_degree else ():
            consider(replace(best().setting, share=share))
    return best()
