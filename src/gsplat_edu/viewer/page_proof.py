"""What lets a page's visitors check it: how many photos saw each splat, and photos to compare with the picture.

A page stores one byte per splat, the number of photos rounded down to 0 or a power of two (a run of 96,518 splats and
87 photos takes 29 kB compressed, 74 kB unrounded), and one JPEG per photo. A photo has the pinhole in which the page
shows its camera (`gsplat_edu.scene.rig.stand_in`). The JPEGs have no EXIF, and the page names no files.
`viewer/web/seen.js` and `viewer/web/compare.js` read this.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Int32, UInt8
from PIL import Image

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.clean.evidence import judging_backend
from gsplat_edu.clean.sight import times_seen
from gsplat_edu.paths.orbits import resized
from gsplat_edu.render.api import render
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.runs.identity import capture_difference
from gsplat_edu.runs.source import Source, run_of
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.photo import area_mean
from gsplat_edu.scene.rig import stand_in
from gsplat_edu.scene.views import View

SIGHT_SIDE = 640
"""Longer side of the images in which splats are counted as seen, px; smaller images stay as they are."""

MOST_COUNTED = 128

FEWEST = 2
"""The page tints splats that fewer photos saw."""

PHOTO_SIDE = 480
"""Longer side of an embedded photo, px; smaller photos stay as they are."""

PHOTO_QUALITY, POSTER_QUALITIES = 80, (75, 60, 45, 30, 15)
"""JPEG quality of photos, and those of the poster, from the best one."""

POSTER_SIDE = 960
"""Longer side of the poster, px."""

POSTER_MOST = 60_000
"""Largest poster, bytes; the quality falls until it fits."""

BORDER_PART = 0.04
"""Width of the border of a photo whose mean colour stands for what no photo saw, in the photo's shorter sides."""

HELD_OUT_PART = 3
"""At most one in this many embedded photos is a held-out one, rounded up."""


@dataclass(frozen=True, eq=False)
class ShownPhoto:
    """A photo in a page.

    Args:
        index: Index of its camera among the views of the page's scene.
        jpeg: The photo, upright, through the pinhole of the page's camera.
        border: Mean colour of the photo's border, RGB from 0 to 1.
    """

    index: int
    jpeg: bytes
    border: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Proof:
    """The evidence in a page.

    Args:
        seen: (N,) number of training photos that saw each splat, as `rounded_counts`; None if it is not shown.
        photos: Photos to compare with the picture.
    """

    seen: UInt8[np.ndarray, " N"] | None = None
    photos: Sequence[ShownPhoto] = ()

    def facts(self, views_before: int) -> dict[str, Any]:
        """Return the entries of the page's facts.

        Args:
            views_before: Number of views that the page lists before those of the capture.
        """
        found: dict[str, Any] = {}
        if self.seen is not None:
            found["seen"] = {"fewest": FEWEST, "share": round(self.share(), 4)}
        if self.photos:
            found["photos"] = [
                {"index": views_before + photo.index, "bytes": len(photo.jpeg)} for photo in self.photos
            ]
            found["border"] = self.border()
        return found

    def border(self) -> tuple[float, float, float]:
        """Return the mean colour of the photos at their borders, RGB from 0 to 1; black without photos."""
        borders = [photo.border for photo in self.photos] or [(0.0, 0.0, 0.0)]
        red, green, blue = np.mean(borders, axis=0).tolist()
        return red, green, blue

    def share(self) -> float:
        """Return the fraction of the splats that fewer than `FEWEST` photos saw."""
        return 0.0 if self.seen is None or not len(self.seen) else float(np.mean(self.seen < FEWEST))

    def line(self) -> str:
        """Describe the evidence in one line."""
        size = sum(len(photo.jpeg) for photo in self.photos)
        few = f"fewer than {FEWEST} photos saw {100 * self.share():.1f} % of the splats"
        return f"{few}; {len(self.photos)} photos of {size:,} bytes to compare"


def seen_of(source: Source, progress: Callable[[], object] = lambda: None) -> UInt8[np.ndarray, " N"]:
    """Count the training photos that see each splat of a run's scene, with the backend cpu; see `rounded_counts`.

    The scene is that of the page: without splats that an edit has removed, photos see what is behind them.

    Args:
        source: The scene, with the cameras of its capture.
        progress: Called after every camera.

    Raises:
        ArgumentError: the scene has no training cameras.
    """
    cameras = training_cameras(source)
    if not cameras:
        raise ArgumentError(f"{source.path}: has no training cameras; give a run")
    small = [
        camera if max(camera.W, camera.H) <= SIGHT_SIDE else resized(camera, SIGHT_SIDE) for camera in cameras
    ]
    count = times_seen(source.scene.gaussians, small, source.settings, judging_backend(None), progress)
    return rounded_counts(count)


def rounded_counts(count: Int32[np.ndarray, " N"]) -> UInt8[np.ndarray, " N"]:
    """Round (N,) counts down to 0 or a power of two, at most `MOST_COUNTED`."""
    _, exponent = np.frexp(np.clip(count, 1, MOST_COUNTED))
    found: UInt8[np.ndarray, " N"] = np.where(count > 0, 1 << (exponent - 1), 0).astype(np.uint8)
    return found


def training_cameras(source: Source) -> list[Camera]:
    """Return the cameras of the photos that a scene was trained on."""
    return [camera for name, camera in source.cameras if name not in source.held_out]


def chosen_views(source: Source, most: int) -> list[int]:
    """Choose the views whose photos a page embeds, spread evenly over the list: held-out ones and training views.

    Args:
        source: The scene.
        most: Largest number of views.

    Returns:
        Indices of the views, increasing.
    """
    test = [i for i, (name, _) in enumerate(source.cameras) if name in source.held_out]
    train = [i for i, (name, _) in enumerate(source.cameras) if name not in source.held_out]
    some = _spread(test, min(-(-most // HELD_OUT_PART), len(test)))
    return sorted([*some, *_spread(train, min(most - len(some), len(train)))])


def photos_of(source: Source, dataset: Path | None, most: int) -> list[ShownPhoto]:
    """Return photos of a run's capture for its page.

    Args:
        source: The scene of a run, perhaps edited.
        dataset: The capture's folder; None for the one in the run's config.json.
        most: Largest number of photos.

    Raises:
        ArgumentError: the scene is none of a run, or the capture is not that of the run.
        CheckpointError: the run is damaged, or its capture is gone.
        DatasetError: the capture cannot be read.
    """
    run = run_of(source.path)
    if run is None:
        raise ArgumentError(f"{source.path}: a scene file has no photos to show; give the run that made it")
    capture = run_dataset(run.read_config(), dataset)
    if found := capture_difference(run, capture):
        raise ArgumentError(f"{capture.path} is not the capture of {run.path}: {found}")
    views = {view.name: view for view in (*capture.train, *capture.test)}
    return [
        shown_photo(index, views[source.cameras[index][0]], source.settings.background)
        for index in chosen_views(source, most)
    ]


def shown_photo(index: int, view: View, background: Sequence[float]) -> ShownPhoto:
    """Return a view's photo through the pinhole of the page's camera, as a JPEG without metadata.

    Args:
        index: Index of its camera among the views of the page's scene.
        view: The view. Parts of the photo that its mask excludes stay as they are; where the lens saw nothing, the
            JPEG is black.
        background: Colour behind a photo that is not opaque.
    """
    shown = stand_in(view.camera)
    target = shown if max(shown.W, shown.H) <= PHOTO_SIDE else resized(shown, PHOTO_SIDE)
    # the photo is first reduced to the resolution that the pinhole has in its middle, so that nothing aliases
    lens = view.camera.through(view.camera.projection)
    reduced = view.scaled(max(1.0, lens.fx / target.fx))
    photo = reduced.read().over(background)
    pixels = photo if photo.dtype == np.uint8 else np.rint(255.0 * photo).astype(np.uint8)
    if not view.camera.pinhole:
        pixels = _through_pinhole(pixels, lens.scaled(reduced.camera.W, reduced.camera.H), target)
    else:
        pixels = area_mean(pixels, target.W, target.H)
    return ShownPhoto(index, _jpeg(pixels, PHOTO_QUALITY), _border_mean(pixels))


def poster_jpeg(source: Source, camera: Camera, proof: Proof | None = None) -> bytes:
    """Render the still that a page shows before its first picture.

    Args:
        source: The scene.
        camera: The camera of the page's start view.
        proof: The page's evidence: where the scene is transparent, the poster has the colour of the photos' borders.

    Returns:
        A JPEG of the camera's shape, at most `POSTER_MOST` bytes; empty if no quality makes it so small.
    """
    camera = stand_in(camera)
    small = camera if max(camera.W, camera.H) <= POSTER_SIDE else resized(camera, POSTER_SIDE)
    settings = source.settings
    if proof is not None and proof.photos:
        settings = replace(settings, background=proof.border())
    with torch.no_grad():
        image = render(source.scene.gaussians, small, settings=settings, backend="cpu").image
    levels = np.rint(255.0 * np.clip(np.nan_to_num(image.numpy(force=True)), 0.0, 1.0))
    tried = (_jpeg(levels.astype(np.uint8), quality) for quality in POSTER_QUALITIES)
    return next((jpeg for jpeg in tried if len(jpeg) <= POSTER_MOST), b"")


def _through_pinhole(
    photo: UInt8[np.ndarray, "h w 3"], lens: Camera, target: Camera
) -> UInt8[np.ndarray, "H W 3"]:
    """Resample a photo through a lens: each pixel of the target looks along its ray into the photo."""
    points = (target.eye + target.rays()).reshape(-1, 3)
    seen = lens.sight(points)
    size = (target.H, target.W)
    columns, rows = (np.asarray(value, dtype=np.float32).reshape(size) for value in (seen.u, seen.v))
    outside = ~np.broadcast_to(np.asarray(seen.valid, dtype=bool), len(points)).reshape(size)
    columns[outside], rows[outside] = -1e4, -1e4
    # a panorama continues at its other side
    across = cv2.BORDER_WRAP if lens.projection.kind == "equirectangular" else cv2.BORDER_CONSTANT
    found: UInt8[np.ndarray, "H W 3"] = cv2.remap(photo, columns, rows, cv2.INTER_LINEAR, borderMode=across)
    return found


def _border_mean(pixels: UInt8[np.ndarray, "H W 3"]) -> tuple[float, float, float]:
    """Return the mean colour of an image's border, RGB from 0 to 1."""
    width = max(1, round(BORDER_PART * min(pixels.shape[:2])))
    outside = np.ones(pixels.shape[:2], dtype=bool)
    outside[width:-width, width:-width] = False
    red, green, blue = (pixels[outside].mean(axis=0) / 255.0).round(4).tolist()
    return red, green, blue


def _spread(indices: Sequence[int], count: int) -> list[int]:
    """Return `count` of some indices, evenly spaced, without preferring the first ones."""
    return [indices[(2 * i + 1) * len(indices) // (2 * count)] for i in range(count)]


def _jpeg(pixels: UInt8[np.ndarray, "H W 3"], quality: int) -> bytes:
    made = io.BytesIO()
    Image.fromarray(pixels).save(made, "JPEG", quality=quality)
    return made.getvalue()
