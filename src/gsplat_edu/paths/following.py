"""Camera paths that stay near a capture's cameras.

There are three kinds, depending on the cameras: an orbit or arc around a common centre of attention; a small loop
between cameras with one viewing direction; a flight along cameras that face outwards or wander.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.base.validation import in_range, whole_number
from gsplat_edu.paths.orbits import common_up
from gsplat_edu.scene.camera import Camera, as_camera, look_at
from gsplat_edu.scene.rig import point_nearest_axes

Vector = Float64[np.ndarray, "3"]
Values = Float64[np.ndarray, " n"]

SAMPLED, DRAWS = 5, 40
"""Number of cameras in a random sample, and number of samples, for finding the centre. With one camera in five wrong, a
sample contains none of them with probability 0.8^5 = 0.33; all 40 samples contain one with probability 1e-7."""

MOST = 0.7
"""At least this fraction of the cameras must have the centre in view."""

PAST, PAST_FACTOR = math.radians(20.0), 3.0
"""A camera misses the centre if its axis is off by more than this angle and by more than this multiple of the median
angle."""

FAR = math.log(3.0)
"""A camera is an outlier if the logarithm of its distance differs from the median by more than this and by more than
`PAST_FACTOR` times the median deviation."""

GAP, SPARSE_GAP, SPARSE = math.radians(40.0), math.radians(75.0), 2.0
"""Largest range of azimuths without a camera that a path crosses: 40 degrees, or up to 75 if twice the median gap is
that large. So a ring of five or more evenly spaced photos counts as closed."""

STEEP = math.radians(65.0)
"""Median elevation above which azimuths are meaningless: the cameras look down."""

ONE_WAY = math.radians(20.0)
"""Cameras share one viewing direction if the median angle to the mean direction is below this."""

BANDWIDTH = math.radians(15.0)
"""Standard deviation of the kernel that averages neighbouring cameras; on narrow arcs, a sixth of the arc."""

INSIDE = 0.95
"""A path along an arc turns back at this fraction of the covered angle."""

RISE = 0.85
"""Amplitude of the rise and fall of a path that turns back, in local standard deviations of the elevation. Between two
rows of cameras it covers 0.85 of the distance to them."""

LOOP_HALF_AXIS = 1.2
"""Half axis of a loop, in standard deviations of the camera centres along it. For centres spread evenly on a line, the
loop covers 0.7 of the line."""

LEAST_LOOP = 0.03
"""Smallest half axis of a loop, in scene depths: even a single camera position gets some parallax."""

MOST_TURN = math.tan(math.radians(12.0))
"""Largest angle by which the view turns towards the centre on a loop between parallel cameras, as a tangent."""

CHAIN = 400
"""Most cameras of a flight; of a longer list, every n-th is used."""

JUMP = 1.0
"""A flight never connects two cameras if distance / depth + angle (radians) between them exceeds this."""


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Cameras to render in sequence.

    Args:
        cameras: One per frame, at equal time intervals. The path is closed: the first follows the last.
        description: The kind of path and the reason for it, without a full stop.
    """

    cameras: list[Camera]
    description: str


def path_along(cameras: Sequence[Camera], frames: int, depth: float = 1.0) -> CameraPath:
    """Make a smooth closed path near a capture's cameras.

    Args:
        cameras: At least one.
        frames: Number of cameras of the path, at least one.
        depth: Distance from the cameras to the scene, world units; used if the optical axes do not meet.

    Returns:
        The path. Its cameras have the intrinsics and size of the first camera that is not an outlier.

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
    """Find the point that most cameras look at, ignoring outliers.

    Args:
        cameras: At least one.

    Returns:
        (3,) world units; None if the axes are parallel or meet behind the cameras, or if fewer than 70 % of the cameras
        have the point in view.
    """
    centre = point_nearest_most_axes(cameras)
    if centre is None or np.mean([_shows(camera, centre) for camera in cameras]) < MOST:
        return None
    return centre


def point_nearest_most_axes(cameras: Sequence[Camera]) -> Vector | None:
    """Find the point nearest to the optical axes of most cameras.

    Each candidate is the point nearest to the axes of a random sample of the cameras (with a fixed seed): a single
    reversed camera would shift the result for all of them. The candidate with the smallest median angle to all axes
    wins and is refined without the cameras that miss it.

    Args:
        cameras: At least one.

    Returns:
        (3,) world units, possibly behind the cameras; None if the axes are parallel.
    """
    eyes, axes = (np.stack(rows) for rows in zip(*((c.eye, c.R[2]) for c in cameras), strict=True))
    rng, count = np.random.default_rng(0), len(cameras)
    samples = [
        np.arange(count),
        *(rng.choice(count, min(SAMPLED, count), replace=False) for _ in range(DRAWS)),
    ]
    found = [point_nearest_axes([cameras[int(i)] for i in rows]) for rows in samples]
    points = [point for point in found if point is not None]
    if not points:
        return None
    angles = min((_angles(point - eyes, axes) for point in points), key=lambda each: float(np.median(each)))
    kept = np.flatnonzero(angles <= max(PAST, PAST_FACTOR * float(np.median(angles))))
    return point_nearest_axes([cameras[int(i)] for i in kept])


def _shows(camera: Camera, point: Vector) -> bool:
    u, v, z = camera.project(camera.world_to_cam(point))
    # Rounding can put the centre of a panorama's cameras in front of some of them.
    in_front = z > 1e-6 * max(1.0, float(np.abs(camera.eye).max()))
    return bool(in_front and -0.5 < u < camera.W - 0.5 and -0.5 < v < camera.H - 0.5)


def _near_usual(cameras: Sequence[Camera], centre: Vector) -> list[Camera]:
    """Drop cameras that miss the centre or whose distance to it is unusual."""
    eyes, axes = (np.stack(rows) for rows in zip(*((c.eye, c.R[2]) for c in cameras), strict=True))
    angles = _angles(centre - eyes, axes)
    logs = np.log(np.maximum(np.linalg.norm(eyes - centre, axis=1), 1e-300))
    apart = np.abs(logs - np.median(logs))
    usual = angles <= max(PAST, PAST_FACTOR * float(np.median(angles)))
    usual &= apart <= max(FAR, PAST_FACTOR * float(np.median(apart)))
    return [camera for camera, fits in zip(cameras, usual, strict=True) if fits]


def _around(cameras: Sequence[Camera], centre: Vector, up: Vector, turns: Values) -> CameraPath:
    """Orbit the centre, or swing over the covered azimuths, at the local mean elevation and distance.

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
            path.cameras, "the cameras are too far apart for a path: using a small loop at one place"
        )
    # At least most of a gap wide; otherwise the average jumps from one camera to the next inside the gap.
    width = max(min(BANDWIDTH, covered / 6), 0.6 * crossed, 1e-6)
    data = azimuths[rows], elevations[rows], np.log(distances[rows])
    if covered >= 2.0 * np.pi:
        az, el, logs = turns, *_local_means(data, turns, None, width)[:2]
        description = "the cameras surround the scene: using a full circle"
    else:
        az = (low + high) / 2 + INSIDE * covered / 2 * np.sin(turns)
        middle, _, spread = _local_means(data, az, None, width)
        el = middle + RISE * spread * np.cos(turns)
        logs = _local_means(data, az, el, width)[1]
        description = f"the cameras cover {math.degrees(covered):.0f} degrees: the path stays within them"
    ring = np.cos(az)[:, None] * start + np.sin(az)[:, None] * side
    eyes = centre + np.exp(logs)[:, None] * (np.cos(el)[:, None] * ring + np.sin(el)[:, None] * up)
    return CameraPath([_like(cameras[0], look_at(eye, centre, up), eye) for eye in eyes], description)


def _covered(azimuths: Values) -> tuple[float, float, Int64[np.ndarray, " m"], float]:
    """Find the longest range of azimuths covered by cameras.

    Returns:
        Its ends, 2 pi apart for a full circle; the cameras inside; the largest gap inside.
    """
    order = np.argsort(azimuths, kind="stable")
    turned = azimuths[order]
    gaps = np.diff(np.r_[turned, turned[0] + 2.0 * np.pi])
    limit = max(GAP, min(SPARSE_GAP, SPARSE * float(np.median(gaps))))
    breaks = np.flatnonzero(gaps > limit)
    if not len(breaks):
        return 0.0, 2.0 * np.pi, order, float(gaps.max())
    # Of the ranges between breaks, take the one with the most cameras.
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
    """Average cameras near given directions with a Gaussian kernel.

    Args:
        data: Azimuth, elevation and logarithm of the distance of each camera.
        az: Azimuths.
        el: Elevations; None weights all elevations equally.
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
    """Move on an ellipse perpendicular to the common viewing direction, within the spread of the cameras.

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
        halves.append(max(min(LOOP_HALF_AXIS * float(column.std()), reach), LEAST_LOOP * depth))
    focus = middle + max(depth, halves[0] / MOST_TURN) * forward if target is None else target
    path = (
        middle
        + np.outer(np.sin(turns) * halves[0], main[:, 0])
        + np.outer(np.cos(turns) * halves[1], main[:, 1])
    )
    up = -np.sum([camera.R[1] for camera in cameras], axis=0)
    if np.linalg.norm(np.cross(up, forward)) < 0.2 * len(cameras):  # back and forth: up axes cancel
        up = -first.R[1]
    description = "the cameras share one viewing direction: using a loop between them"
    return CameraPath([_like(first, look_at(eye, focus, up), eye) for eye in path], description)


def _flight(cameras: Sequence[Camera], turns: Values, depth: float) -> CameraPath:
    """Fly along a chain of cameras, each close to its predecessor in position and direction, averaging both."""
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
    how = "in a closed loop" if closed else "there and back"
    return CameraPath(path, f"the cameras share no point of interest: the path follows them, {how}")


def _chain(apart: Float64[np.ndarray, "n n"]) -> Int64[np.ndarray, " m"]:
    """Order cameras so that neighbours are close: in the given order or by nearest neighbour, whichever is shorter.

    Only the longest stretch without a jump is returned.
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
    return Camera.posed(R, eye, as_camera("camera", camera).intrinsics)


def _units(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300))


def _angles(towards: Float64[np.ndarray, "n 3"], axes: Float64[np.ndarray, "n 3"]) -> Values:
    return np.asarray(np.arccos(np.clip(np.sum(_units(towards) * axes, axis=1), -1.0, 1.0)))
