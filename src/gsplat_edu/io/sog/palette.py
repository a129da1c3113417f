"""Few numbers for many, as SOG keeps them: codebooks of 256 numbers, palettes of vectors.

A codebook starts with entries as dense as the cube root of the values' density, which is best where there are many
entries (Panter and Dite 1951), and is mended by Lloyd's steps on the sorted values. A palette is clustered twice: the
vectors into cells, then those of each cell into entries, which start at its vectors that are heavy and far from its
middle. A million vectors take seconds so, and nothing is random or depends on the number of threads. Values that are
few enough are kept as they are.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.sparse import csr_matrix

from gsplat_edu.threads import one_thread

CODEBOOK = 256
"""Entries of a codebook: a byte chooses one."""

CODEBOOK_STEPS = 40
"""Lloyd's steps of a codebook: on trained scenes the error no longer falls in its fourth digit."""

MOST_SAMPLES = 65_536
"""Quantiles between which the density of a codebook's values is measured."""

CAPS = 64
"""Times that the shares of gaps are capped: each time the sum of those that are too large falls to half or less."""

MOST_ENTRIES = 65_536
"""Entries of a palette: 16 bits choose one."""

ALL_KEPT = 1024
"""Up to this many vectors a palette holds all of them: they take 45 KiB at most."""

PALETTE_STEPS = 4
"""Lloyd's steps of a palette: twice as many change the error by less than half a per cent."""

SAMPLES_PER_CELL = 64
"""Vectors per cell that the cells are found from."""

AT_ONCE = 1 << 22
"""Distances that are held at once."""

HASH = np.uint64(0x9E3779B97F4A7C15)
"""An odd number with no pattern in its bits: 2^64 divided by the golden ratio."""


def codebook(values: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "256"]:
    """Choose 256 numbers that stand for many, with a small mean square error.

    Args:
        values: Any number of finite numbers.

    Returns:
        The entries, ascending. Where there are at most 256 different values, these, the largest repeated.
    """
    distinct, counts = np.unique(values.astype(np.float64), return_counts=True)
    if len(distinct) <= CODEBOOK:
        last = distinct[-1] if len(distinct) else 0.0
        return np.append(distinct, np.full(CODEBOOK - len(distinct), last)).astype(np.float32)
    samples = distinct[np.linspace(0, len(distinct) - 1, min(len(distinct), MOST_SAMPLES)).astype(np.int64)]
    # between neighbouring samples the density is 1 / gap; its cube root integrates to gap^(2/3)
    shares = np.diff(samples) ** (2 / 3)
    for _ in range(CAPS):
        # the gap in front of an outlier has nothing that more than one entry could stand for
        shares = np.minimum(shares, shares.sum() / CODEBOOK)
    places = np.cumsum(np.append(0.0, shares))
    entries = np.interp((np.arange(CODEBOOK) + 0.5) / CODEBOOK * places[-1], places, samples)
    number = np.append(0, np.cumsum(counts))
    total = np.append(0.0, np.cumsum(distinct * counts))
    for _ in range(CODEBOOK_STEPS):
        inner = np.searchsorted(distinct, (entries[1:] + entries[:-1]) / 2)
        ends = np.concatenate([[0], inner, [len(distinct)]])
        members, sums = np.diff(number[ends]), np.diff(total[ends])
        entries = np.where(members > 0, sums / np.maximum(members, 1), entries)
    return np.sort(entries).astype(np.float32)


def nearest_in_codebook(
    values: Float32[np.ndarray, "*shape"], entries: Float32[np.ndarray, "256"]
) -> UInt8[np.ndarray, "*shape"]:
    """Say of each value which entry of an ascending codebook is nearest.

    Args:
        values: Finite numbers.
        entries: The codebook.

    Returns:
        The numbers of the entries.
    """
    borders = (entries[1:].astype(np.float64) + entries[:-1]) / 2
    chosen: UInt8[np.ndarray, "*shape"] = np.searchsorted(borders, values).astype(np.uint8)
    return chosen


def palette(
    vectors: Float32[np.ndarray, "N D"], weights: Float32[np.ndarray, " N"]
) -> tuple[Float32[np.ndarray, "P D"], Int64[np.ndarray, " N"]]:
    """Choose few vectors that stand for many, with a small weighted mean square error.

    Args:
        vectors: N finite vectors; neighbours in this order had better be neighbours in the scene.
        weights: What an error of each counts, positive.

    Returns:
        P entries, and for each vector the number of its entry. Up to 1024 different vectors, and as many as the
        palette has entries, are all kept; else P is at most the largest power of 2 that is not above N, nor above
        65,536.
    """
    count = len(vectors)
    size = count if count <= ALL_KEPT else min(MOST_ENTRIES, 1 << (count.bit_length() - 1))
    vectors = vectors + np.float32(0.0)  # -0.0 becomes 0.0
    kept = _distinct(vectors, size)
    if kept is not None:
        return kept
    # squares of numbers near 1 neither over- nor underflow, and a power of 2 changes no bit of what is kept
    scale = np.float32(2.0 ** np.floor(np.log2(np.abs(vectors).max().astype(np.float64))))
    entries, labels = _clustered(vectors / scale, weights, size)
    return entries * scale, labels


def _distinct(
    vectors: Float32[np.ndarray, "N D"], most: int
) -> tuple[Float32[np.ndarray, "P D"], Int64[np.ndarray, " N"]] | None:
    """Return the different vectors in the order of their coming, and whose number each has; None if they are more."""
    keys = np.zeros(len(vectors), dtype=np.uint64)
    for column in np.ascontiguousarray(vectors.T).view(np.uint32):
        keys = keys * HASH + column
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    if len(first) > most or not np.array_equal(vectors[first][inverse], vectors):  # two may have one key
        return None
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return vectors[first[order]], rank[inverse]


def _clustered(
    vectors: Float32[np.ndarray, "N D"], weights: Float32[np.ndarray, " N"], size: int
) -> tuple[Float32[np.ndarray, "P D"], Int64[np.ndarray, " N"]]:
    """Cluster vectors in cells, and the vectors of each cell in entries: `size` in all, fewer than there are vectors.

    The entries of a cell start at its middle and at picks of its vectors.
    """
    cells = int(np.sqrt(size))
    sample = _spread(len(vectors), min(len(vectors), SAMPLES_PER_CELL * cells))
    middles = _lloyd(vectors[sample], weights[sample], vectors[sample[_spread(len(sample), cells)]])
    cell = _nearest(vectors, middles)
    far = (weights * np.linalg.norm(vectors - middles[cell], axis=1)).astype(np.float64)
    picked = _picked(far**2, size - cells)
    ends = np.cumsum(np.bincount(cell, minlength=cells))[:-1]
    entries: list[Float32[np.ndarray, "_ D"]] = []
    labels = np.empty(len(vectors), dtype=np.int64)
    begin = 0
    for middle, rows in zip(middles, np.split(np.argsort(cell, kind="stable"), ends), strict=True):
        own = vectors[rows]
        found = _lloyd(own, weights[rows], np.concatenate([middle[None], own[picked[rows]]]))
        labels[rows] = begin + _nearest(own, found)
        entries.append(found)
        begin += len(found)
    return np.concatenate(entries), labels


def _picked(chances: Float64[np.ndarray, " N"], count: int) -> Bool[np.ndarray, " N"]:
    """Pick `count` rows, fewer than there are, in proportion to their chances; those due more than once for sure."""
    chances = np.maximum(chances, 1e-30)
    sure: Bool[np.ndarray, " N"] = np.zeros(len(chances), dtype=bool)
    while True:
        due = np.where(sure, 1.0, (count - sure.sum()) * chances / chances[~sure].sum())
        more = ~sure & (due >= 1.0)
        if not more.any():
            break
        sure |= more
    return np.diff(np.floor(np.cumsum(due) + 0.5), prepend=0.0) > 0


def _lloyd(
    points: Float32[np.ndarray, "N D"],
    weights: Float32[np.ndarray, " N"],
    entries: Float32[np.ndarray, "P D"],
) -> Float32[np.ndarray, "P D"]:
    """Move entries to the weighted means of the points that are nearest to them, a few times."""
    for _ in range(PALETTE_STEPS):
        labels = _nearest(points, entries)
        chosen = csr_matrix((weights, (labels, np.arange(len(points)))), shape=(len(entries), len(points)))
        sums = chosen @ points
        members = chosen.sum(axis=1)
        entries = np.where(members > 0, sums / np.where(members > 0, members, 1), entries)
    return entries


def _nearest(
    points: Float32[np.ndarray, "N D"], entries: Float32[np.ndarray, "P D"]
) -> Int64[np.ndarray, " N"]:
    """Say of each point which entry is nearest: |p - e|^2 is |e|^2 - 2 p e, but for what all entries share."""
    squares = (entries * entries).sum(axis=1)
    labels = np.empty(len(points), dtype=np.int64)
    rows = max(1, AT_ONCE // len(entries))
    across = torch.from_numpy(np.ascontiguousarray(-2.0 * entries.T))
    with one_thread():  # the bits of a product would depend on how many there are
        for begin in range(0, len(points), rows):
            distances = (torch.from_numpy(points[begin : begin + rows]) @ across).numpy()
            distances += squares
            labels[begin : begin + rows] = distances.argmin(axis=1)
    return labels


def _spread(count: int, picks: int) -> Int64[np.ndarray, " picks"]:
    """Pick so many of `count` rows at equal distances."""
    return np.arange(picks, dtype=np.int64) * count // picks
