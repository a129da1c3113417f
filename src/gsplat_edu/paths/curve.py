"""Smooth camera motion through keyframes: the curve between them, and the speed along it.

The curve is a centripetal Catmull-Rom spline. Between keyframes 1 and 2 it blends two parabolas, one through keyframes
0, 1, 2 and one through 1, 2, 3. Each parabola is a pyramid of linear interpolations (Aitken and Neville), and for
rotations every linear interpolation becomes a slerp of unit quaternions. The curve passes through all keyframes with a
continuous velocity, for any spacing of the knots: at keyframe 1, the blend and its derivative are those of the parabola
through 0, 1, 2, on both sides. (The angular velocity of squad is continuous only if the knots are evenly spaced.)

The camera moves at constant speed along the curve, or meets the keyframes at their times. Speed combines translation,
rotation and zoom; see `Travel`. The times change only the speed along the curve, which is never negative. A camera that
rests at a keyframe for its `hold` is at the same distance at two times. A path with an `ease` has zero speed at both
ends, or at every keyframe; without times, it meets the keyframes when a camera of constant speed would.

`viewer/web/path.js` contains the same formulas.

Source: Catmull and Rom 1974; Barry and Goldman 1988 (the pyramid); Yuksel, Schaefer and Keyser 2011 (centripetal
knots); Fritsch and Butland 1984 (monotone cubics).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from gsplat_edu.base.validation import ArrayLike, float64_array, whole_number
from gsplat_edu.paths.keyframes import ENDS, VIEWS, KeyframePath
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussian_math import quat_to_R_batch

STEPS = 64
"""Chords per segment whose sum approximates its length."""

SAME = 1e-9
"""Consecutive keyframes count as one place on the curve if their distance is below this fraction of the length."""

FULL_TURN = 2.0 * math.pi

EYE, QUAT, ZOOM = slice(0, 3), slice(3, 7), slice(7, 8)
"""Columns of a state: centre, quaternion (w, x, y, z) of the rotation from camera to world, ln tan(fov / 2)."""

States = Float64[np.ndarray, "n 8"]
Values = Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Travel:
    """The distance between two cameras.

    d² = |Δ eye|² + radius² (angle² + (Δ zoom)²),  zoom = ln tan(fov / 2)

    On a path of length L that turns by the angle A in total, the radius is L / max(A, 2 pi). So on a full circle around
    a subject, turning counts as much as moving; on a straight flight, a slight turn counts little; a path that only
    turns moves at constant angular speed.

    Args:
        radius: World units per radian.
    """

    radius: float

    @classmethod
    def along(cls, states: States) -> Travel:
        """Choose the radius for a sequence of cameras."""
        moved, turned = _differences(states)
        length = float(moved.sum())
        return cls(length / max(float(turned.sum()), FULL_TURN) if length > 0.0 else 1.0)

    def between(self, states: States) -> Float64[np.ndarray, " m"]:
        """Return the distances of consecutive cameras."""
        moved, turned = _differences(states)
        distances: Float64[np.ndarray, " m"] = np.hypot(moved, self.radius * turned)
        return distances


class PathCurve:
    """The motion along a path.

    Args:
        path: The keyframes.

    Attributes:
        seconds: Its length in time.
        loop: Whether it ends where it begins.
        travel: The measure of distance whose rate is constant without times.
        length: Its length by that measure, world units.
    """

    def __init__(self, path: KeyframePath) -> None:
        self.seconds, self.loop, self._ease = path.seconds, path.loop, path.ease
        states = _states(path)
        self.travel = Travel.along(states)
        steps = self.travel.between(states)
        apart = steps > SAME * steps.sum()
        # Keyframes at one place share a node. The last row of a loop is the first keyframe again.
        self._nodes = states[np.r_[True, apart]]
        node_of = np.r_[0, np.cumsum(apart)]
        self._knots = np.r_[0.0, np.cumsum(np.sqrt(steps[apart]))]
        self._measure()
        self._times, self._places = np.zeros(0), np.zeros(0)
        if path.timed:
            times = [k.time for k in path.keyframes if k.time is not None]
            times += [times[0] + path.seconds] if path.loop else []
            self._times = np.array(times) - times[0]
            self._places = self._lengths[STEPS * node_of]
            self._hold([k.hold for k in path.keyframes])
        elif path.ease is not None and self.length > 0.0:
            self._places = self._lengths[::STEPS]
            self._times = self.seconds * (self._places / self.length)

    def cameras(self, frames: int, W: int, H: int) -> list[Camera]:
        """Return the cameras of a video.

        Args:
            frames: Their number, at equal intervals of time. The last is at the path's end; in a loop, one interval
                before.
            W: Width of the images, px.
            H: Height of the images, px.

        Raises:
            ArgumentError: frames is not a whole number of at least 1, or a size is not.
        """
        frames = whole_number("frames", frames, 1)
        intervals = frames if self.loop else max(frames - 1, 1)
        eyes, rotations, fovs = self.poses(self.seconds * np.arange(frames) / intervals)
        focals = 0.5 * H / np.tan(np.radians(fovs) / 2)
        middle = (W - 1) / 2, (H - 1) / 2
        return [
            Camera(R, eye, f, f, *middle, H, W)
            for R, eye, f in zip(rotations, eyes, focals.tolist(), strict=True)
        ]

    def poses(
        self, times: ArrayLike
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, " n"]]:
        """Return the cameras at given times.

        Args:
            times: (n,) seconds from the first keyframe; clamped to the path, or repeated in a loop.

        Returns:
            Centres; world-to-camera rotations; vertical fields of view, degrees.
        """
        at = float64_array("times", times, ("n",))
        at = np.mod(at, self.seconds) if self.loop else np.clip(at, 0.0, self.seconds)
        states = self._at(self._parameter(self.place(at)))
        rotations = np.swapaxes(quat_to_R_batch(states[:, QUAT]), 1, 2)
        return states[:, EYE], rotations, np.degrees(2.0 * np.arctan(np.exp(states[:, ZOOM][:, 0])))

    def _hold(self, holds: list[float]) -> None:
        """Add the end of each rest to the times, at the place where it began."""
        held = np.flatnonzero(holds)
        ends = self._times[held] + np.array(holds)[held]
        self._times = np.insert(self._times, held + 1, ends)
        self._places = np.insert(self._places, held + 1, self._places[held])

    def place(self, at: Values) -> Values:
        """Return the distance from the start, measured by `travel`, at times from 0 to `seconds`."""
        if len(self._times):
            return monotone_interpolation(self._times, self._places, at, self.loop, self._ease)
        places: Values = self.length * at / self.seconds
        return places

    def _parameter(self, places: Values) -> Values:
        """Return the spline's parameter at given distances from the start."""
        if len(self._nodes) == 1:
            return np.zeros_like(places)
        parameters: Values = monotone_interpolation(self._lengths, self._parameters, places, self.loop)
        return parameters

    def _measure(self) -> None:
        """Tabulate the length of the curve at `STEPS` parameters per segment."""
        between = np.arange(STEPS) / STEPS
        spans = np.diff(self._knots)
        inner = self._knots[:-1, None] + spans[:, None] * between
        self._parameters = np.r_[inner.ravel(), self._knots[-1]]
        if len(self._nodes) == 1:
            self._lengths, self.length = np.zeros(1), 0.0
            return
        chords = self.travel.between(self._at(self._parameters))
        # where the curve has a cusp, a chord may be zero; the table has to increase
        self._lengths = np.r_[0.0, np.cumsum(np.maximum(chords, 1e-12 * chords.sum()))]
        self.length = float(self._lengths[-1])

    def _at(self, u: Values) -> States:
        """Evaluate the spline at given parameters."""
        segments = len(self._nodes) - 1
        if segments == 0:
            return np.repeat(self._nodes, len(u), axis=0)
        i = np.clip(np.searchsorted(self._knots, u, side="right") - 1, 0, segments - 1)
        before, after = self._parabola(i, u), self._parabola(i + 1, u)
        share = (u - self._knots[i]) / (self._knots[i + 1] - self._knots[i])
        if not self.loop:
            # at an open end, there is only one parabola; on a path of one segment, only a line
            if segments == 1:
                return _mixed(self._nodes[i], self._nodes[i + 1], share)
            share = np.where(i == 0, 1.0, np.where(i == segments - 1, 0.0, share))
        return _mixed(before, after, share)

    def _parabola(self, i: Int64[np.ndarray, " n"], u: Values) -> States:
        """Evaluate the parabolas through nodes i - 1, i and i + 1.

        At the ends of an open path, where a node is missing, the result is finite and is not used.
        """
        (k0, p0), (k1, p1), (k2, p2) = (self._node(i + step) for step in (-1, 0, 1))

        def share(low: Values, high: Values) -> Values:
            shares: Values = (u - low) / np.where(high > low, high - low, 1.0)
            return shares

        first, second = _mixed(p0, p1, share(k0, k1)), _mixed(p1, p2, share(k1, k2))
        return _mixed(first, second, share(k0, k2))

    def _node(self, index: Int64[np.ndarray, " n"]) -> tuple[Values, States]:
        """Return knots and states; in a loop, indices and knots go on beyond both ends."""
        last = len(self._nodes) - 1
        if not self.loop:
            index = np.clip(index, 0, last)
            return self._knots[index], self._nodes[index]
        turns, rest = np.divmod(index, last)
        states = self._nodes[rest].copy()
        # once around, the quaternions may have changed their sign
        sign = np.sign(self._nodes[0, QUAT] @ self._nodes[-1, QUAT])
        states[:, QUAT] *= np.where(turns % 2 == 0, 1.0, sign)[:, None]
        return self._knots[rest] + turns * self._knots[-1], states


def _states(path: KeyframePath) -> States:
    """Return the keyframes' states; each quaternion has the sign that is nearer to the one before."""
    rows = [*path.keyframes, *(path.keyframes[:1] if path.loop else ())]
    states = np.empty((len(rows), 8))
    states[:, EYE] = [row.eye for row in rows]
    x, y, z, w = Rotation.from_matrix([row.R.T for row in rows]).as_quat().T
    states[:, QUAT] = np.stack([w, x, y, z], axis=1)
    states[:, ZOOM] = [[math.log(math.tan(math.radians(row.fov) / 2))] for row in rows]
    flips = np.sum(states[1:, QUAT] * states[:-1, QUAT], axis=1) < 0
    states[1:, QUAT] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return states


def _differences(
    states: States,
) -> tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, " m"]]:
    """Return the distances of consecutive centres, and the combined angles of rotation and zoom."""
    moved = np.linalg.norm(np.diff(states[:, EYE], axis=0), axis=1)
    angle = 2.0 * _angle(states[:-1, QUAT], states[1:, QUAT])
    angle = np.minimum(angle, FULL_TURN - angle)  # q and -q are one rotation
    return moved, np.hypot(angle, np.diff(states[:, ZOOM], axis=0)[:, 0])


def _angle(a: Float64[np.ndarray, "n 4"], b: Float64[np.ndarray, "n 4"]) -> Values:
    """Return the angle between unit quaternions in four dimensions, exact for equal ones: no arc cosine."""
    apart, together = (np.linalg.norm(v, axis=1) for v in (a - b, a + b))
    angles: Values = 2.0 * np.arctan2(apart, together)
    return angles


def _mixed(a: States, b: States, share: Values) -> States:
    """Interpolate (share in [0, 1]) or extrapolate states: slerp for the quaternions, linear for the rest.

    slerp(a, b, t) = (sin((1 - t) w) a + sin(t w) b) / sin w,  w: the angle between a and b

    The signs of the quaternions stay as they are: a change of sign along the path would make it jump.
    """
    t = share[:, None]
    mixed: States = (1.0 - t) * a + t * b
    angle = _angle(a[:, QUAT], b[:, QUAT])[:, None]
    sine = np.sin(angle)
    # Equal quaternions mix linearly; between opposite ones, which are one rotation, every way is as short.
    straight = sine < 1e-9
    safe = np.where(straight, 1.0, sine)
    bent = (np.sin((1.0 - t) * angle) * a[:, QUAT] + np.sin(t * angle) * b[:, QUAT]) / safe
    nearer = np.where(t < 0.5, a[:, QUAT], b[:, QUAT])
    quats = np.where(straight, np.where(angle < 1.0, mixed[:, QUAT], nearer), bent)
    mixed[:, QUAT] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return mixed


def monotone_interpolation(
    x: Float64[np.ndarray, " k"],
    y: Float64[np.ndarray, " k"],
    at: Values,
    loop: bool,
    ease: str | None = None,
) -> Values:
    """Interpolate a non-decreasing table by cubics that do not decrease either and whose slope is continuous.

    Args:
        x: Increasing.
        y: Not decreasing.
        at: Within the range of x.
        loop: Whether the slope at the end continues at the start.
        ease: Makes the slope zero at both ends of the table (`ENDS`), or at each of its rows (`VIEWS`).
    """
    h = np.diff(x)
    secants = np.diff(y) / h
    slopes = np.r_[secants[0], _harmonic(h[:-1], h[1:], secants[:-1], secants[1:]), secants[-1]]
    if loop:
        slopes[0] = slopes[-1] = _harmonic(h[-1:], h[:1], secants[-1:], secants[:1])[0]
    if ease == VIEWS:
        slopes[:] = 0.0
    elif ease == ENDS:
        slopes[[0, -1]] = 0.0
    i = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(h) - 1)
    s = (at - x[i]) / h[i]
    left, right = h[i] * slopes[i], h[i] * slopes[i + 1]
    rise = y[i + 1] - y[i]
    values: Values = y[i] + s * (
        left + s * (3.0 * rise - 2.0 * left - right + s * (left + right - 2.0 * rise))
    )
    return values


def _harmonic(h0: Values, h1: Values, d0: Values, d1: Values) -> Values:
    """Return the weighted harmonic means of the secants on both sides of inner points; 0 where one is 0."""
    w0, w1 = 2.0 * h1 + h0, h1 + 2.0 * h0
    flat = (d0 <= 0.0) | (d1 <= 0.0)
    safe0, safe1 = np.where(flat, 1.0, d0), np.where(flat, 1.0, d1)
    means: Values = np.where(flat, 0.0, (w0 + w1) / (w0 / safe0 + w1 / safe1))
    return means
