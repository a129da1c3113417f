"""Find the splats in a region: exactly the same ones as in the page (`viewer/web/edit_member.js`).

Both sides compute with the float32 parameters converted to float64, by +, -, *, / and comparisons only, in the order
written here. IEEE 754 defines the result of each to the bit, so both find the same splats. No library may compute a
sum, because its order is unspecified, and no product may be fused with a sum. NaN belongs to no region.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64

from gsplat_edu.base.records import Absent
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.cells import Cells, Column, EditWork
from gsplat_edu.edits.document import NEAR
from gsplat_edu.edits.front import Front, in_front
from gsplat_edu.edits.runs import mask_of
from gsplat_edu.scene.gaussians import Gaussians

Members = Bool[np.ndarray, " N"]


@dataclass(frozen=True, eq=False)
class Values:
    """The values of N splats that regions are compared with, float32 numbers as float64.

    Args:
        means: (N, 3) world units.
        log_scales: (N, 3).
        logits: (N,) of the opacities.
        sh0: (N, 3) coefficients of degree 0.
    """

    means: Float64[np.ndarray, "N 3"]
    log_scales: Float64[np.ndarray, "N 3"]
    logits: Float64[np.ndarray, " N"]
    sh0: Float64[np.ndarray, "N 3"]

    @classmethod
    def of(cls, gaussians: Gaussians) -> Values:
        """Return the values of Gaussians."""
        means, log_scales, logits, sh0 = (
            getattr(gaussians, name).detach().to(torch.float32).double().cpu().numpy()
            for name in ("means", "log_scales", "logit_opacities", "sh0")
        )
        return cls(means, log_scales, logits, sh0[:, 0])


def members(region: ops.Region, values: Values, work: EditWork | None = None) -> Members:
    """Return which splats a region holds.

    Args:
        region: The region.
        values: N splats; NaN and infinity are allowed.
        work: Counts the tests: one for each splat, and those of the edges of a lasso and the segments of a stroke.

    Raises:
        ArgumentError: the work is too much.
    """
    work = EditWork() if work is None else work
    work.add(len(values.means))
    with np.errstate(all="ignore"):  # infinite splats
        found: Members = _members(region, values, work)
    return found


def _members(region: ops.Region, values: Values, work: EditWork) -> Any:  # noqa: ANN401
    match region:
        case ops.PictureRectangle(picture, (u0, v0, u1, v1), front):
            return _drawn(
                picture, front, values.means, work, lambda u, v: (u >= u0) & (u <= u1) & (v >= v0) & (v <= v1)
            )
        case ops.Lasso(picture, points, front):
            return _drawn(picture, front, values.means, work, lambda u, v: _in_polygon(u, v, points, work))
        case ops.Brush(picture, radius, points, front):
            return _drawn(
                picture, front, values.means, work, lambda u, v: _on_stroke(u, v, radius, points, work)
            )
        case ops.Sphere(center, radius):
            x, y, z = (values.means[:, i] - center[i] for i in range(3))
            return (x * x + y * y) + z * z <= radius * radius
        case ops.Box():
            return _in_box(region, values.means)
        case ops.Color(low, high):
            within = [_between(values.sh0[:, i], low[i], high[i]) for i in range(3)]
            return within[0] & within[1] & within[2]
        case ops.Opacity(lowest, highest):
            return _between(values.logits, lowest, highest)
        case ops.Size(lowest, highest):
            x, y, z = values.log_scales.T
            return _between(_larger(_larger(x, y), z), lowest, highest)
        case ops.Distance(center, lowest, highest):
            x, y, z = (values.means[:, i] - center[i] for i in range(3))
            squares = [end if isinstance(end, Absent) else end * end for end in (lowest, highest)]
            return _between((x * x + y * y) + z * z, *squares)
        case ops.List(_, runs):
            return mask_of(runs, len(values.means))
    return np.ones(len(values.means), dtype=bool)


def _drawn(
    picture: ops.Picture,
    front: Front | Absent,
    means: Float64[np.ndarray, "N 3"],
    work: EditWork,
    shape: Callable[[Column, Column], Members],
) -> Members:
    """Apply a shape in a picture to the splats that are seen, then the limit of their depths."""
    u, v, z = _seen(picture, means)
    at = np.flatnonzero(z > NEAR)
    at = at[shape(u[at], v[at])]
    if not isinstance(front, Absent):
        at = at[in_front(front, u[at], v[at], z[at], work)]
    result = np.zeros(len(u), dtype=bool)
    result[at] = True
    return result


def _seen(picture: ops.Picture, means: Float64[np.ndarray, "N 3"]) -> tuple[Column, Column, Column]:
    """Project centres to (u, v, z): u = (fx x) / z + cx, v = (fy y) / z + cy. A picture sees those with z > NEAR."""
    a, b, c = (means[:, i] - picture.position[i] for i in range(3))
    x, y, z = ((row[0] * a + row[1] * b) + row[2] * c for row in zip(*picture.rotation, strict=True))
    u = (picture.fx * x) / z + picture.cx
    v = (picture.fy * y) / z + picture.cy
    return u, v, z


def _in_polygon(u: Column, v: Column, points: tuple[ops.Pixels, ...], work: EditWork) -> Members:
    """Even-odd rule within the polygon's bounds: count the edges that cross the ray towards larger u."""
    columns, rows = [p[0] for p in points], [p[1] for p in points]
    near = (u >= min(columns)) & (u <= max(columns)) & (v >= min(rows)) & (v <= max(rows))
    at = np.flatnonzero(near)
    u, v, odd = u[at], v[at], np.zeros(len(at), dtype=bool)
    cells = Cells(u, v, work)
    ax, ay = points[-1]
    for bx, by in points:
        if ay != by:
            # One more column, because the rounded crossing may lie beyond the edge's bounds.
            some = cells.touched(-math.inf, max(ax, bx), min(ay, by), max(ay, by), margin=1)
            here = some[(ay > v[some]) != (by > v[some])]
            odd[here] ^= u[here] < ((bx - ax) * (v[here] - ay)) / (by - ay) + ax
        ax, ay = bx, by
    result = np.zeros(len(near), dtype=bool)
    result[at] = odd
    return result


def _on_stroke(
    u: Column, v: Column, radius: float, points: tuple[ops.Pixels, ...], work: EditWork
) -> Members:
    """Within the radius of a segment, and of the segment's bounds widened by the radius."""
    columns, rows = np.array([p[0] for p in points]), np.array([p[1] for p in points])
    near = (u >= columns.min() - radius) & (u <= columns.max() + radius)
    near &= (v >= rows.min() - radius) & (v <= rows.max() + radius)
    inside = np.flatnonzero(near)
    u, v, found = u[inside], v[inside], np.zeros(len(inside), dtype=bool)
    cells = Cells(u, v, work)
    ax, ay = points[0]
    for bx, by in points[1:] or points:
        low_u, high_u = min(ax, bx) - radius, max(ax, bx) + radius
        low_v, high_v = min(ay, by) - radius, max(ay, by) + radius
        some = cells.touched(low_u, high_u, low_v, high_v)
        some = some[~found[some]]
        p, q = u[some], v[some]
        at = some[(p >= low_u) & (p <= high_u) & (q >= low_v) & (q <= high_v)]
        dx, dy = bx - ax, by - ay
        wx, wy = u[at] - ax, v[at] - ay
        along, length2 = wx * dx + wy * dy, dx * dx + dy * dy
        ex, ey = u[at] - bx, v[at] - by
        aside = wx * dy - wy * dx
        square = radius * radius
        from_start, from_end = wx * wx + wy * wy <= square, ex * ex + ey * ey <= square
        between = aside * aside <= square * length2
        found[at] = np.where(along <= 0.0, from_start, np.where(along >= length2, from_end, between))
        ax, ay = bx, by
    result = np.zeros(len(near), dtype=bool)
    result[inside] = found
    return result


def _in_box(box: ops.Box, means: Float64[np.ndarray, "N 3"]) -> Members:
    """|axis . (mean - centre)| <= half extent along each axis."""
    a, b, c = (means[:, i] - box.center[i] for i in range(3))
    inside = np.ones(len(means), dtype=bool)
    for axis, half in zip(zip(*box.rotation, strict=True), box.half, strict=True):
        along = (axis[0] * a + axis[1] * b) + axis[2] * c
        inside &= (along >= -half) & (along <= half)
    return inside


def _between(values: Column, low: float | Absent, high: float | Absent) -> Members:
    inside: Members = values == values
    if not isinstance(low, Absent):
        inside &= values >= low
    if not isinstance(high, Absent):
        inside &= values <= high
    return inside


def _larger(a: Column, b: Column) -> Column:
    """Return the larger value, or NaN if one is NaN, as Math.max does."""
    larger: Column = np.maximum(a, b)
    return larger
