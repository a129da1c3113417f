"""Group photos by camera, and recognise fisheyes: by the black around a round image, by EXIF, or by the user's word.

COLMAP starts a fisheye from a focal length and a principal point, and refines both. Its models have no image for
directions at 90 degrees and more from the optical axis, so features that far outside are masked.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsplat_edu.base.constants import AUTO
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.native_lens import projection_of
from gsplat_edu.photos.decoding import decode_grey, decode_mask
from gsplat_edu.sfm.circle import Circle, black_corners, find_circle
from gsplat_edu.sfm.masks import write_mask
from gsplat_edu.sfm.options import ASSUMED, is_fisheye, lens_choice
from gsplat_edu.sfm.photos import PhotoFacts

FIRST_FISHEYE = "SIMPLE_RADIAL_FISHEYE"
"""COLMAP's model with which fisheyes are mapped unless the user chooses one: one coefficient, as for other lenses.
Held-out photos decide whether more are refined."""

USABLE = 80.0
"""Largest angle to the optical axis at which features are used, degrees, by the lens before mapping. COLMAP's models
end at 90 degrees; the rest is for lenses that see more than `ASSUMED`: up to 202 degrees."""

EXAMINED = 12
"""Most photos of a camera in which the circle is sought."""

EDGE = 0.02
"""Width of the rim inside the circle without features, as a fraction of its radius: the edge itself has many."""


@dataclass(frozen=True)
class StartLens:
    """The lens of a fisheye before mapping; sizes are those of the working copies.

    Args:
        model: COLMAP's name of its model.
        focal: Pixels per radian.
        x: Column of the principal point, px; pixel centres have integer coordinates.
        y: Row of the principal point, px.
        circle: The round image; None if the image fills the photo.
    """

    model: str
    focal: float
    x: float
    y: float
    circle: Circle | None = None

    def json(self) -> dict[str, Any]:
        """Return it for `gsplat_edu.sfm.engine.jobs.features`, with the first pixel's centre at (0.5, 0.5)."""
        return {"model": self.model, "focal": self.focal, "cx": self.x + 0.5, "cy": self.y + 0.5}

    @property
    def usable(self) -> Circle:
        """The circle inside which features are used."""
        radius = self.focal * math.radians(USABLE)
        if self.circle is not None:
            radius = min(radius, (1 - EDGE) * self.circle.radius)
        return Circle(self.x, self.y, radius)


@dataclass(frozen=True)
class CameraGroup:
    """Photos that share a camera.

    Args:
        photos: The photos.
        width: Width of the working copies, px.
        height: Height of the working copies, px.
        lens: The fisheye that took them; None for any other lens.
        why: What tells that it is a fisheye, and what its first focal length comes from.
    """

    photos: tuple[PhotoFacts, ...]
    width: int
    height: int
    lens: StartLens | None = None
    why: str = ""

    def json(self) -> dict[str, Any]:
        """Return it for `gsplat_edu.sfm.engine.jobs.features`, with the focal length from EXIF in px of the copies."""
        first = self.photos[0]
        return {
            "names": [photo.copy for photo in self.photos],
            "kind": first.camera.partition(" ")[2],
            "focal": None if first.focal is None else first.focal * self.width / first.W,
            "width": self.width,
            "height": self.height,
            "lens": None if self.lens is None else self.lens.json(),
        }


def camera_groups(
    photos: Sequence[PhotoFacts], folder: Path, longest: int, choice: str = AUTO
) -> list[CameraGroup]:
    """Group photos by camera, and recognise fisheyes.

    Photos with black corners that share a round image are a camera of their own, even if EXIF cannot tell them from the
    others.

    Args:
        photos: The photos.
        folder: Folder of their working copies.
        longest: Longest side of the copies, px.
        choice: The user's camera model, as `gsplat_edu.sfm.options.lens_choice` reads it.
    """
    by_camera: dict[str, list[PhotoFacts]] = {}
    for photo in photos:
        by_camera.setdefault(photo.camera, []).append(photo)
    model, degrees = lens_choice(choice)
    groups = list[CameraGroup]()
    for taken in by_camera.values():
        size = taken[0].copy_size(longest)
        if model != AUTO and not is_fisheye(model):
            groups.append(CameraGroup(tuple(taken), *size))
            continue
        round_ones, circle = _with_circle(taken, folder, size)
        for part in (round_ones, [photo for photo in taken if photo not in round_ones]):
            if part:
                found = circle if part is round_ones else None
                groups.append(_recognised(CameraGroup(tuple(part), *size), found, model, degrees))
    return groups


def lens_lines(groups: Sequence[CameraGroup]) -> Iterator[str]:
    """Yield a line for each fisheye: what the photos were taken for, and why."""
    for group in groups:
        if group.lens is not None:
            what = "circular fisheyes" if group.lens.circle is not None else "fisheyes"
            count = len(group.photos)
            yield (
                f"{count} photos taken for {what}: {group.why}; features beyond {USABLE:.0f} degrees from the axis are "
                "left out, because COLMAP's lenses end at 90; another lens: --camera-model"
            )


def circles_of(groups: Sequence[CameraGroup]) -> dict[str, Circle]:
    """Return the circles of round photos by their working copies, px of these."""
    return {
        photo.copy: group.lens.circle
        for group in groups
        if group.lens is not None and group.lens.circle is not None
        for photo in group.photos
    }


def write_lens_masks(groups: Sequence[CameraGroup], given: Path, folder: Path) -> Path:
    """Write masks that leave out what fisheyes show too far from their axis, on top of the masks of the photos.

    Args:
        groups: All photos.
        given: Folder of the masks of the working copies; need not exist.
        folder: Folder to write to; it is recreated if there are fisheyes.

    Returns:
        The folder with the masks for feature extraction.
    """
    if all(group.lens is None for group in groups):
        return given
    shutil.rmtree(folder, ignore_errors=True)
    for group in groups:
        size = group.width, group.height
        counts = np.ones((group.height, group.width), np.bool_)
        if group.lens is not None:
            counts = group.lens.usable.inside(*size)
        for photo in group.photos:
            own = given / f"{photo.copy}.png"
            both = counts & decode_mask(own) if own.is_file() else counts
            write_mask(both, folder / f"{photo.copy}.png", size)
    return folder


def angle_of_radius(lens: Lens, radius: float) -> float | None:
    """Return the angle to the optical axis that a fisheye shows at a radius, degrees.

    Args:
        lens: The lens.
        radius: Distance from the principal point, px.

    Returns:
        The angle; None if the polynomial turns back before it, so that no direction has this radius.
    """
    projection = projection_of(lens)
    if projection is None:
        return None
    place = radius / lens.fx
    ray = projection.directions(np.array([place]), np.zeros(1), projection.widest(place))[0]
    return float(np.degrees(np.arctan2(np.hypot(ray[0], ray[1]), ray[2]))) if np.isfinite(ray).all() else None


def rim_line(lens: Lens, circle: Circle | None) -> str:
    """Say how far a fisheye sees up to its rim, or that its polynomial turns back before.

    Args:
        lens: The lens that was found.
        circle: Its round image at the same size; None if it fills the photo.
    """
    radius = math.hypot(lens.W, lens.H) / 2 if circle is None else circle.radius
    where = "to the corners" if circle is None else f"across the circle of radius {radius:.1f} px"
    angle = angle_of_radius(lens, radius)
    if angle is not None:
        past = ", beyond COLMAP's 90 to the side" if angle > 90.0 else ""
        return f"the lens sees {2 * angle:.0f} degrees {where}{past}: train --lens native uses all of it"
    low, high = 0.0, radius
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if angle_of_radius(lens, middle) is not None else (low, middle)
    return (
        f"the lens's polynomial turns back {low:.0f} px from its middle, before the rim at {radius:.0f} px: what lies "
        "beyond is not used; more photos, or --camera-model SIMPLE_RADIAL_FISHEYE, may calibrate it better"
    )


def _with_circle(
    photos: Sequence[PhotoFacts], folder: Path, size: tuple[int, int]
) -> tuple[list[PhotoFacts], Circle | None]:
    """Return the photos of a camera that share a round image, and its circle in their working copies."""
    dark = [photo for photo in photos if black_corners(_grey(folder / photo.copy, size))]
    some = dark[:: max(1, math.ceil(len(dark) / EXAMINED))]
    circle = find_circle([_grey(folder / photo.copy, size) for photo in some]) if some else None
    return (dark, circle) if circle is not None else ([], None)


def _grey(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "H W"]:
    grey = decode_grey(path)
    return grey if grey.shape[::-1] == size else np.asarray(Image.fromarray(grey).resize(size))


def _recognised(group: CameraGroup, circle: Circle | None, model: str, degrees: float | None) -> CameraGroup:
    """Give a group its fisheye, if it has one."""
    first = group.photos[0]
    if model == AUTO and circle is None and not first.fisheye:
        return group
    name = FIRST_FISHEYE if model == AUTO else model
    diagonal = math.hypot(group.width, group.height) / 2
    x, y = ((group.width - 1) / 2, (group.height - 1) / 2) if circle is None else circle[:2]
    radius = diagonal if circle is None else circle.radius
    if circle is not None:
        full = circle.scaled(first.W / group.width)
        why = (
            f"their corners are black outside of a circle of radius {full.radius:.1f} px around ({full.x:.1f}, "
            f"{full.y:.1f})"
        )
    else:
        why = "EXIF names the lens so" if first.fisheye else "--camera-model says so"
    if degrees is None and first.fisheye and first.focal is not None:
        focal, said = first.focal * group.width / first.W, "the focal length in EXIF"
    else:
        focal = radius / math.radians((degrees or ASSUMED) / 2)
        across = "the diagonal" if circle is None else "it"
        said = f"{degrees or ASSUMED:g} degrees across {across}"
        said += " until the photos tell" if degrees is None else ", as --camera-model says"
    lens = StartLens(name, focal, x, y, circle)
    return CameraGroup(group.photos, group.width, group.height, lens, f"{why}; the lens starts from {said}")
