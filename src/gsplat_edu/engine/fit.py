"""Whether a program's buffers fit a device, and what would.

A device grants buffers up to a size: a browser's default is 128 MiB, which holds the harmonics of 745,654 Gaussians at
degree 3. The engine keeps each kind of number in one buffer, so a scene beyond that is refused before anything starts.
"""

from __future__ import annotations

from collections.abc import Mapping

from gsplat_edu.base.constants import SH_MAX_DEGREE
from gsplat_edu.engine.passes import WORD, Program, Size
from gsplat_edu.scene.sh import num_coefficients

HARMONICS = tuple(3 * (num_coefficients(degree) - 1) for degree in range(SH_MAX_DEGREE + 1))
"""Numbers of a Gaussian's higher harmonics, by degree."""

GAUSSIANS, REST = "gaussians", "rest"
"""Names of counts: Gaussians, and all of their higher harmonics."""

REMEDIES = {
    GAUSSIANS: "train with a lower `max_gaussians`, reduce the scene",
    REST: "train with a lower `max_gaussians` or `sh_degree`, reduce the scene",
    "pairs": "make the image smaller (`resolution`, `size`), lower `max_gaussians`",
}
"""What helps, by the count that is too large."""

SMALLER_IMAGE = "make the image smaller (`resolution`, `size`)"
"""Helps against any other."""


def why_too_large(program: Program, counts: Mapping[str, int], most: int, device: str) -> str | None:
    """Return what of a program does not fit, what would, and what to do; None if all fits.

    Args:
        program: The program.
        counts: Its counts by name.
        most: Bytes of the largest buffer that the device grants.
        device: Its name.
    """
    largest = max(program.buffers, key=lambda buffer: buffer.size.of(counts))
    size, name = WORD * largest.size.of(counts), largest.size.count
    if size <= most:
        return None
    of_all = ", ".join(f"{count} {each}" for each, count in counts.items())
    needs = f"the buffer {largest.name} needs {size / 2**20:.0f} MiB for {of_all}"
    each = GAUSSIANS if name == REST else name
    fit, remedy = most_that_fit(program, counts, most, each), REMEDIES.get(name, SMALLER_IMAGE)
    if name == REST and (degree := _degree_that_fits(program, counts, most)) is not None:
        remedy = f"all fit with `sh_degree={degree}`; {remedy}"
    return f"{needs}, but {device} allows {most / 2**20:.0f}: {fit} {each} fit; {remedy}"


def most_that_fit(program: Program, counts: Mapping[str, int], most: int, name: str) -> int:
    """Return the largest number of something that fits; the harmonics of each Gaussian stay as they are.

    Args:
        program: The program.
        counts: Its counts by name.
        most: Bytes of the largest buffer that the device grants.
        name: Of the count.
    """
    words = most // WORD
    fits = [_items(buffer.size, words) for buffer in program.buffers if buffer.size.count == name]
    if name == GAUSSIANS and (numbers := counts[REST] // max(counts[GAUSSIANS], 1)):
        fits += [
            _items(buffer.size, words) // numbers for buffer in program.buffers if buffer.size.count == REST
        ]
    return min(fits)


def _items(size: Size, words: int) -> int:
    """Return the largest count whose size is at most so many words."""
    return words // size.words * size.per


def _degree_that_fits(program: Program, counts: Mapping[str, int], most: int) -> int | None:
    """Return the highest degree at which the same Gaussians fit; None if there is none."""
    count = counts[GAUSSIANS]
    for degree in (2, 1, 0):
        fewer = dict(counts) | {REST: count * HARMONICS[degree]}
        if fewer[REST] < counts[REST] and most_that_fit(program, fewer, most, GAUSSIANS) >= count:
            return degree
    return None
