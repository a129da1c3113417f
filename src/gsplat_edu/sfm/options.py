"""Options of structure from motion. Imports nothing heavy, because the command line checks them first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import in_range, one_of, whole_number
from gsplat_edu.sfm.scale_text import check_scale

MATCHERS = ("auto", "exhaustive", "likely", "sequential", "nearest")

MAPPERS = ("auto", "incremental", "global")

PANORAMA = ("auto", "yes", "no")

CAMERA_MODELS = (
    "auto",
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
)

ASSUMED = 180.0
"""Field of view of a fisheye before mapping if nothing tells it, degrees: across its circle, or across the diagonal of
a photo that it fills."""

NARROWEST, WIDEST = 60.0, 330.0
"""Bounds of a field of view that the user gives, degrees."""


def is_fisheye(model: str) -> bool:
    """Return whether a name of `CAMERA_MODELS` is that of a fisheye."""
    return model.endswith("FISHEYE")


def lens_choice(text: str) -> tuple[str, float | None]:
    """Read a camera model, after a fisheye's name optionally a colon and its field of view in degrees.

    Returns:
        A name of `CAMERA_MODELS`, and the field of view or None.

    Raises:
        ArgumentError: the model is unknown, or the field of view is out of range or not a fisheye's.
    """
    name, colon, rest = text.partition(":")
    one_of("camera_model", name, CAMERA_MODELS)
    if not colon:
        return name, None
    if not is_fisheye(name):
        raise ArgumentError(
            f"camera_model: {name} has no field of view; only fisheyes have, such as OPENCV_FISHEYE:200"
        )
    try:
        degrees = float(rest)
    except ValueError:
        raise ArgumentError(f"camera_model: the field of view {rest!r} is not a number of degrees") from None
    return name, in_range("the field of view in camera_model", degrees, NARROWEST, WIDEST)


@dataclass(frozen=True)
class SfmOptions:
    """Options of one reconstruction.

    Args:
        source: A folder of photos, or a video.
        out: Folder of the capture. Intermediate results are kept in its subfolder sfm/.
        frames: Most frames to take from a video.
        matcher: "exhaustive": all pairs. "likely": the pairs that share large features. "sequential": each photo with
            the following ones. "nearest": these, similar photos, and photos taken nearby. "auto": for photos in
            sequence, from 60 on, the pairs of a video; otherwise exhaustive up to 59 photos, likely up to 400, else
            nearest; nearest for videos; for panoramas exhaustive up to 150 faces.
        mapper: "incremental", "global", or "auto": incremental, then global if its result is insufficient.
        camera_model: COLMAP's name of the lens model; "auto": SIMPLE_RADIAL, or SIMPLE_RADIAL_FISHEYE for fisheyes, or
            a model with more parameters if the photos support it. A fisheye's field of view may follow, as in
            "OPENCV_FISHEYE:200".
        max_features: Most SIFT features per photo.
        max_image_size: Longest side for feature extraction, px. The capture keeps the photos' full size.
        threads: Threads of COLMAP; 0 uses all.
        scale: "auto": scale and up from GPS in EXIF if the positions fit the cameras; "none"; or two points marked in
            photos and their distance, `gsplat_edu.sfm.scale_text.marks_of`.
        poses: "auto": start from the poses that the folder comes with, if any; "none"; or the file with them.
        panorama: Whether the photos or frames are 360-degree panoramas; "auto": if their XMP or the
            pictures say so.

    Raises:
        ArgumentError: a value is out of range.
    """

    source: Path
    out: Path
    frames: int = 150
    matcher: str = "auto"
    mapper: str = "auto"
    camera_model: str = "auto"
    max_features: int = 8192
    max_image_size: int = 1600
    threads: int = 0
    panorama: str = "auto"
    scale: str = AUTO
    poses: str | Path = AUTO

    def __post_init__(self) -> None:
        """Check the ranges."""
        whole_number("frames", self.frames, 3)
        one_of("matcher", self.matcher, MATCHERS)
        one_of("mapper", self.mapper, MAPPERS)
        lens_choice(self.camera_model)
        whole_number("max_features", self.max_features, 100)
        whole_number("max_image_size", self.max_image_size, 64)
        whole_number("threads", self.threads, 0)
        check_scale(self.scale)
        one_of("panorama", self.panorama, PANORAMA)
