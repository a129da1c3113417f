"""Find the pairs of photos that are worth matching, by the features of the largest scales.

Matching all features of two photos takes 30 to 250 ms of processor time, and many pairs of an unordered set show
nothing in common. The few features of the largest scales take less than 1 ms, and many of them match if the photos
overlap.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int64

from gsplat_edu.base.threads import one_thread
from gsplat_edu.sfm.pairs import Pair

LARGEST = 300
"""Features of each photo that are compared. Of the pairs of snowmiku97 of which 15 match, COLMAP verifies 98 %, and
these pairs have 96 % of all verified matches."""

RATIO = 0.8
"""A match is at most this fraction as distant as the second nearest feature, as for COLMAP."""

LENGTH = 512.0
"""Length of COLMAP's descriptors, whose 128 entries are rounded to bytes."""

NOTHING: Float32[np.ndarray, "0 128"] = np.zeros((0, 128), np.float32)


def largest_features(database: Path, names: Sequence[str]) -> list[Float32[np.ndarray, "_ 128"]]:
    """Read the SIFT descriptors of each photo's `LARGEST` features of the largest scales.

    Args:
        database: COLMAP's database, with features.
        names: The photos.

    Returns:
        One array per photo, of whole numbers from 0 to 255; empty for a photo without features.
    """
    query = (
        "SELECT k.rows, k.cols, k.data, d.data FROM images i JOIN keypoints k ON k.image_id = i.image_id "
        "JOIN descriptors d ON d.image_id = i.image_id WHERE i.name = ? AND k.rows > 0"
    )
    found = []
    with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as reader:
        for name in names:
            row = reader.execute(query, (name,)).fetchone()
            found.append(NOTHING if row is None else _of_largest_scales(*row))
    return found


def _of_largest_scales(
    rows: int, columns: int, keypoints: bytes, descriptors: bytes
) -> Float32[np.ndarray, "m 128"]:
    a, b, c, d = np.frombuffer(keypoints, np.float32).reshape(rows, columns)[:, 2:6].T.astype(np.float64)
    order = np.argsort(-np.abs(a * d - b * c), kind="stable")[:LARGEST]  # shape: scale times rotation
    return np.frombuffer(descriptors, np.uint8).reshape(rows, 128)[order].astype(np.float32)


def votes(
    described: Sequence[Float32[np.ndarray, "_ 128"]], progress: Callable[[int], None] = lambda done: None
) -> Int64[np.ndarray, "n n"]:
    """Count the matches between the descriptors of each two photos.

    Two descriptors match if each is the other's nearest, and the earlier photo's is clearly nearer to the later one's
    than the second nearest, `RATIO`. The counts are the same on every machine: products of descriptors are whole
    numbers below 2^24, which float32 represents exactly, in any order of summation.

    Args:
        described: Descriptors of n photos, as from `largest_features`.
        progress: Called with the number of pairs done.

    Returns:
        (n, n), symmetric, with a diagonal of zero.
    """
    count = len(described)
    found, done = np.zeros((count, count), np.int64), 0
    with one_thread():  # products this small take longer on several threads
        for i in range(count):
            for j in range(i):
                found[i, j] = found[j, i] = _matches(described[i], described[j])
            done += i
            progress(done)
    return found


def _matches(one: Float32[np.ndarray, "m 128"], other: Float32[np.ndarray, "k 128"]) -> int:
    if not len(one) or not len(other):
        return 0
    product = (torch.from_numpy(one) @ torch.from_numpy(other).T).numpy()
    rows, nearest = np.arange(len(one)), product.argmax(axis=1)
    first = product[rows, nearest]
    mutual = first == product.max(axis=0)[nearest]
    product[rows, nearest] = 0.0
    # Half the squared distances; rounding makes some descriptors longer than LENGTH.
    squared, second = (np.maximum(LENGTH**2 - near, 0.0) for near in (first, product.max(axis=1)))
    return int(np.count_nonzero(mutual & (squared < RATIO**2 * second)))


def likely_pairs(counts: Int64[np.ndarray, "n n"], best: int, enough: int) -> set[Pair]:
    """Pair each photo with those that it has the most matches with.

    Args:
        counts: (n, n) numbers of matches, as from `votes`.
        best: Number of partners of each photo; ties are decided by the photos' order.
        enough: Photos with this number of matches are paired in any case.
    """
    others = counts.copy()
    np.fill_diagonal(others, -1)
    order = np.argsort(-others, axis=1, kind="stable")[:, : min(best, len(counts) - 1)]
    chosen = {(min(i, j), max(i, j)) for i, row in enumerate(order.tolist()) for j in row}
    return chosen | {(i, j) for i, j in np.argwhere(np.triu(others >= enough, 1)).tolist()}
