"""What structure from motion can be asked for. It imports nothing heavy: the command line checks it first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsplat_edu.validation import one_of, whole_number

MATCHERS = ("auto", "exhaustive", "sequential", "nearest")

MAPPERS = ("auto", "incremental", "global")

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


@dataclass(frozen=True)
class SfmOptions:
    """One structure from motion.

    Args:
        source: A folder of photos, or a video.
        out: Folder of the capture. The work is kept in its folder sfm/.
        frames: How many frames of a video are taken, at most.
        matcher: "exhaustive": every pair. "sequential": each photo with those that follow. "nearest": those, the ones
            that look alike, and the ones taken close by. "auto": exhaustive up to 150 photos, else nearest; for
            videos nearest.
        mapper: "incremental", "global", or "auto": the former, and the other one where it does not do.
        camera_model: COLMAP's name of the lens model; "auto": SIMPLE_RADIAL, or a freer one that the photos support.
        max_features: Most SIFT features of a photo.
        max_image_size: Longest side at which features are found, px. The capture has the photos at full size.
        threads: Threads of COLMAP; 0 for all.

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

    def __post_init__(self) -> None:
        """Check the ranges."""
        whole_number("frames", self.frames, 3)
        one_of("matcher", self.matcher, MATCHERS)
        one_of("mapper", self.mapper, MAPPERS)
        one_of("camera_model", self.camera_model, CAMERA_MODELS)
        whole_number("max_features", self.max_features, 100)
        whole_number("max_image_size", self.max_image_size, 64)
        whole_number("threads", self.threads, 0)
