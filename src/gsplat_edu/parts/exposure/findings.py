"""Findings about jumps of exposure or white balance, before and after a training.

Brightness is compared at 3D points that a photo and its neighbours show, so that what else they show does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import Told
from gsplat_edu.data.sparse_depth import tracked_points
from gsplat_edu.data.tracks import visible_points
from gsplat_edu.survey.brightness import (
    JUMP,
    PAIRS,
    SIGMAS,
    Difference,
    agreed,
    difference_of,
    occupied,
    stops_between,
)
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.finding import FEWER_PHOTOS, Examined, Finding, Remedy, Severity, counted
from gsplat_edu.survey.geometry import facing_away
from gsplat_edu.survey.photos import BRIGHT, DARK
from gsplat_edu.survey.trained import Trained, far_below

EXPOSURE = "exposure"
"""Name of the check and of findings about brightness, before and after training."""

CORRECTED = (("appearance", "exposure"),)
"""Options of a training that corrects exposures."""

DIFFERING = 0.08
"""Warn, and correct exposures, when more than this share of neighbouring pairs differs by a jump but no photo jumps:
dark photos in a row agree with one another. Darkening every third photo by 1.5 stops gives 0.125."""

ORDINARY = 16.0
"""A jump must exceed this multiple of the pairs' first quartile. That quartile is 0.03 stops in phone captures and 0.07
if half of the scene is semi-transparent; jumps are much larger."""

TINT = 0.25
"""White balance jumps if one channel differs from the mean of the three by more than this, stops. The limit is lower
than `JUMP` because hue differences are more visible; a phone varies by 0.1."""

DIFFERENT = 0.25
"""A photo differs if its brightness or a channel's tint is off its neighbours' by more than this, stops."""

SHARE = 0.1
"""Correct exposures if at least this fraction of the photos differs. snowmiku97, taken by a phone whose exposure
drifts, has 0.06, and the scene follows with view-dependent colour. Random gains of +-0.7 stops give 0.4."""

SMOOTH = 1.0
"""Sigma of the blur applied to thumbnails, px: about the error of points and poses."""

TRAINED_JUMP = 0.5
"""Warn after a training when a photo is brighter or darker than the scene by more than this, stops. Photos with half
the scene in shadow stay below 0.2."""


def correction_of(survey: Survey) -> Remedy:
    """Choose `--appearance` for a surveyed capture: "exposure" if many photos differ from their neighbours.

    `train --appearance auto` and the advice of `check_exposure` both follow this choice.
    """
    return _correction(survey, Gains(survey))


def _correction(survey: Survey, gains: Gains) -> Remedy:
    if len(survey.shots) < 2 or any(shot.stats.transparent for shot in survey.shots):
        return Remedy("none")
    differ = (np.abs(gains.light) > DIFFERENT) | (gains.tint > DIFFERENT)
    if np.mean(differ) >= SHARE:
        largest = float(np.abs(gains.light).max())
        return Remedy(
            "exposure",
            f"{int(differ.sum())} of {len(differ)} photos differ in brightness or tint from neighbours that see the"
            f" same, by up to {largest:.1f} stops",
        )
    if (share := gains.differing_in_rows) > DIFFERING:
        return Remedy("exposure", _pairs_sentence(share))
    return Remedy("none")


def _pairs_sentence(share: float) -> str:
    return f"{100 * share:.0f} % of consecutive photos differ by more than {JUMP:.1f} stops"


def compares_exposure(survey: Survey) -> bool:
    """Return whether exposures can be compared: by points that several photos show, or by EXIF."""
    return bool(len(survey.points)) or sum(shot.exposure is not None for shot in survey.shots) > 1


def check_exposure(survey: Survey) -> list[Finding]:
    """Find photos whose brightness or tint differs from their neighbours' at shared points."""
    gains = Gains(survey)
    light, tint, corrected = gains.light, gains.tint, _correction(survey, gains).value != "none"
    found = []
    if len(jumping := [i for i in np.argsort(-np.abs(light)) if abs(light[i]) > JUMP]):
        names = tuple(survey.names[i] for i in jumping)
        stops = tuple(f"{light[i]:+.1f}" for i in jumping)
        what = f"{len(names)} of {len(light)} photos are brighter or darker than neighbours that see the same, in stops"
        advice = _advice(corrected, names[0], "if your shadow fell on the scene, remove the photo")
        found.append(_jump(EXPOSURE, what, advice, names, stops, corrected=corrected))
    elif (share := gains.differing_in_rows) > DIFFERING:
        later = "next time, lock the exposure while you take photos"
        found.append(
            _jump(EXPOSURE, _pairs_sentence(share), _advice(corrected, "", later), corrected=corrected)
        )
    if len(tinted := [i for i in np.argsort(-tint) if tint[i] > TINT]):
        names = tuple(survey.names[i] for i in tinted)
        what = f"{len(names)} of {len(tint)} photos have another tint than neighbours that see the same"
        advice = _advice(corrected, names[0], "next time, lock the white balance while you take photos")
        found.append(_jump("white balance", what, advice, names, corrected=corrected))
    return found


def _jump(
    name: str,
    what: str,
    advice: str,
    names: tuple[str, ...] = (),
    stops: tuple[str, ...] = (),
    *,
    corrected: bool,
) -> Finding:
    options, changes = (CORRECTED, ()) if corrected else ((), (FEWER_PHOTOS,) if names else ())
    return Finding(name, Severity.WARNING, what, advice, names, stops, options, changes)


def _advice(corrected: bool, worst: str, then: str) -> str:
    """Advise what `correction_of` chooses; without a correction, to look at the worst photo, if one is named."""
    if corrected:
        return Told(
            f"train with --appearance exposure, which --appearance auto of the recipe fast chooses by itself; {then}",
            f"nothing: a training corrects the exposure by itself; {then}",
        )
    return f"check {worst}: if its exposure or tint jumped, remove it; {then}" if worst else then


class Gains:
    """Brightness and tint of each photo relative to its neighbours.

    The exposure time, aperture and ISO in EXIF decide on brightness where both photos have them, unless shared points
    show that the photos were evened out later. Otherwise colours are compared at the points that both photos show:
    those of COLMAP's tracks, or those that no nearer point hides. The result is the median ratio over the points, then
    the median over the neighbours; 0 if the standard error explains it. Without points and EXIF, all are 0.

    Args:
        survey: The capture.
    """

    def __init__(self, survey: Survey) -> None:
        self._survey = survey

    @cached_property
    def light(self) -> Float64[np.ndarray, " C"]:
        """(C,) how much brighter each photo is, stops; 0 if it cannot be compared or its neighbours disagree."""
        return np.array([agreed(list(differences.values())) for differences in self._light])

    @cached_property
    def tint(self) -> Float64[np.ndarray, " C"]:
        """(C,) largest difference of a channel from the mean of the three, stops; 0 as for `light`."""
        by_channel = [
            [
                agreed(
                    [difference_of(r.stops[:, c] - r.stops.mean(axis=1), r.cells) for r in ratios.values()]
                )
                for ratios in self._ratios
            ]
            for c in range(3)
        ]
        return np.asarray(np.abs(by_channel).max(axis=0))

    @cached_property
    def differing_in_rows(self) -> float:
        """Share of neighbouring pairs that differ by a jump although no photo jumps: dark photos in a row agree.

        Zero if a photo jumps, because it differs from all of its neighbours. Only confirmed pairs count.
        """
        pairs = [(i, j) for i, found in enumerate(self._light) for j in found]
        if not pairs or np.any(np.abs(self.light) > JUMP):
            return 0.0
        stops = [abs(self._light[i][j].stops) for i, j in pairs]
        least = max(JUMP, ORDINARY * float(np.quantile(stops, 0.25)))
        return float(
            np.mean(
                [size > least and self._confirmed(*pair) for size, pair in zip(stops, pairs, strict=True)]
            )
        )

    def _confirmed(self, i: int, j: int) -> bool:
        """Return whether d_ij is certain, and d_ik + d_kj at least half of it in the median of common neighbours k.

        Exposures add up around a triangle of photos; differences by points that one photo hides do not.
        """
        difference, from_i = self._light[i][j], self._light[i]
        around = [from_i[k].stops + self._light[k][j].stops for k in from_i if j in self._light[k]]
        if not around or not difference.is_certain:
            return False
        return float(np.median(around)) * math.copysign(1.0, difference.stops) > 0.5 * abs(difference.stops)

    @cached_property
    def _light(self) -> tuple[dict[int, Difference], ...]:
        """For each photo, how much brighter it is than each neighbour that it can be compared with."""
        exposures, found = [shot.exposure for shot in self._survey.shots], []
        for i, ratios in enumerate(self._ratios):
            differences = {}
            for j in () if i in self._away else self._survey.geometry.neighbours[i].tolist():
                shown = difference_of(ratios[j].stops.mean(axis=1), ratios[j].cells) if j in ratios else None
                here, there = exposures[i], exposures[j]
                recorded = None if here is None or there is None else here - there
                if (difference := _combined(recorded, shown)) is not None:
                    differences[j] = difference
            found.append(differences)
        return tuple(found)

    @cached_property
    def _away(self) -> Container[int]:
        return facing_away(self._survey.geometry)  # another check reports these

    @cached_property
    def _ratios(self) -> tuple[dict[int, Ratios], ...]:
        """For each photo, its ratios to the neighbours that share enough points with it."""
        points, seen = _points_seen(self._survey)
        colors = [self._colors(i, points[rows]) for i, rows in enumerate(seen)]
        found = []
        for i, rows in enumerate(seen):
            ratios = {}
            for j in () if i in self._away else self._survey.geometry.neighbours[i].tolist():
                _, here, there = np.intersect1d(rows, seen[j], assume_unique=True, return_indices=True)
                stops = stops_between(colors[i][here], colors[j][there])
                good = np.isfinite(stops).all(axis=1)
                if good.sum() >= PAIRS:
                    camera = self._survey.geometry.cameras[i]
                    u, v, _ = camera.project(camera.world_to_cam(points[rows[here[good]]]))
                    ratios[j] = Ratios(stops[good], occupied(np.stack([u, v], axis=1), (camera.W, camera.H)))
            found.append(ratios)
        return tuple(found)

    def _colors(self, i: int, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Sample a photo at points; NaN outside the image, its mask or its cut-out, and where the colour is clipped."""
        if not len(points):
            return np.zeros((0, 3))
        shot, camera = self._survey.shots[i], self._survey.geometry.cameras[i]
        image = cv2.GaussianBlur(shot.stats.thumbnail.astype(np.float32), (0, 0), SMOOTH)
        u, v, _ = camera.project(camera.world_to_cam(points))
        columns, rows = (np.nan_to_num(a, nan=-1e6).astype(np.float32)[:, None] for a in (u, v))
        border = (-1.0, -1.0, -1.0)
        colors = cv2.remap(
            image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=border
        )
        colors = colors.reshape(-1, 3).astype(np.float64)
        good = np.all((colors > DARK) & (colors < BRIGHT), axis=1) & np.isfinite(u)
        if (counts := shot.stats.counts) is not None:
            near = cv2.remap(
                counts.view(np.uint8), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
            )
            good &= near.ravel() > 0
        colors[~good] = np.nan
        return colors


class Ratios(NamedTuple):
    """Two photos compared at the points that both show."""

    stops: Float64[np.ndarray, "n 3"]
    """How much brighter the first photo is at each point, by channel, stops."""
    cells: int
    """Number of cells of the first photo that hold at least one of the points."""


def _points_seen(survey: Survey) -> tuple[Float64[np.ndarray, "N 3"], list[Int64[np.ndarray, "..."]]]:
    """Return points, and for each photo the rows of those that it shows."""
    tracked = tracked_points(survey.path, math.inf, 2) if any(survey.observed.values()) else None
    if tracked is not None:
        nothing = np.zeros(0, np.int64)
        return tracked.points, [tracked.seen.get(name, nothing) for name in survey.names]
    points = survey.geometry.some_points
    return points, [visible_points(camera, points).points for camera in survey.geometry.cameras]


def _combined(recorded: float | None, shown: Difference | None) -> Difference | None:
    """Return the difference that EXIF records, or none where points contradict it; without EXIF, what points show."""
    if recorded is None:
        return shown
    if shown is not None:
        most = shown.stops * math.copysign(1.0, recorded) + SIGMAS * shown.error
        if most < 0.5 * abs(recorded):  # somebody evened the photos out, or a flash did
            return Difference(0.0, 0.0)
    return Difference(recorded, 0.0)


class Beforehand(NamedTuple):
    """What the photos alone tell about their exposure."""

    findings: Sequence[Finding] = ()
    """Jumps between them."""
    uncompared: str = ""
    """Why they were not compared; empty if they were."""
    correction: str = "none"
    """What `--appearance auto` chooses (`correction_of`)."""


def beforehand(survey: Callable[[], Survey]) -> Beforehand:
    """Check the photos of a run as before its training.

    Args:
        survey: Surveys the capture.
    """
    try:
        surveyed = survey()
    except DatasetError as error:
        return Beforehand(uncompared=str(error))
    if len(surveyed.shots) < 2:
        return Beforehand(uncompared="fewer than two photos can be read")
    if not compares_exposure(surveyed):
        return Beforehand(uncompared="the capture has no points, and its photos no EXIF exposure")
    return Beforehand(check_exposure(surveyed), correction=correction_of(surveyed).value)


def judged_exposure(run: Trained, appearance: str) -> Examined:
    """Report photos whose brightness differs from the scene's, and jumps between photos that the scene fits.

    Args:
        run: The run. If its training corrected exposures, its residuals compare corrected renders.
        appearance: The setting of its training.
    """
    before = Beforehand()
    if appearance != "none":
        facts = [(EXPOSURE, "each render was given its photo's exposure first, as in the training")]
    else:
        before = before if run.survey is None else beforehand(run.survey)
        why = f"compared with the scene only, not between photos: {before.uncompared}"
        facts = [(EXPOSURE, why)] if before.uncompared else []
    return Examined({EXPOSURE: check_jumps(run, before)}, facts)


def check_jumps(run: Trained, before: Beforehand) -> list[Finding]:
    """Report photos that are brighter or darker than the scene, and what was found before the training.

    Args:
        run: The run.
        before: What the photos alone tell.
    """
    views = (*run.train, *run.test)
    # The render of an unfinished scene is too dark in every view.
    usual = float(np.median([view.stops for view in views])) if views else 0.0
    off = sorted(
        (v for v in views if abs(v.stops - usual) > TRAINED_JUMP), key=lambda v: -abs(v.stops - usual)
    )
    names = tuple(view.name for view in off)
    stops = tuple(f"{view.stops - usual:+.1f}" for view in off)
    what = f"{counted(len(off), 'photo')} brighter or darker than the scene, in stops"
    advice: str = "remove the photos: the scene reproduces the jumps with fog"
    options = CORRECTED if before.correction == "exposure" else ()
    if options:
        advice = Told(
            f"train with --appearance exposure, or {advice}", f"train with exposure correction, or {advice}"
        )
    found = [Finding(EXPOSURE, Severity.WARNING, what, advice, names, stops, options)] if off else []
    # A scene that fits photos of differing exposure hides the difference, so findings from the photos alone count too.
    hidden = "the scene fits them nevertheless, with fog or view-dependent colours"
    unexplained = {view.name for views in (run.train, run.test) for view in far_below(views)}
    found += [
        one if unexplained & set(one.images) else replace(one, sentence=f"{one.sentence}; {hidden}")
        for one in before.findings
        if one.name != EXPOSURE or not one.images or not set(one.images) <= set(names)
    ]
    return found
