"""sight: where a camera with any projection, at rest or with a rolling shutter, sees Gaussians; and the backward pass.

    p(t) = C(w t) R (x - eye - V t),   (u, v) = image(p),   t = pace (q - middle),   q: v, or u of columns read in turn
    rows of J W:   R' C' B,   B = J + k w_image (J of q),   w_image = J dp/dt,   k = pace / (1 - pace w_image of q)

    blur:  exposure / sqrt(12) w_image / (1 - pace w_image of q)

B of a perspective lens is that of the clamped point, whose J, dp/dt and k it takes; so does the blur. t is tau - 1/2,
and pace is 0 for a global shutter. Formulas and names are those of `native/sight.cpp`. A row of the result holds u, v,
the rows of J W, depth, direction, whether the mean is seen, t, and the blur. The kernels compute in the type of the
lens' row.
"""

from __future__ import annotations

from typing import no_type_check

import triton
import triton.language as tl

from gsplat_edu.render.camera_tensors import LENS_GRADIENT_NUMBERS
from gsplat_edu.render.cuda.lens_formulas import (
    BLURRED,
    BOUNDED,
    BY_COLUMNS,
    EQUIRECTANGULAR,
    FISHEYE,
    MOVING,
    PERSPECTIVE,
    clamp_gradient,
    clamped_point,
    dot,
    image_gradient,
    image_of,
    mixed_of,
    plus,
    scaled,
    store_lens_gradient,
    store_sum,
)
from gsplat_edu.scene import sight as formulas

SEEN = tl.constexpr(16)
"""Values per Gaussian of the result."""

LENS_NUMBERS = tl.constexpr(LENS_GRADIENT_NUMBERS)
"""Numbers of a camera's gradient: R row by row, eye, fx, fy, cx, cy, coefficients, turn, shift; a row begins alike."""

ORTHOGRAPHIC = tl.constexpr(3)
EYE, TURN, SHIFT = tl.constexpr(9), tl.constexpr(31), tl.constexpr(34)
WIDEST, PACE, READ_MIDDLE, NEAR, EYE_REST = (tl.constexpr(place) for place in (37, 38, 39, 40, 41))
SPREAD = tl.constexpr(48)
STEPS = tl.constexpr(formulas.SHUTTER_STEPS)
FASTEST = tl.constexpr(formulas.FASTEST)
SETTLED = tl.constexpr(formulas.SETTLED)

POLAR = tl.constexpr(1e-12)
"""At less than this h² / |p|², rounding to float32 leaves no longitude: the Gaussian is not drawn."""


@triton.jit
@no_type_check
def _row(lens, place: tl.constexpr):
    """Load three numbers."""
    return tl.load(lens + place), tl.load(lens + place + 1), tl.load(lens + place + 2)


@triton.jit
@no_type_check
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
@no_type_check
def _turning(lens, v):
    """Return R v."""
    return dot(_row(lens, 0), v), dot(_row(lens, 3), v), dot(_row(lens, 6), v)


@triton.jit
@no_type_check
def _turning_back(lens, v):
    """Return R' v."""
    return plus(mixed_of(_row(lens, 0), v[0], _row(lens, 3), v[1]), scaled(_row(lens, 6), v[2]))


@triton.jit
@no_type_check
def _cayley(h, f, v):
    """Return Cayley's map of half the turn h: v + f (h x v + h x (h x v)). That of -h is its inverse."""
    once = _cross(h, v)
    return plus(v, scaled(plus(once, _cross(h, once)), f))


@triton.jit
@no_type_check
def _moment(lens, at_rest, time, OPTICS: tl.constexpr):
    """Return h, f, the place before and after the turn, C R V, dp/dt, the image and its speed at a time."""
    turn, shift = _row(lens, TURN), _turning(lens, _row(lens, SHIFT))
    h = scaled(turn, 0.5 * time)
    f = 2 / (1 + dot(h, h))
    start = mixed_of(at_rest, 1.0, shift, -time)
    p, moved = _cayley(h, f, start), _cayley(h, f, shift)
    rate = mixed_of(_cross(turn, p), 0.5 * f, moved, -1.0)
    at, J0, J1, e0 = image_of(lens, p, OPTICS)
    return h, f, start, p, moved, rate, at, J0, J1, e0, (dot(J0, rate), dot(J1, rate))


@triton.jit
@no_type_check
def _k(lens, speed, OPTICS: tl.constexpr):
    pace = tl.load(lens + PACE)
    return pace / (1 - pace * (speed[0] if BY_COLUMNS & OPTICS else speed[1]))


@triton.jit
@no_type_check
def _follows(lens, speed, OPTICS: tl.constexpr):
    """Return 1 / (1 - pace w_image of q), by which the row that sees a point changes the motion blur."""
    return 1 / (1 - tl.load(lens + PACE) * (speed[0] if BY_COLUMNS & OPTICS else speed[1]))


@triton.jit
@no_type_check
def scaled2(a, k):
    """Return two numbers times k."""
    return a[0] * k, a[1] * k


@triton.jit
@no_type_check
def _blur_gradient(lens, by_speed, speed, blur, OPTICS: tl.constexpr):
    """Add to the cotangent of w_image what that of the blur passes on: d follows / d speed = pace follows²."""
    spread, follows = tl.load(lens + SPREAD), _follows(lens, speed, OPTICS)
    more = spread * (blur[0] * speed[0] + blur[1] * speed[1]) * tl.load(lens + PACE) * follows * follows
    first, second = by_speed[0] + spread * follows * blur[0], by_speed[1] + spread * follows * blur[1]
    return (first + more, second) if BY_COLUMNS & OPTICS else (first, second + more)


@triton.jit
@no_type_check
def _shear(lens, f, p, moved, rate, J0, J1, e0, speed, OPTICS: tl.constexpr):
    """Return what the ellipse takes of a moment: the point, dp/dt, the rows of J and of the ellipse, speed and k."""
    if BOUNDED & OPTICS:
        p = clamped_point(lens, p, OPTICS)
        rate = mixed_of(_cross(_row(lens, TURN), p), 0.5 * f, moved, -1.0)
        _, J0, J1, e0 = image_of(lens, p, OPTICS)
        speed = (dot(J0, rate), dot(J1, rate))
    return p, rate, J0, J1, e0, speed, _k(lens, speed, OPTICS)


@triton.jit
@no_type_check
def _time_of(lens, at_rest, OPTICS: tl.constexpr):
    """Return t at which a rolling shutter sees points, from their places at half time: Newton's method."""
    pace, middle = tl.load(lens + PACE), tl.load(lens + READ_MIDDLE)
    first, _, _, _ = image_of(lens, at_rest, OPTICS)
    q = first[0] if BY_COLUMNS & OPTICS else first[1]
    for _step in range(STEPS):
        _, _, _, _, _, _, at, _, _, _, speed = _moment(lens, at_rest, pace * (q - middle), OPTICS)
        if BY_COLUMNS & OPTICS:
            q += (at[0] - q) / (1 - pace * speed[0])
        else:
            q += (at[1] - q) / (1 - pace * speed[1])
    return pace * (q - middle)


@triton.jit
@no_type_check
def _offset(means, lens, i, mask):
    """Return mean - eye; the eye is a number of the row's type plus its rounding error."""
    eye, rest = _row(lens, EYE), _row(lens, EYE_REST)
    place = means + 3 * i
    kind = eye[0].dtype
    return (
        tl.load(place, mask=mask, other=0.0).to(kind) - eye[0] - rest[0],
        tl.load(place + 1, mask=mask, other=0.0).to(kind) - eye[1] - rest[1],
        tl.load(place + 2, mask=mask, other=0.0).to(kind) - eye[2] - rest[2],
    )


@triton.jit
@no_type_check
def _rows_of(e0, J1, speed, k, OPTICS: tl.constexpr):
    """Return B = J + k w_image (J of q), the rows of the ellipse under a rolling shutter."""
    along = e0 if BY_COLUMNS & OPTICS else J1
    return mixed_of(e0, 1.0, along, k * speed[0]), mixed_of(J1, 1.0, along, k * speed[1])


@triton.jit
@no_type_check
def sight_kernel(means, lens, seen, n, OPTICS: tl.constexpr, BLOCK: tl.constexpr):
    """Write where a camera sees a block of Gaussians; zeros where it sees none."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask = i < n
    offset = _offset(means, lens, i, mask)
    p = _turning(lens, offset)
    time, direction, slow = 0.0 * p[2], offset, mask
    blur = (time, time)
    if MOVING & OPTICS:
        time = _time_of(lens, p, OPTICS)
        h, f, _, p, moved, rate, at, J0, J1, e0, speed = _moment(lens, p, time, OPTICS)
        _, _, _, J1, e0, own, k = _shear(lens, f, p, moved, rate, J0, J1, e0, speed, OPTICS)
        pace = tl.load(lens + PACE)
        slow = mask & (tl.abs(pace * (speed[0] if BY_COLUMNS & OPTICS else speed[1])) < FASTEST)
        slow = slow & (tl.abs(pace * (own[0] if BY_COLUMNS & OPTICS else own[1])) < FASTEST)
        read = time / tl.where(pace == 0, 1.0, pace) + tl.load(lens + READ_MIDDLE)
        off = ((at[0] if BY_COLUMNS & OPTICS else at[1]) - read) * tl.where(pace == 0, 0.0, 1.0)
        slow = slow & (tl.abs(off) < SETTLED)
        if BLURRED & OPTICS:
            blur = scaled2(own, tl.load(lens + SPREAD) * _follows(lens, own, OPTICS))
        b0, b1 = _rows_of(e0, J1, own, k, OPTICS)
        back = scaled(h, -1.0)
        b0, b1 = _cayley(back, f, b0), _cayley(back, f, b1)
        direction = mixed_of(offset, 1.0, _row(lens, SHIFT), -time)
    else:
        at, _, b1, b0 = image_of(lens, p, OPTICS)
        if BOUNDED & OPTICS:
            _, _, b1, b0 = image_of(lens, clamped_point(lens, p, OPTICS), OPTICS)
    t0, t1 = _turning_back(lens, b0), _turning_back(lens, b1)
    if OPTICS % 4 == ORTHOGRAPHIC:
        direction = plus(_row(lens, 6), scaled(offset, 0.0))
    x, y, z = p
    s, distance = x * x + y * y, tl.sqrt(dot(p, p))
    widest = tl.load(lens + WIDEST)
    if OPTICS % 4 == PERSPECTIVE:
        depth, wide = z, s <= widest * z * z
    elif OPTICS % 4 == FISHEYE:
        depth, wide = distance, z >= widest * distance
    elif OPTICS % 4 == EQUIRECTANGULAR:
        depth, wide = distance, x * x + z * z > POLAR * distance * distance
    else:
        depth, wide = z, mask
    fields = (
        at[0], at[1], t0[0], t0[1], t0[2], t1[0], t1[1], t1[2], depth, direction[0], direction[1], direction[2],
        1 + 0 * depth, time, blur[0], blur[1],
    )  # fmt: skip
    total = time
    for j in tl.static_range(12):
        total += fields[j] * 0
    fine = slow & wide & (depth > tl.load(lens + NEAR)) & (total - total == 0.0)
    for j in tl.static_range(16):
        tl.store(seen + i * SEEN + j, tl.where(fine, fields[j], 0.0), mask=mask)


@triton.jit
@no_type_check
def _load3(pointer, place: tl.constexpr, i, mask, kind: tl.constexpr):
    at = pointer + i * SEEN + place
    return (
        tl.load(at, mask=mask, other=0.0).to(kind),
        tl.load(at + 1, mask=mask, other=0.0).to(kind),
        tl.load(at + 2, mask=mask, other=0.0).to(kind),
    )


@triton.jit
@no_type_check
def _depth_gradient(p, deep, OPTICS: tl.constexpr):
    if OPTICS % 4 == FISHEYE or OPTICS % 4 == EQUIRECTANGULAR:
        found = scaled(p, deep / tl.sqrt(dot(p, p)))
    else:
        found = (0.0 * deep, 0.0 * deep, deep)
    return found


@triton.jit
@no_type_check
def sight_backward_kernel(
    means, lens, seen, grad_seen, grad_means, camera_sums, n,
    OPTICS: tl.constexpr, WITH_CAMERA: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Propagate to the means and, with `WITH_CAMERA`, write each program's sums of the camera's gradient.

    There are two rows of sums for each program: with bounds, the second has what comes through the image points.
    """
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask = i < n
    touched = mask & (tl.load(seen + i * SEEN + 12, mask=mask, other=0.0) > 0)
    offset = _offset(means, lens, i, mask)
    kind: tl.constexpr = offset[0].dtype
    d0, d1 = _load3(grad_seen, 2, i, mask, kind), _load3(grad_seen, 5, i, mask, kind)
    at, direction = _load3(grad_seen, 0, i, mask, kind), _load3(grad_seen, 9, i, mask, kind)
    deep = tl.load(grad_seen + i * SEEN + 8, mask=mask, other=0.0).to(kind)
    seen_direction = direction
    if OPTICS % 4 == ORTHOGRAPHIC:  # its direction is R's last row
        seen_direction = scaled(direction, 0.0)
    sums = camera_sums + tl.program_id(0) * 2 * LENS_NUMBERS
    if MOVING & OPTICS:
        time = tl.load(seen + i * SEEN + 13, mask=mask, other=0.0).to(kind)
        mean = _through_moving(
            lens,
            sums,
            offset,
            time,
            (
                tl.load(grad_seen + i * SEEN + 14, mask=mask, other=0.0).to(kind),
                tl.load(grad_seen + i * SEEN + 15, mask=mask, other=0.0).to(kind),
            ),
            at,
            d0,
            d1,
            deep,
            direction,
            seen_direction,
            touched,
            OPTICS,
            WITH_CAMERA,
        )
    else:
        mean = _through_still(lens, sums, offset, at, d0, d1, deep, direction, touched, OPTICS, WITH_CAMERA)
    mean = plus(mean, seen_direction)
    for k in tl.static_range(3):
        tl.store(grad_means + 3 * i + k, tl.where(touched, mean[k], 0.0), mask=mask)
        if WITH_CAMERA:
            store_sum(sums + EYE + k, -mean[k], touched)


@triton.jit
@no_type_check
def _store_turn(sums, by_R, direction, touched, OPTICS: tl.constexpr):
    """Store the gradient of R, three rows."""
    for j in tl.static_range(3):
        for k in tl.static_range(3):
            value = by_R[j][k]
            if OPTICS % 4 == ORTHOGRAPHIC and j == 2:  # its direction is R's last row
                value += direction[k]
            store_sum(sums + 3 * j + k, value, touched)


@triton.jit
@no_type_check
def _with_outer(by_R, a, b):
    """Return by_R + a b'."""
    return (
        plus(by_R[0], scaled(b, a[0])),
        plus(by_R[1], scaled(b, a[1])),
        plus(by_R[2], scaled(b, a[2])),
    )


@triton.jit
@no_type_check
def _place_gradient(lens, sums, p, at, touched, OPTICS: tl.constexpr, WITH_CAMERA: tl.constexpr):
    """Return the gradient of p through the image point alone, and store the lens' in the second row of sums."""
    _, J0, J1, _ = image_of(lens, p, OPTICS)
    if WITH_CAMERA:
        none = scaled(p, 0.0)
        store_lens_gradient(lens, sums + LENS_NUMBERS, p, at, none, none, none, none, touched, OPTICS)
    return mixed_of(J0, at[0], J1, at[1])


@triton.jit
@no_type_check
def _through_still(
    lens, sums, offset, at, d0, d1, deep, direction, touched, OPTICS: tl.constexpr, WITH_CAMERA: tl.constexpr
):
    """Return the gradient of the mean of a camera at rest, without the direction's part."""
    p = _turning(lens, offset)
    none, inside = scaled(p, 0.0), clamped_point(lens, p, OPTICS)
    e0, e1 = _turning(lens, d0), _turning(lens, d1)
    dp = _depth_gradient(p, deep, OPTICS)
    if BOUNDED & OPTICS:
        dp, at = plus(dp, _place_gradient(lens, sums, p, at, touched, OPTICS, WITH_CAMERA)), scaled(at, 0.0)
    of_inside = image_gradient(lens, inside, at, none, none, e0, e1, OPTICS)
    dp = plus(clamp_gradient(lens, p, of_inside, OPTICS), dp)
    if WITH_CAMERA:
        _, _, J1, ellipse = image_of(lens, inside, OPTICS)
        by_R = (scaled(offset, dp[0]), scaled(offset, dp[1]), scaled(offset, dp[2]))
        by_R = _with_outer(_with_outer(by_R, ellipse, d0), J1, d1)
        _store_turn(sums, by_R, direction, touched, OPTICS)
        store_lens_gradient(lens, sums, inside, at, none, none, e0, e1, touched, OPTICS)
        for k in tl.static_range(6):
            store_sum(sums + TURN + k, 0.0 * deep, touched)
    return _turning_back(lens, dp)


@triton.jit
@no_type_check
def _cayley_gradient(h, f, v, c, half, scale):
    """Add the cotangents of h and f through Cayley's map of v, whose result has the cotangent c."""
    once = _cross(h, v)
    more = plus(plus(_cross(v, c), _cross(once, c)), _cross(v, _cross(c, h)))
    return plus(half, scaled(more, f)), scale + dot(c, plus(once, _cross(h, once)))


@triton.jit
@no_type_check
def _half_gradient(lens, turned, given, cotangents, y, spun):
    """Return the gradient of the turn through Cayley's maps: of h and f, times t / 2.

    Args:
        lens: The lens' row.
        turned: h, f and t.
        given: What the maps turn besides the shift: the place, and the rows' cotangents in camera axes.
        cotangents: Those of the turned place, and the rows that the latter belong to.
        y: The cotangent of dp/dt.
        spun: Its product with the spin, twice the derivative by f.
    """
    h, f, time = turned
    half, scale = _cayley_gradient(h, f, given[0], cotangents[0], scaled(y, 0.0), 0.5 * spun)
    half, scale = _cayley_gradient(h, f, _turning(lens, _row(lens, SHIFT)), scaled(y, -1.0), half, scale)
    half, scale = _cayley_gradient(h, f, given[1], cotangents[1], half, scale)
    half, scale = _cayley_gradient(h, f, given[2], cotangents[2], half, scale)
    return mixed_of(half, 0.5 * time, h, -0.5 * time * f * f * scale)


@triton.jit
@no_type_check
def _through_moving(
    lens, sums, offset, time, blur, at, d0, d1, deep, direction, seen_direction, touched,
    OPTICS: tl.constexpr, WITH_CAMERA: tl.constexpr,
):  # fmt: skip
    """Return the same for a rolling shutter, by the implicit function theorem."""
    h, f, start, p, moved, rate, _, J0, J1, e0, speed = _moment(lens, _turning(lens, offset), time, OPTICS)
    inside, own_rate, C0, C1, e0, own, k = _shear(lens, f, p, moved, rate, J0, J1, e0, speed, OPTICS)
    turn, V = _row(lens, TURN), _row(lens, SHIFT)
    c0, c1 = _turning(lens, d0), _turning(lens, d1)
    rows0, rows1 = _cayley(h, f, c0), _cayley(h, f, c1)
    B0, B1 = _rows_of(e0, C1, own, k, OPTICS)
    along = e0 if BY_COLUMNS & OPTICS else C1
    reach = (dot(along, rows0), dot(along, rows1))
    by_k = k * k * (own[0] * reach[0] + own[1] * reach[1])
    more = mixed_of(rows0, k * own[0], rows1, k * own[1])
    if BY_COLUMNS & OPTICS:
        by_speed = (k * reach[0] + by_k, k * reach[1])
        of_e0, of_e1 = plus(rows0, more), rows1
    else:
        by_speed = (k * reach[0], k * reach[1] + by_k)
        of_e0, of_e1 = rows0, plus(rows1, more)
    if BLURRED & OPTICS:
        by_speed = _blur_gradient(lens, by_speed, own, blur, OPTICS)
    of_J0, of_J1 = scaled(own_rate, by_speed[0]), scaled(own_rate, by_speed[1])
    y = mixed_of(C0, by_speed[0], C1, by_speed[1])
    shown = scaled(at, 0.0) if BOUNDED & OPTICS else at
    of_inside = image_gradient(lens, inside, shown, of_J0, of_J1, of_e0, of_e1, OPTICS)
    of_inside = plus(of_inside, scaled(_cross(y, turn), 0.5 * f))
    dp = plus(clamp_gradient(lens, p, of_inside, OPTICS), _depth_gradient(p, deep, OPTICS))
    if BOUNDED & OPTICS:
        dp = plus(dp, mixed_of(J0, at[0], J1, at[1]))
    # S, the cotangent of t: through p, dp/dt, the rows and the direction
    spun = dot(y, _cross(turn, inside))
    S = dot(dp, rate) - 0.25 * f * f * dot(h, turn) * spun - 0.5 * f * dot(y, _cross(turn, moved))
    S += 0.5 * f * (dot(B0, _cross(turn, rows0)) + dot(B1, _cross(turn, rows1))) - dot(V, seen_direction)
    kS = _k(lens, speed, OPTICS) * S
    if BY_COLUMNS & OPTICS:
        dp, at = plus(dp, scaled(J0, kS)), (at[0] + kS, at[1], at[2])
    else:
        dp, at = plus(dp, scaled(J1, kS)), (at[0], at[1] + kS, at[2])
    before = scaled(h, -1.0)
    back = _cayley(before, f, dp)
    mean = _turning_back(lens, back)
    if WITH_CAMERA:
        if BOUNDED & OPTICS:
            _ = _place_gradient(lens, sums, p, at, touched, OPTICS, WITH_CAMERA)
            at = scaled(at, 0.0)
        store_lens_gradient(lens, sums, inside, at, of_J0, of_J1, of_e0, of_e1, touched, OPTICS)
        still, of_shift = mixed_of(offset, 1.0, V, -time), _cayley(before, f, scaled(y, -1.0))
        by_R = (scaled(still, back[0]), scaled(still, back[1]), scaled(still, back[2]))
        by_R = _with_outer(by_R, of_shift, V)
        by_R = _with_outer(_with_outer(by_R, _cayley(before, f, B0), d0), _cayley(before, f, B1), d1)
        _store_turn(sums, by_R, direction, touched, OPTICS)
        by_V = mixed_of(_turning_back(lens, of_shift), 1.0, plus(mean, seen_direction), -time)
        half = _half_gradient(lens, (h, f, time), (start, c0, c1), (dp, B0, B1), y, spun)
        by_turn = mixed_of(_cross(inside, y), 0.5 * f, half, 1.0)
        for j in tl.static_range(3):
            store_sum(sums + TURN + j, by_turn[j], touched)
            store_sum(sums + SHIFT + j, by_V[j], touched)
    return mean
