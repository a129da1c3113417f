"""Choose the pairs of photos to match: all, or those that are consecutive, similar, or taken nearby."""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.cluster import vq
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

WORDS = 64
"""Visual words in a photo's descriptor (Jégou et al. 2010 use 16 to 256)."""

SAMPLE = 40_000
"""Number of local descriptors from which the words are learnt."""

BLOCK = 256
"""Number of photos whose distances to all others are in memory at once."""

EARTH = 6_371_000.0
"""Mean radius of the earth, m."""

Pair = tuple[int, int]
"""Indices of two photos in the sorted list, the smaller one first."""


def all_pairs(count: int) -> set[Pair]:
    """Return all pairs of `count` photos."""
    return set(combinations(range(count), 2))


def sequential_pairs(count: int, overlap: int) -> set[Pair]:
    """Pair each photo with the next ones, and with those 2, 4, 8 ... positions ahead, as many times.

    Args:
        count: Number of photos.
        overlap: Number of following photos, and of powers of two.
    """
    steps = {*range(1, overlap + 1), *(2**power for power in range(overlap))}
    return {(i, i + step) for step in steps for i in range(count - step)}


def nearest_pairs(points: Float[np.ndarray, "n d"], k: int, apart: int = 1) -> set[Pair]:
    """Pair each point with its k nearest ones.

    Args:
        points: (n, d) any coordinates.
        k: Number of neighbours.
        apart: Points whose indices differ by less are excluded.
    """
    count, pairs = len(points), set[Pair]()
    centred = points - points.mean(axis=0)
    squares = (centred**2).sum(axis=1)
    for start in range(0, count, BLOCK):
        here = np.arange(start, min(start + BLOCK, count))
        distances = squares[here, None] + squares - 2.0 * centred[here] @ centred.T
        distances[np.abs(here[:, None] - np.arange(count)) < apart] = np.inf
        for i, row in zip(here.tolist(), distances, strict=True):
            order = np.argsort(row, kind="stable")[:k]
            pairs |= {(min(i, j), max(i, j)) for j in order[np.isfinite(row[order])].tolist()}
    return pairs


def on_the_ground(places: Sequence[tuple[float, float, float]]) -> Float64[np.ndarray, "n 3"]:
    """Convert latitude, longitude (degrees) and height (m) to positions in m.

    Args:
        places: One per photo.

    Returns:
        (n, 3) on a sphere of the earth's mean radius.
    """
    latitude, longitude, height = np.array(places, dtype=np.float64).T
    latitude, longitude = np.radians(latitude), np.radians(longitude)
    direction = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1
    )
    return np.asarray((EARTH + height)[:, None] * direction)


def photo_descriptors(database: Path, names: Sequence[str], seed: int) -> Float32[np.ndarray, "n d"]:
    """Describe each photo by a VLAD vector: the sums of its SIFT descriptors' offsets from visual words.

    v_w = sum over descriptors d whose nearest word is w of (d - c_w); each v_w is normalised, then the whole vector

    Args:
        database: COLMAP's database, with descriptors.
        names: The photos, in the order of the rows.
        seed: Seed for learning the words.

    Returns:
        (n, 8192) unit vectors; zero for a photo without features. Similar photos have nearby vectors.

    Source: Jégou et al. 2010, "Aggregating local descriptors into a compact image representation"; the normalisation of
        each part follows Arandjelović and Zisserman 2013.
    """
    rng = np.random.default_rng(seed)
    share = max(20, SAMPLE // max(len(names), 1))
    sample = []
    for descriptors in _descriptors(database, names):
        take = rng.permutation(len(descriptors))[:share]
        sample.append(descriptors[take])
    learnt = np.concatenate(sample)
    if len(learnt) < WORDS:
        return np.zeros((len(names), 1), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about words that no descriptor is nearest to, which are harmless
        words, _ = vq.kmeans2(learnt, WORDS, iter=10, minit="points", rng=rng)
    words = np.ascontiguousarray(words, dtype=np.float32)
    rows = [_vlad(descriptors, words) for descriptors in _descriptors(database, names)]
    return np.stack(rows)


def largest_part(count: int, pairs: Sequence[Pair]) -> list[int]:
    """Return the photos of the largest connected component.

    Args:
        count: Number of photos.
        pairs: Connected pairs.
    """
    first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    return np.flatnonzero(labels == np.bincount(labels).argmax()).tolist()


def _vlad(
    descriptors: Float32[np.ndarray, "m 128"], words: Float32[np.ndarray, "w 128"]
) -> Float32[np.ndarray, " d"]:
    if not len(descriptors):
        return np.zeros(words.size, np.float32)
    nearest = np.argmin((words**2).sum(axis=1) - 2.0 * descriptors @ words.T, axis=1)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, descriptors - words[nearest])
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    sums = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0)
    flat = sums.ravel()
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-12))


def _descriptors(database: Path, names: Sequence[str]) -> Iterator[Float32[np.ndarray, "m 128"]]:
    """Read the SIFT descriptors of photos one by one."""
    reader = sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)
    query = "SELECT d.data FROM descriptors d JOIN images i ON i.image_id = d.image_id WHERE i.name = ?"
    try:
        for name in names:
            row = reader.execute(query, (name,)).fetchone()
            data = row[0] if row and row[0] else b""
            yield np.frombuffer(data, np.uint8).reshape(-1, 128).astype(np.float32)
    finally:
        reader.close()
