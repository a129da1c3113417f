"""The operations of an edits file, as values. `docs/EDITS.md` describes each.

Positions, lengths and rotations are in the coordinates of the opened scene: for a run whose capture lies far from zero,
those relative to the run's origin. All operations of a file share these coordinates. `Move` moves selected splats in
them; `Upright` and `Scale` take effect on the whole scene when the result is written.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from gsplat_edu.edits.front import Front
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath

Numbers: TypeAlias = tuple[float, ...]

REPLACE, ADD, SUBTRACT, INTERSECT = HOW = ("replace", "add", "subtract", "intersect")
"""How a selection combines with the one before."""


@dataclass(frozen=True)
class Picture:
    """The camera in whose image a selection was drawn.

    Args:
        position: Centre, world units.
        rotation: Rows of the world-to-camera rotation: right, down, forward.
        fx: Focal length along x, px.
        fy: Focal length along y, px.
        cx: Column of the principal point, px; pixels have integer coordinates.
        cy: Row of the principal point, px.
    """

    position: Numbers
    rotation: tuple[Numbers, Numbers, Numbers]
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class PictureRectangle:
    """Splats whose centres are seen within a rectangle of a picture, u0 <= u <= u1 and v0 <= v <= v1, px.

    As for `Lasso` and `Brush`, `front` limits them to the visible surface; None takes those behind it, too.
    """

    picture: Picture
    corners: Numbers
    front: Front | None = None


@dataclass(frozen=True)
class Lasso:
    """Splats whose centres are seen inside a polygon of a picture, by the even-odd rule; points in px."""

    picture: Picture
    points: tuple[Numbers, ...]
    front: Front | None = None


@dataclass(frozen=True)
class Brush:
    """Splats whose centres are seen within a radius of a polyline in a picture, px."""

    picture: Picture
    radius: float
    points: tuple[Numbers, ...]
    front: Front | None = None


@dataclass(frozen=True)
class Sphere:
    """Splats whose centres lie in a sphere, world units."""

    center: Numbers
    radius: float


@dataclass(frozen=True)
class Box:
    """Splats whose centres lie in a box, world units.

    Args:
        center: Its centre.
        axes: Unit vectors along its sides.
        half: Half its extent along each axis.
    """

    center: Numbers
    axes: tuple[Numbers, Numbers, Numbers]
    half: Numbers


@dataclass(frozen=True)
class Color:
    """Splats whose raw coefficients of degree 0 lie in ranges: low <= sh0 <= high for red, green and blue."""

    low: Numbers
    high: Numbers


@dataclass(frozen=True)
class Opacity:
    """Splats whose logit of the opacity is in a range; None leaves an end open."""

    low: float | None
    high: float | None


@dataclass(frozen=True)
class Size:
    """Splats whose largest log scale is in a range; None leaves an end open."""

    low: float | None
    high: float | None


@dataclass(frozen=True)
class Distance:
    """Splats whose centres have a distance from a point in a range, world units; None leaves an end open."""

    center: Numbers
    low: float | None
    high: float | None


@dataclass(frozen=True)
class List:
    """Splats by their indices in the scene.

    Args:
        reason: Why these, for people.
        runs: Start and count of each run of indices, one after the other, increasing and with gaps.
    """

    reason: str
    runs: tuple[int, ...]


@dataclass(frozen=True)
class Everything:
    """All splats."""


Region: TypeAlias = (
    PictureRectangle | Lasso | Brush | Sphere | Box | Color | Opacity | Size | Distance | List | Everything
)

BY_VALUE = (Color, Opacity, Size, List)
"""Regions that depend on more than the positions of splats."""


@dataclass(frozen=True)
class Select:
    """Change the selection by the splats of a region that are neither deleted nor hidden."""

    how: str
    region: Region


@dataclass(frozen=True)
class Deselect:
    """Select nothing."""


@dataclass(frozen=True)
class Invert:
    """Select what is not selected, and the reverse."""


@dataclass(frozen=True)
class Grow:
    """Select also the visible splats within a radius of a selected one, centre to centre, world units."""

    radius: float


@dataclass(frozen=True)
class Shrink:
    """Deselect the splats within a radius of a visible one that is not selected, centre to centre, world units."""

    radius: float


@dataclass(frozen=True)
class Delete:
    """Delete the selected splats."""


@dataclass(frozen=True)
class Hide:
    """Hide the selected splats: they are neither shown nor selected nor written until `Show`."""


@dataclass(frozen=True)
class Show:
    """Show all hidden splats again."""


@dataclass(frozen=True)
class Crop:
    """Delete all splats outside a box, hidden ones too."""

    box: Box


@dataclass(frozen=True)
class Move:
    """Turn the selected splats about a point, and shift them: m' = R (m - center) + center + translation.

    Args:
        rotation: Rows of R.
        translation: World units.
        center: The point.
    """

    rotation: tuple[Numbers, Numbers, Numbers]
    translation: Numbers
    center: Numbers


@dataclass(frozen=True)
class Upright:
    """Turn the scene so that the plane through three points is the floor: counterclockwise as seen from above."""

    points: tuple[Numbers, Numbers, Numbers]


@dataclass(frozen=True)
class Scale:
    """Scale the scene so that two points have a distance of `length` units of 1 m, cm or mm."""

    points: tuple[Numbers, Numbers]
    length: float
    unit: str


@dataclass(frozen=True)
class StartView:
    """The view in which a page opens, and the pivot of its orbits."""

    view: Keyframe
    pivot: Numbers


@dataclass(frozen=True)
class NamedView:
    """A view by name; another one of the same name replaces it. With a text, it is a step of the page's guided tour."""

    name: str
    view: Keyframe
    text: str = ""


@dataclass(frozen=True)
class RemoveView:
    """Forget a named view."""

    name: str


@dataclass(frozen=True)
class OrderViews:
    """Put the named views in this order; those that are not listed follow, and names without a view have no effect."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class CameraPath:
    """The camera path; None removes it."""

    path: KeyframePath | None


@dataclass(frozen=True)
class Measure:
    """A measured distance, with a note."""

    points: tuple[Numbers, Numbers]
    note: str


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
