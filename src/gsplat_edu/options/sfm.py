"""The options of `gsplat-edu sfm`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.constants import AUTO
from gsplat_edu.options.poses import posed_by
from gsplat_edu.options.values import whole_number_text
from gsplat_edu.sfm.options import CAMERA_MODELS, MAPPERS, MATCHERS, PANORAMA, SfmOptions
from gsplat_edu.sfm.scale_text import MARKS, NONE

EXAMPLE = "example: gsplat-edu sfm holiday.mp4 captures/holiday --frames 200"

OFFERED = (
    *("frames", "matcher", "mapper", "camera_model", "panorama", "scale"),
    *("max_features", "max_image_size", "threads"),
)
"""Options that requests may give."""


def check(arguments: argparse.Namespace) -> None:
    """Check the ranges; raises as `options_from` does."""
    options_from(arguments)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "source",
        type=Path,
        metavar="PHOTOS",
        help="folder of photos, optionally with masks/ or alpha, or a video",
    )
    parser.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help="folder of the capture to write; intermediate results are kept in OUT/sfm",
    )

    def number(flag: str, text: str, default: int) -> None:
        parser.add_argument(
            flag, type=whole_number_text, metavar="N", default=default, help=f"{text} (default: {default})"
        )

    def choice(flag: str, text: str, names: tuple[str, ...]) -> None:
        parser.add_argument(
            flag, metavar="NAME", default="auto", help=f"{text}: {', '.join(names)} (default: auto)"
        )

    number("--frames", "maximum number of frames taken from a video", SfmOptions.frames)
    choice("--matcher", "which pairs of photos are matched", MATCHERS)
    choice("--mapper", "COLMAP mapper", MAPPERS)
    choice(
        "--camera-model",
        "lens model (auto recognises fisheyes by black corners and EXIF, and refines as many parameters as held-out"
        " photos support; a fisheye's field of view may follow, as in OPENCV_FISHEYE:200)",
        CAMERA_MODELS,
    )
    add_panorama(parser)
    add_scale(parser)
    parser.add_argument(
        "--poses",
        metavar="FILE",
        default=AUTO,
        help="start from the poses of this file in the folder, refine them and add the other photos; auto takes those"
        " that the folder comes with, if the photos agree with them; none searches for all (default: auto)",
    )
    number("--max-features", "maximum number of features per photo", SfmOptions.max_features)
    number(
        "--max-image-size", "longest side of the photos for feature detection, px", SfmOptions.max_image_size
    )
    number("--threads", "threads of COLMAP; 0 for all", SfmOptions.threads)


def add_panorama(group: argparse._ActionsContainer) -> None:
    """Add the option for 360-degree photos, which `train` has as well."""
    group.add_argument(
        "--panorama",
        metavar="NAME",
        default="auto",
        help="whether the photos or frames are 360-degree panoramas:"
        f" {', '.join(PANORAMA)} (default: auto, if their XMP or their edges say so)",
    )


def add_scale(group: argparse._ActionsContainer) -> None:
    """Add the option for the scale of the coordinates, which `train` has as well."""
    group.add_argument(
        "--scale",
        metavar='"A B 1.20m"',
        default=AUTO,
        help="two points, each marked in two photos or more, and their distance in m, cm or mm, which becomes the unit:"
        f" {MARKS}, in pixels of the upright photos; auto takes scale and up from GPS if the photos' positions fit;"
        " none leaves the scale arbitrary (default: auto)",
    )


def options_from(arguments: argparse.Namespace) -> SfmOptions:
    """Turn what `add_arguments` parsed into options.

    Raises:
        ArgumentError: one is out of range.
    """
    return SfmOptions(
        arguments.source,
        arguments.out,
        arguments.frames,
        arguments.matcher,
        arguments.mapper,
        arguments.camera_model,
        arguments.max_features,
        arguments.max_image_size,
        arguments.threads,
        arguments.panorama,
        arguments.scale,
        arguments.poses
        if arguments.poses in (AUTO, NONE)
        else posed_by(arguments.source, Path(arguments.poses)) or AUTO,
    )
