"""The matched points of a capture's photos, for its page: where they are in space and in each photo.

The numbers are one little-endian array after another, for M points and for P pairs of a photo and a point in it; the
pairs of a photo follow one another, the photos in the order of the page's cameras:

    positions   M x 3 float32   world units
    rows        P uint32        point of each pair
    places      P x 2 uint16    where the point is in the photo, from 0 (left, top) to 65535 (right, bottom)

Places are those at which the photo's camera sees the point; the feature that was matched lies within its error, which
is a pixel or two, of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import Frame
from gsplat_edu.data.native_lens import native_intrinsics
from gsplat_edu.data.sparse_depth import tracked_points
from gsplat_edu.scene.camera import Camera

MOST_PAIRS = 400_000
"""More pairs of photo and point are thinned by leaving out points."""

WIDEST_PLACE = 65535
"""The right or lower border of a photo in the numbers."""


def matches_of(capture: Path, frames: Sequence[Frame]) -> tuple[dict[str, Any], bytes] | None:
    """Return the matched points of a capture's photos: their facts, for JSON, and their numbers.

    Args:
        capture: The capture, whose tracks a mapper has measured (`gsplat_edu.survey.support.observed_points`).
        frames: Its photos, in the order of the page's cameras.

    Returns:
        The number of points, the number of pairs of each photo, and whether points were left out; None if the capture
        has no tracks, or its files cannot be read, which the reader of the poses reports.
    """
    try:
        tracked = tracked_points(capture, most_error=np.inf, least_views=1)
    except (DatasetError, OSError):
        return None
    if tracked is None:
        return None
    count = len(tracked.points)
    kept = _kept(tracked.seen, count)
    new = np.cumsum(kept) - 1
    rows, places = [], []
    for frame in frames:
        seen = tracked.seen.get(legible(frame.name), np.zeros(0, np.int64))
        seen = seen[kept[seen]]
        at = _places(frame, tracked.points[seen])
        inside = (at >= 0.0).all(axis=1) & (at <= 1.0).all(axis=1)
        rows.append(new[seen[inside]])
        places.append(np.rint(WIDEST_PLACE * at[inside]))
    facts = {
        "points": int(kept.sum()),
        "pairs": [len(some) for some in rows],
        "thinned": bool(not kept.all()),
    }
    arrays = (
        tracked.points[kept].astype("<f4"),
        np.concatenate(rows).astype("<u4"),
        np.concatenate(places).astype("<u2"),
    )
    return facts, b"".join(array.tobytes() for array in arrays)


def _kept(seen: Mapping[str, Int64[np.ndarray, " n"]], count: int) -> Bool[np.ndarray, " N"]:
    """Choose points at random, always the same ones, until there are `MOST_PAIRS`."""
    pairs = np.zeros(count, np.int64)
    for rows in seen.values():
        pairs[rows] += 1
    order = np.random.default_rng(0).permutation(count)
    kept = np.zeros(count, dtype=bool)
    kept[order[np.cumsum(pairs[order]) <= MOST_PAIRS]] = True
    return kept


def _places(frame: Frame, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """Return where a photo shows points, as shares of its width and height; NaN where its camera does not see them."""
    lens = frame.lens
    native = native_intrinsics(lens)
    if native is None:  # a lens that only undistortion knows: the pinhole is near enough for dots
        camera = Camera(frame.R, frame.eye, lens.fx, lens.fy, lens.cx, lens.cy, lens.H, lens.W)
    else:
        camera = Camera.posed(frame.R, frame.eye, native)
    u, v, _ = camera.project(camera.world_to_cam(points))
    return np.stack([(u + 0.5) / lens.W, (v + 0.5) / lens.H], axis=1)
