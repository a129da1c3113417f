"""What photos show before anyone knows where they were taken: their number, sharpness, brightness and overlap.

Each photo is compared with those before and after it in the order of their names, which is the order in which a camera
takes them. Photos overlap as far as features of both fit one epipolar geometry; brightness is compared at those
features. Photos in another order share little with those beside them, and then nothing is said of either.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from gsplat_edu.data.lens import Lens
from gsplat_edu.data.panorama import FaceLens, is_panorama_size
from gsplat_edu.doctor.appearance import blur_findings, chance
from gsplat_edu.doctor.files import too_few
from gsplat_edu.photos.decoding import decode, image_orientation, image_size
from gsplat_edu.scene.photo import shrunk
from gsplat_edu.survey.brightness import (
    JUMP,
    PAIRS,
    Difference,
    agreed,
    difference_of,
    occupied,
    stops_between,
)
from gsplat_edu.survey.finding import Finding, Severity, counted
from gsplat_edu.survey.geometry import NEIGHBOURS
from gsplat_edu.survey.matching import Features, features_in, matches_of
from gsplat_edu.survey.photos import BRIGHT, DARK, detail_of_file

APART = 2
"""A photo is compared with this many photos before it and as many after it."""

FOCAL = 1.0
"""Focal length that matches are tested with, in units of the longer side: between phones and normal lenses. The
eight-point algorithm solves for any matrix, so that another focal length only scales what it allows."""

LOOK = 640
"""Longest side at which photos are compared, px."""

SMOOTH = 2.0
"""Sigma of the blur before brightness is compared, px: about the size of the smallest features."""

ORDERED = 0.5
"""Photos are in the order they were taken if more than this share of neighbours overlap."""


class Measured(NamedTuple):
    """A photo and what was measured of it."""

    name: str
    """Its name."""
    size: tuple[int, int]
    """Width and height as stored, px."""
    detail: list[float]
    """Eight logarithms; see `gsplat_edu.survey.photos.detail_of`."""


def measured(name: str, path: Path) -> Measured:
    """Measure a photo at a reduced size.

    Args:
        name: Its name.
        path: Its file.

    Raises:
        DatasetError: it cannot be decoded.
    """
    size = image_size(path)
    return Measured(name, size, detail_of_file(path, size).tolist())


class Shared(NamedTuple):
    """What two photos both show."""

    overlap: bool
    """Whether enough features of both fit one epipolar geometry."""
    stops: float | None
    """How much brighter the first photo is, stops; None if too few features can be compared."""
    error: float
    """Standard error of `stops`, stops."""


class Look:
    """A photo at a reduced size with its features, to be compared with others.

    Args:
        path: Its file.

    Raises:
        DatasetError: it cannot be decoded.
    """

    def __init__(self, path: Path) -> None:
        pixels, alpha = decode(path, image_orientation(path), LOOK)
        small: UInt8[np.ndarray, "h w 3"] = shrunk(pixels, LOOK)
        h, w = small.shape[:2]
        counts = np.ones((h, w), np.bool_) if alpha is None else shrunk(alpha, LOOK) >= 128
        focal = FOCAL * max(w, h)
        self.lens = (
            FaceLens.of(w, h, 0)
            if is_panorama_size(w, h)
            else Lens(w, h, focal, focal, (w - 1) / 2, (h - 1) / 2)
        )
        self.features: Features = features_in(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), self.lens, counts)
        self._smooth = cv2.GaussianBlur(small.astype(np.float32), (0, 0), SMOOTH)

    def shared_with(self, other: Look) -> Shared:
        """Compare two photos."""
        matches = matches_of(self.features, other.features, (self.lens, other.lens))
        if matches is None:
            return Shared(False, None, 0.0)
        here, there = (
            look._smooth[tuple(np.rint(at).astype(np.int64).T[::-1])]
            for look, at in zip((self, other), matches, strict=True)
        )
        good = np.all((np.minimum(here, there) > DARK) & (np.maximum(here, there) < BRIGHT), axis=1)
        if good.sum() < PAIRS:
            return Shared(True, None, 0.0)
        stops = stops_between(here[good], there[good]).mean(axis=1)
        return Shared(True, *difference_of(stops, occupied(matches[0][good], (self.lens.W, self.lens.H))))


def examine_unplaced(
    photos: Sequence[Measured], total: int, shared: Mapping[tuple[int, int], Shared] | None = None
) -> list[Finding]:
    """Examine photos without poses.

    Args:
        photos: The readable ones, in the order they were taken.
        total: Number of all photos.
        shared: What two photos share, by their indices, the smaller first, up to `APART` apart; None if not compared.
    """
    found = too_few(len(photos), total)
    if len(photos) < 2:
        return found
    near = NEIGHBOURS // 2
    indices = np.arange(len(photos))
    neighbours = [indices[(abs(indices - i) <= near) & (indices != i)] for i in indices]
    details = np.array([photo.detail for photo in photos])
    chances = [chance(photo.size) for photo in photos]
    names = [photo.name for photo in photos]
    found += blur_findings(names, details, neighbours, chances)
    if shared and in_order(shared):
        found += [*_gaps(names, shared), *_jumps(names, shared)]
    return found


def in_order(shared: Mapping[tuple[int, int], Shared]) -> bool:
    """Return whether photos are in the order they were taken: whether most overlap with the next one."""
    following = [both.overlap for (i, j), both in shared.items() if j == i + 1]
    return float(np.mean(following)) > ORDERED


def _gaps(names: Sequence[str], shared: Mapping[tuple[int, int], Shared]) -> list[Finding]:
    """Find gaps in the order of the photos: no photo before a gap overlaps with one after it."""
    gaps = [
        i
        for i in range(len(names) - 1)
        if not any(both.overlap for (one, other), both in shared.items() if one <= i < other)
    ]
    if not gaps:
        return []
    first, next_one = names[gaps[0]], names[gaps[0] + 1]
    where = counted(len(gaps), "place")
    what = f"{where} where a photo shares too little with the next one, first {first} with {next_one}"
    advice = (
        "leave it if other photos show what both show; otherwise take two or three photos between them, each sharing"
        " most of its view with the next, because photos that share nothing with the others cannot be placed"
    )
    images = tuple(names[i] for i in gaps)
    return [Finding("overlap", Severity.NOTE, what, advice, images, tuple(names[i + 1] for i in gaps))]


def _jumps(names: Sequence[str], shared: Mapping[tuple[int, int], Shared]) -> list[Finding]:
    """Find photos that are brighter or darker than those before and after them."""
    around: list[list[Difference]] = [[] for _ in names]
    for (i, j), both in shared.items():
        if both.stops is not None:
            around[i].append(Difference(both.stops, both.error))
            around[j].append(Difference(-both.stops, both.error))
    light = np.array([agreed(differences) for differences in around])
    jumping = [i for i in np.argsort(-abs(light)) if abs(light[i]) > JUMP]
    if not jumping:
        return []
    images, stops = tuple(names[i] for i in jumping), tuple(f"{light[i]:+.1f}" for i in jumping)
    what = f"{len(images)} of {len(names)} photos are brighter or darker than those before and after them, in stops"
    advice = (
        "leave them if the light stayed the same: a training evens exposures out. Next time, lock the exposure while"
        " you take photos"
    )
    return [Finding("brightness", Severity.NOTE, what, advice, images, stops)]
