"""Motion blur in project: what g g' adds to a dilated ellipse and takes from the opacity, and the backward pass.

`gsplat_edu.render.cuda.sight` has found g, the blur's standard deviations, px.
"""

from __future__ import annotations

from typing import no_type_check

import triton
import triton.language as tl

from gsplat_edu.render.cuda.gaussian import dot3
from gsplat_edu.render.cuda.sight import SEEN


@triton.jit
@no_type_check
def blurred(seen, i, mask, r, q, ellipse, DILATION: tl.constexpr):
    """Return g and the blurred a, b, c and determinant of a dilated ellipse.

    No term of the determinants' difference is negative.
    """
    a, b, c, det = ellipse
    g0 = tl.load(seen + i * SEEN + 14, mask=mask, other=0.0)
    g1 = tl.load(seen + i * SEEN + 15, mask=mask, other=0.0)
    along = (g0 * q[0] - g1 * r[0], g0 * q[1] - g1 * r[1], g0 * q[2] - g1 * r[2])
    more = dot3(along[0], along[1], along[2], along[0], along[1], along[2]) + DILATION * (g0 * g0 + g1 * g1)
    return g0, g1, a + g0 * g0, b + g0 * g1, c + g1 * g1, det + more


@triton.jit
@no_type_check
def still_gradient(r, q, still, h, f, g):
    """Add h/2 times the gradient of log det(Sigma2d + d I), the dilated determinant before the blur: h Sigma2d^-1 r."""
    a, b, c, det = still
    over = h / det
    return (
        f[0] + over * (c * r[0] - b * q[0]),
        f[1] + over * (c * r[1] - b * q[1]),
        f[2] + over * (c * r[2] - b * q[2]),
    ), (
        g[0] + over * (a * q[0] - b * r[0]),
        g[1] + over * (a * q[1] - b * r[1]),
        g[2] + over * (a * q[2] - b * r[2]),
    )


@triton.jit
@no_type_check
def store_blur_gradient(grad_seen, g0, g1, da, db, dc, i, touched, mask):
    """Store the gradient of g from that of the blurred ellipse; zero if the Gaussian was not drawn."""
    tl.store(grad_seen + i * SEEN + 14, tl.where(touched, 2 * da * g0 + db * g1, 0.0), mask=mask)
    tl.store(grad_seen + i * SEEN + 15, tl.where(touched, 2 * dc * g1 + db * g0, 0.0), mask=mask)
