"""project: from raw parameters to screen-space ellipses, one packed record per Gaussian; and the backward pass.

    Sigma2d = J W Sigma W' J' + d I + g g', d: dilation, g: motion blur
    u = fx x/z + cx,   alpha = o exp(-d' Sigma2d^-1 d / 2)

A record holds u, v, sx, sy, ty, log2 o, red, green, blue, depth, half width, half height. Then alpha = 2^(log2 o - (sx
dx + sy dy)² - (ty dy)²), whose squares cannot cancel for long, thin ellipses. A half width of 0 marks an invisible
Gaussian.

Where a lens or a rolling shutter (LENS: 1, or 2 with an exposure) sees the Gaussians, and g, the kernels of
`gsplat_edu.render.cuda.sight` have worked out before; project_backward returns the gradient of that, in rows of
`SEEN`, in place of the means'.
"""

from __future__ import annotations

import math
from typing import no_type_check

import triton
import triton.language as tl

from gsplat_edu.base import constants
from gsplat_edu.render.camera_tensors import GRADIENT_NUMBERS
from gsplat_edu.render.cuda.blur import blurred, still_gradient, store_blur_gradient
from gsplat_edu.render.cuda.gaussian import (
    C0,
    DET_FLOOR,
    EYE_AT,
    FOCAL_AT,
    MIDDLE_AT,
    NEAR_AT,
    SIZE_AT,
    THINNEST,
    dot3,
    harmonic,
    harmonic_slope,
    into_camera,
    jacobian_row,
    load3,
    onto_axes,
    rotation,
    shape_on_screen,
    store3,
    unit_quaternion,
)
from gsplat_edu.render.cuda.sight import SEEN

RECORD = tl.constexpr(16)
"""Values per record; twelve are used, sixteen fill a cache line."""

SLOT = tl.constexpr(16)
"""Values per slot: sums of w g (3), of w times the depth's gradient, and six moments of h."""

CAMERA_NUMBERS = tl.constexpr(GRADIENT_NUMBERS)
"""Numbers of a pinhole's gradient, at the offsets of the camera's row."""

ALPHA_MIN = tl.constexpr(constants.ALPHA_MIN)
COLOR_LIMIT = tl.constexpr(constants.COLOR_LIMIT)
SH_OFFSET = tl.constexpr(constants.SH_OFFSET)
LOG2E = tl.constexpr(math.log2(math.e))


@triton.jit
@no_type_check
def _colors(sh0, sh_rest, i, d0, d1, d2, mask, DEGREE: tl.constexpr, REST: tl.constexpr):
    """Return sum_i b_i(d) sh_i + 0.5, the colour before it is floored at 0."""
    red, green, blue = load3(sh0, i, mask)
    red, green, blue = red * C0 + SH_OFFSET, green * C0 + SH_OFFSET, blue * C0 + SH_OFFSET
    for j in tl.static_range(1, (DEGREE + 1) * (DEGREE + 1)):
        basis = harmonic(j, d0, d1, d2)
        r, g, b = load3(sh_rest, i * REST + j - 1, mask)
        red, green, blue = red + basis * r, green + basis * g, blue + basis * b
    return red, green, blue


@triton.jit
@no_type_check
def _is_finite(x):
    return x - x == 0.0


@triton.jit
@no_type_check
def _through_lens(seen, i, mask):
    """Load direction, image position, depth, and the rows of J W."""
    row = seen + i * SEEN
    u, v = tl.load(row, mask=mask, other=0.0), tl.load(row + 1, mask=mask, other=0.0)
    t0, t1, t2 = load3(row + 2, 0, mask)
    p0, p1, p2 = load3(row + 5, 0, mask)
    depth = tl.load(row + 8, mask=mask, other=1.0)
    o0, o1 = tl.load(row + 9, mask=mask, other=0.0), tl.load(row + 10, mask=mask, other=0.0)
    o2 = tl.load(row + 11, mask=mask, other=1.0)
    return o0, o1, o2, u, v, depth, t0, t1, t2, p0, p1, p2


@triton.jit
@no_type_check
def project_kernel(
    means, quats, log_scales, sh0, sh_rest, logits, camera, seen_by_lens, records, n,
    DEGREE: tl.constexpr, REST: tl.constexpr, ANTIALIASED: tl.constexpr, DILATION: tl.constexpr,
    LENS: tl.constexpr, WRAPS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the records of a block of Gaussians."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask = i < n
    if LENS:
        o0, o1, o2, x, y, z, t0, t1, t2, p0, p1, p2 = _through_lens(seen_by_lens, i, mask)
        front = tl.load(seen_by_lens + i * SEEN + 12, mask=mask, other=0.0) > 0
        u, v = x, y
    else:
        o0, o1, o2, x, y, z = into_camera(means, camera, i, mask)
        front = z > tl.load(camera + NEAR_AT)
        z = tl.where(front, z, 1.0)
        t0, t1, t2, _ = jacobian_row(camera, 0, x, z)
        p0, p1, p2, _ = jacobian_row(camera, 1, y, z)
        u = tl.load(camera + FOCAL_AT) * x / z + tl.load(camera + MIDDLE_AT)
        v = tl.load(camera + FOCAL_AT + 1) * y / z + tl.load(camera + MIDDLE_AT + 1)
    qw, qx, qy, qz, length = unit_quaternion(quats, i, mask)
    R = rotation(qw, qx, qy, qz)
    l0, l1, l2 = load3(log_scales, i, mask)
    s0, s1, s2 = tl.exp(l0), tl.exp(l1), tl.exp(l2)
    r = onto_axes(t0, t1, t2, R, s0, s1, s2)
    q = onto_axes(p0, p1, p2, R, s0, s1, s2)
    a, b, c, det0, det = shape_on_screen(r, q, DILATION)
    a, c = a + DILATION, c + DILATION
    opacity = 1 / (1 + tl.exp(-tl.load(logits + i, mask=mask, other=0.0)))
    if LENS == 2:
        before = det
        _, _, a, b, c, det = blurred(seen_by_lens, i, mask, r, q, (a, b, c, det), DILATION)
        if not ANTIALIASED:
            opacity = opacity * tl.sqrt(before / det)
    if ANTIALIASED:
        opacity = opacity * tl.sqrt(tl.maximum(det0, DET_FLOOR) / det)

    distance = tl.sqrt(dot3(o0, o1, o2, o0, o1, o2))
    red, green, blue = _colors(
        sh0, sh_rest, i, o0 / distance, o1 / distance, o2 / distance, mask, DEGREE, REST
    )
    bright = tl.maximum(tl.maximum(tl.abs(red), tl.abs(green)), tl.abs(blue))
    fine = _is_finite(a * c + det + x + y + z * z + opacity + length + red + green + blue) & (
        bright <= COLOR_LIMIT
    )
    seen = mask & front & fine & (det > THINNEST * (a + c)) & (opacity >= ALPHA_MIN)
    level = 2 * tl.log(tl.where(seen, opacity / ALPHA_MIN, 1.0))
    ex, ey = tl.sqrt(level * a), tl.sqrt(level * c)
    W, H = tl.load(camera + SIZE_AT), tl.load(camera + SIZE_AT + 1)
    if not WRAPS:
        seen &= (tl.ceil(u - ex) <= W - 1) & (tl.floor(u + ex) >= 0)
    seen &= (tl.ceil(v - ey) <= H - 1) & (tl.floor(v + ey) >= 0)
    # d' Sigma2d^-1 d = (c / det) (dx - b/c dy)² + dy² / c
    sx = tl.sqrt(c / det * (LOG2E / 2))
    fields = (
        u, v, sx, -b / c * sx, tl.sqrt(1 / c * (LOG2E / 2)), tl.log(opacity) * LOG2E,
        tl.maximum(red, 0.0), tl.maximum(green, 0.0), tl.maximum(blue, 0.0), z, ex, ey,
    )  # fmt: skip
    for j in tl.static_range(12):
        tl.store(records + i * RECORD + j, tl.where(seen, fields[j], 0.0), mask=mask)


@triton.jit
@no_type_check
def _sums(slots, slot_begin, pairs_of, i, mask, BLOCK: tl.constexpr):
    """Add each Gaussian's slots, in order."""
    begin = tl.load(slot_begin + i, mask=mask, other=0)
    count = tl.load(pairs_of + i, mask=mask, other=0)
    zero = tl.zeros([BLOCK], tl.float32)
    red, green, blue, deep, h, hx, hy, hxx, hxy, hyy = (
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
    )
    k, most = 0, tl.max(count, 0)
    while k < most:
        here = mask & (k < count)
        row = slots + (begin + k) * SLOT
        red += tl.load(row, mask=here, other=0.0)
        green += tl.load(row + 1, mask=here, other=0.0)
        blue += tl.load(row + 2, mask=here, other=0.0)
        deep += tl.load(row + 3, mask=here, other=0.0)
        h += tl.load(row + 4, mask=here, other=0.0)
        hx += tl.load(row + 5, mask=here, other=0.0)
        hy += tl.load(row + 6, mask=here, other=0.0)
        hxx += tl.load(row + 7, mask=here, other=0.0)
        hxy += tl.load(row + 8, mask=here, other=0.0)
        hyy += tl.load(row + 9, mask=here, other=0.0)
        k += 1
    return red, green, blue, deep, h, hx, hy, hxx, hxy, hyy, count > 0


@triton.jit
@no_type_check
def _shape_gradient(a, b, c, det, h, hxx, hxy, hyy, DIMMED: tl.constexpr):
    """Return Sigma2d's gradient from the moments of h, with the opacity's factor: -K G K, K = Sigma2d^-1, G = dL/dK."""
    A, B, C = c / det, -b / det, a / det
    gA, gB, gC = -hxx / 2, -hxy / 2, -hyy / 2
    m00, m01, m10, m11 = gA * A + gB * B, gA * B + gB * C, gB * A + gC * B, gB * B + gC * C
    da, db, dc = -(A * m00 + B * m10), -2 * (A * m01 + B * m11), -(B * m01 + C * m11)
    if DIMMED:  # of the root of det(Sigma2d); `_area_gradient` or `still_gradient` has that of the other root
        da, db, dc = da - h / 2 * A, db - h * B, dc - h / 2 * C
    return da, db, dc


@triton.jit
@no_type_check
def _area_gradient(r, q, det0, h, f, g):
    """Add h/2 times the gradient of log det0 to those of r and q: det0 = |n|², n = r x q, so h/det0 (q x n, n x r).

    Through the entries of Sigma2d, where det0 is a0 c0 - b², the gradients of needles would lose their digits.
    """
    n = (r[1] * q[2] - r[2] * q[1], r[2] * q[0] - r[0] * q[2], r[0] * q[1] - r[1] * q[0])
    floored = det0 <= DET_FLOOR
    over = tl.where(floored, 0.0, h / tl.where(floored, 1.0, det0))
    return (
        f[0] + over * (q[1] * n[2] - q[2] * n[1]),
        f[1] + over * (q[2] * n[0] - q[0] * n[2]),
        f[2] + over * (q[0] * n[1] - q[1] * n[0]),
    ), (
        g[0] + over * (n[1] * r[2] - n[2] * r[1]),
        g[1] + over * (n[2] * r[0] - n[0] * r[2]),
        g[2] + over * (n[0] * r[1] - n[1] * r[0]),
    )


@triton.jit
@no_type_check
def _factor_gradient(r, q, det0, still, h, f, g, ANTIALIASED: tl.constexpr, LENS: tl.constexpr):
    """Add to the gradients of r and q the part of the opacity's factor that is not of the drawn ellipse."""
    if ANTIALIASED:
        f, g = _area_gradient(r, q, det0, h, f, g)
    elif LENS == 2:
        f, g = still_gradient(r, q, still, h, f, g)
    return f, g


@triton.jit
@no_type_check
def _place_gradient(norms, camera, conic, sums, i, touched, mask):
    """Return the gradient of the image position, and store its norm."""
    A, B, C = conic
    gu, gv = A * sums[5] + B * sums[6], B * sums[5] + C * sums[6]
    nu, nv = gu * tl.load(camera + SIZE_AT) / 2, gv * tl.load(camera + SIZE_AT + 1) / 2
    _store_if(norms, 1, 0, i, tl.sqrt(nu * nu + nv * nv), touched, mask)
    return gu, gv


@triton.jit
@no_type_check
def _color_gradient(
    sh0, sh_rest, grad_sh0, grad_sh_rest, i, direction, colors, sums, mask, touched,
    DEGREE: tl.constexpr, REST: tl.constexpr,
):  # fmt: skip
    """Propagate the colour's gradient to the coefficients; return the gradient of the direction."""
    d0, d1, d2 = direction
    gr = tl.where(touched & (colors[0] > 0), sums[0], 0.0)
    gg = tl.where(touched & (colors[1] > 0), sums[1], 0.0)
    gb = tl.where(touched & (colors[2] > 0), sums[2], 0.0)
    store3(grad_sh0, i, gr * C0, gg * C0, gb * C0, mask)
    e0, e1, e2 = 0.0 * gr, 0.0 * gr, 0.0 * gr
    for j in tl.static_range(1, REST + 1):
        if j < (DEGREE + 1) * (DEGREE + 1):
            basis = tl.where(touched, harmonic(j, d0, d1, d2), 0.0)
            store3(grad_sh_rest, i * REST + j - 1, basis * gr, basis * gg, basis * gb, mask)
            r, g, b = load3(sh_rest, i * REST + j - 1, mask)
            grad_basis = dot3(r, g, b, gr, gg, gb)
            s0, s1, s2 = harmonic_slope(j, d0, d1, d2)
            e0, e1, e2 = e0 + grad_basis * s0, e1 + grad_basis * s1, e2 + grad_basis * s2
        else:
            store3(grad_sh_rest, i * REST + j - 1, 0.0 * gr, 0.0 * gr, 0.0 * gr, mask)
    return e0, e1, e2


@triton.jit
@no_type_check
def _turn_gradient(w, x, y, z, G):
    """Return dL/dq of a unit quaternion from G = dL/dR, without the component along q."""
    dw = 2 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1]))
    dx = 2 * (y * (G[1] + G[3]) + z * (G[2] + G[6]) + w * (G[7] - G[5]) - 2 * x * (G[4] + G[8]))
    dy = 2 * (x * (G[1] + G[3]) + z * (G[5] + G[7]) + w * (G[2] - G[6]) - 2 * y * (G[0] + G[8]))
    dz = 2 * (x * (G[2] + G[6]) + y * (G[5] + G[7]) + w * (G[3] - G[1]) - 2 * z * (G[0] + G[4]))
    along = dw * w + dot3(dx, dy, dz, x, y, z)
    return dw - along * w, dx - along * x, dy - along * y, dz - along * z


@triton.jit
@no_type_check
def _store_if(pointer, stride: tl.constexpr, place: tl.constexpr, i, value, touched, mask):
    """Store a gradient; zero if the Gaussian was not drawn, whose values are undefined."""
    tl.store(pointer + stride * i + place, tl.where(touched, value, 0.0), mask=mask)


@triton.jit
@no_type_check
def _store_shape(grad_quats, grad_log_scales, turn, R, s, t, p, f, g, i, touched, mask):
    """Store the gradients of scales and quaternion, from those of the rows of J W M (f, g)."""
    G = (
        (t[0] * f[0] + p[0] * g[0]) * s[0], (t[0] * f[1] + p[0] * g[1]) * s[1], (t[0] * f[2] + p[0] * g[2]) * s[2],
        (t[1] * f[0] + p[1] * g[0]) * s[0], (t[1] * f[1] + p[1] * g[1]) * s[1], (t[1] * f[2] + p[1] * g[2]) * s[2],
        (t[2] * f[0] + p[2] * g[0]) * s[0], (t[2] * f[1] + p[2] * g[1]) * s[1], (t[2] * f[2] + p[2] * g[2]) * s[2],
    )  # fmt: skip
    for k in tl.static_range(3):
        along = dot3(R[k], R[3 + k], R[6 + k], G[k], G[3 + k], G[6 + k])
        _store_if(grad_log_scales, 3, k, i, along, touched, mask)
    w, x, y, z, length = turn
    found = _turn_gradient(w, x, y, z, G)
    # A turn does not change a round Gaussian; Adam would make a whole step of each rounding error.
    turns = touched & ((s[0] != s[1]) | (s[1] != s[2]))
    for k in tl.static_range(4):
        _store_if(grad_quats, 4, k, i, found[k] / length, turns, mask)


@triton.jit
@no_type_check
def _store_means(
    grad_means, camera, camera_sums, g, w, direction, distance, i, touched, mask, WITH_CAMERA: tl.constexpr
):
    """Store the means' gradient, from that in camera axes (g) and that of the viewing direction (w), and the eye's."""
    along = dot3(w[0], w[1], w[2], direction[0], direction[1], direction[2])
    for k in tl.static_range(3):
        column = (tl.load(camera + k), tl.load(camera + 3 + k), tl.load(camera + 6 + k))
        mean = dot3(column[0], column[1], column[2], g[0], g[1], g[2])
        mean += (w[k] - along * direction[k]) / distance
        _store_if(grad_means, 3, k, i, mean, touched, mask)
        if WITH_CAMERA:  # all formulas depend on mean - eye
            _store_sum(camera_sums, EYE_AT + k, -mean, touched)


@triton.jit
@no_type_check
def _store_seen(grad_seen, at, d, e, deep, w, direction, distance, i, touched, mask):
    """Store the gradients of image position, rows of J W (d, e), depth, and direction: from that of its unit vector."""
    along = dot3(w[0], w[1], w[2], direction[0], direction[1], direction[2])
    for k in tl.static_range(2):
        _store_if(grad_seen, SEEN, k, i, at[k], touched, mask)
    for k in tl.static_range(3):
        _store_if(grad_seen, SEEN, 2 + k, i, d[k], touched, mask)
        _store_if(grad_seen, SEEN, 5 + k, i, e[k], touched, mask)
        _store_if(grad_seen, SEEN, 9 + k, i, (w[k] - along * direction[k]) / distance, touched, mask)
    _store_if(grad_seen, SEEN, 8, i, deep, touched, mask)
    _store_if(grad_seen, SEEN, 12, i, 0.0 * deep, touched, mask)


@triton.jit
@no_type_check
def project_backward_kernel(
    means, quats, log_scales, sh0, sh_rest, logits, camera, seen_by_lens, slots, slot_begin, pairs_of,
    grad_means, grad_quats, grad_log_scales, grad_sh0, grad_sh_rest, grad_logits, norms, camera_sums, n,
    DEGREE: tl.constexpr, REST: tl.constexpr, ANTIALIASED: tl.constexpr, DILATION: tl.constexpr,
    WITH_CAMERA: tl.constexpr, LENS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add slots and propagate to raw parameters: conic -> Sigma2d -> (J W, M); colour -> (coefficients, direction).

    With `WITH_CAMERA`, each program writes its sums of the camera's gradient: R row by row, the eye, fx, fy, cx, cy.
    """
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask = i < n
    sums = _sums(slots, slot_begin, pairs_of, i, mask, BLOCK)
    touched = mask & sums[10]
    if LENS:
        o0, o1, o2, x, y, z, t0, t1, t2, p0, p1, p2 = _through_lens(seen_by_lens, i, mask)
    else:
        o0, o1, o2, x, y, z = into_camera(means, camera, i, mask)
        t0, t1, t2, ratio_x = jacobian_row(camera, 0, x, z)
        p0, p1, p2, ratio_y = jacobian_row(camera, 1, y, z)
    qw, qx, qy, qz, length = unit_quaternion(quats, i, mask)
    R = rotation(qw, qx, qy, qz)
    l0, l1, l2 = load3(log_scales, i, mask)
    s0, s1, s2 = tl.exp(l0), tl.exp(l1), tl.exp(l2)
    r = onto_axes(t0, t1, t2, R, s0, s1, s2)
    q = onto_axes(p0, p1, p2, R, s0, s1, s2)
    a0, b, c0, det0, det = shape_on_screen(r, q, DILATION)
    a, c = a0 + DILATION, c0 + DILATION
    opacity = 1 / (1 + tl.exp(-tl.load(logits + i, mask=mask, other=0.0)))
    _store_if(grad_logits, 1, 0, i, (1 - opacity) * sums[4], touched, mask)
    still = (a, b, c, det)
    if LENS == 2:
        g0, g1, a, b, c, det = blurred(seen_by_lens, i, mask, r, q, still, DILATION)
    gu, gv = _place_gradient(norms, camera, (c / det, -b / det, a / det), sums, i, touched, mask)
    da, db, dc = _shape_gradient(a, b, c, det, sums[4], sums[7], sums[8], sums[9], ANTIALIASED or LENS == 2)
    # From Sigma2d to r and q, the rows of J W M; then to M's rotation and scales, and to J W.
    f = (2 * da * r[0] + db * q[0], 2 * da * r[1] + db * q[1], 2 * da * r[2] + db * q[2])
    g = (2 * dc * q[0] + db * r[0], 2 * dc * q[1] + db * r[1], 2 * dc * q[2] + db * r[2])
    f, g = _factor_gradient(r, q, det0, still, sums[4], f, g, ANTIALIASED, LENS)
    if LENS == 2:
        store_blur_gradient(grad_means, g0, g1, da, db, dc, i, touched, mask)
    _store_shape(
        grad_quats, grad_log_scales, (qw, qx, qy, qz, length), R, (s0, s1, s2), (t0, t1, t2), (p0, p1, p2),
        f, g, i, touched, mask,
    )  # fmt: skip
    d = _along_rows(R, s0 * f[0], s1 * f[1], s2 * f[2])
    e = _along_rows(R, s0 * g[0], s1 * g[1], s2 * g[2])
    distance = tl.sqrt(dot3(o0, o1, o2, o0, o1, o2))
    direction = (o0 / distance, o1 / distance, o2 / distance)
    colors = _colors(sh0, sh_rest, i, direction[0], direction[1], direction[2], mask, DEGREE, REST)
    w0, w1, w2 = _color_gradient(
        sh0, sh_rest, grad_sh0, grad_sh_rest, i, direction, colors, sums, mask, touched, DEGREE, REST
    )
    if LENS:
        _store_seen(grad_means, (gu, gv), d, e, sums[3], (w0, w1, w2), direction, distance, i, touched, mask)
    else:
        _store_pinhole(
            grad_means, camera, camera_sums, (o0, o1, o2), (x, y, z), (ratio_x, ratio_y), (t0, t1, t2), (p0, p1, p2),
            d, e, gu, gv, sums[3], (w0, w1, w2), direction, distance, i, touched, mask, WITH_CAMERA,
        )  # fmt: skip


@triton.jit
@no_type_check
def _store_pinhole(
    grad_means, camera, camera_sums, offset, at, ratio, t, p, d, e, gu, gv, deep, w, direction, distance,
    i, touched, mask, WITH_CAMERA: tl.constexpr,
):  # fmt: skip
    """Store the means' gradient through a pinhole, and the camera's."""
    g = _mean_gradient(camera, at[0], at[1], at[2], ratio[0], ratio[1], t, p, d, e, gu, gv, deep)
    _store_means(grad_means, camera, camera_sums, g, w, direction, distance, i, touched, mask, WITH_CAMERA)
    if WITH_CAMERA:
        _camera_gradient(camera, camera_sums, offset, at, ratio, t, p, d, e, gu, gv, g, touched)


@triton.jit
@no_type_check
def _store_sum(camera_sums, place: tl.constexpr, value, touched):
    """Store a block's sum of a number of the camera's gradient; Gaussians that were not drawn have none."""
    tl.store(
        camera_sums + tl.program_id(0) * CAMERA_NUMBERS + place, tl.sum(tl.where(touched, value, 0.0), 0)
    )


@triton.jit
@no_type_check
def _camera_gradient(camera, camera_sums, offset, at, ratio, t, p, d, e, gu, gv, g, touched):
    """Store the sums for R and the intrinsics. A clamped x/z is a bound of the image, (constant - cx) / fx."""
    fx, fy = tl.load(camera + FOCAL_AT), tl.load(camera + FOCAL_AT + 1)
    x, y, z = at
    r6, r7, r8 = tl.load(camera + 6), tl.load(camera + 7), tl.load(camera + 8)
    w0 = tl.where(ratio[0] == x / z, 0.0, dot3(d[0], d[1], d[2], r6, r7, r8) / z)
    w1 = tl.where(ratio[1] == y / z, 0.0, dot3(e[0], e[1], e[2], r6, r7, r8) / z)
    for k in tl.static_range(3):
        along0, along1 = fx / z * d[k], fy / z * e[k]
        _store_sum(camera_sums, k, g[0] * offset[k] + along0, touched)
        _store_sum(camera_sums, 3 + k, g[1] * offset[k] + along1, touched)
        _store_sum(camera_sums, 6 + k, g[2] * offset[k] - ratio[0] * along0 - ratio[1] * along1, touched)
    focal0 = gu * x / z + dot3(d[0], d[1], d[2], t[0], t[1], t[2]) / fx + w0 * ratio[0]
    focal1 = gv * y / z + dot3(e[0], e[1], e[2], p[0], p[1], p[2]) / fy + w1 * ratio[1]
    _store_sum(camera_sums, FOCAL_AT, focal0, touched)
    _store_sum(camera_sums, FOCAL_AT + 1, focal1, touched)
    _store_sum(camera_sums, MIDDLE_AT, gu + w0, touched)
    _store_sum(camera_sums, MIDDLE_AT + 1, gv + w1, touched)


@triton.jit
@no_type_check
def _along_rows(R, v0, v1, v2):
    """Return R v."""
    return (
        dot3(R[0], R[1], R[2], v0, v1, v2),
        dot3(R[3], R[4], R[5], v0, v1, v2),
        dot3(R[6], R[7], R[8], v0, v1, v2),
    )


@triton.jit
@no_type_check
def _mean_gradient(camera, x, y, z, ratio_x, ratio_y, t, p, d, e, gu, gv, deep):
    """Return the mean's gradient, camera axes, from those of the rows of J W (d, e), image position and depth."""
    u, v = x / z, y / z
    r6, r7, r8 = tl.load(camera + 6), tl.load(camera + 7), tl.load(camera + 8)
    # J W = f/z (W_row - x/z W_2): d/dx gives -f/z² W_2; d/dz gives -(J W)/z + f x/z³ W_2. A clamped x/z is constant.
    w0 = tl.where(ratio_x == u, dot3(d[0], d[1], d[2], r6, r7, r8), 0.0)
    w1 = tl.where(ratio_y == v, dot3(e[0], e[1], e[2], r6, r7, r8), 0.0)
    along = dot3(d[0], d[1], d[2], t[0], t[1], t[2]) + dot3(e[0], e[1], e[2], p[0], p[1], p[2])
    fx, fy = tl.load(camera + FOCAL_AT) / z, tl.load(camera + FOCAL_AT + 1) / z
    gx, gy = fx * gu - fx / z * w0, fy * gv - fy / z * w1
    return gx, gy, deep - u * fx * gu - v * fy * gv - along / z + (fx * u * w0 + fy * v * w1) / z
