"""A camera path that shows a capture from where it was photographed.

Three kinds, by how the cameras stand: around what they look at, all round or as far as they go; a small loop between
cameras that look one way; a flight along cameras that look outwards or wander.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.camera import Camera, look_at, point_nearest_axes
from gsplat_edu.evaluate.paths import PARALLEL, common_up
from gsplat_edu.validation import in_range, whole_number

Vector = Float64[np.ndarray, "3"]
Values = Float64[np.ndarray, " n"]

SAMPLED, DRAWS = 5, 40
"""Cameras of a random sample, and samples, from which the centre is found: with one camera in five wrong, a sample is
free of them with probability 0.8^5 = 0.33, and 40 samples all have one with probability 1e-7."""

MOST = 0.7
"""Fraction of the cameras that has to see the centre, in front of it."""

PAST, PAST_FACTOR = math.radians(20.0), 3.0
"""A camera looks past the centre if it is off by more than this angle, and by more than this many times the median."""

FAR = math.log(3.0)
"""Cameras nearer or farther than the median by this logarithm, and by `PAST_FACTOR` times the median deviation, are
outliers."""

GAP, SPARSE_GAP, SPARSE = math.radians(40.0), math.radians(75.0), 2.0
"""Azimuths without a camera that a path crosses: 40 degrees, and up to 75 where twice the median gap is as much. Rings
of five or more evenly spaced photos are closed."""

STEEP = math.radians(65.0)
"""Median elevation above which azimuths say nothing: the cameras look down on something."""

ONE_WAY = math.radians(20.0)
"""Largest median angle to the mean viewing direction of cameras that look one way."""

BANDWIDTH = math.radians(15.0)
"""Standard deviation of the kernel that averages cameras of similar azimuth and elevation; a sixth of narrow arcs."""

INSIDE = 0.95
"""A path that turns round does so at this fraction of the covered angle."""

RISE = 0.85
"""A path that turns round rises and sinks by this many local standard deviations of the elevation: between two rows, by
0.85 of the way to them."""

SPREAD = 1.2
"""Half axes of a loop between cameras, in standard deviations: 0.7 of the way to the ends of a uniform line."""

LEAST_LOOP = 0.03
"""Least half axis of a loop, in depths of the scene: one camera, or several in one place, still show some parallax."""

MOST_TURN = math.tan(math.radians(12.0))
"""A loop between parallel cameras turns its view towards its centre by 12 degrees at most."""

CHAIN = 400
"""Cameras of a flight; of more, every n-th."""

JUMP = 1.0
"""A flight does not cross from one camera to the next if distance / depth + angle (radians) is larger."""


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Cameras to render one after the other.

    Args:
        cameras: One per frame, evenly in time. The path is closed: the last one is followed by the first.
        says: What kind of path it is and why, without a full stop.
    """

    cameras: list[Camera]
    says: str


def path_along(cameras: Sequence[Camera], frames: int, depth: float = 1.0) -> CameraPath:
    """Make a smooth closed path among a capture's cameras.

    Args:
        cameras: Any number; at least one.
        frames: Cameras of the path, at least one.
        depth: Distance of the scene from the cameras, world units; used where their optical axes meet nowhere.

    Returns:
        The path. Its cameras have the intrinsics and size of the first camera that is no outlier.

    Raises:
        ArgumentError: there is no camera, frames is not a whole number of at least 1, or depth is not positive.
    """
    frames = whole_number("frames", frames, 1)
    whole_number("number of cameras", len(cameras), 1)
    depth = in_range("depth", depth, 0.0, open_low=True)
    centre = point_looked_at(cameras)
    turns = 2.0 * np.pi * np.arange(frames) / frames
    if centre is not None:
        kept = _near_usual(cameras, centre)
        up = common_up(kept)
        offsets = np.stack([camera.eye for camera in kept]) - centre
        elevations = np.arcsin(np.clip(_units(offsets) @ up, -1.0, 1.0))
        if abs(float(np.median(elevations))) > STEEP:
            return _loop_between(kept, turns, float(np.median(np.linalg.norm(offsets, axis=1))), centre)
        return _around(kept, centre, up, turns)
    axes = np.stack([camera.R[2] for camera in cameras])
    mean = _units(np.median(axes, axis=0)[None] + 1e-12 * axes[0])[0]
    if np.median(np.arccos(np.clip(axes @ mean, -1.0, 1.0))) < ONE_WAY:
        return _loop_between(cameras, turns, depth, None)
    return _flight(cameras, turns, depth)


def point_looked_at(cameras: Sequence[Camera]) -> Vector | None:
    """Find the point that most cameras look at, whatever a minority of them does.

    Args:
        cameras: At least one.

    Returns:
        (3,) world units; None where the axes are parallel or meet behind the cameras, or where fewer than 70 % of the
        cameras have the point in their picture.
    """
    centre = point_nearest_most_axes(cameras, PARALLEL)
    if centre is None or np.mean([_shows(camera, centre) for camera in cameras]) < MOST:
        return None
    return centre


def point_nearest_most_axes(cameras: Sequence[Camera], parallel: float) -> Vector | None:
    """Find the point nearest to the optical axes of most cameras.

    It is sought in random samples of the cameras, always the same ones: one camera turned round would draw the mean
    along. The point with the smallest median angle to all axes is refined with the cameras that do not look past it.

    Args:
        cameras: At least one.
        parallel: As for `gsplat_edu.camera.point_nearest_axes`.

    Returns:
        (3,) world units, perhaps behind the cameras; None where the axes are parallel.
    """
    eyes, axes = (np.stack(rows) for rows in zip(*((c.eye, c.R[2]) for c in cameras), strict=True))
    rng, count = np.random.default_rng(0), len(cameras)
    samples = [
        np.arange(count),
        *(rng.choice(count, min(SAMPLED, count), replace=False) for _ in range(DRAWS)),
    ]
    found = [point_nearest_axes([cameras[int(i)] for i in rows], parallel) for rows in samples]
    points = [point for point in found if point is not None]
    if not points:
        return None
    angles = min((_angles(point - eyes, axes) for point in points), key=lambda each: float(np.median(each)))
    kept = np.flatnonzero(angles <= max(PAST, PAST_FACTOR * float(np.median(angles))))
    return point_nearest_axes([cameras[int(i)] for i in kept], parallel)


def _shows(camera: Camera, point: Vector) -> bool:
    u, v, z = camera.project(camera.world_to_cam(point))
    # rounding puts the centre of a panorama's cameras in front of some of them
    in_front = z > 1e-6 * max(1.0, float(np.abs(camera.eye).max()))
    return bool(in_front and -0.5 < u < camera.W - 0.5 and -0.5 < v < camera.H - 0.5)


def _near_usual(cameras: Sequence[Camera], centre: Vector) -> list[Camera]:
    """Leave out cameras that look past the centre, or stand at quite another distance than most."""
    eyes, axes = (np.stack(rows) for rows in zip(*((c.eye, c.R[2]) for c in cameras), strict=True))
    angles = _angles(centre - eyes, axes)
    logs = np.log(np.maximum(np.linalg.norm(eyes - centre, axis=1), 1e-300))
    apart = np.abs(logs - np.median(logs))
    usual = angles <= max(PAST, PAST_FACTOR * float(np.median(angles)))
    usual &= apart <= max(FAR, PAST_FACTOR * float(np.median(apart)))
    return [camera for camera, fits in zip(cameras, usual, strict=True) if fits]


def _around(cameras: Sequence[Camera], centre: Vector, up: Vector, turns: Values) -> CameraPath:
    """Circle the centre, or swing over the covered azimuths, at the local mean elevation and distance.

    e = c + r (cos(el) (cos(az) a + sin(az) (up × a)) + sin(el) up),  a: the direction of azimuth 0
    """
    offsets = np.stack([camera.eye for camera in cameras]) - centre
    start = _units((offsets[0] - (offsets[0] @ up) * up)[None] + 1e-12 * cameras[0].R[0])[0]
    side = np.cross(up, start)
    azimuths = np.arctan2(offsets @ side, offsets @ start)
    distances = np.linalg.norm(offsets, axis=1)
    elevations = np.arcsin(np.clip(offsets @ up / distances, -1.0, 1.0))
    low, high, rows, crossed = _covered(azimuths)
    covered = high - low
    if covered < LEAST_LOOP and np.ptp(elevations[rows]) < LEAST_LOOP:
        near = [cameras[i] for i in rows]
        path = _loop_between(near, turns, float(np.median(distances[rows])), centre)
        return CameraPath(
            path.cameras, "the cameras stand too far apart for a path: a small loop at one place"
        )
    # not narrower than most of a gap, or the average jumps from one camera to the next in the middle of it
    width = max(min(BANDWIDTH, covered / 6), 0.6 * crossed, 1e-6)
    data = azimuths[rows], elevations[rows], np.log(distances[rows])
    if covered >= 2.0 * np.pi:
        az, el, logs = turns, *_local_means(data, turns, None, width)[:2]
        says = "the cameras stand all round: a full circle"
    else:
        az = (low + high) / 2 + INSIDE * covered / 2 * np.sin(turns)
        middle, _, spread = _local_means(data, az, None, width)
        el = middle + RISE * spread * np.cos(turns)
        logs = _local_means(data, az, el, width)[1]
        says = (
            f"the cameras cover {math.degrees(covered):.0f} degrees: the path swings over those, no farther"
        )
    ring = np.cos(az)[:, None] * start + np.sin(az)[:, None] * side
    eyes = centre + np.exp(logs)[:, None] * (np.cos(el)[:, None] * ring + np.sin(el)[:, None] * up)
    return CameraPath([_like(cameras[0], look_at(eye, centre, up), eye) for eye in eyes], says)


def _covered(azimuths: Values) -> tuple[float, float, Int64[np.ndarray, " m"], float]:
    """Find the longest stretch of azimuths that cameras cover.

    Returns:
        Its ends, 2 pi apart where it is the full circle; the cameras in it; the largest gap in it.
    """
    order = np.argsort(azimuths, kind="stable")
    turned = azimuths[order]
    gaps = np.diff(np.r_[turned, turned[0] + 2.0 * np.pi])
    limit = max(GAP, min(SPARSE_GAP, SPARSE * float(np.median(gaps))))
    breaks = np.flatnonzero(gaps > limit)
    if not len(breaks):
        return 0.0, 2.0 * np.pi, order, float(gaps.max())
    # the stretches between breaks; the one with the most cameras, as most photos are of that side
    pieces = [
        np.arange(first + 1, last + 1)
        for first, last in zip(breaks, [*breaks[1:], breaks[0] + len(gaps)], strict=True)
    ]
    piece = max(pieces, key=len)
    inner = gaps[piece[:-1] % len(gaps)]
    low = float(turned[piece[0] % len(gaps)])
    return low, low + float(inner.sum()), order[piece % len(gaps)], float(inner.max(initial=0.0))


def _local_means(
    data: tuple[Values, Values, Values],
    az: Float64[np.ndarray, " F"],
    el: Float64[np.ndarray, " F"] | None,
    width: float,
) -> tuple[Float64[np.ndarray, " F"], Float64[np.ndarray, " F"], Float64[np.ndarray, " F"]]:
    """Average cameras around directions by a Gaussian kernel.

    Args:
        data: Azimuth, elevation and logarithm of the distance of each camera.
        az: Azimuths.
        el: Elevations; all elevations count the same where None.
        width: Standard deviation of the kernel, radians.

    Returns:
        Mean elevation, mean logarithm of the distance, standard deviation of the elevation.
    """
    azimuths, elevations, logs = data
    away = np.angle(np.exp(1j * (az[:, None] - azimuths)))
    exponents = -0.5 * (away / width) ** 2
    if el is not None:
        exponents -= 0.5 * ((el[:, None] - elevations) / width) ** 2
    weights = np.exp(exponents - exponents.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    middle = weights @ elevations
    variance = np.maximum(weights @ elevations**2 - middle**2, 0.0)
    return middle, weights @ logs, np.sqrt(variance)


def _loop_between(
    cameras: Sequence[Camera], turns: Values, depth: float, target: Vector | None
) -> CameraPath:
    """Move on an ellipse across the viewing direction of cameras that look one way, within where they stand.

    e = m + h1 cos(t) p1 + h2 sin(t) p2,  m: median of the centres,  p: principal axes of the centres across the view
    """
    first = cameras[0]
    eyes = np.stack([camera.eye for camera in cameras])
    forward = _units(np.sum([camera.R[2] for camera in cameras], axis=0)[None] + 1e-12 * first.R[2])[0]
    middle = np.median(eyes, axis=0)
    across = (eyes - middle) - ((eyes - middle) @ forward)[:, None] * forward
    basis = np.stack([first.R[0] - (first.R[0] @ forward) * forward, np.cross(forward, first.R[0])])
    flat = across @ _units(basis).T
    _, vectors = np.linalg.eigh(flat.T @ flat / len(flat))
    halves, main = [], _units(basis).T @ vectors[:, ::-1]
    for column in (flat @ vectors[:, ::-1]).T:
        reach = float(np.quantile(np.abs(column), 0.85))
        halves.append(max(min(SPREAD * float(column.std()), reach), LEAST_LOOP * depth))
    focus = middle + max(depth, halves[0] / MOST_TURN) * forward if target is None else target
    path = (
        middle
        + np.outer(np.sin(turns) * halves[0], main[:, 0])
        + np.outer(np.cos(turns) * halves[1], main[:, 1])
    )
    up = -np.sum([camera.R[1] for camera in cameras], axis=0)
    if np.linalg.norm(np.cross(up, forward)) < 0.2 * len(cameras):  # strips flown to and fro
        up = -first.R[1]
    says = "the cameras look one way: a loop between them"
    return CameraPath([_like(first, look_at(eye, focus, up), eye) for eye in path], says)


def _flight(cameras: Sequence[Camera], turns: Values, depth: float) -> CameraPath:
    """Follow a chain of cameras, each near the one before in place and direction; position and axes are averaged."""
    chosen = [cameras[i] for i in range(0, len(cameras), -(-len(cameras) // CHAIN))]
    eyes, axes = (np.stack(rows) for rows in zip(*((c.eye, c.R[2]) for c in chosen), strict=True))
    apart = np.linalg.norm(eyes[:, None] - eyes, axis=2) / depth + np.arccos(
        np.clip(axes @ axes.T, -1.0, 1.0)
    )
    chain = _chain(apart)
    steps = apart[chain[:-1], chain[1:]]
    back = float(apart[chain[-1], chain[0]])
    closed = len(chain) > 2 and back <= max(JUMP / 2, 2.0 * float(steps.max()))
    places = np.r_[0.0, np.cumsum(steps)]
    length = float(places[-1]) + (back if closed else 0.0)
    width = max(
        length / 40, float(np.median(steps)) if len(steps) else 0.0, 0.6 * float(steps.max(initial=0.0)), 1e-9
    )
    at = length * turns / (2.0 * np.pi) if closed else length * (1.0 - np.cos(turns)) / 2
    away = np.abs(at[:, None] - places)
    away = np.minimum(away, length - away) if closed else away
    weights = np.exp(-0.5 * (away / width) ** 2 + 0.5 * (away.min(axis=1, keepdims=True) / width) ** 2)
    weights /= weights.sum(axis=1, keepdims=True)
    downs = np.stack([chosen[i].R[1] for i in chain])
    path = [
        _like(chosen[chain[0]], look_at(eye, eye + forward, -down), eye)
        for eye, forward, down in zip(
            weights @ eyes[chain], depth * _units(weights @ axes[chain]), weights @ downs, strict=True
        )
    ]
    how = "round and round" if closed else "to their end and back"
    return CameraPath(path, f"the cameras look at no common point: the path follows them, {how}")


def _chain(apart: Float64[np.ndarray, "n n"]) -> Int64[np.ndarray, " m"]:
    """Order cameras so that neighbours are close: as they are listed, or from each to the nearest one left.

    Of the shorter order, the longest stretch without a jump is returned.
    """
    count = len(apart)
    listed = np.arange(count)
    left, nearest = np.ones(count, dtype=bool), [int(np.argmax(apart[0]))]
    left[nearest[0]] = False
    while left.any():
        nearest.append(int(np.argmin(np.where(left, apart[nearest[-1]], np.inf))))
        left[nearest[-1]] = False
    orders = (listed, np.array(nearest))
    pieces = [
        piece
        for order in orders
        for piece in np.split(order, np.flatnonzero(apart[order[:-1], order[1:]] > JUMP) + 1)
    ]
    longest = max(len(piece) for piece in pieces)
    return min(
        (piece for piece in pieces if len(piece) >= 0.9 * longest),
        key=lambda piece: float(apart[piece[:-1], piece[1:]].sum()),
    )


def _like(camera: Camera, R: Float64[np.ndarray, "3 3"], eye: Vector) -> Camera:
    return Camera(R, eye, camera.fx, camera.fy, camera.cx, camera.cy, camera.H, camera.W)


def _units(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300))


def _angles(towards: Float64[np.ndarray, "n 3"], axes: Float64[np.ndarray, "n 3"]) -> Values:
    return np.asarray(np.arccos(np.clip(np.sum(_units(towards) * axes, axis=1), -1.0, 1.0)))
