"""The operations of an edits file, as values. `docs/EDITS.md` describes each.

Positions, lengths and rotations are in the coordinates of the opened scene: for a run whose capture lies far from zero,
those relative to the run's origin. All operations of a file share these coordinates. `Move` moves selected splats in
them; `Upright` and `Scale` take effect on the whole scene when the result is written.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias, get_args

import numpy as np
from msgspec import Meta

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.records import ABSENT, LINES, ONE_LINE, Absent, Record, as_json
from gsplat_edu.edits.front import FARTHEST_PIXEL, Front, Pixel
from gsplat_edu.edits.runs import MOST_NUMBERS, MOST_SPLATS, check_runs
from gsplat_edu.paths.keyframes import FARTHEST, PathRecord, ViewRecord
from gsplat_edu.scene.camera import ROTATION_TOLERANCE

MOST_OPERATIONS = 100_000
MOST_POINTS = 20_000
"""Points of a lasso or a stroke."""

LONGEST_FOCAL = 1e9
LARGEST_RAW = 1e6
"""Logits, log scales and coefficients are compared with at most this."""

SMALLEST = 1e-30
"""Smallest radius, half extent or focal length."""

LONGEST_NAME, LONGEST_NOTE, LONGEST_TEXT = 200, 1000, 2000

LEAST_SINE = 1e-6
"""Sine of the angle between two sides of three floor points, below which they lie on one line."""

Coordinate = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]
Point: TypeAlias = tuple[Coordinate, Coordinate, Coordinate]
Length = Annotated[float, Meta(ge=SMALLEST, le=FARTHEST)]
Focal = Annotated[float, Meta(ge=SMALLEST, le=LONGEST_FOCAL)]
Side = Annotated[int, Meta(ge=1, le=65_536)]
Entry = Annotated[float, Meta(ge=-2.0, le=2.0)]
Row: TypeAlias = tuple[Entry, Entry, Entry]
Rows: TypeAlias = tuple[Row, Row, Row]
Reach = Annotated[float, Meta(ge=0.0, le=FARTHEST)]
Raw = Annotated[float, Meta(ge=-LARGEST_RAW, le=LARGEST_RAW)]
Pixels: TypeAlias = tuple[Pixel, Pixel]
Name = Annotated[str, Meta(min_length=1, max_length=LONGEST_NAME, pattern=ONE_LINE)]
Note = Annotated[str, Meta(max_length=LONGEST_NOTE, pattern=ONE_LINE)]
How = Literal["replace", "add", "subtract", "intersect"]

REPLACE, ADD, SUBTRACT, INTERSECT = HOW = get_args(How)
"""How a selection combines with the one before."""


class Picture(Record, frozen=True):
    """The camera in whose image a selection was drawn.

    Args:
        position: Centre, world units.
        rotation: From camera to world; its columns are right, down and forward.
        fx: Focal length along x, px.
        fy: Focal length along y, px.
        cx: Column of the principal point, px; pixels have integer coordinates.
        cy: Row of the principal point, px.
        width: Of the picture, px.
        height: Of the picture, px.
    """

    position: Point
    rotation: Rows
    fx: Focal
    fy: Focal
    cx: Pixel
    cy: Pixel
    width: Side
    height: Side

    def __post_init__(self) -> None:
        """Check the rotation."""
        _check_rotation(self.rotation)


class PictureRectangle(Record, frozen=True, tag_field="by", tag="rectangle"):
    """Splats whose centres are seen within a rectangle of a picture, u0 <= u <= u1 and v0 <= v <= v1, px.

    As for `Lasso` and `Brush`, `front` limits them to the visible surface; without it, those behind it count, too.
    """

    camera: Picture
    corners: tuple[Pixel, Pixel, Pixel, Pixel]
    front: Front | Absent = ABSENT

    def __post_init__(self) -> None:
        """Check the order of the corners."""
        u0, v0, u1, v1 = self.corners
        if u0 > u1 or v0 > v1:
            raise ArgumentError("corners: u0, v0 must not exceed u1, v1")


class Lasso(Record, frozen=True, tag_field="by", tag="lasso"):
    """Splats whose centres are seen inside a polygon of a picture, by the even-odd rule; points in px."""

    camera: Picture
    points: Annotated[tuple[Pixels, ...], Meta(min_length=3, max_length=MOST_POINTS)]
    front: Front | Absent = ABSENT


class Brush(Record, frozen=True, tag_field="by", tag="brush"):
    """Splats whose centres are seen within a radius of a polyline in a picture, px."""

    camera: Picture
    radius: Annotated[float, Meta(ge=SMALLEST, le=FARTHEST_PIXEL)]
    points: Annotated[tuple[Pixels, ...], Meta(min_length=1, max_length=MOST_POINTS)]
    front: Front | Absent = ABSENT


class Sphere(Record, frozen=True, tag_field="by", tag="sphere"):
    """Splats whose centres lie in a sphere, world units."""

    center: Point
    radius: Length


class _Sides(Record, frozen=True):
    """A box, world units.

    Args:
        center: Its centre.
        rotation: Its columns are unit vectors along the sides.
        half: Half its extent along each of them.
    """

    center: Point
    rotation: Rows
    half: tuple[Length, Length, Length]

    def __post_init__(self) -> None:
        """Check the rotation."""
        _check_rotation(self.rotation)


class Box(_Sides, frozen=True, tag_field="by", tag="box"):
    """Splats whose centres lie in a box."""


class Color(Record, frozen=True, tag_field="by", tag="color"):
    """Splats whose raw coefficients of degree 0 lie in ranges: low <= sh0 <= high for red, green and blue."""

    low: tuple[Raw, Raw, Raw]
    high: tuple[Raw, Raw, Raw]


class Opacity(Record, frozen=True, tag_field="by", tag="opacity"):
    """Splats whose logit of the opacity is in a range; an absent end is open."""

    low: Raw | Absent = ABSENT
    high: Raw | Absent = ABSENT

    def __post_init__(self) -> None:
        """Check that there is an end."""
        _check_ends(self.low, self.high)


class Size(Record, frozen=True, tag_field="by", tag="size"):
    """Splats whose largest log scale is in a range; an absent end is open."""

    low: Raw | Absent = ABSENT
    high: Raw | Absent = ABSENT

    def __post_init__(self) -> None:
        """Check that there is an end."""
        _check_ends(self.low, self.high)


class Distance(Record, frozen=True, tag_field="by", tag="distance"):
    """Splats whose centres have a distance from a point in a range, world units; an absent end is open."""

    center: Point
    low: Reach | Absent = ABSENT
    high: Reach | Absent = ABSENT

    def __post_init__(self) -> None:
        """Check that there is an end."""
        _check_ends(self.low, self.high)


class List(Record, frozen=True, tag_field="by", tag="list"):
    """Splats by their indices in the scene.

    Args:
        reason: Why these, for people.
        runs: Start and count of each run of indices, one after the other, increasing and with gaps.
    """

    reason: Note
    runs: Annotated[tuple[Annotated[int, Meta(ge=0, le=MOST_SPLATS)], ...], Meta(max_length=MOST_NUMBERS)]

    def __post_init__(self) -> None:
        """Check the runs."""
        check_runs(self.runs)


class Everything(Record, frozen=True, tag_field="by", tag="all"):
    """All splats."""


Region: TypeAlias = (
    PictureRectangle | Lasso | Brush | Sphere | Box | Color | Opacity | Size | Distance | List | Everything
)

BY_VALUE = (Color, Opacity, Size, List)
"""Regions that depend on more than the positions of splats."""


class Select(Record, frozen=True, tag_field="op", tag="select"):
    """Change the selection by the splats of a region that are neither deleted nor hidden."""

    how: How
    region: Region


class Deselect(Record, frozen=True, tag_field="op", tag="deselect"):
    """Select nothing."""


class Invert(Record, frozen=True, tag_field="op", tag="invert"):
    """Select what is not selected, and the reverse."""


class Grow(Record, frozen=True, tag_field="op", tag="grow"):
    """Select also the visible splats within a radius of a selected one, centre to centre, world units."""

    radius: Length


class Shrink(Record, frozen=True, tag_field="op", tag="shrink"):
    """Deselect the splats within a radius of a visible one that is not selected, centre to centre, world units."""

    radius: Length


class Delete(Record, frozen=True, tag_field="op", tag="delete"):
    """Delete the selected splats."""


class Hide(Record, frozen=True, tag_field="op", tag="hide"):
    """Hide the selected splats: they are neither shown nor selected nor written until `Show`."""


class Show(Record, frozen=True, tag_field="op", tag="show"):
    """Show all hidden splats again."""


class Crop(_Sides, frozen=True, tag_field="op", tag="crop"):
    """Delete all splats outside a box, hidden ones too."""


class Move(Record, frozen=True, tag_field="op", tag="move"):
    """Turn the selected splats about a point, and shift them: m' = R (m - center) + center + translation.

    Args:
        rotation: Rows of R.
        translation: World units.
        center: The point.
    """

    rotation: Rows
    translation: Point
    center: Point

    def __post_init__(self) -> None:
        """Check the rotation."""
        _check_rotation(self.rotation)


class Upright(Record, frozen=True, tag_field="op", tag="upright"):
    """Turn the scene so that the plane through three points is the floor: counterclockwise as seen from above."""

    points: tuple[Point, Point, Point]

    def __post_init__(self) -> None:
        """Check that the points span a plane."""
        a, b, c = self.points
        # scaled first: products of large numbers would overflow
        sides = np.array([np.subtract(b, a), np.subtract(c, a)])
        largest = np.abs(sides).max(axis=1)
        if largest.min() > 0:
            first, second = sides / largest[:, None]
            sine = np.linalg.norm(np.cross(first, second)) / (np.linalg.norm(first) * np.linalg.norm(second))
        if largest.min() == 0 or sine < LEAST_SINE:
            raise ArgumentError("points: lie on one line; give three points that span the floor")


class Scale(Record, frozen=True, tag_field="op", tag="scale"):
    """Scale the scene so that two points have a distance of `length` units of 1 m, cm or mm."""

    points: tuple[Point, Point]
    length: Length
    unit: Literal["m", "cm", "mm"]

    def __post_init__(self) -> None:
        """Check that there is such a scale."""
        apart = float(np.linalg.norm(np.subtract(*self.points)))
        if apart < SMALLEST or not SMALLEST <= self.length / apart <= FARTHEST:
            raise ArgumentError(f"points: are {apart:g} apart, which no scale makes {self.length:g}")


class StartView(ViewRecord, frozen=True, tag_field="op", tag="start"):
    """The view in which a page opens, and the pivot of its orbits."""

    pivot: Point


class NamedView(ViewRecord, frozen=True, tag_field="op", tag="view"):
    """A view by name; another one of the same name replaces it. With a text, it is a step of the page's guided tour."""

    name: Name
    text: Annotated[str, Meta(max_length=LONGEST_TEXT, pattern=LINES)] = ""


class RemoveView(Record, frozen=True, tag_field="op", tag="remove_view"):
    """Forget a named view."""

    name: Name


class OrderViews(Record, frozen=True, tag_field="op", tag="order_views"):
    """Put the named views in this order; those that are not listed follow, and names without a view have no effect."""

    names: Annotated[tuple[Name, ...], Meta(max_length=MOST_OPERATIONS)]

    def __post_init__(self) -> None:
        """Check that no view is named twice."""
        first: dict[str, int] = {}
        for i, name in enumerate(self.names):
            if first.setdefault(name, i) != i:
                raise ArgumentError(f"names[{i}]: is {as_json(name)} again; name each view once")


class CameraPath(Record, frozen=True, tag_field="op", tag="path"):
    """The camera path; None removes it."""

    path: PathRecord | None


class Measure(Record, frozen=True, tag_field="op", tag="measure"):
    """A measured distance, with a note."""

    points: tuple[Point, Point]
    note: Note


Operation: TypeAlias = (
    Select
    | Deselect
    | Invert
    | Grow
    | Shrink
    | Delete
    | Hide
    | Show
    | Crop
    | Move
    | Upright
    | Scale
    | StartView
    | NamedView
    | RemoveView
    | OrderViews
    | CameraPath
    | Measure
)


def _check_rotation(rotation: Rows) -> None:
    R = np.array(rotation)
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise ArgumentError(
            "rotation: is not a rotation; its columns must be orthonormal, with determinant 1"
        )


def _check_ends(low: float | Absent, high: float | Absent) -> None:
    if low is ABSENT and high is ABSENT:
        raise ArgumentError("lacks 'low' and 'high'; give one of them, or both")
