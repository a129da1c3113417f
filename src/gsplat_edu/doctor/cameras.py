"""Checks of the cameras: intrinsics, parallax, cameras that look away, holes in what an orbit covers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from gsplat_edu.doctor.finding import Finding, Severity
from gsplat_edu.doctor.geometry import FORWARD, INWARD, Geometry, inside
from gsplat_edu.doctor.survey import Shot, Survey
from gsplat_edu.evaluate.paths import common_up
from gsplat_edu.text import short_number

OFF_CENTRE = 0.1
"""Distance of the principal point from the middle, in sides of the image, from which it is told: lenses sit within a
few per cent, and a photo that was cut after its calibration is off by what was cut."""

WIDEST, NARROWEST = math.radians(125.0), math.radians(8.0)
"""Fields of view, along the longer side, beyond which a pinhole is not believed: on film 36 mm wide a lens of 13 mm has
108 degrees, as the widest of phones, and one of 200 mm has 10."""

ZOOM = 1.25
"""Ratio to the median focal length of photos of one size from which one is told to differ: refining it for each photo
moves it by a few per cent."""

FEW_ZOOMED = 0.2
"""Share of photos that differ so up to which it is a fault; more are a second lens, or a zoom that was used."""

NO_PARALLAX = 5e-3
"""Spread of the cameras, in depths of what they look at, below which depth cannot be told: from one to the other end
a point moves by a degree at most, less than 10 px of 1000."""

SAME_PLACE = 1e-9
"""The same where nothing says how far the subject is, in the size of the coordinates: rounding."""

AWAY = math.radians(45.0)
"""Least angle between a camera's axis and the point or the direction that the others look at for it to look away: more
than half of any usual field of view."""

AWAY_FACTOR = 2.5
"""The angle has to be this many times that of three quarters of the cameras too: close-ups of parts look aside."""

SEES_LITTLE = 0.05
"""A camera that sees a smaller share of the points than this times the median camera looks away."""

ALONE = 0.05
"""A camera none of whose neighbours sees more than this share of what it sees is alone. The least of 158 cameras of
three captures was 0.7."""

SUPPORT = 30
"""Points found in a photo that fix its pose: COLMAP's own bound for placing a photo."""

SUPPORT_SHARE = 0.25
"""A camera with fewer points than that is named if it also has fewer than this share of the median camera's: in
captures with little texture few points are all there are."""

HALF_SUPPORT = 0.5
"""A camera that stands oddly is named if it has fewer than this share of the median camera's points."""

FAR_AWAY = 8.0
"""A camera stands far away whose distance from the middle of all cameras is so many times what three quarters of them
keep. At the ends of a walk it is 1.4 times, on an orbit 1."""

APART = 2.0
"""So does a camera that is farther than this from every other camera, in the same unit. Of 184 cameras of four captures
the loneliest was 0.67 away from its neighbour, one of eleven photos."""

PAST = math.radians(25.0)
"""Least angle at which a camera looks past what the others look at, where it is supported badly too, or where that
point is outside of its picture. The largest of 173 cameras of three captures that look at something is 22 degrees."""

HOLE = math.radians(60.0)
"""Least gap of an orbit that is told: sides seen at more than 30 degrees to their normal are drawn out by half."""

HOLE_FACTOR = 3.0
"""A gap has to be so many times the median one: a turn of six photos has no hole."""

TURN = math.radians(240.0)
"""An orbit is meant to go round where its cameras cover more than this: two thirds. Below, something stands in a corner
or hangs on a wall, and its back was not meant to be seen."""

ONE_HEIGHT = math.radians(10.0)
"""Range of elevations, between the 5th and the 95th of a hundred cameras, below which an orbit has one height."""


def check_intrinsics(survey: Survey) -> list[Finding]:
    """Find intrinsics that no camera has, or that differ from those of the other photos."""
    shots = survey.shots
    zoomed = _zoomed(shots)
    told: dict[str, list[str]] = {}
    first: dict[str, str] = {}
    for shot in shots:
        for kind, sentence in _oddities(shot, shot.name in zoomed):
            told.setdefault(kind, []).append(shot.name)
            first.setdefault(kind, sentence)
    return [
        Finding(
            "intrinsics",
            Severity.WARNING,
            f"{first[kind]} ({len(names)} of {len(shots)} photos)",
            "calibrate again, with one camera for all photos of one zoom: wrong intrinsics blur everything",
            tuple(names) if len(names) < len(shots) else (),
        )
        for kind, names in told.items()
    ]


def _oddities(shot: Shot, zoomed: bool) -> list[tuple[str, str]]:
    """Return what is odd about a photo's intrinsics: its kind, and in words."""
    lens, found = shot.lens, list[tuple[str, str]]()
    fx, fy, cx, cy = (short_number(value, 4) for value in (lens.fx, lens.fy, lens.cx, lens.cy))
    if lens.uneven:
        found.append(("uneven", f"fx is {fx} px and fy {fy}, but real pixels are square"))
    aside = max(abs(lens.cx - (lens.W - 1) / 2) / lens.W, abs(lens.cy - (lens.H - 1) / 2) / lens.H)
    if aside > OFF_CENTRE:
        middle = ", ".join(short_number((side - 1) / 2, 4) for side in (lens.W, lens.H))
        what = f"the principal point ({cx}, {cy}) px is far from the middle, ({middle})"
        found.append(("off centre", what))
    field = 2.0 * math.atan(0.5 * max(lens.W / lens.fx, lens.H / lens.fy))
    if not (NARROWEST < field < WIDEST or lens.fisheye):
        found.append(("field", f"a field of view of {math.degrees(field):.0f} degrees is implausible"))
    if zoomed:
        found.append(("zoom", f"a focal length of {fx} px differs from that of the other photos"))
    return found


def _zoomed(shots: Sequence[Shot]) -> set[str]:
    """Return the photos, where they are few, whose focal length is not that of the others of their size."""
    sizes: dict[tuple[int, int], list[Shot]] = {}
    for shot in shots:
        sizes.setdefault(shot.size, []).append(shot)
    found: set[str] = set()
    for alike in sizes.values():
        median = float(np.median([shot.lens.fx / shot.lens.W for shot in alike]))
        odd = [s.name for s in alike if not 1 / ZOOM < s.lens.fx / s.lens.W / median < ZOOM]
        if len(odd) <= FEW_ZOOMED * len(alike):
            found.update(odd)
    return found


def check_sizes(survey: Survey) -> list[Finding]:
    """Find photos of another size than their camera: right where they were made smaller, wrong where they were cut."""
    other = [shot for shot in survey.shots if shot.size != (shot.lens.W, shot.lens.H)]
    if not other:
        return []
    (w, h), lens = other[0].size, other[0].lens
    first = f"first {w}x{h} for {lens.W}x{lens.H}"
    what = f"{len(other)} of {len(survey.shots)} photos differ in size from their camera, {first}"
    advice = "if photos were cropped, not resized, calibrate again: their intrinsics are only rescaled"
    names = tuple(shot.name for shot in other) if len(other) < len(survey.shots) else ()
    return [Finding("sizes", Severity.NOTE, what, advice, names)]


def check_parallax(survey: Survey) -> list[Finding]:
    """Find captures from one place: nothing tells how far anything is."""
    geometry = survey.geometry
    eyes = geometry.eyes
    spread = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())
    same = spread <= SAME_PLACE * max(1.0, float(np.abs(eyes).max()))
    if not same and (not len(survey.points) or geometry.spread >= NO_PARALLAX):
        return []
    what = (
        "all cameras stand at one place"
        if same
        else (
            f"all cameras stand within {short_number(100 * geometry.spread, 2)} % of the distance to what they see"
        )
    )
    advice = "walk while you take the photos: turning on the spot shows no depth, and no scene can be found"
    return [Finding("no parallax", Severity.FATAL, what, advice)]


def check_away(survey: Survey) -> list[Finding]:
    """Find cameras whose pose is probably wrong: by where they look, where they stand, and what fixes them."""
    away = looking_away(survey.geometry)
    doubtful, found = _doubtful(survey, away), list[Finding]()
    if named := away - doubtful.keys():
        names = tuple(survey.names[i] for i in sorted(named))
        what = f"{len(names)} of {len(survey.shots)} cameras point at something that hardly any other camera sees"
        advice = (
            "look at the photos of the cameras that look away: a wrong pose spoils the scene, take it out"
        )
        found.append(Finding("look away", Severity.WARNING, what, advice, names))
    if doubtful:
        order = sorted(doubtful)
        names, reasons = tuple(survey.names[i] for i in order), tuple(doubtful[i] for i in order)
        what = f"{len(names)} of {len(survey.shots)} cameras have doubtful poses"
        advice = "take out the cameras with doubtful poses: a wrong pose spoils the scene for all others"
        found.append(Finding("doubtful poses", Severity.WARNING, what, advice, names, reasons))
    return found


def _doubtful(survey: Survey, away: set[int]) -> dict[int, str]:
    """Return the cameras whose poses are doubtful, and why.

    If the capture says in which photos its points were found, a camera is named for a small count, or for a lower count
    than most together with an odd position or direction. If it does not, a camera is named if it stands apart from all
    others, or if its picture misses what the others look at; those in `away` are named elsewhere.
    """
    (distances, nearest), angles = _stands(survey.geometry), _past(survey.geometry)
    far = distances > FAR_AWAY
    if not any(survey.observed.values()):
        far |= nearest > APART
        return {
            int(i): f"{distances[i]:.0f} times as far as the others"
            if far[i]
            else "looks past what the others look at"
            for i in np.flatnonzero(far | (angles & _missing(survey.geometry)))
            if far[i] or i not in away
        }
    counts = np.array([survey.observed.get(name, 0) for name in survey.names])
    median = float(np.median(counts))
    few = (counts < SUPPORT) & (counts < SUPPORT_SHARE * median)
    poor = counts < HALF_SUPPORT * median
    found = {}
    for i in np.flatnonzero(few | (poor & (far | angles))).tolist():
        reasons = [f"{counts[i]} points"]
        reasons += [f"{distances[i]:.0f} times as far as the others"] * bool(far[i])
        reasons += ["looks past what the others look at"] * bool(angles[i])
        found[i] = ", ".join(reasons)
    return found


def _stands(geometry: Geometry) -> tuple[Float64[np.ndarray, " C"], Float64[np.ndarray, " C"]]:
    """Return how far each camera is from the middle of all and from its nearest one.

    The unit is the distance from the middle that three quarters of them keep.
    """
    distances = np.linalg.norm(geometry.eyes - np.median(geometry.eyes, axis=0), axis=1)
    kept = max(float(np.quantile(distances, 0.75)), 1e-300)
    nearest = cKDTree(geometry.eyes).query(geometry.eyes, k=[2])[0][:, 0]
    return np.asarray(distances / kept), np.asarray(nearest / kept)


def _missing(geometry: Geometry) -> Bool[np.ndarray, " C"]:
    """Say whose pictures miss the point that most cameras look at, if there is one."""
    if geometry.centre is None:
        return np.zeros(len(geometry.cameras), dtype=np.bool_)
    return np.array([not inside(camera, geometry.centre[None])[0] for camera in geometry.cameras])


def _past(geometry: Geometry) -> Bool[np.ndarray, " C"]:
    """Say which cameras look past what the others look at, where there is such a thing."""
    if geometry.arrangement != INWARD or geometry.centre is None:
        return np.zeros(len(geometry.cameras), dtype=np.bool_)
    angles = geometry.angles_to(geometry.centre)
    return np.asarray(angles > max(PAST, AWAY_FACTOR * float(np.quantile(angles, 0.75))))


def looking_away(geometry: Geometry) -> set[int]:
    """Return the cameras that look past what the others look at, see few points, or see what no other does."""
    return _aside(geometry) | _few_points(geometry) | _alone(geometry)


def _aside(geometry: Geometry) -> set[int]:
    """Return the cameras that look past what the others look at, or another way where they look one way."""
    if geometry.arrangement == INWARD and geometry.centre is not None:
        angles = geometry.angles_to(geometry.centre)
    elif geometry.arrangement == FORWARD:
        angles = geometry.angles_to_mean
    else:
        return set()
    limit = max(AWAY, AWAY_FACTOR * float(np.quantile(angles, 0.75)))
    return set(np.flatnonzero(angles > limit).tolist())


def _few_points(geometry: Geometry) -> set[int]:
    """Return the cameras that see far fewer points than others."""
    counts = geometry.in_sight.sum(axis=1)
    return set(np.flatnonzero(counts < SEES_LITTLE * np.median(counts)).tolist())


def _alone(geometry: Geometry) -> set[int]:
    """Return the cameras whose subject no other camera sees; none where that is how the capture is."""
    best = np.array([max(shares.values(), default=0.0) for shares in geometry.shares])
    return set(np.flatnonzero(best < ALONE).tolist()) if np.median(best) > 2 * ALONE else set()


def check_coverage(survey: Survey) -> list[Finding]:
    """Find directions from which no camera looks, where cameras go round something."""
    geometry = survey.geometry
    if geometry.arrangement != INWARD or geometry.centre is None:
        return []
    azimuths, elevations = _around(geometry, geometry.centre)
    order = np.argsort(azimuths, kind="stable")
    gaps = np.diff(np.r_[azimuths[order], azimuths[order[0]] + 2.0 * math.pi])
    widest = int(np.argmax(gaps))
    if 2.0 * math.pi - gaps[widest] < TURN:
        covered = math.degrees(2.0 * math.pi - float(gaps[widest]))
        what = f"the cameras cover {covered:.0f} degrees around what they look at"
        return [
            Finding(
                "one side",
                Severity.NOTE,
                what,
                "take photos of the other side as well, if it is to be seen: without them the scene is empty there",
            )
        ]
    found = []
    if gaps[widest] > max(HOLE, HOLE_FACTOR * float(np.median(gaps))):
        edges = tuple(survey.names[order[k % len(order)]] for k in (widest, widest + 1))
        what = f"a gap of {math.degrees(gaps[widest]):.0f} degrees without a camera, between {edges[0]} and {edges[1]}"
        advice = f"take photos between where {edges[0]} and {edges[1]} were taken: that side of the scene is guessed"
        found.append(Finding("hole", Severity.WARNING, what, advice))
    low, high = np.quantile(elevations, (0.05, 0.95))
    if high - low < ONE_HEIGHT:
        what = f"all cameras look from about the same height, elevations within {math.degrees(high - low):.0f} degrees"
        advice = "add a round of photos from higher up: without it the scene has holes when seen from there"
        found.append(Finding("one height", Severity.NOTE, what, advice))
    return found


def _around(
    geometry: Geometry, centre: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, " C"], Float64[np.ndarray, " C"]]:
    """Return azimuth and elevation of each camera around a point, radians; up is what is up for most."""
    up = common_up(geometry.cameras)
    offsets = geometry.eyes - centre
    side = np.cross(up, geometry.cameras[0].R[2])
    side = np.cross(up, geometry.cameras[0].R[1]) if np.linalg.norm(side) < 1e-3 else side
    side = side / np.linalg.norm(side)
    azimuths = np.arctan2(offsets @ np.cross(up, side), offsets @ side)
    lengths = np.maximum(np.linalg.norm(offsets, axis=1), 1e-300)
    return azimuths, np.arcsin(np.clip(offsets @ up / lengths, -1.0, 1.0))
