"""Checks of the pixels: blurred photos and duplicates.

Each photo is compared with neighbours that see the same subject. A photo of a plain wall has little detail, but so do
its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int64

from gsplat_edu.scene.photo import shrunk
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.finding import ALL_PHOTOS, FEWER_PHOTOS, Finding, Severity, counted
from gsplat_edu.survey.geometry import inside
from gsplat_edu.survey.photos import COARSE, WORK_SIDE

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


def check_blur(survey: Survey) -> list[Finding]:
    """Find photos with less fine detail than their neighbours in some direction, inside of masks and cut-outs."""
    shots, neighbours = survey.shots, survey.geometry.neighbours
    details = np.stack([shot.stats.detail for shot in shots])
    return blur_findings(
        survey.names, details, neighbours, [chance(shot.size, shot.stats.share) for shot in shots]
    )


def blur_findings(
    photos: Sequence[str],
    details: Float64[np.ndarray, "C 8"],
    neighbours: Sequence[Int64[np.ndarray, "..."]],
    chances: Sequence[float],
) -> list[Finding]:
    """Find photos with less fine detail than others that show the same.

    Args:
        photos: Their names.
        details: (C, 8) detail of each by direction (`gsplat_edu.survey.photos.detail_of`).
        neighbours: For each the indices of photos that show the same.
        chances: For each the largest loss that chance explains (`chance`).
    """
    losses = detail_losses(details, neighbours)
    middle = float(np.median(losses))
    sharper = middle - float(np.quantile(losses, 0.16))
    limits = [max(BLUR, middle + BLUR_SPREAD * sharper, least) for least in chances]
    worst_first = [i for i in np.argsort(-losses) if losses[i] > limits[i]]
    if not worst_first:
        return []
    names = tuple(photos[i] for i in worst_first)
    what = f"{len(names)} of {len(losses)} photos show less detail than their neighbours"
    advice = f"remove or retake the blurred photos, first {names[0]}: the scene learns their blur"
    return [Finding("blurred", Severity.WARNING, what, advice, names, changes=(FEWER_PHOTOS,))]


def chance(size: tuple[int, int], measured: float = 1.0) -> float:
    """Return the largest loss that chance explains for a photo.

    Args:
        size: Its width and height, px.
        measured: Share of its pixels in which the detail was measured.
    """
    W, H = size
    share = min(1.0, WORK_SIDE / max(W, H))
    return CHANCE * math.sqrt(2.0 * (4.0 * math.pi * COARSE**2) / max(W * H * share * share * measured, 1.0))


def detail_losses(
    detail: Float64[np.ndarray, "C 8"], neighbours: Sequence[Int64[np.ndarray, "..."]]
) -> Float64[np.ndarray, " C"]:
    """Return each photo's loss of detail relative to the median of its neighbours, in the worst direction.

    Returns:
        Natural logarithms of energy; 0 for a photo like its neighbours.
    """
    losses = np.empty(len(detail))
    for i, near in enumerate(neighbours):
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
    small = shrunk(thumbnail, DUPLICATE_SIDE).reshape(-1, 3)
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
