"""Where a camera sees points of the world: any projection, with or without a rolling shutter.

p(tau) = C(w (tau - 1/2)) R (x - eye - V (tau - 1/2)),  (u, v) = f * projection(p),  tau from the row v (or column u)

The row at which a point is seen depends on the time, and the time on the row; Newton's method solves for it. A point
that moves to first order by dx moves on the image by J_rs R(tau) dx, with

    J_rs = (I + k w e') J,  w = J dp/dtau,  k = s / (1 - s w_e)

J: Jacobian of projection and focal lengths at p(tau). e: unit vector of the readout's axis. s: tau by its coordinate.

The ellipse of a perspective lens takes J, dp/dt and k at the clamped point: x/z and y/z of p(tau) are moved into bounds
around the image (`Camera.jacobian_bounds`), z stays. (I + k w e') J is the derivative of one map at one point. With J
of the clamped point and w of the true one, it would be that of no map; and w of a camera that turns grows with the
square of x/z, so the shear would bring back what the clamp takes away. Place and time are those of the true point.

While a row is exposed for the time e, the pixels of the row see the point move by w e. The row that sees it changes
with the motion, as above, so that in the image it moves by b = e w / (1 - s w_e); of a global shutter s is 0. b takes
w of the ellipse's point, too. The ellipse before the dilation gets b b' / 12 (`Sight.blur` is b / sqrt(12)).

The formulas work on NumPy arrays and torch tensors alike; in torch, the derivative of tau follows from one step of
Newton's method at the solution (the implicit function theorem).

Chapter: 04_splatting.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.base.constants import TILE
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.projection_formulas import (
    POLE,
    Numbers,
    OnPlane,
    Operations,
    Row,
    distort,
    equirectangular,
    fisheye,
    orthographic,
    perspective,
)
from gsplat_edu.scene.shutter import readout_axis, readout_pace

SHUTTER_STEPS = 3
"""Steps of Newton's method for the row of a point. For 5 radians per second and a readout of 30 ms, two leave less than
1e-6 px; the third has the derivative."""

FASTEST = 0.5
"""Largest fraction of the readout's own speed at which a point moves along it. A faster one may be seen twice or not at
all."""


SETTLED = 0.1
"""Largest distance between a point's row and the row at whose time it is seen, px. Newton's method leaves less than a
millionth for points near the image; from a point far beside it, the method may end anywhere."""

Bounds = tuple[tuple[float, float], tuple[float, float]]
"""(low, high) of x/z and of y/z."""


class Optics(NamedTuple):
    """The lens and the shutter of a camera.

    Args:
        projection: The kind of projection; its coefficients are not read.
        coefficients: The fifteen coefficients of the distortion; None for no distortion.
        widest: Largest angle to the optical axis, radians.
        motion: Turn and shift during the readout, six numbers; None for a global shutter.
        readout: The direction of a rolling shutter.
        bounds: (low, high) of x/z and of y/z in the ellipse of a perspective lens, constants; None for no bounds.
        exposure: Time for which a row is exposed, by that of the readout; 0 for no motion blur.
    """

    projection: Projection
    coefficients: Sequence[Numbers] | None
    widest: float
    motion: Sequence[Numbers] | None
    readout: str
    bounds: Bounds | None = None
    exposure: float = 0.0


class Sight(NamedTuple):
    """Where points are seen; of one that is not `valid`, the numbers mean nothing.

    Args:
        u: Columns, px.
        v: Rows, px.
        depth: z, or the distance for a projection whose depth is along the ray; world units.
        jacobian: Rows of d(u, v) / d(x, y, z) by world axes, px per world unit, for the ellipse.
        direction: From the camera, when it sees the point, to the point; world axes, any length.
        valid: Whether the camera sees the point: far enough, within the widest angle, slow enough for the shutter,
            and in a row that was found.
        blur: b / sqrt(12), the standard deviations of the motion while the point is exposed, px; None for no blur.
    """

    u: Numbers
    v: Numbers
    depth: Numbers
    jacobian: tuple[Row, Row]
    direction: Row
    valid: Numbers
    blur: tuple[Numbers, Numbers] | None = None


def sight(
    points: Row,
    R: Sequence[Sequence[Numbers]],
    eye: Row,
    lens: tuple[Numbers, Numbers, Numbers, Numbers],
    optics: Optics,
    size: tuple[int, int],
    z_near: float,
    do: Operations,
) -> Sight:
    """See points.

    Args:
        points: x, y and z in world axes.
        R: Rows of the rotation.
        eye: The camera's centre.
        lens: fx, fy, cx, cy, px.
        optics: Projection, distortion, and shutter.
        size: H and W, px.
        z_near: Smallest depth, world units.
        do: The operations of the points' library.
    """
    offset = _minus(points, eye)
    if optics.motion is None:
        p = _times(R, offset)
        place, ellipse = _image(p, lens, optics, do)
        if _clamps(optics):
            ellipse, _ = _image(_clamped(p, optics, do), lens, optics, do)
        return _sight(p, place, ellipse, R, offset, optics, z_near, do)
    return _moving(offset, R, lens, optics, optics.motion, size, z_near, do)


def _clamps(optics: Optics) -> bool:
    return optics.projection.kind == "perspective" and optics.bounds is not None


def _clamped(p: Row, optics: Optics, do: Operations) -> Row:
    """Return the point at the depth of p whose x/z and y/z are those of p, moved into the bounds."""
    assert optics.bounds is not None
    z = p[2]
    x, y = (
        do.where(at < low * z, low * z, do.where(at > high * z, high * z, at))
        for at, (low, high) in zip(p[:2], optics.bounds, strict=True)
    )
    return x, y, z


class _Moment(NamedTuple):
    """A camera's view of points at a time."""

    p: Row  # in camera axes
    half: Row  # h of Cayley's map
    f: Numbers
    place: OnPlane
    ellipse: OnPlane
    speed: tuple[Numbers, Numbers]  # of the image point by the time, px
    ellipse_speed: tuple[Numbers, Numbers]  # the same at the point of the ellipse


def _moving(
    offset: Row,
    R: Sequence[Sequence[Numbers]],
    lens: tuple[Numbers, Numbers, Numbers, Numbers],
    optics: Optics,
    motion: Sequence[Numbers],
    size: tuple[int, int],
    z_near: float,
    do: Operations,
) -> Sight:
    """See points through a rolling shutter."""
    turn, shift = (motion[0], motion[1], motion[2]), (motion[3], motion[4], motion[5])
    axis, pace = readout_axis(optics.readout), readout_pace(optics.readout, *size)
    middle = ((size[1], size[0])[axis] - 1) / 2
    at_rest, shift_in_camera = _times(R, offset), _times(R, shift)

    def at(time: Numbers) -> _Moment:
        half = _scaled(turn, 0.5 * time)
        f = 2 / (1 + _dot(half, half))
        p = _turned(_minus(at_rest, _scaled(shift_in_camera, time)), half, f)
        spin, drift = _scaled(turn, 0.5 * f), _turned(shift_in_camera, half, f)
        place, ellipse = _image(p, lens, optics, do)
        rate = _minus(_cross(spin, p), drift)
        speed = own = _dot(place.da, rate), _dot(place.db, rate)
        if _clamps(optics):
            inside = _clamped(p, optics, do)
            ellipse, _ = _image(inside, lens, optics, do)
            rate = _minus(_cross(spin, inside), drift)
            own = _dot(ellipse.da, rate), _dot(ellipse.db, rate)
        return _Moment(p, half, f, place, ellipse, speed, own)

    place, _ = _image(at_rest, lens, optics, do)
    q = (place.a, place.b)[axis]
    for _ in range(SHUTTER_STEPS):  # the last one has the derivative
        q = _still(q)
        seen = at(pace * (q - middle))
        q = q + ((seen.place.a, seen.place.b)[axis] - q) / _still(1 - pace * seen.speed[axis])
    time = pace * (q - middle)
    seen = at(time)
    speed, own_speed = pace * seen.speed[axis], pace * seen.ellipse_speed[axis]
    k = pace / (1 - own_speed)
    ellipse = seen.ellipse
    along, back = (ellipse.da, ellipse.db)[axis], _scaled(seen.half, -1)
    da, db = (
        _turned(_plus(row, _scaled(along, k * own)), back, seen.f)
        for row, own in zip((ellipse.da, ellipse.db), seen.ellipse_speed, strict=True)
    )
    sheared = OnPlane(ellipse.a, ellipse.b, da, db)
    direction = _minus(offset, _scaled(shift, time))
    found = _sight(seen.p, seen.place, sheared, R, direction, optics, z_near, do)
    settled = abs((seen.place.a, seen.place.b)[axis] - q) < SETTLED
    found = found._replace(valid=found.valid & settled & (abs(speed) < FASTEST) & (abs(own_speed) < FASTEST))
    if not optics.exposure:
        return found
    spread = optics.exposure / math.sqrt(12.0) / (1 - own_speed)
    return found._replace(blur=(spread * seen.ellipse_speed[0], spread * seen.ellipse_speed[1]))


def _still(value: Numbers) -> Numbers:
    """Return a tensor as a constant; an array is one."""
    return value.detach() if hasattr(value, "detach") else value


def _image(
    p: Row, lens: tuple[Numbers, Numbers, Numbers, Numbers], optics: Optics, do: Operations
) -> tuple[OnPlane, OnPlane]:
    """Return the image point of p and its Jacobian by camera axes, px; and the same with that of the ellipse."""
    kind, c = optics.projection.kind, optics.coefficients
    if kind == "equirectangular":
        return _on_image(equirectangular(*p, do), lens), _on_image(equirectangular(*p, do, POLE), lens)
    if kind == "perspective":
        place = perspective(*p)
    elif kind == "fisheye":
        place = fisheye(*p, do)
    else:
        place = orthographic(*p)
    if c is not None and kind != "orthographic":
        (a, b), (ka, kb) = distort(place.a, place.b, c, optics.projection.radial_first)
        da, db = (_plus(_scaled(place.da, k[0]), _scaled(place.db, k[1])) for k in (ka, kb))
        place = OnPlane(a, b, da, db)
    found = _on_image(place, lens)
    return found, found


def _on_image(place: OnPlane, lens: tuple[Numbers, Numbers, Numbers, Numbers]) -> OnPlane:
    fx, fy, cx, cy = lens
    return OnPlane(fx * place.a + cx, fy * place.b + cy, _scaled(place.da, fx), _scaled(place.db, fy))


def _sight(
    p: Row,
    place: OnPlane,
    ellipse: OnPlane,
    R: Sequence[Sequence[Numbers]],
    direction: Row,
    optics: Optics,
    z_near: float,
    do: Operations,
) -> Sight:
    x, y, z = p
    s = x * x + y * y
    distance = do.sqrt(s + z * z)
    kind = optics.projection.kind
    depth = distance if optics.projection.along_ray else z
    valid = depth > z_near
    if kind == "fisheye":
        valid = valid & (z >= distance * math.cos(optics.widest))
    elif kind == "perspective":
        valid = valid & (s <= math.tan(optics.widest) ** 2 * z * z)
    elif kind == "equirectangular":
        valid = valid & (x * x + z * z > 0)
    else:
        direction = (R[2][0] + 0 * z, R[2][1] + 0 * z, R[2][2] + 0 * z)
    columns = [(R[0][k], R[1][k], R[2][k]) for k in range(3)]
    da, db = (
        (_dot(row, columns[0]), _dot(row, columns[1]), _dot(row, columns[2]))
        for row in (ellipse.da, ellipse.db)
    )
    return Sight(place.a, place.b, depth, (da, db), direction, valid)


def seam_shift(
    columns: Int64[np.ndarray, " w"], u: float | Float64[np.ndarray, "k 1"], W: int
) -> Float64[np.ndarray, "*k w"]:
    """Return the whole turns, px, by which a mean in an equirectangular image is moved to be nearest to each tile.

    W round((tile's middle - u) / W): each tile of 16 columns sees one of the copies of a splat, 360 degrees apart.

    Args:
        columns: Columns of pixels.
        u: Columns of means, px.
        W: Width of the image, px.
    """
    middles = columns // TILE * TILE + (TILE - 1) / 2
    return np.asarray(W * np.floor((middles - u) / W + 0.5))


def _minus(a: Row, b: Row) -> Row:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _plus(a: Row, b: Row) -> Row:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _scaled(a: Row, k: Numbers) -> Row:
    return a[0] * k, a[1] * k, a[2] * k


def _dot(a: Row, b: Row) -> Numbers:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Row, b: Row) -> Row:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _times(R: Sequence[Sequence[Numbers]], p: Row) -> Row:
    x, y, z = (row[0] * p[0] + row[1] * p[1] + row[2] * p[2] for row in R)
    return x, y, z


def _turned(p: Row, half: Row, f: Numbers) -> Row:
    """Return Cayley's map of p: p + f (h x p + h x (h x p))."""
    once = _cross(half, p)
    return _plus(p, _scaled(_plus(once, _cross(half, once)), f))
