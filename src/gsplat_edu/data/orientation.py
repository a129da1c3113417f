"""Decide which photos of a capture are turned by EXIF: those whose poses refer to upright pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import Frame, fits_camera
from gsplat_edu.photos.decoding import UPRIGHT, PhotoHeaders

QUARTER_TURNS = (5, 6, 7, 8)
"""EXIF orientations that exchange width and height."""


def oriented(frames: Sequence[Frame], headers: PhotoHeaders) -> list[Frame]:
    """Mark the photos to be turned. The sizes of the cameras decide, because poses refer to the pixels that were used.

    COLMAP ignores EXIF, so photos are read as stored if that fits their camera. A photo is turned if only its upright
    size fits. If such photos exist, and no photo with a quarter turn in EXIF fits as stored, the program that found the
    poses turned all photos. Then half turns, mirrored and square photos, whose sizes are ambiguous, are turned too.

    Args:
        frames: The frames of a capture.
        headers: Reads the files' headers. Files that cannot be read are left to their reader.
    """
    sizes: dict[Path, tuple[int, int]] = {}
    for frame in frames:
        try:
            sizes[frame.image] = headers.size(frame.image)
        except DatasetError:
            continue
    turned = {
        frame.image: orientation
        for frame in frames
        if frame.image in sizes and not fits_camera(frame.lens, sizes[frame.image])
        if fits_camera(frame.lens, sizes[frame.image][::-1])
        if (orientation := headers.orientation(frame.image)) in QUARTER_TURNS
    }
    if not turned:
        return list(frames)
    others = {frame.image: frame for frame in frames if frame.image in sizes and frame.image not in turned}
    unclear = {path: orientation for path in others if (orientation := headers.orientation(path)) != UPRIGHT}
    if all(
        orientation not in QUARTER_TURNS or fits_camera(others[path].lens, sizes[path][::-1])
        for path, orientation in unclear.items()
    ):
        turned |= unclear
    return [replace(frame, orientation=turned.get(frame.image, UPRIGHT)) for frame in frames]
