"""Checks of the pixels: blurred photos, duplicates, and jumps of exposure or white balance.

Each photo is compared with neighbours that see the same subject. A photo of a plain wall has little detail, but so do
its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from gsplat_edu.base.text import Told
from gsplat_edu.doctor.cameras import facing_away
from gsplat_edu.doctor.finding import ALL_PHOTOS, FEWER_PHOTOS, Finding, Severity, counted
from gsplat_edu.doctor.geometry import inside
from gsplat_edu.doctor.photos import BRIGHT, COARSE, DARK, GAMMA, WORK_SIDE
from gsplat_edu.doctor.survey import Shot, Survey

EXPOSURE = "exposure"
"""Name of findings about brightness, before and after training."""

CORRECTED = (("appearance", "exposure"),)
"""Options of a training that corrects exposures."""

ENOUGH = 3
"""A photo with fewer neighbours than this is compared with all photos instead."""

BLUR = 0.3
"""A photo is blurred if it loses more detail than this: natural logarithm of gradient energy in one direction. Two of
158 photos of three captures exceed it and are visibly blurred; one at 0.29 is slightly blurred. Motion blur of 8 px
in 1024 costs 0.4 to 0.8, blur of 4 px 0.1 to 0.3."""

BLUR_SPREAD = 3.0
"""The loss must also exceed 3 sigma, with sigma estimated from the sharper half of the capture."""

CHANCE = 3.5
"""The loss must also exceed this multiple of sqrt(2 / n), the standard deviation of the logarithm of a mean of n
squares: the expected maximum over eight directions and some hundred photos. n is the photo's area divided by the
smoothing area of its coarse gradients, 4 pi 4². For photos of 500 px and more, this limit is below `BLUR`."""

DUPLICATE = 0.05
"""Two photos are duplicates if their RMS difference is below this, at 32 px and unit contrast. Saving a photo again as
a JPEG of quality 50 changes it by 0.02 (0.04 if it is small and finely textured); a shift by a hundredth of its width,
by 0.2. The smallest difference in three captures was 0.12, between two video frames."""

DUPLICATE_SIDE = 32

DUPLICATE_MOTION = 0.015
"""Duplicates contradict their poses if these imply a shift above this, in image widths. Equal pixels can hide a shift
of 0.003, and poses are not exact."""

SAME_POSE = 1e-4
"""Two poses are equal if their positions differ by less than this multiple of the subject's depth, and their rotations
by less than this in radians: a tenth of a pixel in 1000."""

JUMP = 0.4
"""Exposure jumps if it differs from the neighbours' by more than this, stops: a grey of 128 becomes 113, an error of
25 dB. Of 97 phone photos with automatic exposure, 94 stay below 0.3."""

DIFFERING = 0.08
"""Warn when more than this share of neighbouring pairs differs by a jump: dark photos in a row agree with one another.
fox has 0.006, snowmiku97 0.035; darkening every third photo by 1.5 stops gives 0.125 and more."""

ORDINARY = 16.0
"""A jump must exceed this multiple of the pairs' first quartile. That quartile is 0.03 stops in phone captures and 0.07
if half of the scene is semi-transparent; jumps are much larger."""

TINT = 0.25
"""White balance jumps if one channel differs from the mean of the three by more than this, stops. The limit is lower
than `JUMP` because hue differences are more visible; a phone varies by 0.1."""

ON_RAYS = 1.5
"""Factor on both limits if the capture has no points, since the compared places then match only roughly."""

AGREEING = 0.75
"""This share of the neighbours must show at least half of the difference, so that a shadow's edge does not count."""

PAIRS = 20
"""Two photos are compared if they share at least this many points."""

MISMATCH = 0.8
"""Two photos show different things if their ratios' median absolute deviation exceeds this, stops."""

TINT_MISMATCH = 0.3
"""The same limit for a channel relative to the mean of the three: surfaces differ less in hue than in brightness."""

SMOOTH = 1.0
"""Sigma of the blur applied to thumbnails, px: about the error of points and poses."""

SMOOTH_ON_RAYS = 2.5
"""The same if the capture has no points, so that a constant depth is assumed."""


def check_blur(survey: Survey) -> list[Finding]:
    """Find photos with less fine detail than their neighbours in some direction, inside of masks and cut-outs."""
    losses = detail_losses(survey)
    middle = float(np.median(losses))
    sharper = middle - float(np.quantile(losses, 0.16))
    limits = [max(BLUR, middle + BLUR_SPREAD * sharper, _chance(shot)) for shot in survey.shots]
    worst_first = [i for i in np.argsort(-losses) if losses[i] > limits[i]]
    if not worst_first:
        return []
    names = tuple(survey.names[i] for i in worst_first)
    what = f"{len(names)} of {len(losses)} photos show less detail than their neighbours"
    advice = f"remove or retake the blurred photos, first {names[0]}: the scene learns their blur"
    return [Finding("blurred", Severity.WARNING, what, advice, names, changes=(FEWER_PHOTOS,))]


def _chance(shot: Shot) -> float:
    """Return the largest loss that chance explains for a photo of this size."""
    W, H = shot.size
    share = min(1.0, WORK_SIDE / max(W, H))
    return CHANCE * math.sqrt(
        2.0 * (4.0 * math.pi * COARSE**2) / max(W * H * share * share * shot.stats.share, 1.0)
    )


def detail_losses(survey: Survey) -> Float64[np.ndarray, " C"]:
    """Return each photo's loss of detail relative to the median of its neighbours, in the worst direction.

    Returns:
        Natural logarithms of energy; 0 for a photo like its neighbours.
    """
    detail = np.stack([shot.stats.detail for shot in survey.shots])
    losses = np.empty(len(detail))
    for i, near in enumerate(survey.geometry.neighbours):
        others = near if len(near) >= ENOUGH else np.delete(np.arange(len(detail)), i)
        losses[i] = (np.median(detail[others], axis=0) - detail[i]).max()
    return losses


def check_duplicates(survey: Survey) -> list[Finding]:
    """Find duplicate photos, and different photos with the same pose."""
    duplicates, poses = _duplicates(survey), _same_poses(survey)
    names = survey.names
    if survey.layout == "Blender":
        return _rendered_alike(names, duplicates)
    found = []
    if moved := [(i, j) for i, j in duplicates if _motion(survey, i, j) > DUPLICATE_MOTION]:
        named = tuple(f"{names[i]} and {names[j]}" for i, j in moved)
        what = f"{counted(len(moved), 'pair')} of nearly identical photos with different poses"
        advice = "remove one photo of each identical pair with different poses: one of the poses is wrong"
        found.append(Finding("same photo", Severity.WARNING, what, advice, named, changes=(FEWER_PHOTOS,)))
    if copies := [pair for pair in duplicates if pair not in moved]:
        named = tuple(f"{names[i]} and {names[j]}" for i, j in copies)
        what = f"{counted(len(copies), 'pair')} of nearly identical photos from one place"
        advice = (
            "remove one photo of each duplicate pair: a test photo with a duplicate in training tests nothing"
        )
        found.append(Finding("duplicates", Severity.WARNING, what, advice, named, changes=(FEWER_PHOTOS,)))
    if apart := sorted(poses - set(duplicates)):
        named = tuple(f"{names[i]} and {names[j]}" for i, j in apart)
        what = f"{counted(len(apart), 'pair')} of different photos with the same pose"
        advice = "check the photos that share a pose: something moved between them, or a pose is wrong"
        found.append(Finding("same pose", Severity.WARNING, what, advice, named))
    return found


def _rendered_alike(names: Sequence[str], duplicates: Sequence[tuple[int, int]]) -> list[Finding]:
    """Return a note: rendered photos have exact poses and a split by which scenes are compared."""
    if not duplicates:
        return []
    named = tuple(f"{names[i]} and {names[j]}" for i, j in duplicates)
    what = (
        f"{counted(len(duplicates), 'pair')} of nearly identical photos, which rendered captures often have"
    )
    advice = "keep all photos if you compare with published scores: the split is part of the benchmark"
    return [Finding("duplicates", Severity.NOTE, what, advice, named, changes=(ALL_PHOTOS,))]


def _duplicates(survey: Survey) -> list[tuple[int, int]]:
    """Return the pairs of nearly identical photos; each photo is paired with the earlier one most like it."""
    signatures = [_signature(shot.stats.thumbnail.astype(np.float32)) for shot in survey.shots]
    by_size: dict[int, list[int]] = {}
    for i, signature in enumerate(signatures):
        by_size.setdefault(signature.size, []).append(i)
    pairs = []
    for alike in by_size.values():
        table = np.stack([signatures[i] for i in alike])
        for k in range(1, len(alike)):
            distances = np.sqrt(np.mean(np.square(table[:k] - table[k]), axis=1))
            if distances.min() < DUPLICATE:
                pairs.append((alike[int(np.argmin(distances))], alike[k]))
    return pairs


def _motion(survey: Survey, i: int, j: int) -> float:
    """Return the median shift of photo i's sample points in photo j, in image widths; infinite if none is visible."""
    one, other = survey.geometry.cameras[i], survey.geometry.cameras[j]
    points = survey.geometry.samples[i]
    if not inside(other, points).any():
        return math.inf
    (u, v, _), (x, y, _) = (camera.project(camera.world_to_cam(points)) for camera in (one, other))
    return float(np.nanmedian(np.hypot(u - x, v - y))) / one.W


def _signature(thumbnail: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, " n"]:
    """Return a small version of a photo normalised to mean 0 and contrast 1, independent of exposure."""
    h, w = thumbnail.shape[:2]
    share = min(1.0, DUPLICATE_SIDE / max(h, w))
    size = max(1, round(w * share)), max(1, round(h * share))
    small = cv2.resize(thumbnail, size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    small = small - small.mean(axis=0)
    return np.asarray((small / max(float(small.std()), 1.0)).ravel(), dtype=np.float32)


def _same_poses(survey: Survey) -> set[tuple[int, int]]:
    """Return the pairs of cameras with the same pose."""
    geometry, pairs = survey.geometry, set[tuple[int, int]]()
    rotations = np.stack([camera.R for camera in geometry.cameras])
    for i in range(1, len(rotations)):
        near = np.linalg.norm(geometry.eyes[:i] - geometry.eyes[i], axis=1) < SAME_POSE * geometry.depth
        turned = np.abs(rotations[:i] - rotations[i]).max(axis=(1, 2)) < SAME_POSE
        pairs.update((int(j), i) for j in np.flatnonzero(near & turned))
    return pairs


def check_exposure(survey: Survey) -> list[Finding]:
    """Find photos whose brightness or tint differs from their neighbours' at shared points."""
    gains = Gains(survey)
    unsure = 1.0 if len(survey.points) else ON_RAYS
    light, tint = gains.light, gains.tint
    found = []
    if len(jumping := [i for i in np.argsort(-np.abs(light)) if abs(light[i]) > unsure * JUMP]):
        names = tuple(survey.names[i] for i in jumping)
        stops = tuple(f"{light[i]:+.1f}" for i in jumping)
        what = f"{len(names)} of {len(light)} photos are brighter or darker than neighbours that see the same, in stops"
        first = f"check {names[0]}: if the exposure jumped"
        shadow = "if your shadow fell on the scene, remove the photo"
        advice = Told(
            f"{first}, train with --appearance exposure; {shadow}",
            f"{first}, train with exposure correction; {shadow}",
        )
        found.append(Finding(EXPOSURE, Severity.WARNING, what, advice, names, stops, CORRECTED))
    elif (share := gains.differing(unsure * JUMP)) > DIFFERING:
        what = f"{100 * share:.0f} % of consecutive photos differ by more than {unsure * JUMP:.1f} stops"
        advice = _correct("lock the exposure")
        found.append(Finding(EXPOSURE, Severity.WARNING, what, advice, options=CORRECTED))
    if len(tinted := [i for i in np.argsort(-tint) if tint[i] > unsure * TINT]):
        names = tuple(survey.names[i] for i in tinted)
        what = f"{len(names)} of {len(tint)} photos have another tint than neighbours that see the same"
        advice = _correct("lock the white balance")
        found.append(Finding("white balance", Severity.WARNING, what, advice, names, options=CORRECTED))
    return found


def _correct(later: str) -> Told:
    """Advise to correct exposures now, and what to do at the next capture."""
    then = f"next time, {later} while you take photos"
    return Told(f"train with --appearance exposure; {then}", f"train with exposure correction; {then}")


class Gains:
    """Brightness and tint of each photo relative to its neighbours.

    Colours are compared at the camera's sample points that are visible in both photos. The result is the median ratio
    over the points, then the median over the neighbours.

    Args:
        survey: The capture.
    """

    def __init__(self, survey: Survey) -> None:
        self._survey = survey
        sigma = SMOOTH if len(survey.points) else SMOOTH_ON_RAYS
        self._smooth = [
            cv2.GaussianBlur(shot.stats.thumbnail.astype(np.float32), (0, 0), sigma) for shot in survey.shots
        ]

    @cached_property
    def light(self) -> Float64[np.ndarray, " C"]:
        """(C,) how much brighter each photo is, stops; 0 if it cannot be compared or its neighbours disagree."""
        return np.array([_agreed(_medians(pairs, MISMATCH)) for pairs in self._light])

    @cached_property
    def tint(self) -> Float64[np.ndarray, " C"]:
        """(C,) largest difference of a channel from the mean of the three, stops; 0 as for `light`."""
        by_channel = [[_agreed(_medians(pairs, TINT_MISMATCH)) for pairs in self._tint(c)] for c in range(3)]
        return np.asarray(np.abs(by_channel).max(axis=0))

    def differing(self, limit: float) -> float:
        """Return the share of neighbouring pairs whose brightness differs by more than a limit, stops.

        The limit is at least `ORDINARY` times the pairs' first quartile.
        """
        medians = [_medians(pairs, MISMATCH) for pairs in self._light]
        pairs = np.abs(np.concatenate([np.zeros(0), *medians]))
        return float(np.mean(pairs > max(limit, ORDINARY * np.quantile(pairs, 0.25)))) if len(pairs) else 0.0

    @property
    def _light(self) -> Iterator[list[Float64[np.ndarray, "..."]]]:
        """For each photo and neighbour, how much brighter each point is, stops."""
        return ([ratios.mean(axis=1) for ratios in pairs] for pairs in self._ratios)

    def _tint(self, channel: int) -> Iterator[list[Float64[np.ndarray, "..."]]]:
        """The same for one channel relative to the mean of the three."""
        return ([ratios[:, channel] - ratios.mean(axis=1) for ratios in pairs] for pairs in self._ratios)

    @cached_property
    def _ratios(self) -> tuple[list[Float64[np.ndarray, "_ 3"]], ...]:
        away = facing_away(self._survey.geometry)  # another check reports these
        return tuple([] if i in away else self._against_neighbours(i) for i in range(len(self._smooth)))

    def _against_neighbours(self, i: int) -> list[Float64[np.ndarray, "_ 3"]]:
        points = self._survey.geometry.samples[i]
        here, found = self._colors(i, points), []
        for j in self._survey.geometry.neighbours[i]:
            ratios = GAMMA * np.log2(here / self._colors(int(j), points))
            ratios = ratios[np.isfinite(ratios).all(axis=1)]
            if len(ratios) >= PAIRS:
                found.append(ratios)
        return found

    def _colors(self, i: int, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Sample a photo at points; NaN outside the image, its mask or its cut-out, and where the colour is clipped."""
        if not len(points):
            return np.zeros((0, 3))
        image, camera = self._smooth[i], self._survey.geometry.cameras[i]
        u, v, _ = camera.project(camera.world_to_cam(points))
        columns, rows = (np.nan_to_num(a, nan=-1e6).astype(np.float32)[:, None] for a in (u, v))
        border = (-1.0, -1.0, -1.0)
        colors = cv2.remap(
            image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=border
        )
        colors = colors.reshape(-1, 3).astype(np.float64)
        good = np.all((colors > DARK) & (colors < BRIGHT), axis=1) & np.isfinite(u)
        if (counts := self._survey.shots[i].stats.counts) is not None:
            near = cv2.remap(
                counts.view(np.uint8), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
            )
            good &= near.ravel() > 0
        colors[~good] = np.nan
        return colors


def _agreed(values: Float64[np.ndarray, " n"]) -> float:
    """Return the neighbours' median if most of them show at least half of it, otherwise 0."""
    if len(values) < ENOUGH:
        return 0.0
    median = float(np.median(values))
    return median if np.mean(values * np.sign(median) > 0.5 * abs(median)) >= AGREEING else 0.0


def _medians(pairs: Sequence[Float64[np.ndarray, "..."]], mismatch: float) -> Float64[np.ndarray, " m"]:
    """Return the median of each pair of photos that show the same thing."""
    return np.array([np.median(ratios) for ratios in pairs if _deviation(ratios) < mismatch])


def _deviation(values: Float64[np.ndarray, " n"]) -> float:
    return float(np.median(np.abs(values - np.median(values))))
