"""Compare the poses of a capture with its photos: do they agree, as read or under another convention?

About 40 pairs of photos are matched without poses. Under each reading of the poses (`gsplat_edu.data.conventions`), the
ray of a match should lie on an arc of the other photo: the image of all points along the other ray, from infinity to
the other camera. The error of a match is the mean angle to these arcs, times the focal length. Unlike the distance from
a whole epipolar line, it also sees which way a camera moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import Cloud, Frame, fits_camera, whole_panoramas
from gsplat_edu.data.conventions import READINGS, mistake, readings_for
from gsplat_edu.data.left_out import is_left_out, read_left_out
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.orientation import oriented
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.photos.decoding import upright_size
from gsplat_edu.survey.matching import PANORAMA_SIDE, SIDE, Features, features_of, matches_of, rays_through

SEEDS = 14
"""Photos, evenly spaced by name, that are paired with others: about 40 pairs of at most 56 photos."""

STEPS = (1, 3)
"""Each is paired with the photos that follow by name at these distances: no pose is needed for that."""

NEAR = (2, 10)
"""It is also paired with one of its neighbours by the poses as read, of these ranks the one that turns least."""

FEWEST_PAIRS = 4
"""Fewer matched pairs prove nothing."""

WORKERS = 2
"""Photos examined at the same time."""

AGREES = 8.0
"""Largest median error of poses that agree, px of a photo of 1000 px."""

BETTER = 2.0
"""Another reading is the right one only if its error is smaller by this factor..."""

BEYOND = 0.1
"""...and by this much, px of a photo of 1000 px..."""

IN_PAIRS = 0.8
"""...and in this share of the pairs."""


SAME = 1e-6
"""Relative difference of errors that are equal but for rounding: the readings differ by a turn of the whole world.
The capture's points choose between them."""


class Verdict(Enum):
    """What the photos say about the poses."""

    AGREE = "agree"
    MISREAD = "misread"
    DISAGREE = "disagree"
    UNCHECKED = "unchecked"


@dataclass(frozen=True)
class Proof:
    """The result of the comparison.

    Args:
        verdict: What the photos say.
        error: Median error of the poses as read, px of the photos; NaN if nothing was compared.
        pairs: Matched pairs.
        matches: Matches in all pairs.
        reading: Name of the reading that agrees, if the poses were misread; otherwise "".
        corrected: Its median error, px.
    """

    verdict: Verdict
    error: float
    pairs: int
    matches: int
    reading: str = ""
    corrected: float = float("nan")

    def __str__(self) -> str:
        """One line for the user."""
        error = _px(self.error)
        if self.verdict is Verdict.AGREE:
            return (
                f"The poses agree with the photos: {error} in {self.matches:,} matches of {self.pairs} pairs"
            )
        if self.verdict is Verdict.MISREAD:
            found = f"{_px(self.corrected)} against {error}"
            return f"The poses agree with the photos only if {mistake(self.reading)} ({found})"
        if self.verdict is Verdict.DISAGREE:
            count = f"{error} in {self.matches:,} matches of {self.pairs} pairs"
            return f"The poses do not agree with the photos ({count}): they are from other photos or another lens"
        return "The poses were not checked: too few matches between photos"


def _px(error: float) -> str:
    return f"{error:.2g} px" if error < 10.0 else f"{error:.0f} px"


@dataclass(frozen=True, eq=False)
class _Pair:
    """Matches of two photos, by their places in the list of photos."""

    one: int
    other: int
    a: Float64[np.ndarray, "m 2"]
    b: Float64[np.ndarray, "m 2"]
    rays: dict[tuple[Lens, Lens], tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"]]]

    def rays_of(
        self, lenses: tuple[Lens, Lens]
    ) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"]]:
        """Return the rays through the matches, computed once for all readings that keep the lenses."""
        if lenses not in self.rays:
            self.rays[lenses] = rays_through(lenses[0], self.a), rays_through(lenses[1], self.b)
        return self.rays[lenses]


def prove(reader: CaptureReader, left_out: Sequence[str] | None = None) -> Proof:
    """Compare the poses of a capture with its photos.

    It takes seconds, and gives the same result for any number of threads. Photos that cannot be decoded, or that do not
    fit their camera, are not used.

    Args:
        reader: The capture.
        left_out: Photos that are not used; None uses the capture's own list.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read.
    """
    listed = read_left_out(reader.path) if left_out is None else left_out
    used = [frame for frame in reader.capture.frames if not is_left_out(frame, reader.path, listed)]
    frames = oriented(sorted(used, key=lambda frame: frame.name), reader.headers)
    frames = [frame for frame in frames if _fits(frame, reader)]
    photos = whole_panoramas(frames)
    if len(photos) < 2:
        return Proof(Verdict.UNCHECKED, float("nan"), 0, 0)
    pairs = _matched(photos, _chosen(photos))
    if len(pairs) < FEWEST_PAIRS:
        return Proof(Verdict.UNCHECKED, float("nan"), len(pairs), sum(len(pair.a) for pair in pairs))
    read = {"": photos}
    for name in readings_for(frames):
        try:
            read[name] = whole_panoramas([READINGS[name](frame) for frame in frames])
        except DatasetError:
            continue  # a focal length of zero, or a number out of range: nobody meant that
    errors = {name: _errors(read[name], pairs) for name in read}
    return _judged(read, pairs, errors, reader.capture.cloud)


def _fits(frame: Frame, reader: CaptureReader) -> bool:
    try:
        return fits_camera(frame.lens, upright_size(reader.headers.size(frame.image), frame.orientation))
    except DatasetError:
        return False


def _chosen(photos: Sequence[Frame]) -> list[tuple[int, int]]:
    """Choose pairs by name, which needs no pose, and by the poses as read, which needs no order."""
    eyes, axes = np.stack([frame.eye for frame in photos]), np.stack([frame.R[2] for frame in photos])
    count, pairs = len(photos), dict[tuple[int, int], None]()
    for seed in np.unique(np.linspace(0, count - 1, min(SEEDS, count)).astype(np.int64)).tolist():
        others = [(seed + step) % count for step in STEPS]
        near = np.argsort(np.linalg.norm(eyes - eyes[seed], axis=1), kind="stable")
        near = near[near != seed][min(NEAR[0], count - 2) : NEAR[1]]
        others.append(int(near[np.argmax(np.sum(axes[near] * axes[seed], axis=1))]))
        pairs |= dict.fromkeys((min(seed, other), max(seed, other)) for other in others if other != seed)
    return list(pairs)


def _matched(photos: Sequence[Frame], pairs: Sequence[tuple[int, int]]) -> list[_Pair]:
    """Match the pairs; those with too few matches or an undecodable photo are skipped."""
    wanted = sorted({photo for pair in pairs for photo in pair})

    def detected(photo: int) -> Features | None:
        try:
            return features_of(photos[photo])
        except DatasetError:
            return None

    def matched(pair: tuple[int, int]) -> _Pair | None:
        one, other = (features[photo] for photo in pair)
        if one is None or other is None:
            return None
        found = matches_of(one, other, (photos[pair[0]].lens, photos[pair[1]].lens))
        return None if found is None else _Pair(*pair, *found, {})

    with ThreadPoolExecutor(WORKERS) as pool:
        features = dict(zip(wanted, pool.map(detected, wanted), strict=True))
        return [pair for pair in pool.map(matched, pairs) if pair is not None]


def _errors(photos: Sequence[Frame], pairs: Sequence[_Pair]) -> list[Float64[np.ndarray, "..."]]:
    """Return the error of each match of each pair, px of the photos as their lenses give them."""
    far, rays, centres, focal = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), list[float]()
    for pair in pairs:
        one, other = photos[pair.one], photos[pair.other]
        turn = other.R @ one.R.T
        a, b = pair.rays_of((one.lens, other.lens))
        far += [a @ turn.T, b @ turn]
        rays += [b, a]
        centres += [other.R @ (one.eye - other.eye), one.R @ (other.eye - one.eye)]
        focal.append((max(one.lens.fx, one.lens.fy) + max(other.lens.fx, other.lens.fy)) / 2.0)
    counts = [len(part) for part in rays]
    angles = _to_arcs(np.concatenate(far), np.concatenate(rays), np.repeat(np.stack(centres), counts, axis=0))
    parts = np.split(angles, np.cumsum(counts)[:-1])
    both = [there + back for there, back in zip(parts[::2], parts[1::2], strict=True)]
    return [px * np.where(np.isfinite(sums), sums, np.pi) / 2.0 for sums, px in zip(both, focal, strict=True)]


def _to_arcs(
    far: Float64[np.ndarray, "m 3"], rays: Float64[np.ndarray, "m 3"], centres: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, " m"]:
    """Return the angle between rays and arcs from `far` to the other camera's centre, radians.

    Args:
        far: Directions of the other rays' points at infinity, in this camera's axes.
        rays: This camera's rays.
        centres: (m, 3) the other camera's centre, in this camera's axes; any length.
    """
    ends: Float64[np.ndarray, " m"] = np.minimum(_angles(far, rays), np.pi)
    lengths = np.linalg.norm(centres, axis=1, keepdims=True)
    apart = lengths[:, 0] >= 1e-12
    e = centres / np.maximum(lengths, 1e-12)
    ends = np.where(apart, np.minimum(ends, _angles(e, rays)), ends)
    normals = np.cross(far, e)
    sizes = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(sizes, 1e-12)[:, None]
    height = np.sum(normals * rays, axis=1)
    feet = rays - height[:, None] * normals
    between = (np.sum(np.cross(far, feet) * normals, axis=1) >= 0) & (
        np.sum(np.cross(feet, e) * normals, axis=1) >= 0
    )
    inside = between & apart & (sizes > 1e-9)
    return np.asarray(np.where(inside, np.arcsin(np.clip(np.abs(height), 0.0, 1.0)), ends))


def _angles(a: Float64[np.ndarray, "m 3"], b: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, " m"]:
    across = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.arctan2(across, np.sum(a * b, axis=1)))


def _judged(
    read: dict[str, list[Frame]],
    pairs: Sequence[_Pair],
    errors: dict[str, list[Float64[np.ndarray, "..."]]],
    cloud: Cloud | None,
) -> Proof:
    photos = read[""]
    medians = {name: float(np.median(np.concatenate(of_pairs))) for name, of_pairs in errors.items()}
    by_pair = {name: np.array([np.median(e) for e in of_pairs]) for name, of_pairs in errors.items()}
    used = {photo for pair in pairs for photo in (pair.one, pair.other)}
    unit = float(np.median([_coarseness(photos[photo]) for photo in sorted(used)]))
    given, matches = medians[""], sum(len(pair.a) for pair in pairs)
    best = min((name for name in medians if name), key=lambda name: medians[name], default="")
    if best and cloud is not None:
        equal = [name for name in medians if name and medians[name] <= medians[best] * (1.0 + SAME)]
        points = cKDTree(cloud.points[np.isfinite(cloud.points).all(axis=1)])
        best = min(equal, key=lambda name: _beside(read[name], pairs, points)) if points.n else best
    improved = float(np.mean(by_pair[best] < by_pair[""]))
    if (
        best
        and medians[best] <= AGREES * unit
        and given >= BETTER * medians[best]
        and given - medians[best] >= BEYOND * unit
        and improved >= IN_PAIRS
    ):
        return Proof(Verdict.MISREAD, given, len(pairs), matches, best, medians[best])
    verdict = Verdict.AGREE if given <= AGREES * unit else Verdict.DISAGREE
    return Proof(verdict, given, len(pairs), matches)


def _beside(photos: Sequence[Frame], pairs: Sequence[_Pair], points: cKDTree) -> float:
    """Return how far the matches, triangulated, are from the capture's points: a median, world units."""
    found = []
    for pair in pairs:
        one, other = photos[pair.one], photos[pair.other]
        a, b = (
            rays @ photo.R
            for rays, photo in zip(pair.rays_of((one.lens, other.lens)), (one, other), strict=True)
        )
        between, across = other.eye - one.eye, np.sum(a * b, axis=1)
        parallel = np.maximum(1.0 - across**2, 1e-12)
        along = (a @ between - across * (b @ between)) / parallel
        found.append(points.query(one.eye + along[:, None] * a)[0])
    return float(np.median(np.concatenate(found)))


def _coarseness(frame: Frame) -> float:
    """Return how many pixels of the photo are one of the size at which features are detected."""
    side = PANORAMA_SIDE if frame.lens.model == "equirectangular" else SIDE
    return max(1.0, max(frame.lens.W, frame.lens.H) / side)
