"""Checks of the cameras: implausible intrinsics, missing parallax, cameras facing away, gaps in an orbit's coverage."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.text import Told, short_number
from gsplat_edu.data.dataset import TEST_EVERY
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.doctor.gap import HOLE, ring_of
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import FAR_AWAY, SAME_PLACE, far_ratios, settled_eyes, stray_eyes
from gsplat_edu.survey.capture import Shot, Survey
from gsplat_edu.survey.finding import FEWER_PHOTOS, MORE_PHOTOS, NAMED, Finding, Severity, command
from gsplat_edu.survey.geometry import AWAY_FACTOR, INWARD, Geometry, facing_away, inside
from gsplat_edu.survey.proof import Verdict
from gsplat_edu.train.capacity import advised_side

OFF_CENTRE = 0.1
"""Warn when the principal point is farther than this from the image centre, as a fraction of the image's side. Lenses
are centred within a few per cent; cropping a photo after its calibration moves the centre."""

WIDEST, NARROWEST = math.radians(125.0), math.radians(8.0)
"""Limits of a plausible pinhole's field of view along the longer side. On a sensor 36 mm wide, a 13 mm lens (the widest
of phones, in 35 mm equivalent) has 108 degrees and a 200 mm lens has 10."""

ZOOM = 1.25
"""Warn when a focal length differs from the median of all photos of the same size by more than this factor. Refining it
per photo changes it by a few per cent only."""

INDIVIDUAL = 0.5
"""Cameras are calibrated one by one if more than this share of the photos has intrinsics of its own."""

FEW_ZOOMED = 0.2
"""Up to this share of differing photos is a fault; more indicate a second lens or a zoom."""

NO_PARALLAX = 5e-3
"""Depth cannot be estimated if the cameras' spread is below this multiple of the subject's depth: a point then moves by
at most one degree across all photos, less than 10 px of 1000."""

SUPPORT = 30
"""A pose is reliable with at least this many points observed in the photo: COLMAP's own limit for registration."""

SUPPORT_SHARE = 0.25
"""A camera with fewer points is reported only if it also has less than this share of the median camera's count: in
captures with little texture every photo has few points."""

HALF_SUPPORT = 0.5
"""A camera with an odd position or direction is reported below this share of the median camera's points."""

SPECK = 0.04
"""A stray camera's pose is certainly wrong if all that the others see would be smaller in its photo than this fraction
of the longer side. A photo of 60 degrees shows it so from 43 times the distance of the others; a telephoto lens, or a
drone's photo with points of its own, shows more."""

APART = 2.0
"""A camera is also far away if its nearest neighbour is farther than this, in units of that 75th percentile. The
largest such distance among 184 cameras of four captures was 0.67, in a capture of eleven photos."""

PAST = math.radians(25.0)
"""A camera with few observed points, or without the common centre in its image, is reported if its axis misses that
centre by more than this. The largest angle among 173 inward-facing cameras of three captures is 22 degrees."""

TURN = math.radians(240.0)
"""Cameras that cover more than this angle, two thirds of a turn, are meant as a full orbit. With less, the subject is
in a corner or on a wall, and its back is not meant to be seen."""

ONE_HEIGHT = math.radians(10.0)
"""All cameras are at one height if their elevations, 5th to 95th percentile, differ by less than this."""


def check_intrinsics(survey: Survey) -> list[Finding]:
    """Find implausible intrinsics, and focal lengths that differ from those of the other photos."""
    shots = survey.shots
    zoomed = _zoomed(shots)
    individual = len({(s.lens.fx, s.lens.fy, s.lens.cx, s.lens.cy) for s in shots}) > INDIVIDUAL * len(shots)
    camera = "each of these cameras" if individual else "with one camera for all photos of one zoom"
    flagged: dict[str, list[str]] = {}
    first: dict[str, str] = {}
    for shot in shots:
        for kind, sentence in _oddities(shot, shot.name in zoomed):
            flagged.setdefault(kind, []).append(shot.name)
            first.setdefault(kind, sentence)
    return [
        Finding(
            "intrinsics",
            Severity.WARNING,
            f"{first[kind]} ({len(names)} of {len(shots)} photos)",
            f"calibrate again, {camera}: wrong intrinsics blur everything",
            tuple(names) if len(names) < len(shots) else (),
            certain=kind == "field",
        )
        for kind, names in flagged.items()
    ]


def _oddities(shot: Shot, zoomed: bool) -> list[tuple[str, str]]:
    """Return the faults of a photo's intrinsics as (kind, sentence)."""
    lens, found = shot.lens, list[tuple[str, str]]()
    fx, fy, cx, cy = (short_number(value, 4) for value in (lens.fx, lens.fy, lens.cx, lens.cy))
    if lens.uneven:
        found.append(("uneven", f"fx is {fx} px and fy {fy}, but real pixels are square"))
    aside = max(abs(lens.cx - (lens.W - 1) / 2) / lens.W, abs(lens.cy - (lens.H - 1) / 2) / lens.H)
    if aside > OFF_CENTRE:
        middle = ", ".join(short_number((side - 1) / 2, 4) for side in (lens.W, lens.H))
        what = f"the principal point ({cx}, {cy}) px is far from the image centre, ({middle})"
        found.append(("off centre", what))
    field = 2.0 * math.atan(0.5 * max(lens.W / lens.fx, lens.H / lens.fy))
    if not (NARROWEST < field < WIDEST or lens.wide):
        found.append(("field", f"a field of view of {math.degrees(field):.0f} degrees is implausible"))
    if zoomed:
        found.append(("zoom", f"a focal length of {fx} px differs from that of the other photos"))
    return found


def _zoomed(shots: Sequence[Shot]) -> set[str]:
    """Return the few photos whose focal length differs from that of the others of their size."""
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
    """Find photos whose size differs from their camera's: correct for resized photos, wrong for cropped ones."""
    other = [
        shot
        for shot in survey.shots
        if shot.size != (shot.lens.W, shot.lens.H) and not isinstance(shot.lens, FaceLens)
    ]
    if not other:
        return []
    (w, h), lens = other[0].size, other[0].lens
    first = f"first {w}x{h} for {lens.W}x{lens.H}"
    what = f"{len(other)} of {len(survey.shots)} photos differ in size from their camera, {first}"
    advice = "if the photos were cropped, not resized, calibrate again: intrinsics are only rescaled"
    names = tuple(shot.name for shot in other) if len(other) < len(survey.shots) else ()
    return [Finding("sizes", Severity.NOTE, what, advice, names)]


def side_for_training(survey: Survey) -> int | None:
    """Return the longest side to which photos should be reduced, px; None to keep their size."""
    sizes = [shot.size for shot in survey.shots]
    return advised_side(sizes, len(sizes) - len(sizes) // TEST_EVERY) if sizes else None


def check_resolution(survey: Survey) -> list[Finding]:
    """Find photos that show more than the planned Gaussians resolve."""
    if (side := side_for_training(survey)) is None:
        return []
    W, H = max((shot.size for shot in survey.shots), key=max)
    what = f"photos of {1e-6 * W * H:.1f} megapixels cost time, but the planned Gaussians do not resolve them"
    advice = Told(
        f"train with --resolution auto, which reduces the photos to {side} px",
        f"train with photos that are reduced to {side} px",
    )
    return [Finding("resolution", Severity.NOTE, what, advice, options=(("resolution", AUTO),))]


def check_parallax(survey: Survey) -> list[Finding]:
    """Find captures taken from one place, which contain no depth information."""
    geometry = survey.geometry
    eyes = settled_eyes(geometry.cameras)
    spread = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())
    same = spread <= SAME_PLACE * max(1.0, float(np.abs(eyes).max()))
    if not same and (not len(survey.points) or geometry.spread >= NO_PARALLAX):
        return []
    what = (
        "all cameras are at one place"
        if same
        else (
            f"the cameras' positions differ by {short_number(100 * geometry.spread, 2)} % of the subject's distance"
        )
    )
    advice = "walk while you take the photos: photos from one spot contain no depth, so no scene can be reconstructed"
    return [Finding("no parallax", Severity.FATAL, what, advice, certain=True)]


def check_away(survey: Survey) -> list[Finding]:
    """Find cameras whose pose is probably wrong, from their direction, position and observed points."""
    wrong = wrong_poses(survey.geometry)
    away = facing_away(survey.geometry) - wrong
    doubtful, found = _doubtful(survey, away), list[Finding]()
    doubtful = {i: reason for i, reason in doubtful.items() if i not in wrong}
    if named := away - doubtful.keys():
        names = tuple(survey.names[i] for i in sorted(named))
        what = (
            f"{len(names)} of {len(survey.shots)} cameras point at something that almost no other camera sees"
        )
        advice = "check the photos of the cameras facing away, and remove those with a wrong pose: they spoil the scene"
        found.append(Finding("facing away", Severity.WARNING, what, advice, names, changes=(FEWER_PHOTOS,)))
    if doubtful:
        order = sorted(doubtful)
        names, reasons = tuple(survey.names[i] for i in order), tuple(doubtful[i] for i in order)
        what = f"{len(names)} of {len(survey.shots)} cameras have doubtful poses"
        advice = "remove the cameras with doubtful poses: a wrong pose spoils the scene for all others"
        found.append(
            Finding("doubtful poses", Severity.WARNING, what, advice, names, reasons, changes=(FEWER_PHOTOS,))
        )
    return found


def check_agreement(survey: Survey) -> list[Finding]:
    """Find poses that the photos contradict, as `gsplat_edu.survey.proof` compares them."""
    proof = survey.proof
    if proof is not None and proof.verdict is Verdict.MISREAD:
        advice = "correct the file of the poses for other programs; training reads them as the photos show"
        return [Finding("misread poses", Severity.WARNING, str(proof), advice)]
    if proof is not None and proof.verdict is Verdict.DISAGREE:
        advice = "give the poses of these photos, or find new ones: gsplat-edu sfm"
        return [Finding("foreign poses", Severity.WARNING, str(proof), advice)]
    return []


def check_wrong_poses(survey: Survey) -> list[Finding]:
    """Find cameras whose pose is certainly wrong: alone, far away, and seeing of the scene no more than a speck."""
    order = sorted(wrong_poses(survey.geometry))
    if not order:
        return []
    names, ratios = tuple(survey.names[i] for i in order), far_ratios(survey.geometry.eyes)
    what = f"{len(names)} of {len(survey.shots)} cameras are so far away that the scene is a speck in their photos"
    advice = Told(
        f"leave them out, as a training does by itself: {command('leave-out', survey.path, *names[:NAMED])}",
        "leave out the photos with wrong poses, as a training does by itself",
    )
    values = tuple(f"{ratios[i]:.0f} times as far as the others" for i in order)
    return [
        Finding(
            "wrong poses",
            Severity.WARNING,
            what,
            advice,
            names,
            values,
            changes=(FEWER_PHOTOS,),
            certain=True,
            leaves_out=True,
        )
    ]


def wrong_poses(geometry: Geometry) -> set[int]:
    """Return the cameras whose pose is certainly wrong.

    Each is a stray (`gsplat_edu.scene.rig.stray_eyes`), and both what the other cameras stand around and the points in
    its view are, if they are in its photo at all, smaller than `SPECK`.
    """
    stray = stray_eyes(geometry.eyes)
    settled = geometry.eyes[~stray]
    return {
        i
        for i in np.flatnonzero(stray).tolist()
        if max(_seen_size(geometry.cameras[i], part) for part in (settled, geometry.some_points)) < SPECK
    }


def _seen_size(camera: Camera, points: Float64[np.ndarray, "n 3"]) -> float:
    """Return the size of the points inside a photo, 10th to 90th percentile, as a fraction of its longer side."""
    u, v, _ = camera.project(camera.world_to_cam(points[inside(camera, points)]))
    if len(u) < 2:
        return 0.0
    low, high = np.quantile(np.stack([u, v]), (0.1, 0.9), axis=1)
    return float((high - low).max()) / max(camera.W, camera.H)


def _doubtful(survey: Survey, away: set[int]) -> dict[int, str]:
    """Return the cameras whose poses are doubtful, with the reasons.

    If the capture records which photos observe which points, a camera is doubtful if its count is very low, or if its
    count is below average and its position or direction is odd. Otherwise a camera is doubtful if it is far from all
    others, or if its image misses their common centre; cameras in `away` are reported separately.
    """
    distances, angles = far_ratios(survey.geometry.eyes), _past(survey.geometry)
    far = distances > FAR_AWAY
    if not any(survey.observed.values()):
        far |= _nearest(survey.geometry) > APART
        return {
            int(i): f"{distances[i]:.0f} times as far as the others"
            if far[i]
            else "points away from the common subject"
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
        reasons += ["points away from the common subject"] * bool(angles[i])
        found[i] = ", ".join(reasons)
    return found


def _nearest(geometry: Geometry) -> Float64[np.ndarray, " C"]:
    """Return each camera's distance from its nearest neighbour, in the unit of `far_ratios`."""
    distances = np.linalg.norm(geometry.eyes - np.median(geometry.eyes, axis=0), axis=1)
    usual = max(float(np.quantile(distances, 0.75)), 1e-300)
    return np.asarray(cKDTree(geometry.eyes).query(geometry.eyes, k=[2])[0][:, 0] / usual)


def _missing(geometry: Geometry) -> Bool[np.ndarray, " C"]:
    """Flag cameras without the common centre in their image; none if there is no centre."""
    if geometry.centre is None:
        return np.zeros(len(geometry.cameras), dtype=np.bool_)
    return np.array([not inside(camera, geometry.centre[None])[0] for camera in geometry.cameras])


def _past(geometry: Geometry) -> Bool[np.ndarray, " C"]:
    """Flag inward-facing cameras whose axis misses the common centre by a large angle."""
    if geometry.arrangement != INWARD or geometry.centre is None:
        return np.zeros(len(geometry.cameras), dtype=np.bool_)
    angles = geometry.angles_to(geometry.centre)
    return np.asarray(angles > max(PAST, AWAY_FACTOR * float(np.quantile(angles, 0.75))))


def check_coverage(survey: Survey) -> list[Finding]:
    """Find gaps in the directions from which cameras see a common subject."""
    ring = ring_of(survey.geometry)
    if ring is None:
        return []
    if 2.0 * math.pi - ring.widest < TURN:
        covered = math.degrees(2.0 * math.pi - ring.widest)
        what = f"the cameras cover {covered:.0f} degrees around their subject"
        return [
            Finding(
                "one side",
                Severity.NOTE,
                what,
                "if the other side is to be seen, take photos of it too: without them the scene is empty there",
            )
        ]
    found = []
    if ring.has_gap(HOLE):
        edges = [survey.names[end] for end in ring.ends]
        what = f"a gap of {math.degrees(ring.widest):.0f} degrees without a camera, between {edges[0]} and {edges[1]}"
        advice = (
            f"take photos between the places of {edges[0]} and {edges[1]}: that side of the scene is guessed"
        )
        found.append(Finding("hole", Severity.WARNING, what, advice, changes=(MORE_PHOTOS,)))
    low, high = np.quantile(ring.elevations, (0.05, 0.95))
    if high - low < ONE_HEIGHT:
        what = f"all cameras are at about the same height, elevations within {math.degrees(high - low):.0f} degrees"
        advice = "add an orbit of photos from higher up: without it the scene has holes from there"
        found.append(Finding("one height", Severity.NOTE, what, advice))
    return found
