"""Vector quantisation for SOG: codebooks of 256 values, palettes of vectors.

A codebook starts with entries whose density is the cube root of the values' density, which is optimal for many entries
(Panter and Dite 1951), and is refined by Lloyd's algorithm on the sorted values. A palette is clustered in two levels:
the vectors into cells, then those of each cell into entries, which start at vectors with large weight and far from the
cell's centre. This takes seconds for a million vectors; nothing is random or depends on the number of threads. If there
are few enough values, they are stored exactly.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.sparse import csr_matrix

from gsplat_edu.base.threads import one_thread

CODEBOOK = 256
"""Entries of a codebook, selected by a byte."""

CODEBOOK_STEPS = 40
"""Lloyd iterations of a codebook; on trained scenes the fourth digit of the error no longer changes."""

MOST_SAMPLES = 65_536
"""Number of quantiles used to measure the density of a codebook's values."""

CAPS = 64
"""Iterations of capping the shares of gaps; each one at least halves the sum of the excessive shares."""

MOST_ENTRIES = 65_536
"""Entries of a palette, selected by 16 bits."""

ALL_KEPT = 1024
"""Up to this many vectors are all kept in the palette; they take at most 45 KiB."""

PALETTE_STEPS = 4
"""Lloyd iterations of a palette; twice as many change the error by less than half a per cent."""

SAMPLES_PER_CELL = 64
"""Vectors per cell used to find the cells."""

AT_ONCE = 1 << 22
"""Distances held in memory at once."""

HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 divided by the golden ratio: an odd number whose bits have no pattern."""


def codebook(values: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "256"]:
    """Choose 256 values that represent many values with a small mean square error.

    Args:
        values: Finite values, any number.

    Returns:
        The entries, ascending. If there are at most 256 different values, these values, with the largest one repeated.
    """
    distinct, counts = np.unique(values.astype(np.float64), return_counts=True)
    if len(distinct) <= CODEBOOK:
        last = distinct[-1] if len(distinct) else 0.0
        return np.append(distinct, np.full(CODEBOOK - len(distinct), last)).astype(np.float32)
    samples = distinct[np.linspace(0, len(distinct) - 1, min(len(distinct), MOST_SAMPLES)).astype(np.int64)]
    # the density between neighbouring samples is 1 / gap; its cube root integrates to gap^(2/3)
    shares = np.diff(samples) ** (2 / 3)
    for _ in range(CAPS):
        # the gap before an outlier contains nothing that needs more than one entry
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
    """Return, for each value, the index of the nearest entry in an ascending codebook.

    Args:
        values: Finite values.
        entries: The codebook.

    Returns:
        The indices.
    """
    borders = (entries[1:].astype(np.float64) + entries[:-1]) / 2
    chosen: UInt8[np.ndarray, "*shape"] = np.searchsorted(borders, values).astype(np.uint8)
    return chosen


def palette(
    vectors: Float32[np.ndarray, "N D"], weights: Float32[np.ndarray, " N"], entries: int | None = None
) -> tuple[Float32[np.ndarray, "P D"], Int64[np.ndarray, " N"]]:
    """Choose vectors that represent many vectors with a small weighted mean square error.

    Args:
        vectors: N finite vectors, preferably with neighbours in the scene next to each other.
        weights: Weight of each vector's error, positive.
        entries: Most entries, from `ALL_KEPT` to `MOST_ENTRIES`; None for the largest power of 2 that exceeds neither N
            nor `MOST_ENTRIES`.

    Returns:
        P entries, and for each vector the index of its entry. If there are at most 1024 different vectors, or no more
        than the palette has entries, all are kept.
    """
    count = len(vectors)
    size = min(count, entries or min(MOST_ENTRIES, 1 << (count.bit_length() - 1)))
    size = count if count <= ALL_KEPT else size
    vectors = vectors + np.float32(0.0)  # -0.0 becomes 0.0
    kept = _distinct(vectors, size)
    if kept is not None:
        return kept
    # squares of values near 1 neither overflow nor underflow; scaling by a power of 2 preserves all bits
    scale = np.float32(2.0 ** np.floor(np.log2(np.abs(vectors).max().astype(np.float64))))
    found, labels = _clustered(vectors / scale, weights, size)
    return found * scale, labels


def _distinct(
    vectors: Float32[np.ndarray, "N D"], most: int
) -> tuple[Float32[np.ndarray, "P D"], Int64[np.ndarray, " N"]] | None:
    """Return the distinct vectors in order of appearance, and an index per vector; None for more than `most`."""
    keys = np.zeros(len(vectors), dtype=np.uint64)
    for column in np.ascontiguousarray(vectors.T).view(np.uint32):
        keys = keys * HASH + column
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    if len(first) > most or not np.array_equal(vectors[first][inverse], vectors):  # two may share one key
        return None
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return vectors[first[order]], rank[inverse]


def _clustered(
    vectors: Float32[np.ndarray, "N D"], weights: Float32[np.ndarray, " N"], size: int
) -> tuple[Float32[np.ndarray, "P D"], Int64[np.ndarray, " N"]]:
    """Cluster vectors into cells, and the vectors of each cell into entries: `size` in all, fewer than the vectors.

    The entries of a cell start at its centre and at selected vectors.
    """
    cells = int(np.sqrt(size))
    sample = _spread(len(vectors), min(len(vectors), SAMPLES_PER_CELL * cells))
    middles = _lloyd(vectors[sample], weights[sample], vectors[sample[_spread(len(sample), cells)]])
    cell = _nearest(vectors, middles)
    far = (weights * np.linalg.norm(vectors - middles[cell], axis=1)).astype(np.float64)
    picked = sampled_rows(far**2, size - cells)
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


def sampled_rows(chances: Float64[np.ndarray, " N"], count: int) -> Bool[np.ndarray, " N"]:
    """Select `count` of the rows in proportion to their chances; rows with an expected count above 1 are always in."""
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
    """Move entries to the weighted means of their nearest points, for a few iterations."""
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
    """Return the index of the nearest entry for each point: |p - e|^2 is |e|^2 - 2 p e plus a common term."""
    squares = (entries * entries).sum(axis=1)
    labels = np.empty(len(points), dtype=np.int64)
    rows = max(1, AT_ONCE // len(entries))
    across = torch.from_numpy(np.ascontiguousarray(-2.0 * entries.T))
    with one_thread():  # the bits of a product would depend on the number of threads
        for begin in range(0, len(points), rows):
            distances = (torch.from_numpy(points[begin : begin + rows]) @ across).numpy()
            distances += squares
            labels[begin : begin + rows] = distances.argmin(axis=1)
    return labels


def _spread(count: int, picks: int) -> Int64[np.ndarray, " picks"]:
    """Select `picks` of `count` rows at equal distances."""
    return np.arange(picks, dtype=np.int64) * count // picks
