"""Checks of the pixels: blurred photos, photos there twice, and jumps of exposure or white balance.

Each photo is compared with its neighbours, which see the same: what a wall lacks in detail, the photo beside it lacks
too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from gsplat_edu.doctor.cameras import looking_away
from gsplat_edu.doctor.finding import Finding, Severity, counted
from gsplat_edu.doctor.geometry import inside
from gsplat_edu.doctor.photos import BRIGHT, COARSE, DARK, GAMMA, WORK_SIDE
from gsplat_edu.doctor.survey import Shot, Survey

EXPOSURE = "exposure"
"""Name of findings about brightness, before and after training."""

ENOUGH = 3
"""Neighbours from which a photo is compared with them; with fewer, with all photos."""

BLUR = 0.3
"""Loss of detail, in natural logarithms of energy along one direction, from which a photo is blurred. Of 158 photos of
three captures two are above it, and blurred to the eye; one at 0.29 is so slightly. Being drawn along a line of 8 px
of 1024 costs 0.4 to 0.8, of 4 px 0.1 to 0.3."""

BLUR_SPREAD = 3.0
"""The loss has to be so many standard deviations of the capture's too, those measured on the sharper half."""

CHANCE = 3.5
"""The loss has to be so many times sqrt(2 / n) as well, the standard deviation of the logarithm of a mean of n squares:
the largest of eight directions and some hundred photos. n is the photo's area over that which its coarse gradients are
smoothed over, 4 pi 4²; from 500 px on this is below the limit above."""

TWIN = 0.05
"""Root mean squared difference of two photos, 32 px long and of unit contrast, below which they are one. Written again
as a JPEG of quality 50 a photo differs by 0.02, a small and finely textured one by 0.04; shifted by a hundredth of its
width, by 0.2. The least between two photos of three captures, two frames of a film, was 0.12."""

TWIN_SIDE = 32

TWIN_MOTION = 0.015
"""Shift between two photos by their poses, in widths of the image, up to which equal pixels do not contradict them:
those hide a shift of 0.003, and poses are not exact."""

SAME_POSE = 1e-4
"""Distance of two cameras, in depths of what they look at, and angle between them, radians, below which they are one:
a tenth of a pixel of 1000."""

JUMP = 0.4
"""Difference to the neighbours from which exposure jumps, stops: a grey of 128 becomes 113, an error of 25 dB. Of 97
photos of a phone that exposed each by itself 94 stay below 0.3."""

DIFFERING = 0.08
"""Share of pairs of neighbours that may differ by a jump before exposure is said to: photos that are dark in a row
agree with one another. fox has 0.006, snowmiku97 0.035, every third of the photos dark by 1.5 stops 0.125 and more."""

ORDINARY = 16.0
"""Quarters of the pairs differ by less than 0.03 stops in captures of phones and by 0.07 where half of a scene shines
through the other: what is a jump lies far beyond."""

TINT = 0.25
"""Difference of one channel to the mean of the three from which the white balance jumps, stops: half as much, since
hues are seen sooner and a phone strays by 0.1."""

ON_RAYS = 1.5
"""Both limits are multiplied by this where there are no points: photos are compared where they roughly show the same
thing."""

AGREEING = 0.75
"""Share of the neighbours that have to say the same, by half of it at least: one edge of a shadow is no exposure."""

PAIRS = 20
"""Points seen by both from which two photos are compared."""

MISMATCH = 0.8
"""Median deviation of the ratios of two photos, stops, from which they show different things there."""

TINT_MISMATCH = 0.3
"""The same for a channel against the mean of the three: things differ less in hue than in brightness."""

SMOOTH = 1.0
"""Standard deviation thumbnails are smoothed with, px: points and poses are off by about as much."""

SMOOTH_ON_RAYS = 2.5
"""The same where there are no points and the subject's depth is taken to be the same everywhere."""


def check_blur(survey: Survey) -> list[Finding]:
    """Find photos with less fine detail than their neighbours, along any direction."""
    losses = detail_losses(survey)
    middle = float(np.median(losses))
    sharper = middle - float(np.quantile(losses, 0.16))
    limits = [max(BLUR, middle + BLUR_SPREAD * sharper, _chance(shot)) for shot in survey.shots]
    worst_first = [i for i in np.argsort(-losses) if losses[i] > limits[i]]
    if not worst_first:
        return []
    names = tuple(survey.names[i] for i in worst_first)
    what = f"{len(names)} of {len(losses)} photos show less detail than their neighbours"
    advice = f"take out or retake the blurred photos, first {names[0]}: a scene learns their blur"
    return [Finding("blurred", Severity.WARNING, what, advice, names)]


def _chance(shot: Shot) -> float:
    """Return the loss that chance may give a photo of its size."""
    W, H = shot.size
    share = min(1.0, WORK_SIDE / max(W, H))
    return CHANCE * math.sqrt(2.0 * (4.0 * math.pi * COARSE**2) / (W * H * share * share))


def detail_losses(survey: Survey) -> Float64[np.ndarray, " C"]:
    """Return by how much each photo's detail is below the median of its neighbours', where most is lost.

    Returns:
        Natural logarithms of energy; 0 for a photo like its neighbours.
    """
    detail = np.stack([shot.look.detail for shot in survey.shots])
    losses = np.empty(len(detail))
    for i, near in enumerate(survey.geometry.neighbours):
        others = near if len(near) >= ENOUGH else np.delete(np.arange(len(detail)), i)
        losses[i] = (np.median(detail[others], axis=0) - detail[i]).max()
    return losses


def check_twins(survey: Survey) -> list[Finding]:
    """Find photos that are there twice, and poses that two photos have."""
    twins, poses = _twins(survey), _same_poses(survey)
    names = survey.names
    found = []
    if moved := [(i, j) for i, j in twins if _motion(survey, i, j) > TWIN_MOTION]:
        named = tuple(f"{names[i]} and {names[j]}" for i, j in moved)
        what = f"{counted(len(moved), 'pair')} of photos that are nearly the same, but with poses that differ"
        advice = "take out one photo of each pair that shows the same: one of the two poses is wrong"
        found.append(Finding("same photo", Severity.WARNING, what, advice, named))
    if copies := [pair for pair in twins if pair not in moved]:
        named = tuple(f"{names[i]} and {names[j]}" for i, j in copies)
        what = f"{counted(len(copies), 'pair')} of photos that are nearly the same, from one place"
        advice = "take out one photo of each such pair: if one of them is for testing, it tests nothing"
        found.append(Finding("duplicates", Severity.WARNING, what, advice, named))
    if apart := sorted(poses - set(twins)):
        named = tuple(f"{names[i]} and {names[j]}" for i, j in apart)
        what = f"{counted(len(apart), 'pair')} of photos that show different things"
        advice = "look at the photos that share a pose: something moved between them, or a pose is wrong"
        found.append(Finding("same pose", Severity.WARNING, what, advice, named))
    return found


def _twins(survey: Survey) -> list[tuple[int, int]]:
    """Return the pairs of photos of nearly the same pixels; each photo with the first that it is like."""
    signatures = [_signature(shot.look.thumbnail.astype(np.float32)) for shot in survey.shots]
    by_size: dict[int, list[int]] = {}
    for i, signature in enumerate(signatures):
        by_size.setdefault(signature.size, []).append(i)
    pairs = []
    for alike in by_size.values():
        table = np.stack([signatures[i] for i in alike])
        for k in range(1, len(alike)):
            distances = np.sqrt(np.mean(np.square(table[:k] - table[k]), axis=1))
            if distances.min() < TWIN:
                pairs.append((alike[int(np.argmin(distances))], alike[k]))
    return pairs


def _motion(survey: Survey, i: int, j: int) -> float:
    """Return how far what one picture shows has moved in another, median, in widths; infinite if it is not there."""
    one, other = survey.geometry.cameras[i], survey.geometry.cameras[j]
    points = survey.geometry.samples[i]
    if not inside(other, points).any():
        return math.inf
    (u, v, _), (x, y, _) = (camera.project(camera.world_to_cam(points)) for camera in (one, other))
    return float(np.nanmedian(np.hypot(u - x, v - y))) / one.W


def _signature(thumbnail: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, " n"]:
    """Return a photo as a few numbers with mean 0 and spread 1, whatever its exposure."""
    h, w = thumbnail.shape[:2]
    share = min(1.0, TWIN_SIDE / max(h, w))
    size = max(1, round(w * share)), max(1, round(h * share))
    small = cv2.resize(thumbnail, size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    small = small - small.mean(axis=0)
    return np.asarray((small / max(float(small.std()), 1.0)).ravel(), dtype=np.float32)


def _same_poses(survey: Survey) -> set[tuple[int, int]]:
    """Return the pairs of cameras that stand at one place and look one way."""
    geometry, pairs = survey.geometry, set[tuple[int, int]]()
    rotations = np.stack([camera.R for camera in geometry.cameras])
    for i in range(1, len(rotations)):
        near = np.linalg.norm(geometry.eyes[:i] - geometry.eyes[i], axis=1) < SAME_POSE * geometry.depth
        turned = np.abs(rotations[:i] - rotations[i]).max(axis=(1, 2)) < SAME_POSE
        pairs.update((int(j), i) for j in np.flatnonzero(near & turned))
    return pairs


def check_exposure(survey: Survey) -> list[Finding]:
    """Find photos brighter, darker or of another tint than their neighbours, at what both see."""
    gains = Gains(survey)
    unsure = 1.0 if len(survey.points) else ON_RAYS
    light, tint = gains.light, gains.tint
    found = []
    if len(jumping := [i for i in np.argsort(-np.abs(light)) if abs(light[i]) > unsure * JUMP]):
        names = tuple(survey.names[i] for i in jumping)
        stops = tuple(f"{light[i]:+.1f}" for i in jumping)
        what = f"{len(names)} of {len(light)} photos are brighter or darker than neighbours that see the same, in stops"
        advice = f"look at {names[0]}: did the exposure jump, or your shadow fall on the scene? fix it or leave it out"
        found.append(Finding(EXPOSURE, Severity.WARNING, what, advice, names, stops))
    elif (share := gains.differing(unsure * JUMP)) > DIFFERING:
        what = f"{100 * share:.0f} % of consecutive photos differ by more than {unsure * JUMP:.1f} stops"
        advice = "fix the exposure while you take photos: some are brighter than the rest"
        found.append(Finding(EXPOSURE, Severity.WARNING, what, advice))
    if len(tinted := [i for i in np.argsort(-tint) if tint[i] > unsure * TINT]):
        names = tuple(survey.names[i] for i in tinted)
        what = f"{len(names)} of {len(tint)} photos have another tint than neighbours that see the same"
        advice = "fix the white balance while you take photos, or take out the photos with another tint"
        found.append(Finding("white balance", Severity.WARNING, what, advice, names))
    return found


class Gains:
    """How bright photos are against their neighbours.

    Colours are compared at the points that stand for what a camera sees, where they fall in both photos: the median of
    the ratio over the points, and of that over the neighbours.

    Args:
        survey: The capture.
    """

    def __init__(self, survey: Survey) -> None:
        self._survey = survey
        sigma = SMOOTH if len(survey.points) else SMOOTH_ON_RAYS
        self._smooth = [
            cv2.GaussianBlur(shot.look.thumbnail.astype(np.float32), (0, 0), sigma) for shot in survey.shots
        ]

    @cached_property
    def light(self) -> Float64[np.ndarray, " C"]:
        """(C,) how much brighter a photo is, stops; 0 where it cannot be compared or its neighbours disagree."""
        return np.array([_agreed(_medians(pairs, MISMATCH)) for pairs in self._light])

    @cached_property
    def tint(self) -> Float64[np.ndarray, " C"]:
        """(C,) largest difference of a channel to the mean of the three, stops; 0 as for light."""
        by_channel = [[_agreed(_medians(pairs, TINT_MISMATCH)) for pairs in self._tint(c)] for c in range(3)]
        return np.asarray(np.abs(by_channel).max(axis=0))

    def differing(self, limit: float) -> float:
        """Return the share of pairs of neighbours whose brightness differs by more than a limit, stops.

        Where neighbours differ anyhow, the limit is `ORDINARY` times what the more equal quarter of them does.
        """
        pairs = np.abs(np.concatenate([np.zeros(0), *(_medians(pairs, MISMATCH) for pairs in self._light)]))
        return float(np.mean(pairs > max(limit, ORDINARY * np.quantile(pairs, 0.25)))) if len(pairs) else 0.0

    @property
    def _light(self) -> Iterator[list[Float64[np.ndarray, "..."]]]:
        """For each photo, and each neighbour, by how much each point is brighter, stops."""
        return ([ratios.mean(axis=1) for ratios in pairs] for pairs in self._ratios)

    def _tint(self, channel: int) -> Iterator[list[Float64[np.ndarray, "..."]]]:
        """The same for one channel against the mean of the three."""
        return ([ratios[:, channel] - ratios.mean(axis=1) for ratios in pairs] for pairs in self._ratios)

    @cached_property
    def _ratios(self) -> tuple[list[Float64[np.ndarray, "_ 3"]], ...]:
        away = looking_away(self._survey.geometry)  # what is wrong with those is another matter
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
        """Look points up in a photo; NaN where they fall outside or the colour is cut off."""
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
        colors[~good] = np.nan
        return colors


def _agreed(values: Float64[np.ndarray, " n"]) -> float:
    """Return the median of what neighbours say, where most of them say at least half of it."""
    if len(values) < ENOUGH:
        return 0.0
    median = float(np.median(values))
    return median if np.mean(values * np.sign(median) > 0.5 * abs(median)) >= AGREEING else 0.0


def _medians(pairs: Sequence[Float64[np.ndarray, "..."]], mismatch: float) -> Float64[np.ndarray, " m"]:
    """Return the median of each pair of photos that show the same."""
    return np.array([np.median(ratios) for ratios in pairs if _deviation(ratios) < mismatch])


def _deviation(values: Float64[np.ndarray, " n"]) -> float:
    return float(np.median(np.abs(values - np.median(values))))
