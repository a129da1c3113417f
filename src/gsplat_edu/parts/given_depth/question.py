"""The option `--depth`: depth that the user has."""

from __future__ import annotations

from pathlib import Path

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.scene.given_depth import CAPTURE_AS_DEPTH, POINTS_AS_DEPTH, SCAN_AS_DEPTH
from gsplat_edu.train.setting import PURPOSE, Plain, Question

WORDS = (POINTS_AS_DEPTH, CAPTURE_AS_DEPTH, SCAN_AS_DEPTH)
"""Values that are no folders."""

SOURCES = (
    "of a folder with a map for each photo (16-bit PNG, TIFF, NPY, NPZ, EXR, COLMAP's geometric maps, Record3D);"
    " capture: the maps that transforms.json or COLMAP's folder has; points: the points of COLMAP's tracks"
)
"""What both commands read."""


def check_depth(path: Path) -> None:
    """Check the option without reading a map.

    Raises:
        ArgumentError: the folder does not exist.
    """
    if str(path) not in WORDS and not path.is_dir():
        raise ArgumentError(
            f"depth: {path} is no folder; give the folder of maps, or one of the words {', '.join(WORDS)}"
        )


DEPTH = Question(
    name="depth",
    metavar="DIR",
    help=f"learn from depth: {SOURCES}; scan: the points of --points, which a laser has measured",
    about_capture=f"also judge the depth: {SOURCES}",
    check=check_depth,
    plain=Plain(
        "Depth to learn from",
        {
            "": "none",
            POINTS_AS_DEPTH: "the points that photos share",
            CAPTURE_AS_DEPTH: "the capture's own depth maps",
        },
        PURPOSE,
    ),
    instead_in_blocks="train the capture as a whole, with --resolution",
)
