"""Shapes that are drawn on the masks of photos: rectangles, polygons and strokes of a round brush."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float64
from msgspec import Meta
from PIL import Image, ImageDraw

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.records import Record, record_of
from gsplat_edu.base.text import legible

MOST_SHAPES, MOST_NUMBERS, LARGEST = 500, 4000, 100_000
"""Largest number of shapes on a photo, of numbers in a shape, and largest coordinate and radius, px."""

BRUSH = "brush:"
"""Begins the text of a stroke, before its radius and its points."""


class BrushStroke(Record, frozen=True, rename={"radius": "brush"}):
    """What a round brush covers on its way.

    Args:
        radius: Radius of the brush, px, at least 1.
        points: x and y of each point of the way, px of the upright photo; they may lie outside it. One point is a
            disc.

    Raises:
        ArgumentError: a point lacks its y, or there are none or too many.
    """

    radius: Annotated[int, Meta(ge=1, le=LARGEST)]
    points: tuple[Annotated[int, Meta(ge=-LARGEST, le=LARGEST)], ...]

    def __post_init__(self) -> None:
        """Check the number of points."""
        count = len(self.points)
        if not count or count % 2 or count > MOST_NUMBERS:
            raise ArgumentError(f"has {count} numbers, but a stroke needs x and y of each point")


Shape = tuple[int, ...] | BrushStroke
"""A stroke; or x and y of two opposite corners of a rectangle, or of the three or more corners of a polygon, px of the
upright photo; a rectangle covers the pixels from its smaller up to its larger coordinates, without the latter."""


def parse_shape(text: str) -> Shape:
    """Read a shape: whole numbers with commas between them, of a stroke after "brush:".

    Raises:
        DatasetError: it is no shape.
    """
    is_stroke, sign = text.startswith(BRUSH), "-?" if text.startswith(BRUSH) else ""
    words = text.removeprefix(BRUSH).split(",")
    if len(words) > MOST_NUMBERS + 1 or not all(re.fullmatch(f"{sign}[0-9]+", word) for word in words):
        form = f"{BRUSH}RADIUS,X,Y,X,Y" if is_stroke else "X0,Y0,X1,Y1"
        raise DatasetError(f"shape {legible(text[:40])}: has to be whole numbers, as {form}")
    numbers = [int(word[:9]) for word in words]
    return checked_shape({"brush": numbers[0], "points": numbers[1:]} if is_stroke else numbers)


def checked_shape(found: object) -> Shape:
    """Return parsed JSON as a shape: a list of numbers, or {"brush": radius, "points": list of numbers}.

    Raises:
        DatasetError: it is no shape.
    """
    try:
        shape: Shape = record_of(
            "shape", found, BrushStroke | tuple[Annotated[int, Meta(ge=0, le=LARGEST)], ...]
        )
    except ArgumentError as error:
        raise DatasetError(str(error)) from None
    if isinstance(shape, tuple) and (len(shape) < 4 or len(shape) % 2 or len(shape) > MOST_NUMBERS):
        raise DatasetError(
            f"shape: has {len(shape)} numbers, but needs x and y of two corners of a rectangle, or of three or more "
            "of a polygon"
        )
    return shape


def shape_text(shape: Shape) -> str:
    """Return a shape as `parse_shape` reads it."""
    if isinstance(shape, BrushStroke):
        return BRUSH + ",".join(map(str, (shape.radius, *shape.points)))
    return ",".join(map(str, shape))


def short_text(shape: Shape) -> str:
    """Return the beginning of a shape's text, for messages."""
    words = shape_text(shape).split(",")
    return ",".join(words[:8]) + (",..." if len(words) > 8 else "")


def shape_document(shape: Shape) -> list[int] | dict[str, Any]:
    """Return a shape for JSON, as `checked_shape` takes it."""
    if isinstance(shape, BrushStroke):
        return {"brush": shape.radius, "points": list(shape.points)}
    return list(shape)


def covered(shapes: Sequence[Shape], W: int, H: int) -> Bool[np.ndarray, "H W"]:
    """Return which pixels of an upright photo of W by H px the shapes cover."""
    canvas = Image.new("L", (W, H))
    pen = ImageDraw.Draw(canvas)
    strokes = [shape for shape in shapes if isinstance(shape, BrushStroke)]
    for shape in shapes:
        if isinstance(shape, BrushStroke):
            continue
        x, y = shape[::2], shape[1::2]
        if len(shape) > 4:
            pen.polygon(list(zip(x, y, strict=True)), fill=255)
        elif min(x) < max(x) and min(y) < max(y):
            pen.rectangle((min(x), min(y), max(x) - 1, max(y) - 1), fill=255)
    found: Bool[np.ndarray, "H W"] = np.asarray(canvas) != 0
    for stroke in strokes:
        _paint(found, stroke)
    return found


def _paint(found: Bool[np.ndarray, "H W"], stroke: BrushStroke) -> None:
    """Cover, in place, the pixels whose centres are within the radius of the stroke's way.

    The places within the radius r of a part of the way are convex: each row of pixels meets them in one interval. Every
    interval adds 1 at its first pixel and -1 behind its last one; running sums of a row then count the intervals over
    each pixel. The time grows with the rows of each part plus the pixels around the stroke, whatever the radius.
    """
    H, W = found.shape
    r, points = float(stroke.radius), np.array(stroke.points, float).reshape(-1, 2)
    low, high = points.min(axis=0) - r, points.max(axis=0) + r
    x0, y0 = (int(min(max(np.floor(low[i]), 0.0), (W, H)[i])) for i in (0, 1))
    x1, y1 = (int(min(max(np.ceil(high[i]), 0.0), (W, H)[i])) for i in (0, 1))
    if x0 >= x1 or y0 >= y1:
        return
    steps = np.zeros((y1 - y0, x1 - x0 + 1), np.int16)
    centers = np.arange(y0, y1) + 0.5
    for a, b in zip(points, points[1:] if len(points) > 1 else points, strict=False):
        begin, end = _interval(a, b, r, centers)
        some = np.flatnonzero(begin <= end)  # pixel i has its centre at i + 0.5
        first = np.clip(np.ceil(begin[some] - 0.5), x0, x1).astype(int) - x0
        behind = np.clip(np.floor(end[some] - 0.5) + 1.0, x0, x1).astype(int) - x0
        steps[some, first] += 1
        steps[some, behind] -= 1
    found[y0:y1, x0:x1] |= steps.cumsum(axis=1, dtype=np.int16)[:, :-1] > 0


def _interval(
    a: Float64[np.ndarray, "2"], b: Float64[np.ndarray, "2"], r: float, rows: Float64[np.ndarray, " R"]
) -> tuple[Float64[np.ndarray, " R"], Float64[np.ndarray, " R"]]:
    """Return the least and the largest x within r of the line from a to b in each row; (inf, -inf) for none."""
    begin, end = np.full(len(rows), np.inf), np.full(len(rows), -np.inf)
    for x, y in (a, b):
        inside = np.abs(rows - y) <= r
        half = np.sqrt(np.maximum(r * r - (rows - y) ** 2, 0.0))
        begin = np.where(inside, np.minimum(begin, x - half), begin)
        end = np.where(inside, np.maximum(end, x + half), end)
    length = float(np.hypot(*(b - a)))
    if length == 0.0:
        return begin, end
    normal = r / length * np.array([a[1] - b[1], b[0] - a[0]])
    corners = (a + normal, b + normal, b - normal, a - normal)
    for (px, py), (qx, qy) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if py == qy:
            continue  # the edges beside it end at its corners
        t = (rows - py) / (qy - py)
        meets, x = (t >= 0.0) & (t <= 1.0), px + t * (qx - px)
        begin = np.where(meets, np.minimum(begin, x), begin)
        end = np.where(meets, np.maximum(end, x), end)
    return begin, end
